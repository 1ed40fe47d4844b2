"""Initial guesses and stated values that the data contradict, likely mistakes behind them, and sources of the scale."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from itertools import permutations, product
from typing import NamedTuple

import numpy as np

from icalib.base.remark import Remark
from icalib.estimate.inputs import Inputs, groups_of
from icalib.geometry import so3
from icalib.geometry.small import is_near
from icalib.initialize.initializer import is_contradicted
from icalib.kinds import assessors
from icalib.model.bodies import SIZE
from icalib.observability.assessor import Cause
from icalib.observability.contradictions import Contradiction
from icalib.observability.prior_sensitivity import Relaxed
from icalib.result import ParameterGroup
from icalib.result.verdict import UNUSABLE
from icalib.rig import Rig
from icalib.sensors.parameter import display_unit
from icalib.sensors.sensor import TRANSLATION

# Notes on initial guesses of the rig file that the data contradict, with likely mistakes.


def guess_notes(inputs: Inputs, groups: Sequence[ParameterGroup]) -> Iterator[Remark]:
    """One sentence for each initial guess that the estimate contradicts, by the kind of sensor or `is_contradicted`."""
    groups_by_key = {(g.sensor, g.name): g for g in groups}
    for sensor, name, parameter in groups_of(inputs.user_rig or inputs.rig):
        group, guess = groups_by_key.get((sensor.name, name)), parameter.value
        if group is None or guess is None or parameter.mode != "free" or {*UNUSABLE} & {*group.verdict}:
            continue
        far = assessors()[sensor.sensor_type].is_far_guess(sensor, name, groups_by_key)
        if far is None:
            far = is_contradicted(sensor.spec(name), guess, group.value)
        if far:
            rotation = groups_by_key.get((sensor.name, "rotation"))
            R_imu_sensor = None if rotation is None else rotation.value
            hint = looks_like(inputs.rig, (sensor.name, name), guess, group.value, R_imu_sensor)
            yield Remark("guess_contradicted", _sentence(group, guess) + hint)


def _sentence(group: ParameterGroup, guess: np.ndarray) -> str:
    """A sentence with the guess and the estimate, or their difference for rotations and time offsets."""
    what = f"the guess of {group.name.replace('_', ' ')} of {group.sensor}"
    if group.name == "rotation":
        off = np.rad2deg(np.linalg.norm(so3.log(np.ascontiguousarray(guess.T @ group.value))))
        return f"{what} is {off:.1f} deg from what the data show, which alone count."
    unit, scale = display_unit(group.unit)
    unit = f" {unit}" if unit else ""
    if group.name == "time_offset":
        off = guess - group.value
        return f"{what} is {scaled(np.abs(off), scale)}{unit} from what the data show, which alone count."
    estimate_text = f"{scaled(group.value, scale)}{unit}"
    return f"{what}, {scaled(guess, scale)}{unit}, is far from what the data show, {estimate_text}, which alone count."


# Likely mistakes behind a contradicted value of the rig file: an inverse, another frame, another unit.

NEAR_RAD = 0.15  # rad: largest difference between a rotation in another convention and the estimate
NEARLY = 0.1  # relative difference between a value in another unit and the estimate
TURNS = [  # all rotations by right angles, and reflections
    np.array(axes, dtype=np.float64)[list(order)]
    for order in permutations(range(3))
    for axes in (np.diag(signs) for signs in product((1.0, -1.0), repeat=3))
]
LENGTHS = {1e-3: "millimetres", 1e-2: "centimetres", 0.0254: "inches"}
IMAGE_SIZES = (2.0, 0.5, 4.0, 0.25)


def looks_like(
    rig: Rig, key: tuple[str, str], value: np.ndarray, estimate: np.ndarray, rotation: np.ndarray | None = None
) -> str:
    """A sentence that names the likely mistake and begins with a space, or an empty text. value: of the rig file;
    estimate: estimate of the same group; rotation: estimated R_imu_sensor (3, 3), needed for an inverse translation."""
    name = key[1]
    if name == "rotation":
        return _frames(value, estimate)
    if name == "translation" and rotation is not None:
        inverse = -rotation.T @ estimate
        if is_near(value, inverse, NEARLY) and not is_near(value, estimate, NEARLY):
            return " It looks like that of the inverse: icalib wants p_imu_sensor."
    sensor = rig.sensors.get(key[0])
    for size, unit in (LENGTHS if sensor is not None and sensor.spec(name).unit == "m" else {}).items():
        if is_near(estimate, size * value, NEARLY):
            return f" It looks like {unit}: write metres."
    if name == "time_offset" and is_near(estimate, 1e-3 * value, NEARLY):
        return " It looks like milliseconds: write seconds."
    if name == "intrinsics":
        for size in IMAGE_SIZES:
            if is_near(estimate[:2], size * value[:2], NEARLY):
                return f" The focal length is {size:g} times that: was it of images of another size?"
    if sensor is None:
        return ""
    return assessors()[sensor.sensor_type].looks_like(sensor, name, value, estimate)


def _frames(value: np.ndarray, estimate: np.ndarray) -> str:
    """The sentence for a rotation that is inverted, or in a frame with other axes."""
    if _angle(value.T, estimate) < NEAR_RAD:
        return " It looks like the inverse, as in Kalibr's T_cam_imu: icalib wants R_imu_sensor."
    if min(_angle(value @ turn, estimate) for turn in TURNS if np.linalg.det(turn) > 0.0) < NEAR_RAD:
        return " It looks like that of a frame whose axes are named otherwise, as a link's and a camera's are."
    return ""


def _angle(a: np.ndarray, b: np.ndarray) -> float:
    """Angle [rad] between the rotations a and b (3, 3)."""
    return float(np.linalg.norm(so3.log(np.ascontiguousarray(a.T @ b))))


# Warnings on fixed values and priors of the rig file that the data contradict.


def absurd_values(
    inputs: Inputs, against: Sequence[Contradiction], groups: Sequence[ParameterGroup]
) -> Iterator[Remark]:
    """Sentences on sensors with impossible values, unless they contradict a stated value in `against`."""
    groups_by_key = {(g.sensor, g.name): g for g in groups}
    named = {c.key[0] for c in against}
    for sensor in inputs.rig.sensors.values():
        if sensor.name not in named:
            yield from assessors()[sensor.sensor_type].absurd(sensor, groups_by_key)


def stated_words(inputs: Inputs, c: Contradiction) -> Remark:
    """A sentence on the contradiction `c`: both values, their standard deviations and distance, and a likely
    mistake."""
    spec = inputs.specs[c.key]
    labels, (unit, scale) = spec.labels, spec.display_unit
    stated, unit = c.parameter.sigma, f" {unit}" if unit else ""
    sigma = scale * float(c.sigma[c.worst])
    allowed = "" if stated is None else f" +- {scale * np.broadcast_to(stated, c.off.shape)[c.worst]:.3g}{unit}"
    if c.key[1] == "rotation":
        angle, axis = scale * float(np.linalg.norm(c.off)), labels[c.worst]
        given = f"rotation of {c.key[0]}{allowed and f' ({allowed.strip()})'}"
        estimate_text = f"{angle:.3g}{unit} from it (+- {sigma:.2g}{unit} about {axis})"
    else:
        label = "" if len(labels) == 1 else f" {labels[c.worst]}"
        value = scale * np.broadcast_to(np.asarray(c.parameter.value), c.off.shape)[c.worst]
        given = f"{c.key[1].replace('_', ' ')}{label} of {c.key[0]}, {value:.6g}{allowed or unit},"
        estimate_text = f"{_rounded(scale * float(c.value[c.worst]), sigma)} +- {sigma:.2g}{unit}"
    kind, advice = ("fixed value", "leave it free") if stated is None else ("prior", "give it a larger sigma")
    assert c.parameter.value is not None
    hint = looks_like(inputs.rig, c.key, c.parameter.value, c.value)
    sentence = (
        f"the {kind} of {given} contradicts the data, which alone show {estimate_text}: {c.away[c.worst]:.0f} standard "
        f"deviations away; correct it, or {advice}.{hint}"
    )
    if stated is None:
        return Remark("fixed_value_contradicted", sentence)
    return Remark("prior_contradicted", sentence)


def scaled(values: np.ndarray, scale: float) -> str:
    """Text of the numbers `values` times `scale`, to four digits, in brackets if there are several."""
    texts = [f"{scale * v:.4g}" for v in values]
    return texts[0] if len(texts) == 1 else f"[{', '.join(texts)}]"


def _rounded(value: float, sigma: float) -> str:
    """Text of a value, with digits down to a tenth of its standard deviation."""
    digits = 1 - int(np.floor(np.log10(sigma))) if sigma > 0.0 else 6
    return f"{value:.{min(max(digits, 0), 12)}f}"


# The size of the target as the rig file states it, compared with the size by all measurements but the ruler, above all
# those of the accelerometer.

WRONG = 0.02  # relative error of the size: larger than that of a ruler or a good accelerometer
BEYOND = 0.05  # relative error of the size that no accelerometer explains: these are off by 3 % at most
CLEARLY = 5.0  # standard deviations
UNKNOWN = 0.05  # relative standard deviation from which on the size is unobservable
SCALE = "scale"  # name of the parameter that scales all lengths of a sensor, with the prior `scale_sigma`


class TargetSize(NamedTuple):
    """Ratio of true to stated size, and its standard deviation; gain: the decrease of chi^2 with it."""

    ratio: float
    std: float
    gain: float


def felt_size(inputs: Inputs, relaxed_rig: Relaxed | None, factor: float) -> TargetSize | None:
    """Ratio of the target's true size to the stated one without the prior on it, by one Newton step, and its standard
    deviation: `factor` times the formal one, and the square of the step for what is not linear in it. None without a
    target or an IMU, or if the size is unobservable."""
    is_felt = inputs.bodies.used and inputs.imu is not None and not inputs.rig.assumes_motion
    if relaxed_rig is None or not is_felt:
        return None
    step, sigma = relaxed_rig.step([SIZE])
    (column,) = relaxed_rig.layout.columns(*SIZE)
    if sigma[column] > UNKNOWN:
        return None
    ratio = float(relaxed_rig.state.values[SIZE][0] + step[column])
    std, gain = np.hypot(factor * sigma[column], step[column] ** 2), (step[column] / sigma[column]) ** 2
    return TargetSize(ratio, float(std), float(gain))


def is_certain(size: TargetSize | None) -> bool:
    """Whether the size differs from the stated one by more than any error of an accelerometer."""
    return size is not None and abs(size.ratio - 1.0) > max(BEYOND, CLEARLY * size.std)


def size_words(inputs: Inputs, size: TargetSize | None) -> tuple[tuple[Remark, ...], tuple[Remark, ...]]:
    """Warnings, and notes, on the size of the target."""
    if size is None:
        return (), ()
    rig, digits = inputs.rig, max(2, 1 - int(np.floor(np.log10(size.std))))
    ratio = f"{size.ratio:.{digits}f} +- {size.std:.{digits}f}"
    others = any(not s.sees_target or getattr(s, TRANSLATION.name).mode != "free" for s in rig.mounted)
    by = "the accelerometer" + (" and what else shows it" if others else "")
    words = f"by {by} the target is {ratio} times the size that the rig file says"
    if abs(size.ratio - 1.0) <= max(WRONG, CLEARLY * size.std):
        return (), (
            Remark("target_size_by_accelerometer", f"{words}; accelerometers may be off by 1 to 3 % themselves."),
        )
    warning = Remark(
        "target_size_wrong",
        f"{words}, and so are the distances that cameras show; measure the printed target and correct its size in "
        "the rig file, or if that is right calibrate the accelerometer, whose scale is off.",
    )
    return (warning,), ()


def scale_notes(inputs: Inputs, size: TargetSize | None) -> Iterator[Remark]:
    """A note if the scale of all lengths comes from a single source."""
    sources = scale_sources(inputs, size)
    if len(sources) == 1:
        sentence = f"every length comes from {sources[0]} alone: 1 % error there is 1 % in every length here."
        yield Remark("scale_from_one_source", sentence)


def scale_sources(inputs: Inputs, size: TargetSize | None) -> list[str]:
    """Texts that name the sources of the metric scale. size: of the target by the accelerometer, None if
    unobservable."""
    rig = inputs.user_rig or inputs.rig
    target = rig.has_target and any(s.sees_target for s in rig.mounted)
    has_imu = rig.imu is not None and not rig.imu.assumed
    sources = ["the size of the target"] if target else []
    sensor_sources = (assessors()[sensor.sensor_type].length(sensor, rig) for sensor in rig.mounted)
    sources += [source for source in sensor_sources if source]
    if has_imu and (size is not None or not target):
        sources.append("the accelerometer")
    return sources


def scale_causes(inputs: Inputs, groups: Sequence[ParameterGroup], size: TargetSize | None) -> Iterator[Cause]:
    """A cause if the size of the target and the scales of sensors contradict each other. Each is a factor with a prior
    about 1. The least-squares compromise moves all of them, so the contradiction is larger than any single deviation.
    It explains contradictions of all stated sizes, such as wheel radii."""
    sigmas = {SIZE: inputs.rig.target.size_sigma} if size is None else {}
    sensors = inputs.rig.sensors.values()
    sigmas |= {(s.name, SCALE): sigma for s in sensors if (sigma := getattr(s, "scale_sigma", 0.0)) > 0.0}
    off = {k: float(g.value[0]) - 1.0 for g in groups if (k := (g.sensor, g.name)) in sigmas and g.columns is not None}
    away = {key: abs(d) / sigmas[key] for key, d in off.items()}
    if max(away.values(), default=0.0) <= CLEARLY:
        return
    apart = 100.0 * float(np.ptp([0.0, *off.values()]))
    first, *others = scale_sources(inputs, size)
    more = " and ".join(others) or "what else shows a length"
    yield Cause(
        Remark(
            "lengths_contradict",
            f"{first} and {more} contradict each other: lengths differ by {apart:.1f} % or more, "
            f"{max(away.values()):.0f} standard deviations of what the rig file allows; find out which is wrong, and "
            "correct it in the rig file.",
        ),
        float(sum(a**2 for a in away.values())),
        True,
        tuple((s.name, name) for s in sensors for name in assessors()[s.sensor_type].sizes(s)),
    )
