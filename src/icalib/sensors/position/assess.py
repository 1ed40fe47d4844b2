"""Position sensors in a result: residuals, notes on noise and time scales, warnings of correlated errors."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from icalib.base.remark import Remark
from icalib.estimate.estimate import Estimate
from icalib.estimate.inputs import Inputs, origin_difference
from icalib.motion.factor import Whitened, pairs_of
from icalib.observability.assessor import AssessedEstimate, Assessment, Assessor
from icalib.result import SensorFit
from icalib.result.calibration import Timeline, lag_one_correlation, row_record
from icalib.result.quantities import excess, times
from icalib.rig import Rig
from icalib.sensors.position.model import FIRST_NOISE_M
from icalib.sensors.position.residual import SLOW_OFFSET, PositionFactor, PositionNoise, random_walk_of
from icalib.sensors.position.spec import MESSAGES, PositionSensor
from icalib.sensors.position.stream import PositionResiduals, PositionStream

# Correlation of successive residuals above which a warning is given: its value, and its value in standard errors. White
# noise leaves 0 or less. At 0.1 the formal standard deviations of a lever arm were 1.4 times too small.
MIN_CORRELATION, MIN_CORRELATION_SIGMAS = 0.1, 3.0
# Differences between time scales [s]: GPS time is ahead of UTC by 18 s since 2017, and behind TAI by 19 s. Source: IERS
# Bulletin C.
SCALES = {18.0: "GPS time and UTC", 19.0: "TAI and GPS time", 37.0: "TAI and UTC"}
SAME_SCALE_S = 0.5  # largest distance of a time offset from one of SCALES: receivers and drivers have smaller delays
# Names of the residuals' axes: x, y and z of the sensor's frame, which are east, north and up for GNSS.
LABELS = {"horizontal": ("east", "north"), "vertical": ("up",)}


def assess(a: AssessedEstimate) -> Assessment:
    """What results say of this kind of sensor."""
    return Assessment(
        residuals=residuals(a.inputs, a.estimate, a.timeline),
        notes=notes(a.inputs, a.estimate, a.timeline),
        warnings=warnings(a.inputs, a.estimate),
    )


def residuals(inputs: Inputs, estimate: Estimate, timeline: Timeline) -> Iterator[PositionResiduals]:
    """Residuals of each position sensor, along the axes of its frame."""
    for factor, rows in pairs_of(estimate.problem.factors, estimate.outcome.residuals, PositionFactor):
        record = row_record("positions", factor.rows(rows, estimate.outcome.state), timeline, LABELS)
        yield PositionResiduals(**vars(record), position=factor.position, rejected=~factor.used)


def notes(inputs: Inputs, estimate: Estimate, timeline: Timeline) -> Iterator[Remark]:
    """Sentences on the number of fixes in use, their noise, and time offsets that are differences of time scales."""
    for factor, rows in pairs_of(estimate.problem.factors, estimate.outcome.residuals, PositionFactor):
        sensor, stream = inputs.sensor(factor.name), inputs.stream(factor.name)
        assert isinstance(stream, PositionStream)
        used = f"{int(factor.used.sum())} of {len(stream.stamps_ns)} fixes of {factor.name}"
        wrong = int((~factor.used).sum())
        rejected = f"; {wrong} are outliers of the trajectory, the largest by {_largest(factor, rows):.2g} m"
        sentence = f"{used}{rejected if wrong else ''}; {_noise(sensor, stream, factor.noise)}."
        yield Remark("position_noise_used", sentence)
        offset = estimate.outcome.state.values[factor.name, "time_offset"]
        offset = offset - origin_difference(inputs.measurements, stream)
        yield from scale_of_time(factor.name, float(offset[0]))


def _largest(factor: PositionFactor, rows: Whitened) -> float:
    """Norm [m] of the largest residual among the outliers; 0 if there is none."""
    return float(np.linalg.norm(factor.raw(rows)[~factor.used], axis=1).max(initial=0.0))


def _noise(sensor: PositionSensor, stream: PositionStream, noise: PositionNoise) -> str:
    if sensor.position_noise == MESSAGES:
        return "noise as the recording states it"
    if isinstance(sensor.position_noise, float):
        return f"noise {1e3 * sensor.position_noise:.3g} mm of each axis, as the rig file has it"
    if len(stream.covariance):
        return (
            f"noise {noise.horizontal:.2g} (horizontal) and {noise.vertical:.2g} times (vertical) what the recording "
            "states, as residuals show it"
        )
    sizes = [1e3 * size * FIRST_NOISE_M for size in (noise.horizontal, noise.vertical)]
    return f"noise {sizes[0]:.3g} mm horizontal and {sizes[1]:.3g} mm vertical, as residuals show it"


def scale_of_time(name: str, offset: float) -> Iterator[Remark]:
    """A sentence if the time offset [s] is about the difference between two time scales, see `SCALES`."""
    for seconds, scales in SCALES.items():
        if abs(abs(offset) - seconds) < SAME_SCALE_S:
            beyond = abs(offset) - seconds
            yield Remark(
                "time_scales_differ",
                f"the time offset of {name}, {offset:+.3f} s, is the {seconds:.0f} s between {scales}, and "
                f"{beyond:+.3f} s.",
            )


def warnings(inputs: Inputs, estimate: Estimate) -> Iterator[Remark]:
    """A sentence for each sensor whose successive residuals are correlated, so that its sigmas are too small."""
    for factor, rows in pairs_of(estimate.problem.factors, estimate.outcome.residuals, PositionFactor):
        whitened = rows.residual[factor.used]
        correlation = lag_one_correlation(whitened)
        if correlation <= max(MIN_CORRELATION, MIN_CORRELATION_SIGMAS / np.sqrt(max(whitened.size, 1))):
            continue
        density = random_walk_of(factor.seconds, np.where(factor.used[:, None], factor.raw(rows), np.nan))
        known = inputs.sensor(factor.name).position_random_walk
        advice = f"set position_random_walk: {np.hypot(known, density):.2g} in the rig file" if density else ""
        yield Remark(
            "position_errors_correlated",
            f"the residuals of {factor.name} are correlated ({correlation:.2f} from fix to fix); the cause is unknown. "
            "Its standard deviations may be 1.3 times too small; "
            f"{advice or 'leave out worse fixes with least_status'}.",
        )


def misfit(sensor: PositionSensor, f: SensorFit, is_noise: bool) -> Remark | None:
    """A sentence if the residuals are larger than the stated noise predicts, else None."""
    if excess(f) == 1.0:
        return None
    if f.kind == SLOW_OFFSET:
        return Remark(
            "position_random_walk_understated",
            f"the slow offset of {f.sensor} is {times(f)} larger than position_random_walk predicts; make it larger.",
        )
    stated = "the recording states" if sensor.position_noise == MESSAGES else "position_noise predicts"
    return Remark(
        "position_noise_understated",
        f"{f.kind} residuals of {f.sensor} are {times(f)} larger than {stated}; leave position_noise out, and it is "
        "estimated.",
    )


def length(sensor: PositionSensor, rig: Rig) -> str | None:
    """The measurements of this sensor that make the metric scale observable, as words of a sentence."""
    return f"the positions of {sensor.name}"


ASSESSOR = Assessor(assess, misfit, length=length)
