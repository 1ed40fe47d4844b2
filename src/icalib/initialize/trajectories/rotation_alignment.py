"""Time offset, rotation and gyroscope bias that align a sensor's trajectory to the IMU, by angular rates."""

from __future__ import annotations

from icalib.errors import EstimationError
from icalib.initialize.steps.rate_alignment import (
    RateAlignment,
    align_rates,
    alignment_as_stated,
    is_still,
    rates_contradict,
    rms_rates,
)
from icalib.initialize.steps.rate_correlation import SensorRates
from icalib.initialize.steps.single_recording import KnownExtrinsics
from icalib.motion.imu_data import ImuData


def align_trajectory(imu: ImuData, name: str, rates: SensorRates, known: KnownExtrinsics) -> RateAlignment:
    """Alignment from the angular rates of the sensor `name`; `known` values are kept. Raises EstimationError if the
    rates do not determine it, or contradict the known values."""
    if known.rotation is not None and known.offset is not None:
        alignment = alignment_as_stated(imu, name, rates, known.offset, known.rotation)
        if rates_contradict(imu, rates, alignment):
            raise EstimationError(
                f"{name} does not turn as {imu.name} does with the rotation and time_offset in the rig file; "
                "correct them, or remove them so that they are estimated."
            )
        return alignment
    _check_turning(imu, name, rates)
    alignment = align_rates(imu, name, rates, known.offset)
    return (
        alignment if known.rotation is None else alignment_as_stated(imu, name, rates, alignment.offset, known.rotation)
    )


def _check_turning(imu: ImuData, name: str, rates: SensorRates) -> None:
    """Raises EstimationError if neither sensor turned significantly."""
    imu_rate, sensor_rate = rms_rates(imu, rates)
    if is_still(imu_rate, sensor_rate):
        raise EstimationError(
            f"{name} and {imu.name} hardly turn ({imu_rate:.4f} rad/s RMS), so time offset and rotation are "
            "unobservable; record again with rotation about two axes or more, or give rotation and "
            f"time_offset of {name} in the rig file."
        )
