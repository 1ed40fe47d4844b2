"""Reads and checks the measurements of all sensors of a rig from a recording."""

from __future__ import annotations

from dataclasses import replace

from icalib.data.measurements import Measurements
from icalib.data.recordings.base import Progress, Reading, Recording
from icalib.data.stamps.jumps import LONGEST_S, ClockJumps
from icalib.data.stamps.sections import S
from icalib.rig import Rig
from icalib.sensors import SENSOR_KINDS, facet


def read_measurements(recording: Recording, rig: Rig, progress: Progress = lambda *_: None) -> Measurements:
    """Read and check the streams of all sensors of `rig` from `recording`. If a sensor recorded images, target corners
    or feature tracks are detected in them.

    Clock jumps split a stream; one segment is used. Notes list rejected data. Raises RecordingError, naming the file
    and line or instant, for data that are missing, unreadable, unordered, in wrong units, or not of this rig.
    """
    progress("reading", 0.0)
    recording.use_layouts(tuple(rig.sensors.values()))
    jumps = ClockJumps(LONGEST_S)
    reading = Reading(rig, _uncut if rig.cameras_alone else jumps.cut, progress)
    streams = []
    for kind in SENSOR_KINDS:
        sensors = [s for s in rig.sensors.values() if s.sensor_type == kind]
        streams += facet(kind, "read").read(recording, sensors, reading) if sensors else []
    notes = sum((sentences for _, sentences in streams), recording.notes() + jumps.notes)
    return Measurements.of_streams(*(stream for stream, _ in streams), notes=notes)


def without_jumps(rig: Rig, measurements: Measurements) -> Measurements:
    """Measurements in memory without clock jumps, as `read_measurements` removes them from files."""
    m, jumps = measurements, ClockJumps(LONGEST_S)
    if rig.cameras_alone:  # stamps only match images of different cameras
        return m
    streams = {key: jumps.cut(s, s.name) for key, s in m.streams.items()}
    return replace(m, streams=streams, notes=m.notes + jumps.notes) if jumps.notes else m


def _uncut(stream: S, what: str) -> S:
    del what
    return stream
