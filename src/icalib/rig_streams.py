"""Whether measurements made in memory are those of the rig; what is read from files is so already."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Protocol, TypeVar

from icalib.errors import RecordingError
from icalib.measurements import Measurements
from icalib.rig import Rig


class _Named(Protocol):
    @property
    def name(self) -> str: ...


T = TypeVar("T", bound=_Named)


def streams_of_rig(rig: Rig, measurements: Measurements) -> Measurements:
    """The same streams in the order of the rig's sensors. A camera has corners or tracks, or both.

    Raises RecordingError where a sensor of the rig has no stream, or a stream is of no such sensor of the rig.
    """
    m, where = measurements, measurements.name or "the recording"
    _ordered(() if rig.imu is None else (rig.imu,), () if m.imu is None else (m.imu,), where)
    if rig.imu is not None and m.imu is None:
        raise RecordingError(f"{where} has no readings of {rig.imu.name}; add them, or take it out of the rig.")
    cameras, tracks = _ordered(rig.cameras, m.cameras, where), _ordered(rig.cameras, m.tracks, where)
    seeing = {s.name for s in (*cameras, *tracks)}
    lidars, wheels = _ordered(rig.lidars, m.lidars, where), _ordered(rig.wheels, m.wheels, where)
    poses = _ordered(rig.poses, m.poses, where)
    given = seeing.union(s.name for s in (*lidars, *wheels, *poses))
    missing = [s.name for s in (*rig.cameras, *rig.lidars, *rig.wheels, *rig.poses) if s.name not in given]
    if missing:
        raise RecordingError(
            f"{where} has nothing of {' and '.join(missing)}; add what was measured, or take it out of the rig."
        )
    return replace(m, cameras=cameras, tracks=tracks, lidars=lidars, wheels=wheels, poses=poses)


def _ordered(sensors: Sequence[_Named], streams: Sequence[T], where: str) -> tuple[T, ...]:
    by_name = {s.name: s for s in streams}
    known = [s.name for s in sensors]
    for name in by_name:
        if name not in known:
            raise RecordingError(
                f"{where} has a stream called {name}, but the rig has {' and '.join(known) or 'none'} of its kind; "
                "give it the sensor's name, or add the sensor to the rig."
            )
    if len(by_name) < len(streams):
        twice = next(s.name for k, s in enumerate(streams) if s.name in [t.name for t in streams[:k]])
        raise RecordingError(f"{where} has two streams of {twice}; give one.")
    return tuple(by_name[name] for name in known if name in by_name)
