"""What a result keeps and says of pose sensors: residuals, their noise, and poses that drift or are filtered."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from icalib.estimate.estimate import Estimate
from icalib.estimate.problem.inputs import Inputs
from icalib.motion.factor import Whitened
from icalib.result import SensorFit
from icalib.result.excess import excess, times
from icalib.result.row_records import lag_one_correlation
from icalib.result.timeline import Timeline
from icalib.rig import PoseSensor, Rig
from icalib.sensors.pose.residual import AbsolutePoseFactor, PoseNoise, RelativePosesFactor

# Correlations of residuals of poses with their neighbours. Of white noise between poses, steps have -0.5.
CORRELATED, ALTERNATING = 0.5, 0.35
UNKNOWN = "they are no white noise, and the cause is unknown: check its clock and mount, and record again, slower"


def notes(inputs: Inputs, found: Estimate, timeline: Timeline) -> Iterator[str]:
    """How many poses are in use, and their noise."""
    counts = {f.name: f.count(out, "rotation") // 3 for f, out in _pose_factors(found)}
    posing = [found.judged.noise[s.name] for s in inputs.rig.poses]
    for sensor, stream, noise in zip(inputs.rig.poses, inputs.measurements.poses, posing, strict=True):
        what = "poses" if sensor.kind == "absolute" else "steps"
        count = f"{counts[sensor.name]} {what} from {len(stream.stamps_ns)} poses"
        yield f"{count} of {sensor.name}; {_noise(sensor, noise)}."


def _pose_factors(found: Estimate) -> list[tuple[AbsolutePoseFactor | RelativePosesFactor, Whitened]]:
    pairs = [(f, found.outcome.residuals[key]) for key, f in found.problem.factors.items()]
    return [(f, out) for f, out in pairs if isinstance(f, AbsolutePoseFactor | RelativePosesFactor)]


def _noise(sensor: PoseSensor, noise: PoseNoise) -> str:
    root = "" if sensor.kind == "absolute" else "/sqrt(s)"
    turn = f"{np.rad2deg(noise.rotation):.3g} deg{root} {_source(sensor.rotation_noise)}"
    return f"noise {turn}, {1e3 * noise.position:.3g} mm{root} {_source(sensor.position_noise)}"


def _source(given: float | None) -> str:
    return "as residuals show it" if given is None else "as the rig file has it"


def warnings(inputs: Inputs, found: Estimate) -> Iterator[str]:
    """Where residuals of poses follow one another, which noise does not."""
    kinds = {s.name: s.kind for s in inputs.rig.poses}
    for factor, rows in _pose_factors(found):
        for what, own in (("rotation", rows.residual[:, :3]), ("position", rows.residual[:, 3:])):
            correlation = lag_one_correlation(own)
            if kinds[factor.name] == "absolute" and correlation > CORRELATED:
                yield (
                    f"the {what} residuals of {factor.name} follow one another (correlation {correlation:.2f} from "
                    "pose to pose): its poses are filtered, or drift, so all looks better known than it is; trust the "
                    "empirical factor, or try kind: relative, which lets poses drift."
                )
            if kinds[factor.name] == "relative" and correlation < -ALTERNATING:
                yield (
                    f"the {what} residuals of {factor.name} alternate (correlation {correlation:.2f} from step to "
                    "step), as those of poses that are noisy but do not drift; try kind: absolute."
                )


def misfit(sensor: PoseSensor, f: SensorFit, is_noise: bool) -> str | None:
    """A sentence where poses are off by more than the rig file states."""
    if excess(f) == 1.0:
        return None
    advice = "leave it out, and it is estimated" if is_noise else UNKNOWN
    return f"{f.kind} residuals of {f.sensor} are {times(f)} larger than its stated noise predicts; {advice}."


def length(sensor: PoseSensor, rig: Rig) -> str | None:
    """What shows how long a metre is."""
    return f"the positions of {sensor.name}"
