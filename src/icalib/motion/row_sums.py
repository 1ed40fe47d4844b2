"""Adds measurement rows between neighbouring keyframes to the normal equations."""

from __future__ import annotations

from collections.abc import Iterator
from typing import NamedTuple

import numpy as np

from icalib.motion.factor import Whitened
from icalib.optim.arrowhead import Piece
from icalib.optim.robust_weights import LOSSES, Loss
from icalib.optim.rows import Rows, accumulate_rows

# Rows whose Jacobians are computed at once: these fit the processor's cache.
ROWS_PER_CHUNK = 256


class Into(NamedTuple):
    """Target of `add_rows`: the arguments of `Factor.accumulate`."""

    piece: Piece
    out: Whitened
    sums: bool
    curved: bool


class RobustNoise(NamedTuple):
    """Noise of n measurements of m rows. whitening (n, m, m): lower triangular; name and scale of the robust loss of
    each whitened row."""

    whitening: np.ndarray
    loss: str
    loss_scale: float


def in_chunks(rows: slice) -> Iterator[slice]:
    """Slices of at most ROWS_PER_CHUNK rows that make up `rows`."""
    for start in range(rows.start, rows.stop, ROWS_PER_CHUNK):
        yield slice(start, min(start + ROWS_PER_CHUNK, rows.stop))


def rows_by_recording(
    keyframe: np.ndarray, starts: tuple[int, ...], n_keyframes: int, piece: Piece
) -> Iterator[tuple[int, slice]]:
    """Rows in `piece`, at most ROWS_PER_CHUNK at a time, each slice with the number of its recording.

    keyframe (n,), sorted: of each measurement; starts: first keyframe of each recording. Rows belong to intervals, so
    those at the last keyframe, n_keyframes - 1, go to the last interval.
    """
    edges = np.searchsorted(keyframe, (*starts, n_keyframes))
    low, high = np.searchsorted(np.minimum(keyframe, n_keyframes - 2), [piece.first, piece.last])
    for k in range(len(starts)):
        for some in in_chunks(slice(max(int(edges[k]), int(low)), min(int(edges[k + 1]), int(high)))):
            yield k, some


def add_rows(
    rows: Rows, chunk: slice, keyframe: np.ndarray, columns: np.ndarray, noise: RobustNoise, into: Into
) -> float:
    """Adds the rows `chunk` of a factor, each to the interval that begins at its `keyframe` (n,), and fills `into.out`.
    Returns half the robust chi^2. columns (c,): calibration columns of rows.J, -1 where fixed."""
    loss = Loss(LOSSES[noise.loss], noise.loss_scale, into.curved)
    return accumulate_rows(
        rows, keyframe, noise.whitening, loss, columns, into.piece.sums(into.sums), into.out.residual[chunk],
        into.out.root[chunk],
    )  # fmt: skip
