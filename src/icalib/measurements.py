"""What sensors measured: frozen arrays with checked shapes, stamped in int64 nanoseconds of each sensor's own clock."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from icalib.errors import RecordingError


def _check(condition: bool, sentence: str) -> None:
    if not condition:
        raise RecordingError(sentence)


def seconds_since(stamps_ns: np.ndarray, origin_ns: int) -> np.ndarray:
    """Stamps as float64 seconds since `origin_ns`; the difference is taken in integers, so no digit is lost."""
    return (stamps_ns - np.int64(origin_ns)).astype(np.float64) * 1e-9


@dataclass(frozen=True)
class ImuStream:
    """Readings of one IMU.

    stamps_ns (N,) int64, strictly increasing; gyro (N, 3) rad/s; accel (N, 3) m/s^2 (specific force), imu frame.
    """

    name: str
    stamps_ns: np.ndarray
    gyro: np.ndarray
    accel: np.ndarray

    def __post_init__(self) -> None:
        n = len(self.stamps_ns)
        _check(self.stamps_ns.dtype == np.int64, f"{self.name}: stamps must be int64 nanoseconds.")
        _check(self.gyro.shape == (n, 3), f"{self.name}: gyro must have shape ({n}, 3), not {self.gyro.shape}.")
        _check(self.accel.shape == (n, 3), f"{self.name}: accel must have shape ({n}, 3), not {self.accel.shape}.")

    @property
    def origin_ns(self) -> int:
        return int(self.stamps_ns[0])

    @property
    def seconds(self) -> np.ndarray:
        """(N,) seconds since this clock's own first stamp."""
        return seconds_since(self.stamps_ns, self.origin_ns)


@dataclass(frozen=True)
class CornerStream:
    """Target corners that one camera saw, image by image.

    stamps_ns (M,) int64, one per image, strictly increasing; start (M + 1,) int64, corners of image i are
    start[i]:start[i+1]; point (N,) int64, index into the target's points; uv (N, 2) pixels, (0, 0) is the
    centre of the top-left pixel.
    """

    name: str
    stamps_ns: np.ndarray
    start: np.ndarray
    point: np.ndarray
    uv: np.ndarray

    def __post_init__(self) -> None:
        n, m = len(self.uv), len(self.stamps_ns)
        _check(self.stamps_ns.dtype == np.int64, f"{self.name}: stamps must be int64 nanoseconds.")
        _check(self.start.shape == (m + 1,), f"{self.name}: start must have shape ({m + 1},), not {self.start.shape}.")
        _check(int(self.start[-1]) == n, f"{self.name}: start must end at the number of corners, {n}.")
        _check(self.point.shape == (n,), f"{self.name}: point must have shape ({n},), not {self.point.shape}.")
        _check(self.uv.shape == (n, 2), f"{self.name}: uv must have shape ({n}, 2), not {self.uv.shape}.")

    @property
    def origin_ns(self) -> int:
        return int(self.stamps_ns[0])

    @property
    def seconds(self) -> np.ndarray:
        """(M,) seconds since this clock's own first stamp."""
        return seconds_since(self.stamps_ns, self.origin_ns)

    @property
    def image(self) -> np.ndarray:
        """(N,) the image that each corner belongs to."""
        return np.repeat(np.arange(len(self.stamps_ns)), np.diff(self.start))


@dataclass(frozen=True)
class Measurements:
    """Everything one recording holds that the rig asks for."""

    imu: ImuStream | None
    cameras: tuple[CornerStream, ...]
    notes: tuple[str, ...] = ()  # what was dropped or repaired while reading, one sentence each
    name: str = ""  # of the recording, for sentences about one of several

    @property
    def origin_ns(self) -> int:
        """The first stamp of the body's clock: the IMU's, or without one the first camera's."""
        return self.cameras[0].origin_ns if self.imu is None else self.imu.origin_ns
