"""Measurements from numpy arrays, for `icalib.calibrate_measurements`.

Each function returns the stream of one sensor; `name` is the sensor's name in the rig. Stamps are strictly increasing:
seconds (float) or nanoseconds (integer) on the clock of the sensor. Integers are exact; float seconds since 1970 have a
resolution of 0.2 us. All functions raise RecordingError for wrong shapes, types or values.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, Literal

import numpy as np

from icalib.data.measurements import (
    CornerStream,
    ImuStream,
    LidarStream,
    Measurements,
    PoseStream,
    TrackStream,
    WheelStream,
)
from icalib.errors import RecordingError
from icalib.sensors.parameter import ROUNDING
from icalib.sensors.stream import Stream


def measurements(*streams: Stream, name: str = "") -> Measurements:
    """The streams of all sensors of one recording, in any order. name: of the recording, for error messages."""
    return Measurements.of_streams(*streams, name=name)


def imu(name: str, stamps: Any, gyro: Any, accel: Any) -> ImuStream:
    """Readings of an IMU in its frame: stamps (N,), gyro (N, 3) [rad/s], accel (N, 3) specific force [m/s^2]."""
    return ImuStream(name, _stamps(name, stamps), _floats(name, "gyro", gyro), _floats(name, "accel", accel))


def corners(name: str, stamps: Any, points: Sequence[Any], pixels: Sequence[Any]) -> CornerStream:
    """Target corners detected by a camera, for M images with stamps (M,).

    points: for each image (n,) indices into `target.points`. pixels: for each image (n, 2) px; (0, 0) is the centre of
    the top-left pixel.
    """
    start, index, uv = _grouped(name, stamps, points, pixels, 2)
    return CornerStream(name, _stamps(name, stamps), start, index, uv)


def tracks(name: str, stamps: Any, features: Sequence[Any], pixels: Sequence[Any]) -> TrackStream:
    """Feature tracks of a camera, for M images with stamps (M,).

    features: for each image (n,) ids; a scene point has the same id in all images and cameras. pixels: for each image
    (n, 2) px, as for `corners`.
    """
    start, index, uv = _grouped(name, stamps, features, pixels, 2)
    return TrackStream(name, _stamps(name, stamps), start, index, uv)


def lidar(name: str, stamps: Any, xyz: Sequence[Any], offsets: Sequence[Any]) -> LidarStream:
    """S scans of a LiDAR with stamps (S,), without motion compensation.

    xyz: for each scan (n, 3) m, each point in the LiDAR frame at the instant of that point. offsets: for each scan (n,)
    s, instant of the point minus stamp of its scan.
    """
    start, _, points = _grouped(name, stamps, [np.zeros(len(scan), np.int64) for scan in xyz], xyz, 3)
    seconds = [_floats(name, "offsets", offset) for offset in offsets]
    offset = np.concatenate([np.zeros(0), *seconds]).astype(np.float32)
    unknown = np.full(len(points), -1, np.int32)
    return LidarStream(name, _stamps(name, stamps), start, offset, points.astype(np.float32), unknown)


def wheels(
    name: str,
    stamps: Any,
    rate: Any,
    *,
    sampling: Literal["interval-mean", "instantaneous"] = "interval-mean",
    kind: Literal["pair", "steered", "twist"] = "pair",
) -> WheelStream:
    """Wheel odometry with stamps (N,) and rate (N, 2), whose columns depend on `kind`.

    pair: rates of the left and right wheel [rad/s]. steered: wheel rate [rad/s] and steering angle [rad]. twist: speed
    [m/s] and yaw rate [rad/s]. sampling: whether rates are means over the interval or instantaneous.
    """
    return WheelStream(name, _stamps(name, stamps), _floats(name, "rate", rate), sampling, kind)


def poses(name: str, stamps: Any, rotation: Any, position: Any) -> PoseStream:
    """Poses T_frame_sensor in a static frame: stamps (N,), rotation (N, 3, 3) or scipy Rotation, position (N, 3) m."""
    rotation = rotation.as_matrix() if hasattr(rotation, "as_matrix") else rotation
    R = _floats(name, "rotation", rotation)
    if R.shape[1:] == (3, 3) and not (np.abs(R @ R.swapaxes(1, 2) - np.eye(3)) < ROUNDING).all():
        raise RecordingError(f"{name}: rotation has matrices that are no rotations; correct them.")
    return PoseStream(name, _stamps(name, stamps), R, _floats(name, "position", position))


def _stamps(name: str, stamps: Any) -> np.ndarray:
    """(N,) int64 ns. Raises RecordingError if stamps are not a vector of finite, strictly increasing numbers."""
    values = np.asarray(stamps)
    if values.ndim != 1 or len(values) == 0 or values.dtype.kind not in "iuf":
        raise RecordingError(f"{name}: stamps must be a vector of seconds, or of integer nanoseconds.")
    if values.dtype.kind == "f" and not np.isfinite(values).all():
        raise RecordingError(f"{name}: stamps have entries that are NaN or infinite; remove these readings.")
    ns = np.round(values * 1e9).astype(np.int64) if values.dtype.kind == "f" else values.astype(np.int64)
    if (np.diff(ns) <= 0).any():
        where = int(np.argmax(np.diff(ns) <= 0)) + 1
        raise RecordingError(f"{name}: stamps must increase, but entry {where} does not; sort them, without repeats.")
    return ns


def _floats(name: str, what: str, values: Any) -> np.ndarray:
    try:
        array = np.asarray(values, dtype=np.float64)
    except (TypeError, ValueError) as error:
        raise RecordingError(f"{name}: {what} must be an array of numbers.") from error
    if not np.isfinite(array).all():
        raise RecordingError(f"{name}: {what} has entries that are NaN or infinite; remove these readings.")
    return array


def _grouped(
    name: str, stamps: Any, index: Sequence[Any], values: Sequence[Any], columns: int
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Concatenates M groups: index (N,) int64 and values (N, columns); group k is rows start[k] to start[k + 1], start
    (M + 1,)."""
    if not len(index) == len(values) == len(stamps):
        raise RecordingError(f"{name}: there are {len(stamps)} stamps, but {len(index)} and {len(values)} groups.")
    arrays = [_floats(name, "values", v).reshape(-1, columns) for v in values]
    counts = [len(a) for a in arrays]
    numbers = [np.asarray(i, dtype=np.int64).ravel() for i in index]
    wrong = next((k for k, (i, n) in enumerate(zip(numbers, counts, strict=True)) if len(i) != n), None)
    if wrong is not None:
        raise RecordingError(f"{name}: group {wrong} has {len(numbers[wrong])} numbers for {counts[wrong]} values.")
    start = np.concatenate([[0], np.cumsum(counts)]).astype(np.int64)
    return start, np.concatenate([np.zeros(0, np.int64), *numbers]), np.concatenate([np.zeros((0, columns)), *arrays])
