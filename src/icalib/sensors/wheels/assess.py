"""Assessment of wheels in a result: residuals, warnings about the ground and the vertical, implausible sizes."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from icalib.base.remark import Remark
from icalib.estimate.estimate import Estimate
from icalib.estimate.inputs import Inputs
from icalib.geometry.small import is_near
from icalib.initialize.initializer import level_sensor
from icalib.motion.factor import of_type, pairs_of
from icalib.observability.assessor import AssessedEstimate, Assessment, Assessor, Groups
from icalib.result import RowResiduals, SensorFit
from icalib.result.calibration import Timeline, row_record
from icalib.result.quantities import excess, times
from icalib.rig import Rig, Wheels
from icalib.sensors.wheels.ground_factor import HEIGHT, TILT, GroundFactor
from icalib.sensors.wheels.residual import WheelFactor
from icalib.sensors.wheels.spec import REVERSED_YAW

LABELS = {"wheels": ("left", "right"), "lateral slip": ("lateral",), "vertical slip": ("vertical",)} | {
    "yaw": ("yaw",),
    "path": ("forward", "lateral"),
    "speed": ("speed",),
    "wheel": ("wheel",),
    "steering": ("steering",),
}
# For each kind of residual: its name in messages, the noise field of the rig file, and the unit of that noise.
_ROWS = {
    "wheels": ("wheel angles", "wheel_noise", "rad/sqrt(s)"),
    "wheel": ("wheel angles", "wheel_noise", "rad/sqrt(s)"),
    "speed": ("speeds", "speed_noise", "m/sqrt(s)"),
    "yaw": ("yaw rates", "yaw_noise", "rad/sqrt(s)"),
    "steering": ("steering angles", "steering_noise", "rad/sqrt(Hz)"),
    "lateral slip": ("lateral slip", "lateral_slip", "m/sqrt(s)"),
    "vertical slip": ("vertical slip", "vertical_slip", "m/sqrt(s)"),
}
UPRIGHT_COSINE = 0.5  # cosine of 60 deg, the largest angle between an axis of the body and the vertical
# Radius over baseline: 1/15 of a floor robot to 1 of a toy. Rates in rpm instead of rad/s turn 1/3 into 1/30.
MIN_RADIUS_RATIO, MAX_RADIUS_RATIO = 1.0 / 25.0, 4.0
RATE_UNIT_FACTORS = {np.pi / 30.0: "rpm", np.pi / 180.0: "deg/s"}
UNIT_TOLERANCE = 0.1  # relative deviation of a size ratio from the factor of a wrong unit


def assess(a: AssessedEstimate) -> Assessment:
    """What results say of this kind of sensor."""
    return Assessment(
        residuals=residuals(a.inputs, a.estimate, a.timeline),
        notes=notes(a.inputs, a.estimate, a.timeline),
        warnings=warnings(a.inputs, a.estimate),
    )


def residuals(inputs: Inputs, estimate: Estimate, timeline: Timeline) -> Iterator[RowResiduals]:
    """The residuals of each set of wheels, one row per interval between keyframes; the measured slip is 0."""
    for factor, rows in pairs_of(estimate.problem.factors, estimate.outcome.residuals, WheelFactor):
        yield row_record("increments", factor.rows(rows, estimate.outcome.state), timeline, LABELS)


def notes(inputs: Inputs, estimate: Estimate, timeline: Timeline) -> Iterator[Remark]:
    """A note if only the assumption of an upright camera or LiDAR decides whether wheels are upside down."""
    for wheels, up in _without_vertical(inputs, estimate):
        if not inputs.rig.moves_by_poses and _posture(inputs, up) is None:
            yield Remark(
                "vertical_from_camera",
                f"{wheels}: nothing but {_body(inputs)}, which then stands upright, shows which way is up; if it is "
                f"upside down, {_other_vertical(inputs, wheels)}.",
            )


def warnings(inputs: Inputs, estimate: Estimate) -> Iterator[Remark]:
    """Warnings if no LiDAR sees the ground of wheels, or if no sensor determines the vertical."""
    yield from ground_warnings(estimate)
    yield from _upwards_warnings(inputs, estimate)


def ground_warnings(estimate: Estimate) -> Iterator[Remark]:
    """A warning for each ground factor whose floor no LiDAR sees."""
    for factor in of_type(estimate.problem.factors, GroundFactor):
        if not len(factor.keyframes):
            yield Remark(
                "ground_not_seen",
                f"none of the planes that LiDARs see is a floor (nearly level and below the IMU), so the ground of "
                f"{factor.name} counts for nothing; see that a LiDAR sees it, or write plane: level.",
            )


def _upwards_warnings(inputs: Inputs, estimate: Estimate) -> Iterator[Remark]:
    """A warning with both possible verticals if no sensor determines the sign of the vertical, and the assumption of an
    upright camera or LiDAR does not apply: the motion comes from pose sensors, or it is not upright in the result."""
    for wheels, up in _without_vertical(inputs, estimate):
        if inputs.rig.moves_by_poses:
            x, y, z = up
            yield Remark(
                "vertical_unknown_for_poses",
                f"{wheels}: nothing shows which way is up: no frame of a pose sensor is level. Here up is ({x:.2f}, "
                f"{y:.2f}, {z:.2f}) in the axes of {_body(inputs)}; if that is down, "
                f"{_other_vertical(inputs, wheels)}.",
            )
        elif posture := _posture(inputs, up):
            yield Remark(
                "vertical_ambiguous",
                f"{wheels}: nothing shows which way is up. Either {_body(inputs)} {posture}, or "
                f"{_other_vertical(inputs, wheels)}.",
            )


def _without_vertical(inputs: Inputs, estimate: Estimate) -> Iterator[tuple[str, np.ndarray]]:
    """Names of wheels for which neither data nor rig file determine the sign of the vertical. With each name: the z
    axis (3,) of the wheel frame in the axes of the body."""
    values = estimate.outcome.state.values
    if not inputs.rig.assumes_motion or level_sensor(inputs, estimate.outcome.state) is not None:
        return
    for wheels in inputs.rig.wheels:
        if wheels.rotation.mode == "free":
            yield wheels.name, values[wheels.name, "rotation"][:, 2]


def _posture(inputs: Inputs, up: np.ndarray) -> str | None:
    """The posture of the body as text for messages, None if it is upright. up (3,): the vertical in its axes: of a
    camera x right, y down, z forward; of a LiDAR x forward, z up."""
    x, y, z = up
    down, ahead = (-z, x) if inputs.rig.sensors[_body(inputs)].shows_planes else (y, z)
    if down < -UPRIGHT_COSINE:
        return None
    if down > UPRIGHT_COSINE:
        return "stands upside down"
    return "looks up" if ahead > UPRIGHT_COSINE else "looks down" if ahead < -UPRIGHT_COSINE else "lies on its side"


def _body(inputs: Inputs) -> str:
    """Name of the sensor whose frame is the body frame in a rig without an IMU."""
    return inputs.rig.reference_without_imu


def _other_vertical(inputs: Inputs, name: str) -> str:
    """The mistake in the recording or rig file of the wheels `name` if the vertical has the other sign, as text."""
    wheels = next(w for w in inputs.rig.wheels if w.name == name)
    return REVERSED_YAW[wheels.kind]


def misfit(wheels: Wheels, f: SensorFit, is_noise: bool) -> Remark | None:
    """A sentence if residuals are larger than the rig file states, with the field to change; else None."""
    if excess(f) == 1.0:
        return None
    if f.kind in (TILT, HEIGHT):
        field = "tilt_noise" if f.kind == TILT else "bump_noise"
        what = "tilts against" if f.kind == TILT else "moves up and down over"
        return Remark(
            "ground_not_even",
            f"{wheels.name} {what} its ground {times(f)} more than {field} predicts, as on ramps or where the ground "
            "is another plane; take ground out, or that part of the recording.",
        )
    relative = f.kind == "yaw" and wheels.kind == "pair"  # relative poses of a pair have a yaw, too
    what, field, unit = _ROWS.get("" if relative else f.kind, (f.kind, "", ""))
    words = f"{what} residuals of {wheels.name} are {times(f)} larger than {field or 'its noise'} predicts"
    if not is_noise:
        return Remark(
            "wheel_residuals_not_white",
            f"{words}, and are no white noise; the cause is unknown. Wheels that skid, stop counting or lose air have "
            "such residuals. Take out parts where they are large.",
        )
    if not field:
        return Remark("wheel_pose_residuals_large", f"{words}; use factor: increments.")
    sentence = f"{words}; write {field}: {excess(f) * getattr(wheels, field):.2g} ({unit}) and calibrate again."
    return Remark("wheel_noise_understated", sentence)


def length(wheels: Wheels, rig: Rig) -> str | None:
    """Text on what determines the scale, if these wheels do: they report metres, or their sizes are stated; else
    None."""
    known = wheels.measures == "poses" or getattr(wheels, wheels.drive_specs[0].name).mode != "free"
    return f"the stated sizes of {wheels.name}" if known else None


def sizes(wheels: Wheels) -> tuple[str, ...]:
    """Names of the parameters that determine the scale if they are stated."""
    return (wheels.drive_specs[0].name,)


def absurd(wheels: Wheels, groups: Groups) -> Iterator[Remark]:
    """A sentence if the ratio of radius to baseline is implausible, as for readings in a wrong unit."""
    if wheels.kind != "pair":
        return
    radii, baseline = groups.get((wheels.name, "radii")), groups.get((wheels.name, "baseline"))
    if radii is None or baseline is None:
        return
    ratio = float(radii.value.mean() / baseline.value[0])
    if MIN_RADIUS_RATIO < ratio < MAX_RADIUS_RATIO:
        return
    cause = {"ticks": "its counts_per_turn", "rates": "its rate_unit"}.get(
        wheels.measures, "whether its angles are in radians"
    )
    yield Remark(
        "wheel_sizes_implausible",
        f"the wheels of {wheels.name} come out with a radius of {1e3 * radii.value.mean():.3g} mm and "
        f"{1e3 * baseline.value[0]:.4g} mm between them, which no vehicle has; check {cause}.",
    )


def looks_like(wheels: Wheels, name: str, value: np.ndarray, estimated: np.ndarray) -> str:
    """A sentence on the likely mistake in a stated size, with a leading space; empty without one. value, estimated: the
    stated and the estimated size."""
    if name not in ("radii", "radius"):
        return ""
    if is_near(estimated, 0.5 * value, UNIT_TOLERANCE):
        return " It looks like a diameter: write the radius."
    if wheels.measures == "ticks" and wheels.counts_per_turn is not None:
        return f" With it counts_per_turn would be {wheels.counts_per_turn * float(np.median(value / estimated)):.0f}."
    for factor, unit in RATE_UNIT_FACTORS.items() if wheels.measures == "rates" else ():
        if is_near(estimated, factor * value, UNIT_TOLERANCE):
            return f" Its readings look like {unit}: write rate_unit: {unit}."
    return ""


ASSESSOR = Assessor(assess, misfit, length=length, sizes=sizes, absurd=absurd, looks_like=looks_like)
