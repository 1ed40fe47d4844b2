"""Tracks: splits features into the tracks that the estimate uses.

A feature becomes one or several tracks. Tracks end where the chain of keyframes is cut, between recordings, and where
the feature is unobserved for long, because the cost of elimination grows with the length of tracks. Each track is
estimated as a separate point. Only the constraint that tracks of one feature are the same point is lost.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from icalib.data.measurements import TrackStream

MIN_TRACK_OBSERVATIONS = 3  # two observations hardly constrain the poses


@dataclass(frozen=True)
class TrackNoise:
    """Noise of the tracks of one camera: sigma_n^2 = sigma^2 (1 + growth n), with n earlier views of the feature.

    sigma [px]: standard deviation per axis of the first view; growth: relative increase of the variance per view."""

    sigma: float
    growth: float = 0.0

    def of(self, stream: TrackStream) -> np.ndarray:
        """(N,) px: standard deviation of each observation per axis; `sigma` for all if numbers of views are unknown."""
        if not len(stream.views):
            return np.full(len(stream.uv), self.sigma)
        return self.sigma * np.sqrt(1.0 + self.growth * stream.views)


@dataclass(frozen=True)
class Tracks:
    """Tracks in the order of their first keyframes.

    For each camera: track, pair (N,): index of the track and of the pair of each observation, -1 without a track. A
    pair is a track with one of its images: pair_track, pair_camera, pair_image (E,) are its indices, in the order of
    keyframes. edges (S + 1,): keyframes at which all tracks end; tracks_from, pairs_from (S + 1,): first track and pair
    after each edge. The anchor of a track is the image in the middle of its observations: camera, image (T,). start
    (T, 3) m: initial points, in the frames of the anchor cameras."""

    track: tuple[np.ndarray, ...]
    pair: tuple[np.ndarray, ...]
    pair_track: np.ndarray
    pair_camera: np.ndarray
    pair_image: np.ndarray
    edges: np.ndarray
    tracks_from: np.ndarray
    pairs_from: np.ndarray
    camera: np.ndarray
    image: np.ndarray
    start: np.ndarray

    @property
    def count(self) -> int:
        return len(self.start)

    def stretch_of(self) -> np.ndarray:
        """(T,) keyframe index of the last edge at or before the start of each track."""
        return self.edges[np.searchsorted(self.tracks_from, np.arange(self.count), side="right") - 1]

    def within(self, first: int, stop: int) -> tuple[slice, slice]:
        """Slices of the tracks and of the pairs between the keyframes `first` and `stop`, which must be edges."""
        a, b = np.searchsorted(self.edges, [first, stop])
        return slice(*self.tracks_from[[a, b]].tolist()), slice(*self.pairs_from[[a, b]].tolist())


@dataclass(frozen=True)
class ObservationTable:
    """All N observations of all cameras, camera by camera.

    feature, image, keyframe (N,): number of the feature, index of the image of its camera, index of the keyframe. used
    (N,) bool: whether the observation may be in a track; counts: number of observations of each camera."""

    feature: np.ndarray
    image: np.ndarray
    keyframe: np.ndarray
    used: np.ndarray
    counts: tuple[int, ...]

    def labels(self, seconds: np.ndarray, edges: np.ndarray, longest_gap: float) -> np.ndarray:
        """(N,) label of the track of each observation, -1 if not used.

        Tracks end at the keyframes `edges`, and where a feature is unobserved for longer than `longest_gap` [s].
        seconds (K,): times of the keyframes."""
        at = np.flatnonzero(self.used)
        order = at[np.lexsort((self.keyframe[at], self.feature[at]))]
        feature, keyframe = self.feature[order], self.keyframe[order]
        stretch = np.searchsorted(edges, keyframe, side="right")
        new = np.ones(len(order), dtype=bool)
        new[1:] = (np.diff(feature) != 0) | (np.diff(stretch) != 0) | (np.diff(seconds[keyframe]) > longest_gap)
        out = np.full(len(self.feature), -1)
        out[order] = np.cumsum(new) - 1
        return out

    def in_order(self, label: np.ndarray) -> np.ndarray:
        """The labels (N,), renumbered in the order of first keyframes; -1 for tracks with too few observations."""
        labelled = label >= 0
        n = int(label.max(initial=-1)) + 1
        first = np.full(n, np.iinfo(np.int64).max)
        np.minimum.at(first, label[labelled], self.keyframe[labelled])
        left = np.bincount(label[labelled], minlength=n) >= MIN_TRACK_OBSERVATIONS
        order = np.argsort(first, kind="stable")
        number = np.full(n + 1, -1)
        number[order[left[order]]] = np.arange(int(left.sum()))
        return number[label]

    def tracks(self, label: np.ndarray, edges: np.ndarray) -> Tracks:
        """The tracks of labels (N,) as `in_order` returns them, with all initial points at zero."""
        labelled, n = np.flatnonzero(label >= 0), int(label.max(initial=-1)) + 1
        pairs = labelled[np.argsort(self.keyframe[labelled], kind="stable")]
        pair = np.full(len(label), -1)
        pair[pairs] = np.arange(len(pairs))
        lives = pairs[np.argsort(label[pairs], kind="stable")]
        begins = np.searchsorted(label[lives], np.arange(n))
        middle = lives[begins + np.bincount(label[lives], minlength=n) // 2]
        tracks_from = np.searchsorted(self.keyframe[lives[begins]], edges)
        camera = np.repeat(np.arange(len(self.counts)), self.counts)
        track_by_camera, pair_by_camera = (tuple(np.split(a, np.cumsum(self.counts)[:-1])) for a in (label, pair))
        return Tracks(
            track_by_camera, pair_by_camera, label[pairs], camera[pairs], self.image[pairs], edges, tracks_from,
            np.searchsorted(self.keyframe[pairs], edges), camera[middle], self.image[middle], np.zeros((n, 3)),
        )  # fmt: skip


_NO_NUMBERS = np.zeros(0, dtype=np.int64)
_NO_EDGES = np.zeros(2, dtype=np.int64)
NO_TRACKS = Tracks(
    (),
    (),
    _NO_NUMBERS,
    _NO_NUMBERS,
    _NO_NUMBERS,
    _NO_EDGES,
    _NO_EDGES,
    _NO_EDGES,
    _NO_NUMBERS,
    _NO_NUMBERS,
    np.zeros((0, 3)),
)
