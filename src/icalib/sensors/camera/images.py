"""Corners and tracks of one camera on the same images, so that both share its instants, keyframes and poses."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from icalib.data.measurements import CornerStream, Measurements, TrackStream
from icalib.errors import EstimationError
from icalib.rig import Rig

_NONE = np.zeros(0, dtype=np.int64)


def on_common_images(rig: Rig, recording: Measurements) -> Measurements:
    """The recording with a stream of corners and one of tracks for each camera of `rig`, on the same images; either may
    be empty. Without any tracks it stays as it is.

    Raises EstimationError naming a camera that saw nothing, or tracks without an IMU and a target.
    """
    if not recording.tracks:
        return recording
    if recording.imu is None:
        raise EstimationError(
            "tracks need an IMU or a pose sensor, for nothing else determines the scale; add one, or remove the tracks."
        )
    corners, tracks = {c.name: c for c in recording.cameras}, {t.name: t for t in recording.tracks}
    pairs = [_together(c.name, corners.get(c.name), tracks.get(c.name)) for c in rig.cameras]
    return recording.without(*(c.name for c in rig.cameras)).with_streams(
        *(stream for pair in pairs for stream in pair)
    )


def _together(name: str, corners: CornerStream | None, tracks: TrackStream | None) -> tuple[CornerStream, TrackStream]:
    streams = [s for s in (corners, tracks) if s is not None and len(s.uv)]
    if not streams:
        raise EstimationError(f"{name} has neither corners nor tracks; check its fields in the rig file.")
    stamps = np.unique(np.concatenate([s.stamps_ns for s in streams]))
    no_uv, start = np.zeros((0, 2)), np.zeros(len(stamps) + 1, dtype=np.int64)
    on_corners = CornerStream(name, stamps, start, _NONE, no_uv)
    on_tracks = TrackStream(name, stamps, start, _NONE, no_uv)
    if corners is not None and len(corners.uv):
        on_corners = replace(corners, stamps_ns=stamps, start=_start(stamps, corners))
    if tracks is not None and len(tracks.uv):
        on_tracks = replace(tracks, stamps_ns=stamps, start=_start(stamps, tracks))
    return on_corners, on_tracks


def _start(stamps: np.ndarray, stream: CornerStream | TrackStream) -> np.ndarray:
    """(M + 1,) the stream's groups among the images at `stamps` (M,), empty where it has none."""
    count = np.zeros(len(stamps), dtype=np.int64)
    count[np.searchsorted(stamps, stream.stamps_ns)] = np.diff(stream.start)
    return np.concatenate([[0], np.cumsum(count)])
