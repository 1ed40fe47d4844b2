"""Which features the estimate uses, and where each begins and ends: tracks.

A feature of the scene becomes one track, or several: it is cut where the chain is cut, between recordings, and where
it was out of sight for long, because a track costs while it lives. Cutting loses what ties the parts together, and
nothing else: each part is a point of unknown position of its own.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from icalib.data.measurements import TrackStream

FEWEST = 3  # observations of a track; two images of one point are met by almost any pose


@dataclass(frozen=True)
class TrackNoise:
    """Noise of one camera's tracks: sigma [px] per axis of a feature's first view, and by how much its variance grows
    with each further view, over that of the first: sigma_n^2 = sigma^2 (1 + growth n)."""

    sigma: float
    growth: float = 0.0

    def of(self, stream: TrackStream) -> np.ndarray:
        """(N,) px: standard deviation of each observation per axis. It is the same for all where the tracker does not
        say how often it had seen a feature."""
        if not len(stream.views):
            return np.full(len(stream.uv), self.sigma)
        return self.sigma * np.sqrt(1.0 + self.growth * stream.views)


@dataclass(frozen=True)
class Tracks:
    """Tracks in the order of their first keyframes. By camera, of each observation: track (N,), -1 where it has none;
    pair (N,), of its track with its image.

    pair_track, pair_camera and pair_image (E,): what each pair joins, in the order of keyframes; edges (S + 1,):
    keyframes between which tracks are cut; tracks_from and pairs_from (S + 1,): the first of each stretch; start (T,
    3): where each point is first looked for, in the frame of the camera that saw it in the middle of its life; camera
    and image (T,): which that was."""

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
        """(T,) the edge behind which each track lies."""
        return self.edges[np.searchsorted(self.tracks_from, np.arange(self.count), side="right") - 1]

    def within(self, first: int, stop: int) -> tuple[slice, slice]:
        """Tracks and pairs of keyframes first..stop, both of them edges."""
        a, b = np.searchsorted(self.edges, [first, stop])
        return slice(*self.tracks_from[[a, b]].tolist()), slice(*self.pairs_from[[a, b]].tolist())


@dataclass(frozen=True)
class Sightings:
    """All observations, camera after camera: feature, image of the camera, and `keyframe` (N,); used (N,): whether they
    count; counts: how many of them each camera has."""

    feature: np.ndarray
    image: np.ndarray
    keyframe: np.ndarray
    used: np.ndarray
    counts: tuple[int, ...]

    def labels(self, seconds: np.ndarray, edges: np.ndarray, longest_gap: float) -> np.ndarray:
        """(N,) a number for each stretch of a feature's life, -1 for observations that do not count; `seconds` (K,) of
        the keyframes."""
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
        """(N,) the same labels, but for those with too few observations, numbered in the order of their first
        keyframes."""
        seen = label >= 0
        n = int(label.max(initial=-1)) + 1
        first = np.full(n, np.iinfo(np.int64).max)
        np.minimum.at(first, label[seen], self.keyframe[seen])
        left = np.bincount(label[seen], minlength=n) >= FEWEST
        order = np.argsort(first, kind="stable")
        number = np.full(n + 1, -1)
        number[order[left[order]]] = np.arange(int(left.sum()))
        return number[label]

    def tracks(self, label: np.ndarray, edges: np.ndarray) -> Tracks:
        """Of labels that are in order; where points are looked for is unknown as yet."""
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
