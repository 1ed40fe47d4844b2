"""Feature tracks from the images of a recording: tracked on all cores, and cached for the next run.

Images are tracked in segments, each on one core; tracks end at the end of a segment. Segments depend only on the
recording, so the tracks do not depend on the number of cores.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import chain, islice

import numpy as np

from icalib.data.measurements import TrackStream
from icalib.data.recordings import DamagedImageError, Payload, Recording, decode
from icalib.detection.images import (
    Progress,
    batches_of,
    image_count,
    keep_arrays,
    load_kept,
    on_all_cores,
    stream_key,
    words_on_damaged,
)
from icalib.detection.tracking.tracker import Observations, Tracker
from icalib.errors import RecordingError
from icalib.rig import Camera
from icalib.sensors.camera.read.images import camera_images, image_topic
from icalib.sensors.camera.read.moving import moving_features
from icalib.sensors.camera.read.robot_parts import stay_in_place
from icalib.sensors.camera.read.stereo import matched

TRACKER_VERSION = 3  # of the tracker and of the cache; raise it with each change that changes tracks
# images of a segment, and most bytes of a segment that waits in memory; larger ones are tracked on one core
SEGMENT_IMAGES, SEGMENT_BYTES = 120, 128 << 20
LEAST_APART_NS = 35_000_000  # least interval between images with observations; images in between only help to track
FEWEST_VIEWS = 3  # images of a track, at least; two views of one point constrain the poses very little
FEWEST_IN_IMAGE = 12  # tracked points of an image, at least; fewer constrain the motion of the camera little
NOTED = 0.05  # share of rejected tracks above which a note tells of them
_COLUMNS = ("stamps_ns", "start", "feature", "uv", "views", "spread", "damaged_ns")
_COUNTS = ("moving", "in_place")


@dataclass(frozen=True)
class _TrackArrays:
    """Tracks of some images, in the form of `TrackStream`: stamps_ns (M,), start (M + 1,), feature, views, spread (N,)
    and uv (N, 2).

    moving: number of features that do not fit the motion of the camera; in_place: number of those that stay in place;
    damaged_ns (D,): stamps of images that cannot be decoded; error: the reason for the last of them, or "".
    """

    stamps_ns: np.ndarray
    start: np.ndarray
    feature: np.ndarray
    uv: np.ndarray
    views: np.ndarray
    spread: np.ndarray
    moving: int
    in_place: int
    damaged_ns: np.ndarray
    error: str = ""


def find_all_tracks(
    recording: Recording, cameras: Sequence[Camera], keep: bool = True, progress: Progress = lambda _: None
) -> list[tuple[TrackStream, tuple[str, ...]]]:
    """Feature tracks of each of the cameras, and sentences on rejected points. A feature number is the same point in
    all cameras; pairs of cameras with a common field of view share features. Raises RecordingError as `find_tracks`."""
    by_camera = []
    for k, camera in enumerate(cameras):
        by_camera.append(find_tracks(recording, camera, keep, lambda done, k=k: progress((k + done) / len(cameras))))
    first = np.cumsum([0, *(int(stream.feature.max(initial=-1)) + 1 for stream, _ in by_camera)])
    apart = [replace(stream, feature=stream.feature + n) for n, (stream, _) in zip(first, by_camera, strict=False)]
    return list(zip(matched(recording, cameras, apart), (notes for _, notes in by_camera), strict=True))


def find_tracks(
    recording: Recording, camera: Camera, keep: bool = True, progress: Progress = lambda _: None
) -> tuple[TrackStream, tuple[str, ...]]:
    """Feature tracks of all images of `camera`, numbered from 0, and sentences on images and points that were left out.

    With `keep`, tracks of an earlier run are loaded from the cache, and new ones are saved. Raises RecordingError if
    the camera has no images, their resolution is wrong, they cannot be read, or they show nothing to track.
    """
    topic, where = image_topic(recording, camera), recording.where(camera)
    files: dict[int, str] = {}
    key = stream_key(camera_images(recording, camera, files), f"tracks {TRACKER_VERSION}") if keep else ""
    kept = load_kept(key, (*_COLUMNS, *_COUNTS)) if keep else None
    if kept is not None:
        stamps_ns, start, feature, uv, views, spread, damaged_ns = (kept[name] for name in _COLUMNS)
        moving, in_place = (int(kept[name]) for name in _COUNTS)
        tracks = _TrackArrays(stamps_ns, start, feature, uv, views, spread, moving, in_place, damaged_ns)
    else:
        count, payloads = image_count(recording, topic), camera_images(recording, camera, files)
        tracks = _track(payloads, lambda n: progress(n / max(count, n)))
        if not len(tracks.stamps_ns):
            raise RecordingError(tracks.error or f"{where}: there are no images; check that the camera was running.")
        if keep:
            keep_arrays(key, {name: np.asarray(getattr(tracks, name)) for name in (*_COLUMNS, *_COUNTS)})
    stream = _stream(camera.name, tracks, where)
    return stream, tuple(f"{where}: {note}" for note in _notes(tracks, files))


def _track(payloads: Iterator[Payload], done: Callable[[int], None]) -> _TrackArrays:
    """Tracks of all images, in segments. done: called with the number of images so far."""
    parts: list[_TrackArrays] = []
    first = next(payloads, None)
    if first is None:
        return _joined(parts)
    payloads = chain([first], payloads)
    if len(first.data) * SEGMENT_IMAGES <= SEGMENT_BYTES:
        segments = on_all_cores(batches_of(payloads, SEGMENT_IMAGES, SEGMENT_BYTES), _track_segment)
    else:
        segments = _as_they_are_read(payloads)
    for part in segments:
        parts.append(part)
        done(sum(len(p.stamps_ns) for p in parts))
    return _joined(parts)


def _as_they_are_read(payloads: Iterator[Payload]) -> Iterator[_TrackArrays]:
    """Tracks of segments whose images are too large to wait in memory, on one core."""
    for first in payloads:
        yield _track_segment(chain([first], islice(payloads, SEGMENT_IMAGES - 1)))


def _track_segment(payloads: Iterable[Payload]) -> _TrackArrays:
    """Tracks of one segment, without features that move, stay in place, or are in fewer than FEWEST_VIEWS images."""
    tracker, error, size = Tracker(), "", (1, 1)
    stamps, observations, damaged = [], [], []
    for p in payloads:
        try:
            image = decode(p)
        except DamagedImageError as reason:
            damaged.append(p.stamp_ns)
            error = str(reason)
            continue
        size = image.shape[1], image.shape[0]
        if stamps and p.stamp_ns - stamps[-1] < LEAST_APART_NS:
            tracker.pass_over(image)
            continue
        stamps.append(p.stamp_ns)
        observations.append(tracker.add(image))
    tracks = _track_arrays(stamps, observations, damaged, error)
    good = np.bincount(tracks.feature) >= FEWEST_VIEWS
    in_place = good & stay_in_place(tracks.start, tracks.feature, tracks.uv)
    moving = good & ~in_place & moving_features(tracks.start, tracks.feature, tracks.uv, size)
    kept = _selected(tracks, (good & ~in_place & ~moving)[tracks.feature])
    return replace(kept, moving=int(moving.sum()), in_place=int(in_place.sum()))


def _track_arrays(
    stamps_ns: list[int], observations: list[Observations], damaged_ns: list[int], error: str
) -> _TrackArrays:
    """All observations of images at stamps_ns; damaged_ns and error as in `_Found`."""
    count = [len(s.feature) for s in observations]
    return _TrackArrays(
        np.array(stamps_ns, np.int64),
        np.cumsum([0, *count]).astype(np.int64),
        np.concatenate([np.zeros(0, np.int64), *(s.feature for s in observations)]),
        np.concatenate([np.zeros((0, 2)), *(s.uv for s in observations)]),
        np.concatenate([np.zeros(0, np.int64), *(s.views for s in observations)]),
        np.concatenate([np.zeros(0), *(s.spread for s in observations)]),
        0,
        0,
        np.array(damaged_ns, np.int64),
        error,
    )


def _selected(tracks: _TrackArrays, kept: np.ndarray) -> _TrackArrays:
    """The observations selected by the mask kept (N,)."""
    start = np.concatenate([[0], np.cumsum(kept)])[tracks.start].astype(np.int64)
    columns = {name: getattr(tracks, name)[kept] for name in ("feature", "uv", "views", "spread")}
    return replace(tracks, start=start, **columns)


def _joined(parts: Sequence[_TrackArrays]) -> _TrackArrays:
    """Tracks of the `parts` in sequence, with features renumbered to be unique."""
    none = np.zeros(0, np.int64)
    first = np.cumsum([0, *(int(p.feature.max(initial=-1)) + 1 for p in parts)])
    begin = np.cumsum([0, *(len(p.feature) for p in parts)])
    return _TrackArrays(
        np.concatenate([none, *(p.stamps_ns for p in parts)]),
        np.concatenate([none, *(b + p.start[:-1] for b, p in zip(begin, parts, strict=False)), begin[-1:]]),
        np.concatenate([none, *(f + p.feature for f, p in zip(first, parts, strict=False))]),
        np.concatenate([np.zeros((0, 2)), *(p.uv for p in parts)]),
        np.concatenate([none, *(p.views for p in parts)]),
        np.concatenate([np.zeros(0), *(p.spread for p in parts)]),
        sum(p.moving for p in parts),
        sum(p.in_place for p in parts),
        np.concatenate([none, *(p.damaged_ns for p in parts)]),
        next((p.error for p in reversed(parts) if p.error), ""),
    )


def _stream(name: str, tracks: _TrackArrays, where: str) -> TrackStream:
    """The tracks as a stream, without images that have no observation. Raises RecordingError if less than half of the
    images have FEWEST_IN_IMAGE tracked points."""
    count = np.diff(tracks.start)
    enough = int((count >= FEWEST_IN_IMAGE).sum())
    if 2 * enough < len(count):
        raise RecordingError(
            f"{where}: only {enough} of {len(count)} images have {FEWEST_IN_IMAGE} tracked points or more; "
            f"record with texture and light, or let {name} see a target."
        )
    kept = count > 0
    start = np.concatenate([[0], np.cumsum(count[kept])]).astype(np.int64)
    return TrackStream(
        name, tracks.stamps_ns[kept], start, tracks.feature, tracks.uv, views=tracks.views, spread=tracks.spread
    )


def _notes(tracks: _TrackArrays, files: dict[int, str]) -> Iterator[str]:
    """Sentences on damaged images, and on points that were rejected because they move or stay in place."""
    yield from words_on_damaged(tracks.damaged_ns.tolist(), files)
    count = len(np.unique(tracks.feature)) + tracks.moving + tracks.in_place
    if tracks.moving > NOTED * count:
        yield f"{tracks.moving} of {count} points do not fit a single motion of the camera and were rejected."
    if tracks.in_place > NOTED * count:
        yield (
            f"{tracks.in_place} of {count} points keep their place in the image while the camera turns, as if "
            "on the robot or on a dirty lens; they were rejected."
        )
