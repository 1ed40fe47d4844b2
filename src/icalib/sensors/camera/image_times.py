"""Images of cameras: a common list of images for corners and tracks, keyframes, and images in use."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from icalib.data.measurements import CornerStream, Measurements, TrackStream
from icalib.errors import EstimationError
from icalib.motion.imu_data import ImuData
from icalib.motion.poses import MERGED_WITHIN_S, assign_keyframes, usable
from icalib.optim.rows import grouped_quantiles
from icalib.optim.state import State
from icalib.rig import Rig, Scheme, Settings
from icalib.sensors.camera.corner_factor import CornerFactor, CornerOutput

_NONE = np.zeros(0, dtype=np.int64)


def on_common_images(rig: Rig, recording: Measurements) -> Measurements:
    """The recording with a corner stream and a track stream for each camera of `rig`, both with the same images.

    Either stream may have no observations. A recording without any tracks is returned unchanged. Raises
    EstimationError if there are tracks without an IMU, or naming a camera with neither corners nor tracks.
    """
    if not recording.tracks:
        return recording
    if recording.imu is None:
        raise EstimationError(
            "tracks need an IMU, a LiDAR or a pose sensor, for nothing else determines the scale; add one, or remove "
            "the tracks."
        )
    corners, tracks = {c.name: c for c in recording.cameras}, {t.name: t for t in recording.tracks}
    pairs = [_together(c.name, corners.get(c.name), tracks.get(c.name)) for c in rig.cameras]
    return recording.without(*(c.name for c in rig.cameras)).with_streams(
        *(stream for pair in pairs for stream in pair)
    )


def _together(name: str, corners: CornerStream | None, tracks: TrackStream | None) -> tuple[CornerStream, TrackStream]:
    """Both streams of one camera on the union of their images; None counts as empty. Raises EstimationError if both are
    empty."""
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
    """(M + 1,) start of the stream's rows of each image in `stamps` (M,) ns; images it lacks have no rows."""
    count = np.zeros(len(stamps), dtype=np.int64)
    count[np.searchsorted(stamps, stream.stamps_ns)] = np.diff(stream.start)
    return np.concatenate([[0], np.cumsum(count)])


def keyframes_of(
    scheme: Scheme, state: State, times: np.ndarray, images: list[slice], imu: ImuData | None
) -> np.ndarray:
    """(M,) index of the keyframe from which the pose of each image follows, in the same recording.

    times (M,) s: instants of the images; images: the range of images of each recording."""
    forwards, pairs = imu is not None and imu.forwards, zip(images, state.recordings, strict=True)
    return np.concatenate([assign_keyframes(scheme, state.seconds[k], times[i], forwards) + k.start for i, k in pairs])


def are_used(imu: ImuData | None, times: np.ndarray, keyframes: np.ndarray, max_gap_s: float) -> np.ndarray:
    """(M,) bool: images in use. With an IMU, those within its recording, outside gaps longer than `max_gap_s`. Without
    an IMU, those taken at their keyframe. times, keyframes (M,) s: instants of each image and of its keyframe."""
    if imu is None:
        return np.abs(times - keyframes) <= MERGED_WITHIN_S
    return usable(imu, times, max_gap_s)


# Rejects sets of images whose stamps are equal, but which were not exposed at the same time on a moving rig.
#
# Without an IMU, simultaneous images of several cameras share a keyframe, and so a pose of the rig. If the rig moved
# between their exposures, no pose fits all of them, even if each image alone fits the target. The median residual of
# an image is then far above that of the camera's other images.

MAX_MEDIAN_RATIO = 8.0  # median residual of an image over that of the median image; blur and lens misfit reach a few
MAX_REJECTED_SHARE = 0.2  # of the shared keyframes; if more do not fit, there is another cause, and none is rejected


def not_simultaneous(
    cameras: Sequence[CornerFactor], outputs: Sequence[CornerOutput], settings: Settings
) -> list[np.ndarray]:
    """For each camera (M,) bool: its images at shared keyframes with an image that does not fit.

    An image does not fit if its median residual is above `outlier_min_px` and above `MAX_MEDIAN_RATIO` times that of
    the camera's median image. All images of its keyframe are rejected, because the late one is not known.
    """
    shared = _shared_keyframes(cameras)
    bad = np.zeros(len(shared), dtype=bool)
    for camera, out in zip(cameras, outputs, strict=True):
        size = np.linalg.norm(out.residual, axis=1)  # a common error would compensate the shift of a late image
        medians = grouped_quantiles(size, camera.stream.image, len(camera.keyframe), 0.5)
        tested = shared[camera.keyframe] & np.isfinite(medians)
        if tested.any():
            limit = max(MAX_MEDIAN_RATIO * float(np.median(medians[tested])), settings.outlier_min_px)
            bad[camera.keyframe[tested & (medians > limit)]] = True
    if bad.sum() > MAX_REJECTED_SHARE * shared.sum():
        bad[:] = False
    return [bad[camera.keyframe] for camera in cameras]


def _shared_keyframes(cameras: Sequence[CornerFactor]) -> np.ndarray:
    """(K,) bool: keyframes with images of two or more cameras; keyframe K - 1 is the last one with an image."""
    count = np.zeros(1 + max(int(c.keyframe.max(initial=-1)) for c in cameras), dtype=np.int64)
    for camera in cameras:
        count[np.unique(camera.keyframe)] += 1
    return count > 1
