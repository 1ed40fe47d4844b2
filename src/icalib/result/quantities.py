"""Parameters as text, rounded by their standard deviation; poses relative to the body; sizes of residuals."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from math import floor, inf, isfinite, log10, radians
from typing import Any

import numpy as np
from scipy.linalg import orth

from icalib.geometry import so3
from icalib.result.calibration import Calibration, ParameterGroup, SensorFit, Verdict
from icalib.result.derived import joint_covariance, pose_groups, relative_jacobian
from icalib.result.verdict import component_verdict, counted, in_null_space, tolerance, worst
from icalib.rig import LENS
from icalib.rig.rig import ONE
from icalib.sensors.parameter import display_unit
from icalib.sensors.sensor import ROTATION, TRANSLATION

# Parameters as text in degrees, millimetres and milliseconds, rounded according to the standard deviation.

TURNS = ("roll", "pitch", "yaw")
NOT_COUNTED = "In brackets: without weight in the verdict, as auxiliary, with a prior, or of a lens that projects well."
NEAR_LOCK = "Within 5 std of gimbal lock (pitch 90 deg), that of roll, pitch and yaw is unknown."
SHARPENED = 0.5  # posterior over prior standard deviation: below it, the data contribute most of the information


@dataclass(frozen=True)
class Row:
    """Text of one parameter for a table. std and formal are empty if the parameter is fixed. value is empty where only
    the standard deviation is a number, as for rotation about the sensor's axes; verdict and formal are empty for roll,
    pitch and yaw of an estimated rotation, on which the verdict is by axis. A verdict that does not count for that on
    the result, see `verdict.counted`, is in brackets."""

    sensor: str
    group: str
    name: str
    value: str
    std: str
    formal: str
    factor: str
    unit: str
    verdict: str


def table_rows(calibration: Calibration) -> list[Row]:
    """`rows` for a table, sensors first, without the poses of the rigid bodies of a target, which can be many."""
    placed = (r for r in rows(calibration) if r.sensor not in calibration.bodies)
    return sorted(placed, key=lambda r: r.sensor not in calibration.rig["sensors"])


def rows(calibration: Calibration) -> list[Row]:
    """Rows of all parameters of all sensors, in the order of the groups, with poses relative to the body. IMU
    intrinsics that stay close to their prior share one row; an ideal IMU has none."""
    out, in_body = list[Row](), in_body_frame(calibration)
    for group in nontrivial_groups(in_body):
        if group.name == "rotation":
            out += _angle_rows(in_body, group)
            if group.columns is None:
                continue
        group_rows = _rows_of(group, counted(calibration, group))
        sharpened = _sharpened(calibration, group)
        out += [row for row, is_sharper in zip(group_rows, sharpened, strict=True) if is_sharper]
        if merged := [row for row, is_sharper in zip(group_rows, sharpened, strict=True) if not is_sharper]:
            verdict = worst(tuple(v for v, is_sharper in zip(group.verdict, sharpened, strict=True) if not is_sharper))
            words = _verdict_words(verdict, counted(calibration, group))
            out.append(Row(group.sensor, group.name, f"{len(merged)} more intrinsics", "prior", "", "", "", "", words))
    return out


def _sharpened(calibration: Calibration, group: ParameterGroup) -> list[bool]:
    """(n,) whether the data reduce the standard deviation of each IMU intrinsic below `SHARPENED` times that of its
    prior. True for all other parameters."""
    given = calibration.rig.get("sensors", {}).get(group.sensor, {})
    prior = given.get("intrinsics") if given.get("type") == "imu" else None
    if group.name != "intrinsics" or not isinstance(prior, dict) or "sigma" not in prior:
        return [True] * len(group.labels)
    return (group.std < SHARPENED * np.array(prior["sigma"])).tolist()


def records(c: Calibration) -> list[dict[str, Any]]:
    """A record for each entry of each group, SI. The entries of a rotation are roll, pitch and yaw; a target's
    tilt has no values."""
    out = list[dict[str, Any]]()
    for g in nontrivial_groups(c):
        labels, values, std, verdicts = g.labels, _values(g, 1.0), g.std, g.verdict
        if g.name == ROTATION.name:
            labels, verdicts = TURNS, (worst(g.verdict),) * len(TURNS)
            values, std = so3.rpy(g.value).tolist(), so3.rpy_std(g.value, joint_covariance(c, [g]))
        for label, value, sigma, verdict in zip(labels, values, std.tolist(), verdicts, strict=True):
            about = {"sensor": g.sensor, "group": g.name, "entry": label or g.name, "value": value}
            out.append(about | {"std": sigma, "unit": g.unit, "verdict": verdict})
    return out


def nontrivial_groups(calibration: Calibration) -> list[ParameterGroup]:
    """All groups except those fixed at zero, and except the identity rotation of the body or the reference."""
    still = [(name, "rotation") for name in (calibration.body, calibration.reference)]
    return [
        g
        for g in calibration.groups
        if g.columns is not None
        or (g.value.any() and not ((g.sensor, g.name) in still and np.array_equal(g.value, np.eye(3))))
    ]


def rpy_deg(R: np.ndarray, covariance: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """(3,) roll, pitch, yaw [deg] with R = Rz(yaw) Ry(pitch) Rx(roll), as in the rig file, and (3,) their standard
    deviations, see `so3.rpy_std`. covariance (3, 3): of the rotation about the sensor's axes [rad^2]."""
    return np.rad2deg(so3.rpy(R)), np.rad2deg(so3.rpy_std(R, covariance))


def format_number(value: float, digits: int = 2) -> str:
    """`value` with `digits` significant digits, without an exponent if it is in 1e-5 to 1e6; "unknown" for NaN,
    "infinite" for infinity."""
    if not isfinite(value):
        return "unknown" if np.isnan(value) else "infinite"
    if value == 0.0 or not 1e-5 <= abs(value) < 1e6:
        return f"{value:.{digits - 1}e}" if value else "0"
    return f"{value:.{max(0, digits - 1 - floor(log10(abs(value))))}f}"


def chi2_words(fit: SensorFit) -> str:
    """Text of chi^2 per post-fit degree of freedom; a lower bound if their number is below its sampling error."""
    if fit.chi2_per_dof is None:
        return f"at least {format_number(fit.chi2 / largest_dof(fit))}"
    return format_number(fit.chi2_per_dof, 3)


def dof_words(fit: SensorFit) -> str:
    """Text of the post-fit degrees of freedom; an upper bound if they are below their sampling error."""
    return f"at most {largest_dof(fit):.0f}" if fit.chi2_per_dof is None else f"{fit.dof:.0f}"


def rms_words(fit: SensorFit) -> str:
    """Text of the RMS of the raw residuals with its unit: mm for lengths, mrad for angles. Empty without an RMS."""
    if fit.rms is None:
        return ""
    unit, scale = {"m": ("mm", 1e3), "rad": ("mrad", 1e3)}.get(fit.unit, (fit.unit, 1.0))
    return f"{format_number(scale * fit.rms, 3)} {unit}".rstrip()


def _verdict_words(verdict: Verdict, counting: tuple[Verdict, ...]) -> str:
    return verdict if verdict in ("determined", "fixed", *counting) else f"({verdict})"


def _rows_of(group: ParameterGroup, counting: tuple[Verdict, ...]) -> list[Row]:
    unit, scale = display_unit(group.unit)
    names, values = _names(group), _values(group, scale)
    factors = [None] * len(names) if group.columns is None or group.factor is None else group.factor.tolist()
    return [
        Row(
            sensor=group.sensor,
            group=group.name,
            name=names[i],
            value=_value_text(values[i], scale * group.std[i]),
            std="" if verdict == "fixed" else format_number(scale * group.std[i]),
            formal="" if verdict == "fixed" else format_number(scale * group.std_formal[i]),
            factor="" if factors[i] is None else f"{factors[i]:.1f}",
            unit=unit,
            verdict=_verdict_words(verdict, counting),
        )
        for i, verdict in enumerate(group.verdict)
    ]


def _angle_rows(c: Calibration, group: ParameterGroup) -> list[Row]:
    """Rows of roll, pitch and yaw of a rotation."""
    angles = zip(TURNS, *(x.tolist() for x in rpy_deg(group.value, joint_covariance(c, [group]))), strict=True)
    if group.columns is None:
        return [Row(group.sensor, group.name, name, f"{x:.6g}", "", "", "", "deg", "fixed") for name, x, _ in angles]
    return [
        Row(group.sensor, group.name, name, _value_text(angle, std), format_number(std), "", "", "deg", "")
        for name, angle, std in angles
    ]


def _names(group: ParameterGroup) -> list[str]:
    if group.labels == (group.name,) or group.labels == ("",):
        return [group.name.replace("_", " ")]
    if group.name in LENS:
        return list(group.labels)
    one = ONE.get(group.name, group.name)
    return [f"{one} {label}".replace("_", " ") for label in group.labels]


def _values(group: ParameterGroup, scale: float) -> list[float | None]:
    if group.value.ndim == 2:  # a rotation matrix: only its standard deviations are shown
        return [None] * len(group.labels)
    return (scale * group.value).tolist()


def _value_text(value: float | None, std: float) -> str:
    """The value, rounded to the second significant digit of its standard deviation."""
    if value is None:
        return ""
    if not isfinite(std) or std <= 0.0 or not 1e-9 < std < 1e3:
        return f"{value:.6g}"
    return f"{value:.{max(0, 1 - floor(log10(std)))}f}"


# Converts a result to poses relative to the sensor `body` of the rig file, if that is not the reference.

_POSE = (ROTATION, TRANSLATION)
_NAMES = tuple(spec.name for spec in _POSE)
_SI = {"rotation_tolerance_deg": radians(1.0), "translation_tolerance_m": 1.0}  # SI value of one unit of each setting


def in_body_frame(c: Calibration) -> Calibration:
    """`c` with rotation and translation of every sensor as T_body_sensor; `c` itself if `body` is `reference`.

    The body gets the identity as a fixed pose. An IMU that is not the body gets a pose. The covariance is J C J^T, to
    first order. The empirical factor of a pose is the ratio of its standard deviations with and without the factors of
    its source groups. The null space becomes span(J N). Verdicts on poses follow from the null space and the standard
    deviations, as in `c`. All other groups are unchanged; time offsets stay relative to the reference.
    """
    if c.body == c.reference:
        return c
    groups, row_blocks, names = list[ParameterGroup](), [np.zeros((0, len(c.covariance)))], list[str]()
    for group, rows in _reframed(c):
        columns = tuple(range(len(names), len(names) + len(rows))) if rows.any() else None
        groups.append(replace(group, columns=columns))
        if columns is not None:
            row_blocks.append(rows)
            names += [f"{group.sensor}.{group.name}.{label}" for label in group.labels]
    J = np.vstack(row_blocks)
    null = _null_space(c, J, groups)
    return replace(
        c,
        groups=tuple(_with_null_space(c, g, null) for g in groups),
        covariance=J @ c.covariance @ J.T,
        covariance_names=tuple(names),
        null_space=null,
    )


def _reframed(c: Calibration) -> Iterator[tuple[ParameterGroup, np.ndarray]]:
    """Each group in the frame of the body, with its Jacobian (n, B) by the estimated parameters of `c`. The pose of the
    IMU comes first."""
    sensors = (*(() if c.imu is None else (c.imu,)), *c.mounted)
    moved = {(name, g.name): (g, rows) for name in sensors for g, rows in _pose_in_body(c, name)}
    yield from (moved.pop((c.imu, name)) for name in _NAMES if c.imu is not None)
    for group in c.groups:
        yield moved.get((group.sensor, group.name), (group, _rows(c, group)))


def _pose_in_body(c: Calibration, sensor: str) -> Iterator[tuple[ParameterGroup, np.ndarray]]:
    """Rotation and translation of T_body_sensor as groups, with their Jacobians (3, B) by the estimated parameters of
    `c`."""
    T, J = c.T_body_sensor(sensor), np.zeros((6, len(c.covariance)))
    if sensor != c.body:
        pair = [*pose_groups(c, c.body), *pose_groups(c, sensor)]
        J = relative_jacobian(c, c.body, sensor) @ np.vstack([_rows(c, g) for g in pair])
    scale = _scales(c)
    for spec, value, rows in zip(_POSE, (T[:3, :3], T[:3, 3]), (J[:3], J[3:]), strict=True):
        formal, std = (np.sqrt(np.einsum("ij,jk,ik->i", r, c.covariance, r)) for r in (rows, rows * scale))
        sizes, by_guess = std / _allowed(c, spec.tolerance), _by_guess(c, rows)
        verdict: tuple[Verdict, ...] = tuple(
            "fixed" if s == 0.0 else component_verdict(s if c.converged else inf, g)
            for s, g in zip(sizes, by_guess, strict=True)
        )
        factor = np.divide(std, formal, out=np.ones(3), where=formal > 0.0)
        mode = "free" if rows.any() else "fixed"
        group = ParameterGroup(
            sensor, spec.name, spec.labels, spec.unit, value, formal, std, verdict, mode, factor=factor
        )
        yield group, rows


def _by_guess(c: Calibration, rows: np.ndarray) -> np.ndarray:
    """(n,) whether unobservable parameters are most of the variance, for n rows of a Jacobian (n, B)."""
    columns = [k for g in c.groups for k, v in zip(g.columns or (), g.verdict, strict=False) if v == "unobservable"]
    some = np.zeros_like(rows)
    some[:, columns] = rows[:, columns]
    total, part = (np.einsum("ij,jk,ik->i", r, c.covariance, r) for r in (rows, some))
    return part > 0.5 * total


def _rows(c: Calibration, group: ParameterGroup | None) -> np.ndarray:
    """(n, B) selection matrix of the columns of the group: zeros if the group is fixed, and (3, B) zeros for a None."""
    rows = np.zeros((3 if group is None else len(group.labels), len(c.covariance)))
    if group is not None and group.columns is not None:
        rows[np.arange(len(group.columns)), list(group.columns)] = 1.0
    return rows


def _scales(c: Calibration) -> np.ndarray:
    """(B,) empirical factor of each estimated parameter, at least 1."""
    scale = np.ones(len(c.covariance))
    for g in c.groups:
        if g.columns is not None and g.factor is not None:
            scale[list(g.columns)] = np.maximum(g.factor, 1.0)
    return scale


def _null_space(c: Calibration, J: np.ndarray, groups: Sequence[ParameterGroup]) -> np.ndarray:
    """(B', m) orthonormal basis of the null space of the parameters of `groups`, in tolerance units. J (B', B): their
    Jacobian by the estimated parameters of `c`."""
    if not c.null_space.size:
        return np.zeros((len(J), 0))
    before, after = _pose_tolerances(c, c.groups, J.shape[1]), _pose_tolerances(c, groups, len(J))
    return orth(J * before / after[:, None] @ c.null_space)


def _pose_tolerances(c: Calibration, groups: Sequence[ParameterGroup], size: int) -> np.ndarray:
    """(size,) tolerances of the parameters in `groups`: of rotations [rad] and translations [m]. All other entries are
    1, as J leaves these parameters unchanged."""
    tolerances = np.ones(size)
    for spec in _POSE:
        columns = [k for g in groups if g.name == spec.name for k in g.columns or ()]
        tolerances[columns] = _allowed(c, spec.tolerance)
    return tolerances


def _allowed(c: Calibration, setting: object) -> float:
    """Tolerance of rotations [rad] or translations [m], from the setting of this name."""
    assert isinstance(setting, str)
    return tolerance(c, setting) * _SI[setting]


def _with_null_space(c: Calibration, group: ParameterGroup, null: np.ndarray) -> ParameterGroup:
    """The group with verdict unobservable on each component of a sensor's pose that lies in the null space (B', m)."""
    if group.name not in _NAMES or group.columns is None or group.sensor not in c.rig["sensors"]:
        return group
    is_null = in_null_space(null)[list(group.columns)]
    verdict: tuple[Verdict, ...] = tuple(
        "unobservable" if n else v for n, v in zip(is_null, group.verdict, strict=True)
    )
    return replace(group, verdict=verdict)


# Residuals that are larger or smaller than the stated noise predicts.
#
# The post-fit degrees of freedom are estimated by sampling. If they are few compared with the number of residuals, the
# estimate is unreliable. This happens if the stated noise of an IMU is far too small, so that the trajectory fits that
# noise. The ratio is then computed with the largest number of degrees of freedom within the sampling error, as a lower
# bound.

LARGE_CHI2 = 2.0  # chi^2 per post-fit degree of freedom above which a warning is given
# Ratio of residuals to the stated noise above which standard deviations are meaningless. If the stated noise of a
# simulated IMU is ten times too small, the ratio is 3 to 5, and errors reach 12 standard deviations.
FAR_BEYOND = 4.0
SMALL_CHI2 = 0.5  # chi^2 per post-fit degree of freedom below which a warning is given
SAMPLED_DOF = 3.0  # largest error of sampled degrees of freedom, over the square root of the number of residuals


def dof_known(fit: SensorFit) -> bool:
    """Whether the degrees of freedom exceed their sampling error of `SAMPLED_DOF` * sqrt(count)."""
    return fit.dof > SAMPLED_DOF * np.sqrt(fit.count)


def largest_dof(fit: SensorFit) -> float:
    """Upper bound of the degrees of freedom, by their sampling error; at least 1."""
    return max(min(max(fit.dof, 0.0) + SAMPLED_DOF * np.sqrt(fit.count), fit.count), 1.0)


def excess(fit: SensorFit) -> float:
    """Ratio of residuals to the stated noise, sqrt(chi^2 / dof); a lower bound if not `dof_known`. 1 if chi^2 / dof is
    below `LARGE_CHI2`."""
    chi2_per_dof = fit.chi2 / (fit.dof if dof_known(fit) else largest_dof(fit))
    return float(np.sqrt(chi2_per_dof)) if chi2_per_dof > LARGE_CHI2 else 1.0


def is_small(fit: SensorFit) -> bool:
    """Whether the residuals are much smaller than the stated noise predicts."""
    return dof_known(fit) and fit.chi2 / max(fit.dof, 1.0) < SMALL_CHI2


def ratio(fit: SensorFit) -> float:
    """Ratio of residuals to the stated noise, sqrt(chi^2 / dof), for known degrees of freedom."""
    return float(np.sqrt(max(fit.chi2, 0.0) / fit.dof))


def times(fit: SensorFit) -> str:
    """`excess` as text, such as "3.3x" or "at least 3.3x"."""
    return f"{'' if dof_known(fit) else 'at least '}{excess(fit):.2g}x"


# A calibration as text, for the Python prompt.

_HEAD = ("sensor", "parameter", "value", "std", "unit", "verdict")
_RIGHT = (False, False, True, True, False, False)  # alignment of the columns: numbers are right-aligned


def one_line(c: Calibration) -> str:
    """One line with the sensors, the verdict and the number of reasons."""
    sensors = ", ".join(c.rig["sensors"])
    count = len(c.reasons)
    why = f", {count} reason{'s' * (count > 1)}" if count else ""
    return f"<Calibration of {sensors}: {c.verdict}{why}; see .summary()>"


def summary_text(c: Calibration) -> str:
    """The verdict with its reasons, and a table of all parameters with standard deviations and verdicts."""
    table = [_HEAD, *(_cells(row) for row in table_rows(c))]
    widths = [max(len(cells[k]) for cells in table) for k in range(len(_HEAD))]
    lines = []
    for cells in table:
        padded = (x.rjust(w) if right else x.ljust(w) for x, w, right in zip(cells, widths, _RIGHT, strict=True))
        lines.append("  ".join(padded).rstrip())
    return "\n".join([f"Verdict: {c.verdict}", *_reasons(c), "", *lines])


def _reasons(c: Calibration) -> list[str]:
    return [f"Reason {k}: {reason}" for k, reason in enumerate(c.reasons, 1)]


def _cells(row: Row) -> tuple[str, ...]:
    return row.sensor, row.name, row.value, row.std, row.unit, row.verdict
