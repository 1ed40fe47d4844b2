"""Tracks: which features the estimate uses, and where each begins and ends.

A feature becomes one track or several. A track ends where the chain is cut, between recordings, and where the feature
was out of sight for long, because the cost of elimination grows with the length of tracks. Each track is a point of
its own, of unknown position; only the constraint between the tracks of one feature is lost.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from icalib.data.measurements import TrackStream

MIN_TRACK_OBSERVATIONS = 3  # two observations fit almost any pose


@dataclass(frozen=True)
class TrackNoise:
    """Noise of the tracks of one camera: sigma [px] per axis of the first view of a feature, and the growth of its
    variance with each later view n: sigma_n^2 = sigma^2 (1 + growth n)."""

    sigma: float
    growth: float = 0.0

    def of(self, stream: TrackStream) -> np.ndarray:
        """(N,) px: standard deviation of each observation per axis, the same for all if the tracker does not count
        views."""
        if not len(stream.views):
            return np.full(len(stream.uv), self.sigma)
        return self.sigma * np.sqrt(1.0 + self.growth * stream.views)


@dataclass(frozen=True)
class Tracks:
    """Tracks in the order of their first keyframes.

    By camera: track (N,), index for each observation, -1 without one; pair (N,), index of its pair. A pair is a track
    and one of its images: pair_track, pair_camera and pair_image (E,), in the order of keyframes. edges (S + 1,):
    keyframes at which all tracks end; tracks_from and pairs_from (S + 1,): the first behind each edge. The anchor of a
    track is the camera that observes it in the middle of its length: camera and image (T,); start (T, 3) m: initial
    point, in the frame of the anchor."""

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
        """(T,) the last edge before each track."""
        return self.edges[np.searchsorted(self.tracks_from, np.arange(self.count), side="right") - 1]

    def within(self, first: int, stop: int) -> tuple[slice, slice]:
        """Slices of the tracks and pairs between keyframes first and stop, which must be edges."""
        a, b = np.searchsorted(self.edges, [first, stop])
        return slice(*self.tracks_from[[a, b]].tolist()), slice(*self.pairs_from[[a, b]].tolist())


@dataclass(frozen=True)
class ObservationTable:
    """All N observations, camera by camera: feature, image of its camera, and keyframe (N,); used (N,) bool, whether
    they may be in a track; counts: number of observations of each camera."""

    feature: np.ndarray
    image: np.ndarray
    keyframe: np.ndarray
    used: np.ndarray
    counts: tuple[int, ...]

    def labels(self, seconds: np.ndarray, edges: np.ndarray, longest_gap: float) -> np.ndarray:
        """(N,) label of the track of each observation, -1 if not used. Tracks end at keyframes `edges`, and where a
        feature was out of sight for `longest_gap` [s]; seconds (K,): of the keyframes."""
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
        """(N,) labels numbered in the order of first keyframes; -1 for tracks with too few observations."""
        seen = label >= 0
        n = int(label.max(initial=-1)) + 1
        first = np.full(n, np.iinfo(np.int64).max)
        np.minimum.at(first, label[seen], self.keyframe[seen])
        left = np.bincount(label[seen], minlength=n) >= MIN_TRACK_OBSERVATIONS
        order = np.argsort(first, kind="stable")
        number = np.full(n + 1, -1)
        number[order[left[order]]] = np.arange(int(left.sum()))
        return number[label]

    def tracks(self, label: np.ndarray, edges: np.ndarray) -> Tracks:
        """Tracks of labels that are in order, with all initial points at zero."""
        seen, n = np.flatnonzero(label >= 0), int(label.max(initial=-1)) + 1
        pairs = seen[np.argsort(self.keyframe[seen], kind="stable")]
        pair = np.full(len(label), -1)
        pair[pairs] = np.arange(len(pairs))
        lives = pairs[np.argsort(label[pairs], kind="stable")]
        begins = np.searchsorted(label[lives], np.arange(n))
        middle = lives[begins + np.bincount(label[lives], minlength=n) // 2]
        tracks_from = np.searchsorted(self.keyframe[lives[begins]], edges)
        camera = np.repeat(np.arange(len(self.counts)), self.counts)
        own_track, own_pair = (tuple(np.split(a, np.cumsum(self.counts)[:-1])) for a in (label, pair))
        return Tracks(
            own_track, own_pair, label[pairs], camera[pairs], self.image[pairs], edges, tracks_from,
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
