"""When points of a LiDAR that turns were measured, from where they lie: for clouds that do not say it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

_TURN = 2.0 * np.pi
_LEAST_TURNED = 0.5  # turns of a scan; what does not turn goes to and fro
_ROWS = 1.5  # turns of a scan, above which its rings follow one another
_EDGE = 0.25  # of a turn


@dataclass(frozen=True)
class SweepOrder:
    """direction: 1 against the clock seen from above, -1 with it. by_rows: rings follow one another in the message,
    each a whole turn; else columns do."""

    direction: int
    by_rows: bool


def find_sweep(scans: Sequence[np.ndarray]) -> SweepOrder | None:
    """How the LiDAR turns, from the points (N, 3) of some scans in the order of the message; None if it does not."""
    turned = np.array([_turned(xyz) for xyz in scans])
    middle = float(np.median(turned))
    if abs(middle) < _LEAST_TURNED:
        return None
    return SweepOrder(1 if middle > 0 else -1, abs(middle) > _ROWS)


def sweep_share(sweep: SweepOrder, xyz: np.ndarray, height: int) -> np.ndarray:
    """(N,) share of the turn that had passed when each point (N, 3) was measured, from the scan's first column on; NaN
    of points at zero or without numbers. height: rows of an organised message.

    Lasers of a column look to slightly different sides, so a point close to where the scan begins may belong to its
    beginning or its end; its place in the message tells.
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
    passed -= (passed > 1.0 - _EDGE) & (place < _EDGE)
    passed += (passed < _EDGE) & (place > 1.0 - _EDGE)
    share[usable] = passed[usable] + (place[first] if organised else 0.0)
    return share


def _usable(xyz: np.ndarray) -> np.ndarray:
    return np.isfinite(xyz).all(axis=1) & (xyz[:, :2] != 0).any(axis=1)


def _turned(xyz: np.ndarray) -> float:
    """How many turns the points make, one after the other; positive against the clock."""
    used = xyz[_usable(xyz)]
    step = np.diff(np.arctan2(used[:, 1], used[:, 0], dtype=np.float64))
    return float((np.mod(step + np.pi, _TURN) - np.pi).sum() / _TURN)
