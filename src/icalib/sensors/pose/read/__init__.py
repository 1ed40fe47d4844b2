"""Reads poses from tables, topics of poses or odometry, or chains of transforms, and checks them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from icalib.base.remark import Remark
from icalib.data.measurements import PoseStream
from icalib.data.messages import MessageType, TopicInfo, read_poses
from icalib.data.recording import Reader, Reading, ReadStream, Recording
from icalib.data.stamps import kept_readings, stands_still_between
from icalib.data.tables import TableFile, holds
from icalib.errors import RecordingError
from icalib.geometry import so3
from icalib.sensors.pose.read.bad_poses import are_poses, continuous_poses, single_outliers, stale_copies
from icalib.sensors.pose.read.transforms import (
    DEFAULT_TOPIC,
    MESSAGE,
    MESSAGE_TYPE,
    POSE_RATE_HZ,
    POSE_TABLE,
    POSE_TABLES,
    TRANSFORMS,
    PoseReadings,
    as_frame_sensor,
    is_tum_text,
    read_pose_file,
    read_transform_poses,
    refuse_without_frames,
    stamps_by_row,
)
from icalib.sensors.pose.spec import PoseSensor
from icalib.sensors.sensor import TableLayout

_TRANSFORMS = MessageType(
    MESSAGE_TYPE, TRANSFORMS, stamped=False, latched_suffix="tf_static", read_as=MESSAGE_TYPE, definition=MESSAGE
)
MESSAGES = (
    MessageType("geometry_msgs/msg/PoseStamped", "pose"),
    MessageType("geometry_msgs/msg/PoseWithCovarianceStamped", "pose"),
    MessageType("geometry_msgs/msg/TransformStamped", "pose"),
    MessageType("nav_msgs/msg/Odometry", "odometry"),
    _TRANSFORMS,
    replace(_TRANSFORMS, name="tf/msg/tfMessage"),
)


def _stamps(path: Path, layout: TableLayout) -> np.ndarray:
    """(N,) int64 stamps [ns] of a table."""
    return read_pose_file(path.parent.name, path, layout).stamps_ns


def _is_one(path: Path) -> bool:
    """Whether a file named `poses.csv` contains poses, as tables of other sensors may have this name."""
    return is_tum_text(path) or any(holds(path, kind) for kind in POSE_TABLES)


def _is_tum(path: Path) -> bool:
    """Whether a text file of any other name is TUM text."""
    if path.stem == "poses":
        return False
    try:
        return holds(path, POSE_TABLE) and len(read_pose_file(path.stem, path).stamps_ns) > 1
    except RecordingError:
        return False


TABLES = (
    TableFile("poses.csv", "table of poses", "pose", _stamps, _is_one, POSE_TABLE, stamps_by_row),
    TableFile("poses.tum", "table of poses", "pose", _stamps, rows=stamps_by_row),
    TableFile("poses.txt", "table of poses", "pose", _stamps, rows=stamps_by_row),
    *(TableFile(f"*{ending}", "table of poses", "pose", _stamps, _is_tum) for ending in (".tum", ".txt")),
)


def read(recording: Recording, sensors: Sequence[PoseSensor], reading: Reading) -> list[ReadStream]:
    """The checked streams, with notes. Raises RecordingError as `readings` and `checked_poses` do."""
    streams = []
    for sensor in sensors:
        where = recording.where(sensor)
        written = reading.cut(readings(recording, sensor), f"{where} ({sensor.name})")
        streams.append(checked_poses(as_frame_sensor(written, sensor), sensor, where))
    return streams


def readings(recording: Recording, sensor: PoseSensor) -> PoseReadings:
    """All poses as recorded, from a chain of transforms, a table (which may be next to a bag), or a topic. Stamps may
    repeat or decrease.

    Raises RecordingError if the data are missing or cannot be read, naming file and line, or topic. It names the
    instant of an invalid rotation.
    """
    if sensor.frames is not None:
        if not recording.has_messages:
            raise RecordingError(
                f"{recording.root} is a folder, but `frames` of {sensor.name} needs the transforms (/tf) of a bag; "
                "give the bag, or remove `frames` from the rig file."
            )
        return read_transform_poses(recording, sensor, recording.note)
    topic = source(recording, sensor)
    if isinstance(topic, Path):
        poses = read_pose_file(sensor.name, topic, sensor.layout, recording.note, sensor.rotations)
        return recording.inside(poses, topic)
    poses = read_poses(recording, topic.name, topic.kind)
    order = recording.by_stamp(topic.name, poses.stamps_ns)
    return PoseReadings(sensor.name, poses.stamps_ns[order], poses.rotation[order], poses.position[order])


def source(recording: Recording, sensor: PoseSensor) -> Path | TopicInfo:
    """The table, which may be next to a bag, or the topic: of transforms if the sensor has `frames`, else of poses or
    odometry."""
    in_bag = sensor.topic is not None or sensor.frames is not None
    if not recording.has_messages or not (in_bag or recording.find(sensor.path) is None):
        return recording.table(sensor, sensor.path)
    if sensor.frames is not None:
        return recording.topic(sensor.name, sensor.topic or DEFAULT_TOPIC, TRANSFORMS)
    refuse_without_frames(recording.root, recording.topics(), sensor)
    return recording.topic(sensor.name, sensor.topic, "pose", "odometry")


# Checks of recorded poses: they must be of one moving sensor, in metres, in one static frame.

_MAX_SPEED = 100.0  # m/s; a higher median speed means a wrong unit of length or time
_MAX_INVALID_SHARE = 0.5  # share of all poses; with more, the writing program is faulty
# Jumps cancel if the length of their sum is below the larger of these: metres, share of the largest jump.
_MAX_NET_JUMP_M, _MAX_NET_JUMP_SHARE = 0.05, 0.5
_MIN_TRAVEL_M, _MIN_TRAVEL_RAD = 0.02, 0.02  # a sensor with smaller largest displacement and rotation is at rest


def checked_poses(read: PoseReadings, sensor: PoseSensor, where: str) -> tuple[PoseStream, tuple[Remark, ...]]:
    """The poses with strictly increasing stamps and without single bad poses, and notes on removed or suspicious data.

    Raises RecordingError naming `where` and the instant if poses are too few or mostly invalid, or stamps are out of
    order or repeated with other values. It is also raised for wrong units of time or length, a sensor at rest, or jumps
    of the frame of absolute poses.
    """
    what = f"{where} ({read.name})"
    if len(read.stamps_ns) < 3:
        raise RecordingError(f"{what}: only {len(read.stamps_ns)} poses; a calibration needs the whole recording.")
    read, broken = _without_invalid(read, what)
    values = np.hstack([read.position, read.rotation.reshape(-1, 9)])
    remedy = "write the sensor's own stamps"
    kept, notes = kept_readings(read.stamps_ns, values, what, POSE_RATE_HZ, "pose", remedy)
    read = read.some(kept)
    copied, single, jumped = (), (), ()
    if not stands_still_between(read.seconds, read.rotation, read.position):
        # The controller of a robot at rest repeats its pose in every digit, which is not a stale copy.
        read, copied = _without_copies(read, what)
    if not stands_still_between(read.seconds, read.rotation, read.position):
        # The steps between stops of a robot are not jumps.
        read, single = _without_outliers(read, what)
        read, jumped = _on_trajectory(read, sensor, what)
        _refuse_units(read, what)
    _refuse_stillness(read, what)
    stream = PoseStream(read.name, read.stamps_ns, np.ascontiguousarray(read.rotation), read.position, read.numbers)
    return stream, broken + notes + copied + single + jumped


def _without_invalid(read: PoseReadings, what: str) -> tuple[PoseReadings, tuple[Remark, ...]]:
    """Valid poses, and a note on removed ones. Raises RecordingError if most are invalid."""
    good = are_poses(read.rotation, read.position)
    if good.all():
        return read, ()
    first, count = read.stamps_ns[np.argmin(good)], int((~good).sum())
    if count > _MAX_INVALID_SHARE * len(good) or len(good) - count < 3:
        raise RecordingError(
            f"{what}: {count} of {len(good)} poses are not finite or have no unit quaternion, the first at "
            f"{first} ns; correct the program that writes them."
        )
    note = Remark(
        "poses_invalid",
        f"{what}: {count} of {len(good)} poses are not finite or have no unit quaternion and were removed, the "
        f"first at {first} ns.",
    )
    return read.some(good), (note,)


def _without_copies(read: PoseReadings, what: str) -> tuple[PoseReadings, tuple[Remark, ...]]:
    """Poses without stale copies, and a note if any was removed."""
    stale = stale_copies(read.seconds, read.rotation, read.position)
    if not stale.any():
        return read, ()
    note = Remark(
        "poses_stale",
        f"{what}: {int(stale.sum())} of {len(stale)} poses repeat an earlier one exactly during motion, as if "
        "the tracker was lost or the driver sent its last pose again. They were removed, the first at "
        f"{read.stamps_ns[np.argmax(stale)]} ns.",
    )
    return read.some(~stale), (note,)


def _without_outliers(read: PoseReadings, what: str) -> tuple[PoseReadings, tuple[Remark, ...]]:
    """Poses without single outliers, and a note if any was removed."""
    wrong = single_outliers(read.seconds, read.rotation, read.position)
    if not wrong.any():
        return read, ()
    note = Remark(
        "pose_outliers",
        f"{what}: {int(wrong.sum())} of {len(wrong)} poses are outliers of the trajectory and were removed, "
        f"the first at {read.stamps_ns[np.argmax(wrong)]} ns.",
    )
    return read.some(~wrong), (note,)


def _on_trajectory(read: PoseReadings, sensor: PoseSensor, what: str) -> tuple[PoseReadings, tuple[Remark, ...]]:
    """Poses on the trajectory, and a note on jumps. Raises RecordingError if jumps of absolute poses do not cancel."""
    path = continuous_poses(read.seconds, read.rotation, read.position)
    if not len(path.jumps):
        return read, ()
    first, count = read.stamps_ns[path.jumps[0]], int((~path.on).sum())
    words = f"{what}: {len(path.jumps)} jumps of its poses, the first at {first} ns, by up to {path.size_m:.2g} m"
    words += f" and {path.size_rad:.2g} rad"
    if sensor.kind == "absolute" and path.net_jump_m > max(_MAX_NET_JUMP_M, _MAX_NET_JUMP_SHARE * path.size_m):
        raise RecordingError(
            f"{words}, and do not return, as if an odometry closed a loop or lost its track. Write kind: "
            f"relative for {sensor.name} in the rig file, with an IMU, or cut the recording with --from and --to."
        )
    if not count:
        return read, (Remark("poses_jump", f"{words}; the robust loss reduces their weight."),)
    note = Remark(
        "poses_off_trajectory",
        f"{words}. {count} of {len(path.on)} poses are off the trajectory of the others, as if the tracker was "
        f"lost, and were removed; the longest gap is {path.longest_s:.2g} s.",
    )
    return read.some(path.on), (note,)


def _refuse_stillness(read: PoseReadings, what: str) -> None:
    """Raise RecordingError if the sensor does not move."""
    far = np.linalg.norm(read.position - np.median(read.position, axis=0), axis=1).max()
    turned = _sizes(so3.log_many(np.ascontiguousarray(read.rotation[0].T @ read.rotation))).max()
    if far < _MIN_TRAVEL_M and turned < _MIN_TRAVEL_RAD:
        raise RecordingError(
            f"{what}: all poses are the same within {far:.2g} m and {turned:.2g} rad; check that it follows the robot, "
            "or record again while moving."
        )


def _refuse_units(read: PoseReadings, what: str) -> None:
    """Raise RecordingError if the speed is implausible."""
    step = np.diff(read.stamps_ns) * 1e-9
    speed = float(np.median(np.linalg.norm(np.diff(read.position, axis=0), axis=1) / step))
    if speed > _MAX_SPEED:
        raise RecordingError(
            f"{what}: it moves at {speed:.4g} m/s, which is implausible. Positions must be in the "
            "position_unit of the rig file (metres without it), and stamps in its time_unit."
        )


def _sizes(vectors: np.ndarray) -> np.ndarray:
    """(n,) norms of vectors (n, 3)."""
    return np.linalg.norm(vectors, axis=1)


READER = Reader(MESSAGES, TABLES, read, source)
