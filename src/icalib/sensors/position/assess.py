"""What a result keeps and says of position sensors: residuals, noise, errors that last, and scales of time."""

from __future__ import annotations

from collections.abc import Iterator

from icalib.estimate.estimate import Estimate
from icalib.estimate.problem.inputs import Inputs, origin_difference
from icalib.motion.factor import pairs_of
from icalib.result import RowResiduals, SensorFit
from icalib.result.excess import excess, times
from icalib.result.row_records import lag_one_correlation, row_record
from icalib.result.timeline import Timeline
from icalib.rig import Rig
from icalib.sensors.position.model import FIRST_NOISE_M
from icalib.sensors.position.residual import PositionFactor, PositionNoise
from icalib.sensors.position.spec import MESSAGES, PositionSensor
from icalib.sensors.position.stream import PositionStream

CORRELATED = 0.5  # of a residual with the one before: white noise has 0, an error that lasts for two fixes 0.6
# Seconds by which clocks of satellite systems and of computers differ: GPS time is ahead of UTC by 18 s since 2017, and
# behind TAI by 19 s. Source: IERS Bulletin C.
SCALES = {18.0: "GPS time and UTC", 19.0: "TAI and GPS time", 37.0: "TAI and UTC"}
SAME_SCALE_S = 0.5  # about one of them: receivers and drivers are not later than that
# Axes of a levelled frame of GNSS; in others they are x, y and z.
LABELS = {"horizontal": ("east", "north"), "vertical": ("up",)}


def residuals(inputs: Inputs, found: Estimate, timeline: Timeline) -> Iterator[RowResiduals]:
    """Of each position sensor, along the axes of its frame."""
    for factor, rows in pairs_of(found.problem.factors, found.outcome.residuals, PositionFactor):
        yield row_record("positions", factor.rows(rows, found.outcome.state), timeline, LABELS)


def notes(inputs: Inputs, found: Estimate, timeline: Timeline) -> Iterator[str]:
    """How many fixes are in use, their noise, and scales of time."""
    del timeline
    for factor, _ in pairs_of(found.problem.factors, found.outcome.residuals, PositionFactor):
        sensor, stream = inputs.sensor(factor.name), inputs.stream(factor.name)
        assert isinstance(stream, PositionStream)
        used = f"{len(factor.seconds)} of {len(stream.stamps_ns)} fixes of {factor.name}"
        yield f"{used}; {_noise(sensor, stream, factor.noise)}."
        own = found.outcome.state.values[factor.name, "time_offset"] - origin_difference(inputs.measurements, stream)
        yield from scale_of_time(factor.name, float(own[0]))


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


def scale_of_time(name: str, offset: float) -> Iterator[str]:
    """A sentence where a time offset [s] is that between two scales of time."""
    for seconds, scales in SCALES.items():
        if abs(abs(offset) - seconds) < SAME_SCALE_S:
            beyond = abs(offset) - seconds
            yield (
                f"the time offset of {name}, {offset:+.3f} s, is the {seconds:.0f} s between {scales}, and "
                f"{beyond:+.3f} s."
            )


def warnings(inputs: Inputs, found: Estimate) -> Iterator[str]:
    """Where errors of fixes last, so that they count for less than their number."""
    del inputs
    for factor, rows in pairs_of(found.problem.factors, found.outcome.residuals, PositionFactor):
        correlation = lag_one_correlation(rows.residual)
        if correlation > CORRELATED:
            yield (
                f"the residuals of {factor.name} follow one another (correlation {correlation:.2f} from fix to fix), "
                "as those of multipath, or of a receiver that filters; the empirical factor counts it in the standard "
                "deviations. Record for longer, or leave out worse fixes with least_status."
            )


def misfit(sensor: PositionSensor, f: SensorFit, is_noise: bool) -> str | None:
    """A sentence where fixes are off by more than the rig file or the recording states."""
    del is_noise
    if excess(f) == 1.0:
        return None
    stated = "the recording states" if sensor.position_noise == MESSAGES else "position_noise predicts"
    return (
        f"{f.kind} residuals of {f.sensor} are {times(f)} larger than {stated}; leave position_noise out, and it is "
        "estimated."
    )


def length(sensor: PositionSensor, rig: Rig) -> str | None:
    """What shows how long a metre is."""
    del rig
    return f"the positions of {sensor.name}"
