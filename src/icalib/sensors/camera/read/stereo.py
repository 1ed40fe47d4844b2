"""Stereo matching: a feature that two cameras see at about the same time becomes one feature of both.

Lucas-Kanade tracks each point from one image to the other and back; the patch is then aligned as between images of one
camera. This works for pairs of cameras with similar views. Matches that do not fit the epipolar geometry of the pair,
which is the same in all images, are left out.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import combinations
from typing import Any

import numpy as np

from icalib.base.extras import load_cv2
from icalib.data.measurements import TrackStream
from icalib.data.recordings import DamagedImageError, Payload, Recording, decode
from icalib.detection.images import on_all_cores
from icalib.detection.tracking.epipolar import FEWEST_MATCHED_POINTS
from icalib.detection.tracking.tracker import (
    ALIGNED_PX,
    BACK_PX,
    MIN_NCC,
    RADIUS,
    WINDOW_PX,
    align,
    cut_templates,
    prepared,
)
from icalib.rig import Camera
from icalib.sensors.camera.read.images import image_topic
from icalib.sensors.camera.read.moving import best_lambda, from_centre, misfits

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
