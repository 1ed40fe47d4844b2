"""Pose sensors in a result: notes on their noise, and warnings if poses are filtered or drift."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from itertools import chain

import numpy as np

from icalib.base.remark import Remark
from icalib.estimate.estimate import Estimate
from icalib.estimate.inputs import Inputs, with_association
from icalib.motion.factor import Whitened, output_at, pairs_of
from icalib.observability.assessor import AssessedEstimate, Assessment, Assessor
from icalib.optim.arrowhead import UNOBSERVABLE_BELOW, NotDefiniteError, essential_information, solve
from icalib.result import SensorFit
from icalib.result.calibration import Timeline, lag_one_correlation
from icalib.result.quantities import excess, times
from icalib.rig import PoseSensor, Rig
from icalib.sensors.pose.residual import POSE_KINDS, PoseFactor, PoseNoise, RelativePosesFactor
from icalib.sensors.pose.spec import POSITION_ROTATION

# Lag-one autocorrelation of residuals: a warning is given above the first value (absolute poses), or below minus the
# second (relative poses). It is 0 for the assumed noise, and -0.5 for differences of poses with independent noise.
MAX_LAG_ONE_CORRELATION, MAX_LAG_ONE_ANTICORRELATION = 0.5, 0.35


def assess(a: AssessedEstimate) -> Assessment:
    """What results say of this kind of sensor."""
    return Assessment(
        notes=notes(a.inputs, a.estimate, a.timeline),
        warnings=chain(turned_positions(a), warnings(a.inputs, a.estimate)),
    )


def notes(inputs: Inputs, estimate: Estimate, timeline: Timeline) -> Iterator[Remark]:
    """One note for each pose sensor: number of poses (or relative poses) used, and their noise."""
    counts = {
        f.name: f.count(out, "rotation") // 3
        for f, out in pairs_of(estimate.problem.factors, estimate.outcome.residuals, PoseFactor)
    }
    posing = [estimate.measurement_model.noise[s.name] for s in inputs.rig.poses]
    for sensor, stream, noise in zip(inputs.rig.poses, inputs.measurements.poses, posing, strict=True):
        what = "poses" if sensor.kind == "absolute" else "steps"
        count = f"{counts[sensor.name]} {what} from {len(stream.stamps_ns)} poses"
        yield Remark("pose_noise_used", f"{count} of {sensor.name}; {_noise(sensor, noise)}.")


def _noise(sensor: PoseSensor, noise: PoseNoise) -> str:
    """Words for the noise of rotation and position, with units and sources."""
    root = "" if sensor.kind == "absolute" else "/sqrt(s)"
    turn = f"{np.rad2deg(noise.rotation):.3g} deg{root} {_source(sensor.rotation_noise)}"
    return f"noise {turn}, {1e3 * noise.position:.3g} mm{root} {_source(sensor.position_noise)}"


def _source(given: float | None) -> str:
    """Words for the source of a noise: the rig file (`given`), or the residuals (None)."""
    return "as residuals show it" if given is None else "as the rig file has it"


def turned_positions(a: AssessedEstimate) -> Iterator[Remark]:
    """A warning for each pose sensor whose positions are turned against its rotations: a mount that moves looks like
    that, too, and is tested apart. Relative poses turn displacements in the axes of the sensor."""
    for e in (e for e in a.effects if e.spec is POSITION_ROTATION and e.differs):
        relative = a.inputs.sensor(e.sensor).kind == "relative"
        what, axes = ("displacements", "sensor") if relative else ("positions", "frame")
        angle = float(np.linalg.norm(e.value))
        axis = ", ".join(f"{x:.2f}" for x in e.value / angle)
        sentence = (
            f"rotations and {what} of {e.sensor} contradict each other: its {what} are turned by "
            f"{np.rad2deg(angle):.2g} deg, {np.sqrt(e.chi2):.0f} standard deviations, about the axis ({axis}) of its "
            f"{axes}. Write position_rotation: free, so that it is estimated."
        )
        yield Remark("rotations_contradict_positions", sentence)


def warnings(inputs: Inputs, estimate: Estimate) -> Iterator[Remark]:
    """Warnings on residuals that are correlated in time: poses are filtered or drift, or the kind (absolute, relative)
    is wrong."""
    for factor, rows in pairs_of(estimate.problem.factors, estimate.outcome.residuals, PoseFactor):
        sensor: PoseSensor = inputs.sensor(factor.name)
        correlations = _correlations(rows)
        for what, correlation in correlations.items():
            if sensor.kind == "relative" and correlation < -MAX_LAG_ONE_ANTICORRELATION:
                yield Remark(
                    "relative_poses_alternate",
                    f"the {what} residuals of {factor.name} alternate (correlation {correlation:.2f} from step to "
                    "step), as those of poses that are noisy but do not drift; try kind: absolute.",
                )
        following = [(w, c) for w, c in correlations.items() if c > MAX_LAG_ONE_CORRELATION]
        if sensor.kind == "absolute" and following:
            what, correlation = " and ".join(w for w, _ in following), max(c for _, c in following)
            yield Remark(
                "poses_filtered_or_drifting",
                f"the {what} residuals of {factor.name} follow one another (correlation {correlation:.2f} from pose to "
                "pose): its poses are filtered, or drift; trust the empirical factor. "
                f"{_trial(inputs, estimate, sensor)}",
            )


def _correlations(rows: Whitened) -> dict[str, float]:
    """Lag-one autocorrelation of the residuals of each kind."""
    return {kind: lag_one_correlation(rows.residual[:, columns]) for kind, columns in POSE_KINDS.items()}


def _trial(inputs: Inputs, estimate: Estimate, sensor: PoseSensor) -> str:
    """A sentence on whether kind: relative would help, from its residuals and normal equations at the solution."""
    if inputs.rig.imu is None or inputs.rig.assumes_motion:
        return "Relative poses need an IMU."
    if any(getattr(other, "frame", "") == sensor.name for other in inputs.rig.mounted):
        return "Relative poses have no frame, and another sensor shares that of these."
    tried = replace(inputs, rig=inputs.rig.with_sensors(replace(sensor, kind="relative")))
    tried = with_association(tried, inputs.association)
    model, state = estimate.measurement_model, estimate.outcome.state
    factor = model.problem(tried, state).factors[sensor.name, "poses"]
    assert isinstance(factor, RelativePosesFactor)
    residual = output_at(factor, state).residual
    size = {kind: max(float(np.sqrt(np.mean(residual[:, c] ** 2))), 1e-12) for kind, c in POSE_KINDS.items()}
    noise = replace(factor.noise, **{kind: size[kind] * getattr(factor.noise, kind) for kind in POSE_KINDS})
    problem = replace(model, noise={**model.noise, sensor.name: noise}).problem(tried, state)
    pieces, rows = problem.pieces(), problem.residuals()
    problem.linearise(state, pieces, rows)
    try:
        information = solve(pieces, problem.n_keyframes, problem.tolerance).information
    except NotDefiniteError:
        information = np.zeros((problem.layout.size, problem.layout.size))
    if essential_information(information, problem.tolerance, problem.layout) < UNOBSERVABLE_BELOW:
        return "Tried kind: relative, which lets poses drift: it would not determine all parameters."
    worst = max(_correlations(rows[factor.key]).values(), key=abs)
    if -MAX_LAG_ONE_ANTICORRELATION <= worst <= MAX_LAG_ONE_CORRELATION:
        return f"Tried kind: relative, which lets poses drift: its steps are white (correlation {worst:.2f}); write it."
    return f"Tried kind: relative, which lets poses drift: its steps are not white, either (correlation {worst:.2f})."


def misfit(sensor: PoseSensor, f: SensorFit, is_noise: bool) -> Remark | None:
    """A sentence if residuals are larger than the stated noise predicts, else None. is_noise: whether residuals are
    white and constant over the recording, so that a larger stated noise is the remedy."""
    if excess(f) == 1.0:
        return None
    words = f"{f.kind} residuals of {f.sensor} are {times(f)} larger than its stated noise predicts"
    if is_noise:
        return Remark("pose_noise_understated", f"{words}; leave it out, and it is estimated.")
    return Remark(
        "pose_residuals_not_white",
        f"{words}; they are no white noise, and the cause is unknown: check its clock and mount, and record again, "
        "slower.",
    )


def length(sensor: PoseSensor, rig: Rig) -> str | None:
    """Words for the source of the metric scale."""
    return f"the positions of {sensor.name}"


ASSESSOR = Assessor(assess, misfit, length=length)
