"""Frames that stand still in the world of each recording, in which a sensor reports."""

from __future__ import annotations

from collections.abc import Sequence

from icalib.optim.state import Entry, in_recording
from icalib.rig import ParameterSpec, scene

FRAME = tuple(spec.name for spec in scene.FRAME)  # R_world_frame, p_world_frame


def frame_of(sensor: str, recording: int) -> str:
    """Owner of the blocks `FRAME` of a sensor, in one of several recordings, counted from 0."""
    return in_recording(f"frame of {sensor}", recording)


def frame_entries(
    sensor: str, n_recordings: int, estimated: bool = True, specs: Sequence[ParameterSpec] = scene.FRAME
) -> list[Entry]:
    """The frame of a sensor in each recording, by its `specs`; it is not `estimated` where it is the world's."""
    return [spec.entry(frame_of(sensor, k), estimated) for k in range(n_recordings) for spec in specs]
