"""Pose sensors in a result: notes on their noise, and warnings if poses are filtered or drift."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from icalib.estimate.estimate import Estimate
from icalib.estimate.problem.inputs import Inputs
from icalib.motion.factor import pairs_of
from icalib.result import SensorFit
from icalib.result.excess import excess, times
from icalib.result.row_records import lag_one_correlation
from icalib.result.timeline import Timeline
from icalib.rig import PoseSensor, Rig
from icalib.sensors.pose.residual import PoseFactor, PoseNoise

# Lag-one autocorrelation of residuals: a warning is given above the first value (absolute poses), or below minus the
# second (relative poses). It is 0 for the assumed noise, and -0.5 for differences of poses with independent noise.
MAX_LAG_ONE_CORRELATION, MAX_LAG_ONE_ANTICORRELATION = 0.5, 0.35
UNKNOWN_CAUSE = "they are no white noise, and the cause is unknown: check its clock and mount, and record again, slower"


def notes(inputs: Inputs, estimate: Estimate, timeline: Timeline) -> Iterator[str]:
    """One note for each pose sensor: number of poses (or relative poses) used, and their noise."""
    counts = {
        f.name: f.count(out, "rotation") // 3
        for f, out in pairs_of(estimate.problem.factors, estimate.outcome.residuals, PoseFactor)
    }
    posing = [estimate.measurement_model.noise[s.name] for s in inputs.rig.poses]
    for sensor, stream, noise in zip(inputs.rig.poses, inputs.measurements.poses, posing, strict=True):
        what = "poses" if sensor.kind == "absolute" else "steps"
        count = f"{counts[sensor.name]} {what} from {len(stream.stamps_ns)} poses"
        yield f"{count} of {sensor.name}; {_noise(sensor, noise)}."


def _noise(sensor: PoseSensor, noise: PoseNoise) -> str:
    """Words for the noise of rotation and position, with units and sources."""
    root = "" if sensor.kind == "absolute" else "/sqrt(s)"
    turn = f"{np.rad2deg(noise.rotation):.3g} deg{root} {_source(sensor.rotation_noise)}"
    return f"noise {turn}, {1e3 * noise.position:.3g} mm{root} {_source(sensor.position_noise)}"


def _source(given: float | None) -> str:
    """Words for the source of a noise: the rig file (`given`), or the residuals (None)."""
    return "as residuals show it" if given is None else "as the rig file has it"


def warnings(inputs: Inputs, estimate: Estimate) -> Iterator[str]:
    """Warnings on residuals that are correlated in time: poses are filtered or drift, or the kind (absolute, relative)
    is wrong."""
    kinds = {s.name: s.kind for s in inputs.rig.poses}
    for factor, rows in pairs_of(estimate.problem.factors, estimate.outcome.residuals, PoseFactor):
        for what, components in (("rotation", rows.residual[:, :3]), ("position", rows.residual[:, 3:])):
            correlation = lag_one_correlation(components)
            if kinds[factor.name] == "absolute" and correlation > MAX_LAG_ONE_CORRELATION:
                yield (
                    f"the {what} residuals of {factor.name} follow one another (correlation {correlation:.2f} from "
                    "pose to pose): its poses are filtered, or drift, so all looks better known than it is; trust the "
                    "empirical factor, or try kind: relative, which lets poses drift."
                )
            if kinds[factor.name] == "relative" and correlation < -MAX_LAG_ONE_ANTICORRELATION:
                yield (
                    f"the {what} residuals of {factor.name} alternate (correlation {correlation:.2f} from step to "
                    "step), as those of poses that are noisy but do not drift; try kind: absolute."
                )


def misfit(sensor: PoseSensor, f: SensorFit, is_noise: bool) -> str | None:
    """A sentence if residuals are larger than the stated noise predicts, else None. is_noise: whether residuals are
    white and constant over the recording, so that a larger stated noise is the remedy."""
    if excess(f) == 1.0:
        return None
    advice = "leave it out, and it is estimated" if is_noise else UNKNOWN_CAUSE
    return f"{f.kind} residuals of {f.sensor} are {times(f)} larger than its stated noise predicts; {advice}."


def length(sensor: PoseSensor, rig: Rig) -> str | None:
    """Words for the source of the metric scale."""
    return f"the positions of {sensor.name}"
