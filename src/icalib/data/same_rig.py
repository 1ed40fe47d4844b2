"""Whether measurements made in memory are those of the rig (what is read from files is so already), and positions near
the origin of their frame."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Protocol, TypeVar

import numpy as np

from icalib.data.measurements import Measurements, PoseStream
from icalib.errors import RecordingError
from icalib.rig import Rig


class _Named(Protocol):
    @property
    def name(self) -> str: ...


T = TypeVar("T", bound=_Named)
FAR_M = 100.0  # from the origin of a frame; its rotation and its origin are hard to tell apart from further away


def streams_of_rig(rig: Rig, measurements: Measurements) -> Measurements:
    """The same streams in the order of the rig's sensors. A camera has corners or tracks, or both. Positions of pose
    sensors that are far from the origin of their frame, as in UTM, are counted from among them; the notes say so.

    Raises RecordingError where a sensor of the rig has no stream, or a stream is of no such sensor of the rig.
    """
    m, where = measurements, measurements.name or "the recording"
    _ordered(() if rig.imu is None else (rig.imu,), () if m.imu is None else (m.imu,), where)
    if rig.imu is not None and m.imu is None:
        raise RecordingError(f"{where} has no readings of {rig.imu.name}; add them, or remove it from the rig.")
    cameras, tracks = _ordered(rig.cameras, m.cameras, where), _ordered(rig.cameras, m.tracks, where)
    seeing = {s.name for s in (*cameras, *tracks)}
    lidars, wheels = _ordered(rig.lidars, m.lidars, where), _ordered(rig.wheels, m.wheels, where)
    poses = _ordered(rig.poses, m.poses, where)
    found = [near(s) for s in poses]
    poses, notes = tuple(s for s, _ in found), sum((words for _, words in found), m.notes)
    given = seeing.union(s.name for s in (*lidars, *wheels, *poses))
    missing = [s.name for s in (*rig.cameras, *rig.lidars, *rig.wheels, *rig.poses) if s.name not in given]
    if missing:
        raise RecordingError(
            f"{where} has no data of {' and '.join(missing)}; add the measurements, or remove it from the rig."
        )
    return replace(m, cameras=cameras, tracks=tracks, lidars=lidars, wheels=wheels, poses=poses, notes=notes)


def near(stream: PoseStream) -> tuple[PoseStream, tuple[str, ...]]:
    """The poses with positions counted from whole metres among them where they are far from the origin, which loses no
    digit, and a note on it."""
    origin = np.round(np.median(stream.position, axis=0)) if len(stream.position) else np.zeros(3)
    if not np.linalg.norm(origin) > FAR_M:
        return stream, ()
    x, y, z = origin
    return replace(stream, position=stream.position - origin), (
        f"{stream.name}: positions are relative to ({x:.0f}, {y:.0f}, {z:.0f}) m of its frame, whose origin is "
        "far away.",
    )


def _ordered(sensors: Sequence[_Named], streams: Sequence[T], where: str) -> tuple[T, ...]:
    by_name = {s.name: s for s in streams}
    known = [s.name for s in sensors]
    for name in by_name:
        if name not in known:
            raise RecordingError(
                f"{where} has a stream called {name}, but the rig has {' and '.join(known) or 'none'} of its "
                "kind; give it the sensor's name, or add the sensor to the rig."
            )
    if len(by_name) < len(streams):
        twice = next(s.name for k, s in enumerate(streams) if s.name in [t.name for t in streams[:k]])
        raise RecordingError(f"{where} has two streams of {twice}; give one.")
    return tuple(by_name[name] for name in known if name in by_name)
