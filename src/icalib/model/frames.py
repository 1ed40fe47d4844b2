"""Reference frames of sensors that report poses or positions. They are fixed in the world of each recording."""

from __future__ import annotations

from collections.abc import Sequence

from icalib.optim.state import Entry, in_recording
from icalib.rig import ParameterSpec, scene

FRAME = tuple(spec.name for spec in scene.FRAME)  # R_world_frame, p_world_frame


def frame_of(sensor: str, recording: int) -> str:
    """Name of a sensor's reference frame in a `recording` (counted from 0): the first part of the keys of the blocks
    `FRAME`."""
    return in_recording(f"frame of {sensor}", recording)


def frame_entries(
    sensor: str, n_recordings: int, estimated: bool = True, specs: Sequence[ParameterSpec] = scene.FRAME
) -> list[Entry]:
    """Layout entries of a sensor's reference frame in each recording. estimated: False if the frame is the world
    frame."""
    return [spec.entry(frame_of(sensor, k), estimated) for k in range(n_recordings) for spec in specs]
