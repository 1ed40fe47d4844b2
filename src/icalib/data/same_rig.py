"""Checks that measurements made in memory have a stream for each sensor of the rig. Readers of files ensure this."""

from __future__ import annotations

from dataclasses import replace

from icalib.data.measurements import Measurements
from icalib.errors import RecordingError
from icalib.rig import Rig


def streams_of_rig(rig: Rig, measurements: Measurements) -> Measurements:
    """The streams in the order of the rig's sensors. A camera has corners, feature tracks, or both.

    Positions far from the origin of their frame, such as UTM coordinates, are shifted close to it, with a note. Raises
    RecordingError if a sensor has no stream, or a stream belongs to no sensor of its kind in the rig.
    """
    m, where = measurements, measurements.name or "the recording"
    for stream in m.streams.values():
        alike = [s.name for s in rig.sensors.values() if s.sensor_type == stream.sensor_type]
        if stream.name not in alike:
            raise RecordingError(
                f"{where} has a stream called {stream.name}, but the rig has {' and '.join(alike) or 'none'} of its "
                "kind; give it the sensor's name, or add the sensor to the rig."
            )
    given = {s.name for s in m.streams.values()}
    missing = [name for name in rig.sensors if name not in given]
    if missing:
        raise RecordingError(
            f"{where} has no data of {' and '.join(missing)}; add the measurements, or remove it from the rig."
        )
    ordered = {s.key: s for name in rig.sensors for s in m.streams.values() if s.name == name}
    return _near_origin(rig, replace(m, streams=ordered))


def _near_origin(rig: Rig, measurements: Measurements) -> Measurements:
    """The measurements with positions near the origin of their frame. Sensors that share a frame are shifted
    together."""
    owner = {name: sensor.shared_frame or name for name, sensor in rig.sensors.items()}
    far = ((s.name, s.better_origin()) for s in measurements.streams.values())
    origins = {name: origin for name, origin in far if origin is not None}
    streams, notes = dict(measurements.streams), measurements.notes
    for key, stream in measurements.streams.items():
        origin = origins.get(owner[stream.name])
        if origin is None:
            continue
        streams[key] = stream.relative_to(origin)
        x, y, z = origin
        where = f"({x:.0f}, {y:.0f}, {z:.0f}) m of its frame, whose origin is far away"
        notes += (f"{stream.name}: positions are relative to {where}.",)
    return replace(measurements, streams=streams, notes=notes)
