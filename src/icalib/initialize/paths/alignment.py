"""Time offset, rotation and gyroscope bias that make a path turn as the IMU does."""

from __future__ import annotations

from icalib.errors import EstimationError
from icalib.initialize.steps.by_recording import Held
from icalib.initialize.steps.clock_shifts import CameraRates
from icalib.initialize.steps.clocks import Alignment, align, as_given, contradicts, is_still, turning
from icalib.motion.imu_data import ImuData


def align_path(imu: ImuData, name: str, rates: CameraRates, held: Held) -> Alignment:
    """From the angular rates of the sensor `name`; what is `held` stays. Raises EstimationError where the rates do not
    show the alignment."""
    if held.rotation is not None and held.offset is not None:
        found = as_given(imu, name, rates, held.offset, held.rotation)
        if contradicts(imu, rates, found):
            raise EstimationError(
                f"{name} does not turn as {imu.name} does with the rotation and time_offset in the rig file; "
                "correct them, or remove them so that they are estimated."
            )
        return found
    _check_turning(imu, name, rates)
    found = align(imu, name, rates, held.offset)
    return found if held.rotation is None else as_given(imu, name, rates, found.offset, held.rotation)


def _check_turning(imu: ImuData, name: str, rates: CameraRates) -> None:
    """Raises EstimationError where neither turns."""
    turned, seen = turning(imu, rates)
    if is_still(turned, seen):
        raise EstimationError(
            f"{name} and {imu.name} hardly turn ({turned:.4f} rad/s RMS), so time offset and rotation are "
            "unobservable; record again with rotation about two axes or more, or give rotation and "
            f"time_offset of {name} in the rig file."
        )
