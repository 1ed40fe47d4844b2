"""Instants of points from their azimuths, for clouds of spinning LiDARs without point times."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

_TURN = 2.0 * np.pi
_MIN_TURNS = 0.5  # turns per scan; a LiDAR with fewer oscillates, or its points are not in order of azimuth
_MIN_TURNS_BY_ROWS = 1.5  # turns per scan; with more, the message contains one ring after another
_SEAM_TURNS = 0.25  # points that near to the first column may belong to either end of the scan


@dataclass(frozen=True)
class SweepOrder:
    """Order of points in a scan. direction: 1 counterclockwise seen from above, -1 clockwise. by_rows: the message
    contains one ring after another; otherwise one column after another."""

    direction: int
    by_rows: bool


def find_sweep(scans: Sequence[np.ndarray]) -> SweepOrder | None:
    """Order of points, found from the points (N, 3) of some scans in message order; None if the LiDAR does not spin."""
    turned = np.array([_turned(xyz) for xyz in scans])
    middle = float(np.median(turned))
    if abs(middle) < _MIN_TURNS:
        return None
    return SweepOrder(1 if middle > 0 else -1, abs(middle) > _MIN_TURNS_BY_ROWS)


def sweep_share(sweep: SweepOrder, xyz: np.ndarray, height: int) -> np.ndarray:
    """(N,) time of each point (N, 3) since the first column, as a share of a turn; NaN for points that are zero or not
    finite. height: number of rows of an organised message.

    Lasers of a column have slightly different azimuths. A point near the first column may thus belong to the beginning
    or the end of the scan; its position in the message decides.
    """
    n = len(xyz)
    usable = _usable(xyz)
    share = np.full(n, np.nan)
    if not usable.any():
        return share
    organised = height > 1 and n % height == 0
    place = np.arange(n) / n
    if sweep.by_rows:
        place = np.arange(n) % (n // height) / (n // height) if organised else np.full(n, 0.5)
    first = np.flatnonzero(usable)[np.argmin(place[usable])]
    azimuth = np.arctan2(xyz[:, 1], xyz[:, 0], dtype=np.float64)
    passed = np.mod(sweep.direction * (azimuth - azimuth[first]) / _TURN, 1.0)
    passed -= (passed > 1.0 - _SEAM_TURNS) & (place < _SEAM_TURNS)
    passed += (passed < _SEAM_TURNS) & (place > 1.0 - _SEAM_TURNS)
    share[usable] = passed[usable] + (place[first] if organised else 0.0)
    return share


def _usable(xyz: np.ndarray) -> np.ndarray:
    """(N,) whether points (N, 3) are finite and have an azimuth."""
    return np.isfinite(xyz).all(axis=1) & (xyz[:, :2] != 0).any(axis=1)


def _turned(xyz: np.ndarray) -> float:
    """Number of turns over the successive points (N, 3), positive counterclockwise."""
    used = xyz[_usable(xyz)]
    step = np.diff(np.arctan2(used[:, 1], used[:, 0], dtype=np.float64))
    return float((np.mod(step + np.pi, _TURN) - np.pi).sum() / _TURN)
