"""Are these poses those of one thing that moves, in metres, in one frame that stands still?"""

from __future__ import annotations

import numpy as np

from icalib.errors import RecordingError
from icalib.geometry import so3
from icalib.measurements import PoseStream
from icalib.recordings.ordered import kept_readings
from icalib.recordings.poses import PoseReadings
from icalib.rig import PoseSensor

_RATE_HZ = (2.0, 5000.0)
_FASTEST_M_S = 100.0
_JUMP_M, _JUMP_RAD = 0.05, 0.05  # beyond the steps before and after, and
_JUMP_TIMES = 20.0  # the median of all steps beyond theirs
_RETURNS = 0.5  # of a jump's length: jumps that add up to less come back
_STILL_M, _STILL_RAD = 0.02, 0.02  # from pose to pose, farthest from the first


def checked_poses(read: PoseReadings, sensor: PoseSensor, where: str) -> tuple[PoseStream, tuple[str, ...]]:
    """The poses with strictly increasing stamps, and notes on what was dropped or looks odd.

    Raises RecordingError naming `where` and the instant: too few poses, NaN, stamps out of order or repeated with other
    values, other units of time or length, standing still, and of absolute poses a frame that jumps.
    """
    what = f"{where} ({read.name})"
    if len(read.stamps_ns) < 3:
        raise RecordingError(f"{what}: only {len(read.stamps_ns)} poses; a calibration needs the whole recording.")
    values = np.hstack([read.position, read.rotation.reshape(-1, 9)])
    own = "write the sensor's own stamps"
    kept, notes = kept_readings(read.stamps_ns, values, what, _RATE_HZ, "pose", own)
    if notes:
        read = PoseReadings(read.name, read.stamps_ns[kept], read.rotation[kept], read.position[kept])
    _refuse_stillness(read, what)
    _refuse_units(read, what)
    stream = PoseStream(read.name, read.stamps_ns, np.ascontiguousarray(read.rotation), read.position)
    return stream, notes + _jumps(stream, sensor, what)


def _refuse_stillness(read: PoseReadings, what: str) -> None:
    far = np.linalg.norm(read.position - np.median(read.position, axis=0), axis=1).max()
    turned = _sizes(so3.log_many(np.ascontiguousarray(read.rotation[0].T @ read.rotation))).max()
    if far < _STILL_M and turned < _STILL_RAD:
        raise RecordingError(
            f"{what}: all poses are the same within {far:.2g} m and {turned:.2g} rad; check that it follows the robot, "
            "or record again while moving."
        )


def _refuse_units(read: PoseReadings, what: str) -> None:
    step = np.diff(read.stamps_ns) * 1e-9
    speed = float(np.median(np.linalg.norm(np.diff(read.position, axis=0), axis=1) / step))
    if speed > _FASTEST_M_S:
        raise RecordingError(
            f"{what}: it moves at {speed:.4g} m/s, faster than any robot; positions in millimetres are to be divided "
            "by 1000, stamps are in nanoseconds."
        )


def _jumps(stream: PoseStream, sensor: PoseSensor, what: str) -> tuple[str, ...]:
    """A note where poses jump; raises RecordingError where those of a frame that stands still do not come back."""
    way = np.diff(stream.position, axis=0)
    beyond = _beyond(way)
    turn = _turn_steps(stream.rotation)
    jump = (_sizes(beyond) > _limit(beyond, _JUMP_M)) | (_sizes(_beyond(turn)) > _limit(_beyond(turn), _JUMP_RAD))
    jump &= np.diff(stream.stamps_ns) < 2 * np.median(np.diff(stream.stamps_ns))
    if not jump.any():
        return ()
    i, size = int(np.argmax(jump)), float(_sizes(beyond)[jump].max())
    first = stream.stamps_ns[i + 1]
    words = f"{what}: {int(jump.sum())} jumps of its poses, the first at {first} ns, by up to {size:.2g} m"
    lasting = float(np.linalg.norm(beyond[jump].sum(axis=0)))
    if sensor.kind == "absolute" and lasting > max(_JUMP_M, _RETURNS * size):
        raise RecordingError(
            f"{words}, and they do not come back, as where an odometry closes a loop or loses its track; write kind: "
            f"relative for {sensor.name} in the rig file, or cut the recording."
        )
    return (f"{words}; the robust loss of the settings weighs them down.",)


def _beyond(steps: np.ndarray) -> np.ndarray:
    """Each of steps (n, 3) less the median of it and its neighbours, two on each side."""
    padded = np.pad(steps, ((2, 2), (0, 0)), mode="edge")
    near = np.stack([padded[k : k + len(steps)] for k in range(5)])
    return steps - np.median(near, axis=0)


def _limit(beyond: np.ndarray, least: float) -> float:
    return max(least, _JUMP_TIMES * float(np.median(_sizes(beyond))))


def _sizes(vectors: np.ndarray) -> np.ndarray:
    return np.linalg.norm(vectors, axis=1)


def _turn_steps(rotation: np.ndarray) -> np.ndarray:
    """(N - 1, 3) what each pose turned from the one before, about axes of the sensor, rad."""
    return so3.log_many(np.ascontiguousarray(rotation[:-1].transpose(0, 2, 1) @ rotation[1:]))
