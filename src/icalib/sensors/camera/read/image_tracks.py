"""Feature tracks from images: tracked on all cores, matched in stereo, without what moves or belongs to the robot."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import chain, combinations, islice
from typing import Any

import numpy as np
from scipy.spatial import KDTree

from icalib.base.extras import load_cv2
from icalib.base.remark import Remark
from icalib.data.measurements import TrackStream
from icalib.data.recordings import DamagedImageError, Payload, Recording, decode
from icalib.detection.images import (
    Progress,
    SeenImages,
    batches_of,
    image_count,
    keep_arrays,
    load_kept,
    on_all_cores,
    stream_key,
    words_on_damaged,
)
from icalib.detection.tracker import (
    ALIGNED_PX,
    BACK_PX,
    FEWEST_MATCHED_POINTS,
    MIN_NCC,
    RADIUS,
    WINDOW_PX,
    Observations,
    Tracker,
    align,
    cut_templates,
    epipolar_errors,
    prepared,
)
from icalib.errors import RecordingError
from icalib.rig import Camera
from icalib.sensors.camera.read.detected_corners import camera_images, image_topic
from icalib.sensors.camera.stream import shared_rows

# Feature tracks from the images of a recording: tracked on all cores, and cached for the next run.
#
# Images are tracked in segments, each on one core; tracks end at the end of a segment. Segments depend only on the
# recording, so the tracks do not depend on the number of cores.

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
    recording: Recording,
    cameras: Sequence[Camera],
    keep: bool = True,
    progress: Progress = lambda _: None,
    pictures: int = 0,
) -> list[tuple[TrackStream, tuple[Remark, ...]]]:
    """Feature tracks of each of the cameras, and sentences on rejected points. A feature number is the same point in
    all cameras; pairs of cameras with a common field of view share features. Raises RecordingError as `find_tracks`."""
    by_camera = []
    for k, camera in enumerate(cameras):
        show = lambda done, k=k: progress((k + done) / len(cameras))  # noqa: E731
        by_camera.append(find_tracks(recording, camera, keep, show, pictures))
    first = np.cumsum([0, *(int(stream.feature.max(initial=-1)) + 1 for stream, _ in by_camera)])
    apart = [replace(stream, feature=stream.feature + n) for n, (stream, _) in zip(first, by_camera, strict=False)]
    return list(zip(matched(recording, cameras, apart), (notes for _, notes in by_camera), strict=True))


def find_tracks(
    recording: Recording,
    camera: Camera,
    keep: bool = True,
    progress: Progress = lambda _: None,
    pictures: int = 0,
) -> tuple[TrackStream, tuple[Remark, ...]]:
    """Feature tracks of all images of `camera`, numbered from 0, and sentences on images and points that were left out.

    With `keep`, tracks of an earlier run are loaded from the cache, and new ones are saved. pictures: most images that
    the stream keeps to be shown. Raises RecordingError if the camera has no images, their resolution is wrong, they
    cannot be read, or they show nothing to track.
    """
    topic, where = image_topic(recording, camera), recording.where(camera)
    count = image_count(recording, topic)
    seen = SeenImages(count, pictures)
    key = stream_key(camera_images(recording, camera, seen), f"tracks {TRACKER_VERSION}") if keep else ""
    kept = load_kept(key, (*_COLUMNS, *_COUNTS)) if keep else None
    if kept is not None:
        stamps_ns, start, feature, uv, views, spread, damaged_ns = (kept[name] for name in _COLUMNS)
        moving, in_place = (int(kept[name]) for name in _COUNTS)
        tracks = _TrackArrays(stamps_ns, start, feature, uv, views, spread, moving, in_place, damaged_ns)
    else:
        payloads = camera_images(recording, camera, seen)
        tracks = _track(payloads, lambda n: progress(n / max(count, n)))
        if not len(tracks.stamps_ns):
            raise RecordingError(tracks.error or f"{where}: there are no images; check that the camera was running.")
        if keep:
            keep_arrays(key, {name: np.asarray(getattr(tracks, name)) for name in (*_COLUMNS, *_COUNTS)})
    stream = replace(_stream(camera.name, tracks, where), pictures=seen.pictures)
    return stream, tuple(note.with_sentence(f"{where}: {note}") for note in _notes(tracks, seen.files))


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


def _notes(tracks: _TrackArrays, files: dict[int, str]) -> Iterator[Remark]:
    """Sentences on damaged images, and on points that were rejected because they move or stay in place."""
    yield from words_on_damaged(tracks.damaged_ns.tolist(), files)
    count = len(np.unique(tracks.feature)) + tracks.moving + tracks.in_place
    if tracks.moving > NOTED * count:
        sentence = f"{tracks.moving} of {count} points do not fit a single motion of the camera and were rejected."
        yield Remark("tracked_points_moving", sentence)
    if tracks.in_place > NOTED * count:
        yield Remark(
            "tracked_points_fixed_in_image",
            f"{tracks.in_place} of {count} points keep their place in the image while the camera turns, as if "
            "on the robot or on a dirty lens; they were rejected.",
        )


# Stereo matching: a feature that two cameras see at about the same time becomes one feature of both.
#
# Lucas-Kanade tracks each point from one image to the other and back; the patch is then aligned as between images of
# one camera. This works for pairs of cameras with similar views. Matches that do not fit the epipolar geometry of the
# pair, which is the same in all images, are left out.

MATCHED_EVERY_S = 0.25  # between matched images; features are tracked for about a second
MOST_APART_S = 0.05  # between both images, at most
STEREO_PYRAMID_LEVEL = 4  # for disparities of up to 160 px
FEWEST_MATCHES = 100  # in a recording, at least; fewer may be wrong matches
LEAST_SHARED_FEATURES = 0.1  # least share of the tried features
# Largest standard deviation of matches from their epipolar lines. It is larger for wrong matches, or for two lenses of
# different kinds.
MOST_EPIPOLAR_SIGMA_PX = 1.0


@dataclass(frozen=True)
class _Matches:
    """Matches of two cameras: row (N,) in the stream of the first; image (N,) of the second, and uv (N, 2) px there;
    tried: number of rows that were tried."""

    row: np.ndarray
    image: np.ndarray
    uv: np.ndarray
    tried: int


def matched(recording: Recording, cameras: Sequence[Camera], streams: Sequence[TrackStream]) -> tuple[TrackStream, ...]:
    """The streams, with observations of features of other cameras added. Before, the streams must not share feature
    numbers.

    Only pairs of cameras of equal resolution are tried. Pairs that share hardly any features stay unchanged.
    """
    extended = list(streams)
    for i, j in combinations(range(len(cameras)), 2):
        if cameras[i].resolution == cameras[j].resolution:
            extended[j] = _with_features_of(recording, (cameras[i], cameras[j]), (streams[i], streams[j]), extended[j])
    return tuple(extended)


def _with_features_of(
    recording: Recording, cameras: tuple[Camera, Camera], streams: tuple[TrackStream, TrackStream], into: TrackStream
) -> TrackStream:
    """The stream `into` of the second camera, with its observations of the first camera's features added. streams: of
    both cameras, as tracked."""
    pairs = _pairs(*streams)
    payloads = _payload_pairs(recording, cameras, streams, pairs)
    parts = list(on_all_cores(payloads, lambda job: _match(*job, streams[0])))
    if not parts:
        return into
    row, image = (np.concatenate([getattr(p, name) for p in parts]) for name in ("row", "image"))
    uv, tried = np.concatenate([p.uv for p in parts]), sum(p.tried for p in parts)
    good = _consistent(streams[0].uv[row], uv, cameras[0].resolution)
    if good.sum() < max(FEWEST_MATCHES, LEAST_SHARED_FEATURES * tried):
        return into
    return _inserted(into, image[good], streams[0].feature[row[good]], uv[good], streams[0], row[good])


def _pairs(first: TrackStream, second: TrackStream) -> list[tuple[int, int]]:
    """Indices of images of both cameras that are near in time, one pair every MATCHED_EVERY_S."""
    at = first.stamps_ns
    j = np.clip(np.searchsorted(second.stamps_ns, at), 1, max(len(second.stamps_ns) - 1, 1))
    j = np.where(np.abs(second.stamps_ns[j - 1] - at) <= np.abs(second.stamps_ns[j] - at), j - 1, j)
    near = np.abs(second.stamps_ns[j] - at) <= MOST_APART_S * 1e9
    slot = np.floor((at - at[0]) * 1e-9 / MATCHED_EVERY_S).astype(np.int64)
    chosen = np.flatnonzero(near)
    chosen = chosen[np.unique(slot[chosen], return_index=True)[1]]
    chosen = chosen[np.unique(j[chosen], return_index=True)[1]]  # an image has a feature once
    return [(int(i), int(j[i])) for i in chosen]


def _payload_pairs(
    recording: Recording,
    cameras: tuple[Camera, Camera],
    streams: tuple[TrackStream, TrackStream],
    pairs: list[tuple[int, int]],
) -> Iterator[tuple[Payload, Payload, int, int]]:
    """The images of the pairs, and their indices."""
    first, second = (
        _with_stamps(recording, camera, {int(stream.stamps_ns[pair[k]]) for pair in pairs})
        for k, (camera, stream) in enumerate(zip(cameras, streams, strict=True))
    )
    for (i, j), a, b in zip(pairs, first, second, strict=True):
        yield a, b, i, j


def _with_stamps(recording: Recording, camera: Camera, stamps_ns: set[int]) -> Iterator[Payload]:
    """The images of the camera with these stamps."""
    return (p for p in recording.payloads(image_topic(recording, camera)) if p.stamp_ns in stamps_ns)


def _match(a: Payload, b: Payload, i: int, j: int, stream: TrackStream) -> _Matches:
    """Features of image i of `stream`, whose data are `a`, found in image j of the other camera, whose data are `b`."""
    cv2: Any = load_cv2()
    rows = np.arange(stream.start[i], stream.start[i + 1])
    none = _Matches(rows[:0], rows[:0], np.zeros((0, 2)), len(rows))
    try:
        first, second = decode(a), decode(b)
    except DamagedImageError:
        return none
    edge = RADIUS + 2
    inside = ((stream.uv[rows] > edge) & (stream.uv[rows] < np.array(first.shape[::-1]) - edge - 1)).all(axis=1)
    rows = rows[inside]
    if not len(rows):
        return none
    even, smooth = zip(prepared(first), prepared(second), strict=True)
    before = stream.uv[rows].astype(np.float32)
    size = (WINDOW_PX, WINDOW_PX)
    after, status, _ = cv2.calcOpticalFlowPyrLK(
        even[0], even[1], before, None, winSize=size, maxLevel=STEREO_PYRAMID_LEVEL
    )
    back, back_status, _ = cv2.calcOpticalFlowPyrLK(
        even[1], even[0], after, None, winSize=size, maxLevel=STEREO_PYRAMID_LEVEL
    )
    good = (status.ravel() > 0) & (back_status.ravel() > 0) & (np.linalg.norm(back - before, axis=1) < BACK_PX)
    pixels = np.rint(stream.uv[rows])
    templates, textured = cut_templates(smooth[0], pixels)
    A, ncc = np.tile(np.eye(2), (len(rows), 1, 1)), np.full(len(rows), -1.0)
    uv = after.astype(np.float64) + pixels - stream.uv[rows]
    align(smooth[1], templates, uv, A, ncc)
    uv = uv + np.einsum("nij,nj->ni", A, stream.uv[rows] - pixels)
    good &= textured & (ncc > MIN_NCC) & (np.linalg.norm(uv - after, axis=1) < ALIGNED_PX)
    return _Matches(rows[good], np.full(int(good.sum()), j), uv[good], len(rows))


def _consistent(p: np.ndarray, q: np.ndarray, resolution: tuple[int, int]) -> np.ndarray:
    """(n,) bool: matches that fit the common epipolar geometry of the pair of cameras."""
    if len(p) < FEWEST_MATCHED_POINTS:
        return np.zeros(len(p), dtype=bool)
    (x, half_px), (y, _) = from_centre(p, resolution), from_centre(q, resolution)
    wrong, sigma_px = misfits(x, y, best_lambda([(x, y)]), half_px, 0)
    return ~wrong & (sigma_px <= MOST_EPIPOLAR_SIGMA_PX)


def _inserted(
    stream: TrackStream, image: np.ndarray, feature: np.ndarray, uv: np.ndarray, source: TrackStream, row: np.ndarray
) -> TrackStream:
    """The stream with further observations added; their views and spread are those of the camera that tracked the
    features."""
    images = np.concatenate([stream.image, image])
    order = np.argsort(images, kind="stable")
    start = np.concatenate([[0], np.cumsum(np.bincount(images, minlength=len(stream.stamps_ns)))]).astype(np.int64)
    return replace(
        stream,
        start=start,
        feature=np.concatenate([stream.feature, feature])[order],
        uv=np.concatenate([stream.uv, uv])[order],
        views=np.concatenate([stream.views, source.views[row]])[order],
        spread=np.concatenate([stream.spread, source.spread[row]])[order],
    )


# Detects features that do not fit the motion of the camera: people, other vehicles, wrong matches.

COMPARED_IMAGES = (1, 4)  # each image is compared with those that are this many images earlier
LENS_APART, LENS_PAIRS = 6, 8  # images apart, and number, of the pairs from which the distortion is estimated
# Candidates of the distortion, for points in units of half the image diagonal; 0 is a lens without distortion, -1 one
# that sees half a sphere at the image corners.
LAMBDAS = (-1.2, -1.0, -0.8, -0.6, -0.45, -0.3, -0.2, -0.1, 0.0, 0.1, 0.2)
# standard deviations, and px, the larger of both: error above which a point does not fit
TIMES_SIGMA, LEAST_PX = 4.0, 1.0
# share of a feature's comparisons that may fail: a moving point fails most, a single wrong match up to four
MOST_MISFIT_SHARE = 1.0 / 3.0


def moving_features(start: np.ndarray, feature: np.ndarray, uv: np.ndarray, resolution: tuple[int, int]) -> np.ndarray:
    """(F,) bool, by feature number: whether it does not fit the epipolar geometry of most points in more than a third
    of its comparisons.

    start (M + 1,), feature (N,), uv (N, 2) px as in `TrackStream`, features numbered from 0; resolution (width,
    height).
    """
    n = int(feature.max(initial=-1)) + 1
    xy, half_px = from_centre(uv, resolution)
    lam = _lambda(start, feature, xy)
    tried, failed = np.zeros(n, dtype=np.int64), np.zeros(n, dtype=np.int64)
    for apart in COMPARED_IMAGES:
        for k in range(apart, len(start) - 1):
            before, after = shared_rows(start, feature, k - apart, k)
            if len(before) < FEWEST_MATCHED_POINTS:
                continue
            wrong, _ = misfits(xy[before], xy[after], lam, half_px, k)
            tried[feature[before]] += 1
            failed[feature[before[wrong]]] += 1
    return failed > MOST_MISFIT_SHARE * tried


def from_centre(uv: np.ndarray, resolution: tuple[int, int]) -> tuple[np.ndarray, float]:
    """Pixels uv (n, 2) relative to the image centre, in units of half the image diagonal; and this unit [px]."""
    half_px = 0.5 * float(np.hypot(*resolution))
    return (uv - 0.5 * (np.array(resolution) - 1.0)) / half_px, half_px


def misfits(p: np.ndarray, q: np.ndarray, lam: float, half_px: float, seed: int) -> tuple[np.ndarray, float]:
    """(n,) bool: points p and q (n, 2), as of `from_centre`, that do not fit the epipolar geometry of most; and the
    standard deviation [px] of the errors."""
    error, sigma = epipolar_errors(p, q, lam, seed)
    return error > max(TIMES_SIGMA * sigma, LEAST_PX / half_px), sigma * half_px


def _lambda(start: np.ndarray, feature: np.ndarray, xy: np.ndarray) -> float:
    """The distortion (lambda of the division model) with the least mean error over LENS_PAIRS pairs of images."""
    firsts = np.unique(np.linspace(0, max(len(start) - 2 - LENS_APART, 0), LENS_PAIRS).astype(int))
    pairs = [
        shared_rows(start, feature, int(k), int(k) + LENS_APART) for k in firsts if k + LENS_APART < len(start) - 1
    ]
    return best_lambda([(xy[p], xy[q]) for p, q in pairs if len(p) >= FEWEST_MATCHED_POINTS])


def best_lambda(pairs: list[tuple[np.ndarray, np.ndarray]]) -> float:
    """The distortion with the least mean error over `pairs` of point arrays (n, 2) in two images; 0 without pairs."""
    size = [sum(epipolar_errors(p, q, lam, 0)[1] for p, q in pairs) for lam in LAMBDAS]
    return LAMBDAS[int(np.argmin(size))] if pairs else 0.0


# Detects points on the robot itself, or on the lens: they stay in place in the image while the scene moves.

SCENE_MOVES_PX = 10.0  # least motion of the scene over a track, common to all points, as if the camera turns
STAYS_PX = 1.0  # largest motion of a point in place, by noise and vibration
NEAR_ROBOT_PX = 64.0  # a short track without motion is in place, too, if it is this near to a point in place


def stay_in_place(start: np.ndarray, feature: np.ndarray, uv: np.ndarray) -> np.ndarray:
    """(F,) whether each feature stays in place in the image, from its first view to its last, while the scene moves.

    start (M + 1,), feature (N,) and uv (N, 2) px as in `TrackStream`, features numbered from 0. The motion of the scene
    is the median motion of the points, for each component. A rotation of the camera moves all points alike. Forward
    motion has a median near zero, so that points straight ahead are not mistaken for points on the robot. Tracks that
    are too short to decide are in place if they are near others in place.
    """
    n = int(feature.max(initial=-1)) + 1
    image = np.repeat(np.arange(len(start) - 1), np.diff(start))
    order = np.lexsort((image, feature))
    follows = (np.diff(feature[order]) == 0) & (np.diff(image[order]) == 1)
    before, after = order[:-1][follows], order[1:][follows]
    travelled, flow, into = np.zeros((len(start) - 1, 2)), uv[after] - uv[before], image[after]
    for k in np.unique(into):
        travelled[k] = np.median(flow[into == k], axis=0)
    travelled = np.cumsum(travelled, axis=0)
    first, last = _ends(feature[order], n)
    moved = np.linalg.norm((travelled[image[order[last]]] - travelled[image[order[first]]]), axis=1)
    low, high = np.full((n, 2), np.inf), np.full((n, 2), -np.inf)
    np.minimum.at(low, feature, uv)
    np.maximum.at(high, feature, uv)
    stays = np.linalg.norm(np.where(np.isfinite(high), high - low, np.inf), axis=1) < STAYS_PX
    in_place = stays & (moved > SCENE_MOVES_PX)
    if in_place.any():
        still = np.flatnonzero(stays)
        distance, _ = KDTree(low[in_place]).query(low[still])
        in_place[still[distance < NEAR_ROBOT_PX]] = True
    return in_place


def _ends(feature: np.ndarray, n: int) -> tuple[np.ndarray, np.ndarray]:
    """(n,) the first and the last row of each feature in the sorted feature (N,); row 0 for a feature without rows."""
    begin, end = np.searchsorted(feature, np.arange(n)), np.searchsorted(feature, np.arange(n), side="right")
    has_rows = end > begin
    return np.where(has_rows, begin, 0), np.where(has_rows, end - 1, 0)
