"""Rows of a sensor between keyframes, into the normal equations: what factors share whose measurements lie between two
neighbouring keyframes."""

from __future__ import annotations

from collections.abc import Iterator
from typing import NamedTuple

import numpy as np

from icalib.motion.factor import Whitened
from icalib.optim.arrowhead import Piece
from icalib.optim.robust_weights import LOSSES, Loss
from icalib.optim.rows import Rows, accumulate_rows

# Rows of a factor that are made at once: their Jacobians stay in the processor's cache.
ROWS_PER_CHUNK = 256


class Into(NamedTuple):
    """Where rows go, as `Factor.accumulate` is told."""

    piece: Piece
    out: Whitened
    sums: bool
    curved: bool


class RobustNoise(NamedTuple):
    """whitening (n, m, m) of the rows at hand; name and bend of the robust loss of each whitened row."""

    whitening: np.ndarray
    loss: str
    loss_scale: float


def in_chunks(own: slice) -> Iterator[slice]:
    """The rows `own`, ROWS_PER_CHUNK at a time."""
    for start in range(own.start, own.stop, ROWS_PER_CHUNK):
        yield slice(start, min(start + ROWS_PER_CHUNK, own.stop))


def rows_by_recording(
    keyframe: np.ndarray, starts: tuple[int, ...], n_keyframes: int, piece: Piece
) -> Iterator[tuple[int, slice]]:
    """The rows in `piece` of measurements at keyframes `keyframe` (n,), in order, ROWS_PER_CHUNK at a time: number of
    the recording, and its rows. Rows belong to intervals: those at the last keyframe, number n_keyframes - 1, go to the
    last interval. starts: the first keyframe of each recording."""
    edges = np.searchsorted(keyframe, (*starts, n_keyframes))
    low, high = np.searchsorted(np.minimum(keyframe, n_keyframes - 2), [piece.first, piece.last])
    for k in range(len(starts)):
        for some in in_chunks(slice(max(int(edges[k]), int(low)), min(int(edges[k + 1]), int(high)))):
            yield k, some


def add_rows(
    rows: Rows, own: slice, keyframe: np.ndarray, columns: np.ndarray, noise: RobustNoise, into: Into
) -> float:
    """Adds the rows `own` of a factor, each to the interval that begins at its keyframe `keyframe` (n,), and fills
    `into.out`; returns half the robust chi^2. columns (c,): calibration columns of rows.J, -1 where fixed."""
    loss = Loss(LOSSES[noise.loss], noise.loss_scale, into.curved)
    return accumulate_rows(
        rows, keyframe, noise.whitening, loss, columns, into.piece.sums(into.sums), into.out.residual[own],
        into.out.root[own],
    )  # fmt: skip
