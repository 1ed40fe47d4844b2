"""Rows of a sensor between nodes, into the normal equations: what factors share whose measurements lie between two
neighbouring nodes."""

from __future__ import annotations

from collections.abc import Iterator
from typing import NamedTuple

import numpy as np

from icalib.motion.factor import Whitened
from icalib.motion.imu_data import ImuData
from icalib.optim.arrowhead import Piece
from icalib.optim.interval_sums import Rows, accumulate_rows
from icalib.optim.robust_weights import LOSSES, Loss
from icalib.optim.state import Layout

# Rows of a factor that are made at once: their Jacobians stay in the processor's cache.
CHUNK = 256


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
    """The rows `own`, CHUNK at a time."""
    for start in range(own.start, own.stop, CHUNK):
        yield slice(start, min(start + CHUNK, own.stop))


def add_rows(
    rows: Rows,
    own: slice,
    node: np.ndarray,
    columns: np.ndarray,
    layout: Layout,
    imu: ImuData | None,
    by: RobustNoise,
    into: Into,
) -> float:
    """Adds the rows `own` of a factor, each to the interval that begins at its `node`, and fills `into.out`; returns
    half the robust chi^2. columns (c,): of the calibration parameters; those of the IMU's intrinsics follow where rows
    have them."""
    if imu is not None and rows.J_calib.shape[2] > len(columns):
        columns = np.concatenate([columns, layout.columns(imu.name, "intrinsics")])
    free = np.flatnonzero(columns >= 0)
    loss = Loss(LOSSES[by.loss], by.loss_scale, into.curved)
    return accumulate_rows(
        rows, node, by.whitening, loss, free, columns[free], into.piece.sums(into.sums), into.out.residual[own],
        into.out.root[own],
    )  # fmt: skip
