"""Poses of one frame in another from the transforms of a bag (/tf, /tf_static), composed along the tree of frames."""

from __future__ import annotations

from array import array
from collections import defaultdict
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Protocol

import numpy as np
from scipy.spatial.transform import Rotation

from icalib.base.remark import Remark
from icalib.data.images import Note, ignore
from icalib.data.messages import HasMessages, TopicInfo, find_topic, unit_rotations
from icalib.data.tables import STAMP, Table, TableKind, holds, in_axes, read_table, split_kind, vector_names
from icalib.errors import RecordingError
from icalib.geometry import so3
from icalib.rig import PLAIN_TABLE, PoseSensor, TableLayout
from icalib.sensors.pose.spec import METRES
from icalib.sensors.stream import RawReadings

TRANSFORMS = "transforms"  # the kind of a topic that contains transforms
DEFAULT_TOPIC = "/tf"
MESSAGE_TYPE = "tf2_msgs/msg/TFMessage"  # tf/msg/tfMessage is an older name of this type
MESSAGE = "geometry_msgs/TransformStamped[] transforms\n"
_STATIC = "_static"  # suffix of topics with static transforms
_MAX_INTERPOLATED_PERIODS = 3.0  # in median periods of an edge; longer gaps are not interpolated
_MAX_BACKWARDS_NS = 1_000_000_000  # largest decrease of an edge's stamps; with a larger one the clock was set back
_MAX_LISTED_FRAMES = 30  # frames listed in one message
Pair = tuple[str, str]  # parent, child


class HasTopics(HasMessages, Protocol):
    """The part of the `BagRecording` interface that is needed here."""

    def topics(self) -> tuple[TopicInfo, ...]: ...


@dataclass(frozen=True, eq=False)
class Edge:
    """T_parent_child over time. stamps_ns (N,) int64, strictly increasing; rotation (N, 3, 3); position (N, 3) [m].
    static: from a topic of static transforms, with N = 1."""

    parent: str
    child: str
    stamps_ns: np.ndarray
    rotation: np.ndarray
    position: np.ndarray
    static: bool

    @property
    def changes(self) -> bool:
        """Whether the transform changes over time."""
        rows = np.hstack([self.position, self.rotation.reshape(-1, 9)])
        return bool((rows != rows[0]).any())

    @property
    def rate_hz(self) -> float | None:
        """Rate by the median step between stamps [Hz]; None if the edge is static or has one row."""
        if self.static or len(self.stamps_ns) < 2:
            return None
        return 1e9 / float(np.median(np.diff(self.stamps_ns)))


@dataclass(frozen=True)
class _TransformEdge:
    """An edge of a chain. inverted: whether the chain passes it from child to parent."""

    edge: Edge
    inverted: bool


def transform_topics(topics: Sequence[TopicInfo], given: str = DEFAULT_TOPIC) -> list[TopicInfo]:
    """The topic `given` of transforms and its static counterpart, as far as they have messages."""
    stem = given.strip("/").removesuffix(_STATIC)
    sent = [t for t in topics if t.kind == TRANSFORMS and t.count]
    return [t for t in sent if t.name.strip("/") in (stem, stem + _STATIC)]


def read_transform_poses(bag: HasTopics, sensor: PoseSensor, note: Note) -> PoseReadings:
    """T_parent_child between the two `frames` of the sensor, at the stamps of the most frequent changing edge between
    them.

    If several edges are as frequent, the last one counts. All other changing edges are interpolated. `note` is called
    with a sentence on removed data. Raises RecordingError, one sentence, if topic or frames do not exist, the frames
    are not connected, or no transform between them changes.
    """
    assert sensor.frames is not None
    topics, name = bag.topics(), sensor.topic or DEFAULT_TOPIC
    used = transform_topics(topics, name)
    if not used:
        topic = find_topic(str(bag.root), topics, name)
        holds = "no messages" if topic.kind == TRANSFORMS else topic.type
        raise RecordingError(
            f"{bag.root}: {topic.name} holds {holds}, but `frames` of {sensor.name} needs transforms, as on "
            f"{DEFAULT_TOPIC}; remove `frames`, or correct `topic`."
        )
    where = f"{bag.root} {' and '.join(t.name for t in used)}"
    edges = read_edges(bag, used, note)
    parent, child = (frame.lstrip("/") for frame in sensor.frames)
    steps = _chain(edges, parent, child, f"{where} ({sensor.name})")
    return _along(steps, sensor, where, note)


def refuse_without_frames(root: Path, topics: Sequence[TopicInfo], sensor: PoseSensor) -> None:
    """Raise RecordingError if `frames` is missing: the sensor's topic contains transforms, or the bag has transforms
    but no other poses."""
    if sensor.topic is not None:
        wanted = any(t.name.strip("/") == sensor.topic.strip("/") and t.kind == TRANSFORMS for t in topics)
    else:
        poses = any(t.kind in ("pose", "odometry") and t.count for t in topics)
        wanted = not poses and bool(transform_topics(topics))
    if wanted:
        raise RecordingError(
            f"{root}: {sensor.topic or DEFAULT_TOPIC} holds transforms of many frames; set `frames: [parent, child]` "
            f"of {sensor.name} in the rig file (`icalib inspect` lists them)."
        )


def read_edges(bag: HasMessages, topics: Sequence[TopicInfo], note: Note) -> dict[Pair, Edge]:
    """All edges of `topics` by parent and child. Transforms that are repeated with the same stamp count once."""
    edges: dict[Pair, Edge] = {}
    # Static topics are last, so that their transforms replace moving ones of the same two frames.
    for topic in sorted(topics, key=lambda t: t.name.endswith(_STATIC)):
        static, where = topic.name.endswith(_STATIC), f"{bag.root} {topic.name}"
        received = _rows(bag, topic.name)
        if not static and (unstamped := sum(r.unstamped for r in received.values())):
            sentence = (
                f"{where}: {unstamped} transforms have no stamp. Their receive times are used instead, which "
                "are late and jittery; let the publisher stamp them."
            )
            note(Remark("transforms_without_stamp", sentence))
        for pair, r in received.items():
            rows = np.array(r.values, np.float64).reshape(-1, 7)
            edges[pair] = _edge(pair, np.array(r.stamps_ns, np.int64), rows, static, where, note)
    return edges


@dataclass
class _Rows:
    """An edge as received. stamps_ns: receive time if a message has no stamp; values: x, y, z, qx, qy, qz, qw of each
    transform; unstamped: number of transforms without stamp."""

    stamps_ns: array[int] = field(default_factory=lambda: array("q"))
    values: array[float] = field(default_factory=lambda: array("d"))
    unstamped: int = 0


def _rows(bag: HasMessages, topic: str) -> dict[Pair, _Rows]:
    """All transforms of a topic, by edge."""
    rows: dict[Pair, _Rows] = defaultdict(_Rows)
    for received_ns, message in bag.messages(topic, TRANSFORMS):
        for t in message.transforms:
            row = rows[t.header.frame_id.lstrip("/"), t.child_frame_id.lstrip("/")]
            p, q, stamp = t.transform.translation, t.transform.rotation, t.header.stamp
            stamp_ns = stamp.sec * 1_000_000_000 + stamp.nanosec
            row.unstamped += not stamp_ns
            row.stamps_ns.append(stamp_ns or received_ns)
            row.values.extend((p.x, p.y, p.z, q.x, q.y, q.z, q.w))
    return rows


def _edge(pair: Pair, stamps_ns: np.ndarray, rows: np.ndarray, static: bool, where: str, note: Note) -> Edge:
    """The edge of rows (N, 7) x, y, z, qx, qy, qz, qw, without invalid and repeated ones. Raises RecordingError if most
    are invalid, or the clock was set back."""
    frames = f"{pair[0]} -> {pair[1]}"
    with np.errstate(over="ignore", invalid="ignore"):
        good = np.isfinite(rows).all(axis=1) & (
            np.abs(np.linalg.norm(rows[:, 3:], axis=1) - 1.0) < MAX_QUATERNION_ERROR
        )
    if 2 * good.sum() < len(good):
        raise RecordingError(
            f"{where}: the transform {frames} at {stamps_ns[np.argmin(good)]} ns is not finite or has no unit "
            "quaternion, as are most others; correct the publisher."
        )
    if not good.all():
        sentence = (
            f"{where}: {int((~good).sum())} of {len(good)} transforms {frames} are not finite or have no unit "
            f"quaternion and were removed, the first at {stamps_ns[np.argmin(good)]} ns."
        )
        note(Remark("transforms_invalid", sentence))
    stamps_ns, rows = stamps_ns[good], rows[good]
    if static:  # the last message replaces earlier ones
        stamps_ns, rows = stamps_ns[-1:], rows[-1:]
    else:
        _, first = np.unique(stamps_ns, return_index=True)
        received = stamps_ns[np.sort(first)]
        back_ns = int((np.maximum.accumulate(received) - received).max(initial=0))
        if back_ns > _MAX_BACKWARDS_NS:
            raise RecordingError(
                f"{where}: the stamps of {frames} go back by {back_ns * 1e-9:.1f} s, so the clock was set back; cut "
                "the recording there with --from and --to."
            )
        stamps_ns, rows = stamps_ns[first], rows[first]
    rotation = unit_rotations(rows[:, 3:], np.ones(len(rows), dtype=bool))
    return Edge(*pair, stamps_ns, rotation, rows[:, :3].copy(), static)


def _chain(edges: dict[Pair, Edge], parent: str, child: str, what: str) -> list[_TransformEdge]:
    """Shortest chain of edges from `parent` to `child`, in either direction (breadth-first search). Raises
    RecordingError if there is none."""
    frames = sorted({frame for pair in edges for frame in pair})
    for frame in (parent, child):
        if frame not in frames:
            more = f" and {len(frames) - _MAX_LISTED_FRAMES} more" if len(frames) > _MAX_LISTED_FRAMES else ""
            raise RecordingError(
                f"{what}: there is no frame {frame}; there are {', '.join(frames[:_MAX_LISTED_FRAMES])}{more}; correct "
                "`frames`."
            )
    steps_to: dict[str, list[_TransformEdge]] = {parent: []}
    queue = [parent]
    for frame in queue:
        for (a, b), edge in edges.items():
            for near, far, inverted in ((a, b, False), (b, a, True)):
                if near == frame and far not in steps_to:
                    steps_to[far] = [*steps_to[frame], _TransformEdge(edge, inverted)]
                    queue.append(far)
    if child not in steps_to:
        raise RecordingError(
            f"{what}: no transforms connect {parent} and {child}; {parent} is connected with "
            f"{', '.join(sorted(f for f in steps_to if f != parent)[:_MAX_LISTED_FRAMES])}; correct `frames`, or "
            "record /tf_static as well."
        )
    return steps_to[child]


def _along(steps: Sequence[_TransformEdge], sensor: PoseSensor, where: str, note: Note) -> PoseReadings:
    """Poses composed along a chain, at the common stamps of its changing edges. Raises RecordingError if no transform
    changes."""
    assert sensor.frames is not None
    what, frames = f"{where} ({sensor.name})", " -> ".join(sensor.frames)
    sent = [s.edge for s in steps if len(s.edge.stamps_ns) > 1]
    moving = [e for e in sent if e.changes] or sent
    if not moving:
        raise RecordingError(
            f"{what}: nothing moves between the frames {frames}; choose `frames` with a joint or the motion of "
            "a vehicle between them."
        )
    stamps_ns = _common_stamps(moving, what, frames, note)
    R, p = np.tile(np.eye(3), (len(stamps_ns), 1, 1)), np.zeros((len(stamps_ns), 3))
    for step in steps:
        edge = step.edge
        edge_R, edge_p = _at(edge, stamps_ns) if edge in moving else (edge.rotation[:1], edge.position[:1])
        if step.inverted:
            edge_R = edge_R.transpose(0, 2, 1)
            edge_p = -np.einsum("nij,nj->ni", edge_R, edge_p)
        R, p = R @ edge_R, p + np.einsum("nij,nj->ni", R, np.broadcast_to(edge_p, p.shape))
    return PoseReadings(sensor.name, stamps_ns, np.ascontiguousarray(R), p)


def _common_stamps(moving: Sequence[Edge], what: str, frames: str, note: Note) -> np.ndarray:
    """(N,) stamps of the changing edge with most transforms (the last of several) at which all other changing edges are
    known."""
    stamps_ns = max(moving[::-1], key=lambda e: len(e.stamps_ns)).stamps_ns
    known = np.logical_and.reduce([_covered(edge, stamps_ns) for edge in moving])
    if not known.any():
        raise RecordingError(
            f"{what}: the transforms between {frames} have no time in common; check the clocks of their publishers."
        )
    if not known.all():
        sentence = (
            f"{what}: {int((~known).sum())} of {len(known)} poses {frames} were removed, the first at "
            f"{stamps_ns[np.argmin(known)]} ns, because another transform between the two frames is missing "
            "there."
        )
        note(Remark("transforms_missing", sentence))
    return stamps_ns[known]


def _covered(edge: Edge, stamps_ns: np.ndarray) -> np.ndarray:
    """(N,) whether an edge is known at stamps (N,): at the stamps of the edge, and between two that are close."""
    after = np.searchsorted(edge.stamps_ns, stamps_ns)
    last = len(edge.stamps_ns) - 1
    exact = edge.stamps_ns[np.minimum(after, last)] == stamps_ns
    gap = edge.stamps_ns[np.minimum(after, last)] - edge.stamps_ns[np.maximum(after - 1, 0)]
    near = gap <= _MAX_INTERPOLATED_PERIODS * float(np.median(np.diff(edge.stamps_ns)))
    return exact | ((after > 0) & (after <= last) & near)


def _at(edge: Edge, stamps_ns: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Rotations (N, 3, 3) and positions (N, 3) of an edge at stamps (N,), which must be covered. Interpolation is
    geodesic for rotations and linear for positions."""
    i = np.clip(np.searchsorted(edge.stamps_ns, stamps_ns, side="right") - 1, 0, len(edge.stamps_ns) - 2)
    duration = (edge.stamps_ns[i + 1] - edge.stamps_ns[i]).astype(np.float64)
    share = ((stamps_ns - edge.stamps_ns[i]) / duration)[:, None]
    R, p = edge.rotation[i], edge.position[i]
    turn = so3.log_many(np.ascontiguousarray(R.transpose(0, 2, 1) @ edge.rotation[i + 1]))
    return R @ so3.exp_many(share * turn), p + share * (edge.position[i + 1] - p)


# Recorded poses of a sensor, and their reader for tables: CSV and TUM text.

POSE_RATE_HZ = (1e-3, 5000.0)  # lowest and highest plausible rate
POSE_TABLE = TableKind(
    ("t [ns]",),
    ("x [m]", "y [m]", "z [m]", "qx", "qy", "qz", "qw"),
    (
        STAMP,
        *vector_names("p|pos|position|t|trans|translation|p_rs_r|"),
        *vector_names("q|quat|quaternion|orientation|r|rot|rotation|q_rs", "xyzw"),
    ),
    POSE_RATE_HZ,
)
_THREE = TableKind(("t [ns]",), (*POSE_TABLE.decimals[:3], "rx", "ry", "rz"), rate_hz=POSE_RATE_HZ)
# Rows of a 3 x 4 or 4 x 4 matrix one after another
_MATRICES = tuple(
    TableKind(("t [ns]",), tuple(f"m{i}{k}" for i in range(1, rows + 1) for k in range(1, 5)), rate_hz=POSE_RATE_HZ)
    for rows in (3, 4)
)
POSE_TABLES = (POSE_TABLE, _THREE, *_MATRICES)
# Only the stamps, so that a row whose pose cannot be read still counts as a row.
_STAMPS = TableKind(("t [ns]",), known=(STAMP,), rate_hz=POSE_RATE_HZ, more=True)
_TUM_SUFFIXES = (".tum", ".txt")
MAX_QUATERNION_ERROR = 1e-2  # largest deviation of a quaternion's length from 1, as in rounded text


@dataclass(frozen=True)
class PoseReadings(RawReadings):
    """Recorded poses: rotation R_frame_sensor (N, 3, 3), NaN if invalid; position p_frame_sensor (N, 3) [m]."""

    rotation: np.ndarray
    position: np.ndarray
    numbers: np.ndarray = field(default_factory=lambda: np.zeros((0, 0)))  # see `PoseStream`


def as_frame_sensor(read: PoseReadings, sensor: PoseSensor) -> PoseReadings:
    """The poses as T_frame_sensor. They are converted if the rig file states inverted poses, or another unit or
    other axes of positions."""
    read = replace(read, position=read.position * METRES[sensor.position_unit])
    if sensor.position_axes is not None:
        read = replace(read, position=in_axes(read.position, sensor.position_axes))
    if not sensor.inverted:
        return read
    R = np.ascontiguousarray(read.rotation.transpose(0, 2, 1))
    return replace(read, rotation=R, position=-np.einsum("nij,nj->ni", R, read.position))


def is_tum_text(path: Path) -> bool:
    """Whether a file is TUM text, by its suffix. Its stamps are in seconds."""
    return path.suffix.lower() in _TUM_SUFFIXES


def read_pose_file(
    name: str, path: Path, layout: TableLayout = PLAIN_TABLE, note: Note = ignore, how: str | None = None
) -> PoseReadings:
    """The poses of the sensor `name` in the table at `path`, with columns t [ns], x, y, z, qx, qy, qz, qw.

    how: `rotations` of the sensor. Without it a table of 7 columns has angles or rotation vectors, one of 13 or 17
    columns has matrices. Three numbers are then read as angles about fixed axes until `conventions` compares all.

    Stamps of .tum and .txt files are in seconds. Rotations of invalid quaternions are NaN. `note` is called with a
    sentence on omitted rows. Raises RecordingError naming file and line, or if most quaternions are invalid.
    """
    table = _table(path, how, layout, note)
    stamps_ns, values = table.integers[:, 0].copy(), table.decimals
    if values.shape[1] >= 12:
        T = values[:, :12].reshape(-1, 3, 4)
        values = np.hstack([T[:, :, 3], T[:, :, :3].reshape(-1, 9)])
    numbers = values[:, 3:].copy()
    if numbers.shape[1] == 4:
        _refuse_no_quaternions(name, path, stamps_ns, numbers)
    how = how or {3: f"xyz, {angle_unit(numbers)}", 4: "xyzw", 9: "matrix"}[numbers.shape[1]]
    return PoseReadings(name, stamps_ns, rotations_of(numbers, how), values[:, :3].copy(), numbers)


def _table(path: Path, how: str | None, layout: TableLayout, note: Note) -> Table:
    """The table at `path` by the first kind that it fits, of those that `how` allows."""
    kinds = POSE_TABLES
    if how is not None:
        in_order = replace(POSE_TABLE, known=())  # the header may name another order than that stated
        kinds = {"matrix": _MATRICES, "xyzw": (in_order,), "wxyz": (in_order,)}.get(how, (_THREE,))
    failed: RecordingError | None = None
    for kind in kinds:
        if failed and not (len(layout.columns) == len(kind.names) or (not layout.columns and holds(path, kind))):
            continue
        try:
            return read_table(path, replace(kind, unit="s") if is_tum_text(path) else kind, layout, note)
        except RecordingError as error:
            failed = failed or error
    assert failed is not None
    raise failed


def angle_unit(numbers: np.ndarray) -> str:
    """The unit of angles or rotation vectors: degrees if any number is larger than a full turn in radians."""
    return "degrees" if np.abs(numbers).max(initial=0.0) > 2.0 * np.pi else "radians"


def rotations_of(numbers: np.ndarray, how: str) -> np.ndarray:
    """Rotations (N, 3, 3) that are written as `how` (`PoseSensor.rotations`) in numbers (N, 3, 4 or 9); NaN where they
    are none."""
    name, _, unit = how.partition(", ")
    if name == "vector":
        return Rotation.from_rotvec(numbers, degrees=unit == "degrees").as_matrix()
    if unit:
        return Rotation.from_euler(name, numbers, degrees=unit == "degrees").as_matrix()
    if name != "matrix":
        xyzw = numbers if name == "xyzw" else numbers[:, [1, 2, 3, 0]]
        return unit_rotations(xyzw, np.abs(_lengths(xyzw) - 1.0) < MAX_QUATERNION_ERROR)
    R = np.clip(numbers, -2.0, 2.0).reshape(-1, 3, 3)
    error = np.abs(R @ R.transpose(0, 2, 1) - np.eye(3)).max(axis=(1, 2))
    good = (error < 2.0 * MAX_QUATERNION_ERROR) & (np.linalg.det(R) > 0.0)
    out = np.full(R.shape, np.nan)
    out[good] = Rotation.from_matrix(R[good]).as_matrix()
    return out


def _lengths(xyzw: np.ndarray) -> np.ndarray:
    """(N,) lengths of quaternions (N, 4)."""
    return np.linalg.norm(np.clip(xyzw, -1e9, 1e9), axis=1)  # clipped so that squares do not overflow


def _refuse_no_quaternions(name: str, path: Path, stamps_ns: np.ndarray, xyzw: np.ndarray) -> None:
    """Raise RecordingError if most quaternions (N, 4) have another length than 1."""
    length = _lengths(xyzw)
    wrong = ~(np.abs(length - 1.0) < MAX_QUATERNION_ERROR)
    if 2 * wrong.sum() > len(wrong):
        i = int(np.argmax(wrong))
        raise RecordingError(
            f"{path} ({name}): the quaternion at {stamps_ns[i]} ns has length {length[i]:.3g}, not 1, and most are "
            "no better; check the order of the columns, x, y, z, qx, qy, qz, qw."
        )


def stamps_by_row(table: Path, layout: TableLayout, note: Note) -> tuple[dict[int, int], int]:
    """Stamps [ns] of readable rows by row number, from 0; and the number of all rows."""
    kind = replace(_STAMPS, unit="s") if is_tum_text(table) else _STAMPS
    stamps = 1 if split_kind(POSE_TABLE, layout.columns) is None else 2  # the first columns of a pose
    read = read_table(table, kind, replace(layout, columns=layout.columns[:stamps]), note)
    return dict(zip(read.numbers.tolist(), read.integers[:, 0].tolist(), strict=True)), read.written
