"""One camera against the IMU by angular rates: checks, time offset, rotation, gyroscope bias; what is given is used."""

from __future__ import annotations

import numpy as np

from icalib.errors import EstimationError
from icalib.initialization.guess import BoardPoses
from icalib.initialization.rates import GyroMeans, camera_rates
from icalib.initialization.rotation import RateFit, check_motion, check_scale, fit_rates, vector_correlation
from icalib.initialization.time_offset import MIN_CORRELATION, correlate
from icalib.measurements import CornerStream, ImuStream
from icalib.rig import Camera

_NS = 1_000_000_000


def align(camera: Camera, stream: CornerStream, imu: ImuStream, gyro: GyroMeans, poses: BoardPoses) -> RateFit:
    """Rotation, gyroscope bias and offset between the relative clocks.

    Raises EstimationError for a motionless recording, clocks that never overlap, a given offset at which the rates do
    not agree, and a gyroscope that turns at another scale than the camera.
    """
    rates = camera_rates(stream.seconds, poses)
    check_motion(rates, gyro, camera.name, imu.name)
    given = camera.time_offset.value
    if given is None:
        offset = correlate(rates, gyro, camera.name, imu.name)
    else:
        offset = relative_offset(float(given[0]), stream.origin_ns, imu.origin_ns)
        agreement = vector_correlation(rates, gyro, offset)
        if agreement < MIN_CORRELATION:
            raise EstimationError(
                f"at the time_offset of {camera.name} in the rig file, {float(given[0]):g} s, its angular rate does not "
                f"agree with that of {imu.name} (correlation {agreement:.2f}, {MIN_CORRELATION} needed); correct it, or "
                "write time_offset: free to have it found."
            )
    check_scale(rates, gyro, offset, camera.name, imu.name)
    return fit_rates(rates, gyro, offset, camera.rotation.value, given is None)


def relative_offset(time_offset_s: float, camera_origin_ns: int, imu_origin_ns: int) -> float:
    """The offset between clocks counted from their own first stamps; whole seconds cancel before digits are lost."""
    whole, rest_ns = _split(camera_origin_ns - imu_origin_ns)
    return (time_offset_s + whole) + rest_ns * 1e-9


def absolute_offset(relative_s: float, camera_origin_ns: int, imu_origin_ns: int) -> float:
    """Inverse of `relative_offset`."""
    whole, rest_ns = _split(camera_origin_ns - imu_origin_ns)
    return (relative_s - rest_ns * 1e-9) - whole


def _split(difference_ns: int) -> tuple[int, int]:
    """Whole seconds and the rest, at most half a second either way."""
    whole = (difference_ns + _NS // 2) // _NS
    return whole, difference_ns - whole * _NS


def mean_bias(fits: list[RateFit]) -> np.ndarray:
    """(3,) gyroscope bias, each camera's weighted by its number of rates."""
    return np.average([f.gyro_bias for f in fits], axis=0, weights=[f.count for f in fits])
