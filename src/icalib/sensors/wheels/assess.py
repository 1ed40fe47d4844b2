"""What a result keeps and says of wheels: residuals, the ground they stand on, and sizes that no vehicle has."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from icalib.estimate.estimate import Estimate
from icalib.estimate.problem.inputs import Inputs
from icalib.geometry.vectors import is_near
from icalib.initialize.steps.vertical import level_sensor
from icalib.motion.factor import of_type
from icalib.result import ParameterGroup, RowResiduals, SensorFit
from icalib.result.excess import excess, times
from icalib.result.row_records import row_record
from icalib.result.timeline import Timeline
from icalib.rig import Rig, Wheels
from icalib.sensors.wheels.ground_factor import HEIGHT, TILT, GroundFactor
from icalib.sensors.wheels.initialize.drive_guess import OPPOSITE
from icalib.sensors.wheels.residual import IncrementFactor, RelativePoseFactor

LABELS = {"wheels": ("left", "right"), "lateral slip": ("lateral",), "vertical slip": ("vertical",)} | {
    "yaw": ("yaw",),
    "path": ("forward", "lateral"),
    "speed": ("speed",),
    "wheel": ("wheel",),
    "steering": ("steering",),
}
# Of rows of wheels: what they are, the field of the rig file that says how far off they may be, and its unit.
_ROWS = {
    "wheels": ("wheel angles", "wheel_noise", "rad/sqrt(s)"),
    "wheel": ("wheel angles", "wheel_noise", "rad/sqrt(s)"),
    "speed": ("speeds", "speed_noise", "m/sqrt(s)"),
    "yaw": ("yaw rates", "yaw_noise", "rad/sqrt(s)"),
    "steering": ("steering angles", "steering_noise", "rad/sqrt(Hz)"),
    "lateral slip": ("lateral slip", "lateral_slip", "m/sqrt(s)"),
    "vertical slip": ("vertical slip", "vertical_slip", "m/sqrt(s)"),
}
UPRIGHT = 0.5  # cosine of the angle between the downward axis of the image and that of the vehicle: 60 degrees
# Radii over baseline: from 1/15 of a floor robot to 1 of a toy; rates in rpm make 1/3 a 1/30.
SMALLEST_SHARE, LARGEST_SHARE = 1.0 / 25.0, 4.0
RATES = {np.pi / 30.0: "rpm", np.pi / 180.0: "deg/s"}
NEARLY = 0.1  # of a number in another unit


def residuals(inputs: Inputs, found: Estimate, timeline: Timeline) -> Iterator[RowResiduals]:
    """Of each set of wheels; slip is measured to be 0. A row is an interval between keyframes."""
    for key, factor in found.problem.factors.items():
        if isinstance(factor, IncrementFactor | RelativePoseFactor):
            rows = factor.rows(found.outcome.residuals[key], found.outcome.state)
            yield row_record("increments", rows, timeline, LABELS)


def notes(inputs: Inputs, found: Estimate, timeline: Timeline) -> Iterator[str]:
    """Where a camera that stands upright is all that speaks for the wheels as they are."""
    for wheels, up in _open(inputs, found):
        if not inputs.rig.moves_by_poses and _stance(up) is None:
            yield (
                f"{wheels}: nothing but {_body(inputs)}, which then stands upright, shows which way is up; if it is "
                f"upside down, {_opposite(inputs, wheels)}."
            )


def warnings(inputs: Inputs, found: Estimate) -> Iterator[str]:
    """Where no LiDAR sees the ground of wheels, or nothing shows which way is up."""
    yield from ground_warnings(found)
    yield from _upwards_warnings(inputs, found)


def ground_warnings(found: Estimate) -> Iterator[str]:
    """Warnings on ground constraints whose floor no LiDAR sees."""
    for factor in of_type(found.problem.factors, GroundFactor):
        if not len(factor.keyframes):
            yield (
                f"none of the planes that LiDARs see is a floor (nearly level and below the IMU), so the ground of "
                f"{factor.name} counts for nothing; see that a LiDAR sees it, or write plane: level."
            )


def _upwards_warnings(inputs: Inputs, found: Estimate) -> Iterator[str]:
    """Both readings of wheels that stand on the ground only if the first camera does not stand upright, or with a pose
    sensor whose frame is not level."""
    for wheels, up in _open(inputs, found):
        if inputs.rig.moves_by_poses:
            x, y, z = up
            yield (
                f"{wheels}: nothing shows which way is up: no frame of a pose sensor is level. Here up is ({x:.2f}, "
                f"{y:.2f}, {z:.2f}) in the axes of {_body(inputs)}; if that is down, {_opposite(inputs, wheels)}."
            )
        elif stance := _stance(up):
            yield (
                f"{wheels}: nothing shows which way is up. Either {_body(inputs)} {stance}, or "
                f"{_opposite(inputs, wheels)}."
            )


def _open(inputs: Inputs, found: Estimate) -> Iterator[tuple[str, np.ndarray]]:
    """Names of wheels of which the motion does not show what is up, nor the rig file, and z of their frame in the axes
    of the body."""
    values = found.outcome.state.values
    if not inputs.rig.assumes_motion or level_sensor(inputs, found.outcome.state) is not None:
        return
    for wheels in inputs.rig.wheels:
        if wheels.rotation.mode == "free":
            yield wheels.name, values[wheels.name, "rotation"][:, 2]


def _stance(up: np.ndarray) -> str | None:
    """How a camera stands in whose axes (x to the right, y down, z ahead) up is `up` (3,); None: upright."""
    _, down, ahead = up
    if down < -UPRIGHT:
        return None
    if down > UPRIGHT:
        return "stands upside down"
    return "looks up" if ahead > UPRIGHT else "looks down" if ahead < -UPRIGHT else "lies on its side"


def _body(inputs: Inputs) -> str:
    return inputs.rig.reference_without_imu


def _opposite(inputs: Inputs, name: str) -> str:
    wheels = next(w for w in inputs.rig.wheels if w.name == name)
    return OPPOSITE[wheels.kind]


def misfit(wheels: Wheels, f: SensorFit, is_noise: bool) -> str | None:
    """A sentence where wheels slip or turn by more than the rig file states."""
    if excess(f) == 1.0:
        return None
    if f.kind in (TILT, HEIGHT):
        field = "tilt_noise" if f.kind == TILT else "bump_noise"
        what = "tilts against" if f.kind == TILT else "moves up and down over"
        return (
            f"{wheels.name} {what} its ground {times(f)} more than {field} predicts, as on ramps or where the ground "
            "is another plane; take ground out, or that part of the recording."
        )
    relative = f.kind == "yaw" and wheels.kind == "pair"  # the paper's relative poses have a yaw, too
    what, field, unit = _ROWS.get("" if relative else f.kind, (f.kind, "", ""))
    words = f"{what} residuals of {wheels.name} are {times(f)} larger than {field or 'its noise'} predicts"
    if not is_noise:
        return f"{words}, and are no white noise, as where wheels skid; take such parts out, or drive slower."
    if not field:
        return f"{words}; use factor: increments."
    return f"{words}; write {field}: {excess(f) * getattr(wheels, field):.2g} ({unit}) and calibrate again."


def length(wheels: Wheels, rig: Rig) -> str | None:
    """What shows how long a metre is: wheels that report metres, or turns of wheels of a known size."""
    known = wheels.measures == "poses" or getattr(wheels, wheels.drive_specs[0].name).mode != "free"
    return f"the stated sizes of {wheels.name}" if known else None


def sizes(wheels: Wheels) -> tuple[str, ...]:
    """The parameters that say how long a metre is."""
    return (wheels.drive_specs[0].name,)


def absurd(wheels: Wheels, found: dict[tuple[str, str], ParameterGroup]) -> Iterator[str]:
    """Wheels that are tiny or huge beside what is between them: readings in another unit."""
    if wheels.kind != "pair":
        return
    radii, baseline = found.get((wheels.name, "radii")), found.get((wheels.name, "baseline"))
    if radii is None or baseline is None:
        return
    share = float(radii.value.mean() / baseline.value[0])
    if SMALLEST_SHARE < share < LARGEST_SHARE:
        return
    cause = {"ticks": "its counts_per_turn", "rates": "its rate_unit"}.get(
        wheels.measures, "whether its angles are in radians"
    )
    yield (
        f"the wheels of {wheels.name} come out with a radius of {1e3 * radii.value.mean():.3g} mm and "
        f"{1e3 * baseline.value[0]:.4g} mm between them, which no vehicle has; check {cause}."
    )


def looks_like(wheels: Wheels, name: str, value: np.ndarray, found: np.ndarray) -> str:
    """What the stated size of wheels looks like, as a sentence that begins with a space; or nothing."""
    if name not in ("radii", "radius"):
        return ""
    if is_near(found, 0.5 * value, NEARLY):
        return " It looks like a diameter: write the radius."
    if wheels.measures == "ticks" and wheels.counts_per_turn is not None:
        return f" With it counts_per_turn would be {wheels.counts_per_turn * float(np.median(value / found)):.0f}."
    for size, unit in RATES.items() if wheels.measures == "rates" else ():
        if is_near(found, size * value, NEARLY):
            return f" Its readings look like {unit}: write rate_unit: {unit}."
    return ""
