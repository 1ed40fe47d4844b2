"""Time offsets at which the IMU felt the motion that fixes show, by the size of third differences of position.

Third differences over equal steps hold no gravity and no velocity, and their size no attitude: the IMU's readings give
them from rotations over three steps alone.
"""

from __future__ import annotations

import numpy as np

from icalib.initialize.steps.cross_correlation import CorrelationPeak, best_shifts
from icalib.motion.imu_data import ImuData
from icalib.sensors.position.initialize.attitude import Fix
from icalib.sensors.position.initialize.triples import Carried

GRID_HZ = 20.0
STEP_S = 1.0
SHORTEST_OVERLAP_S = 10.0
MOST_PEAKS = 6
PEAKS_APART_S = 0.3
LEAST_CORRELATION = 0.3
LEAST_CHANGE = 1e-4  # m/s^2 or m/s
MOST_FELT, LEVERED = 1.5, 5.0  # times, and at least m/s^2: a long lever arm adds its own where the rig turns


def likely_offsets(imu: ImuData, fix: Fix) -> list[CorrelationPeak]:
    """Offsets in steps of 1 / GRID_HZ s from the sensor's clock to the IMU's, most likely first."""
    seen, is_seen = _of_fixes(fix)
    felt, is_felt = _of_imu(imu)
    is_seen &= seen <= max(MOST_FELT * felt.max(initial=0.0), LEVERED)  # more than the IMU ever felt is no motion
    if not (varies(seen, is_seen) and varies(felt, is_felt)):
        return []
    least, apart = SHORTEST_OVERLAP_S * GRID_HZ, round(PEAKS_APART_S * GRID_HZ)
    return best_shifts(felt, is_felt, seen, is_seen, least, MOST_PEAKS, apart)


def varies(signal: np.ndarray, known: np.ndarray) -> bool:
    """Whether a signal (n,), where it is `known` (n,), changes by more than rounding, so that it can be correlated."""
    return bool(known.any()) and float(np.ptp(signal[known])) > LEAST_CHANGE


def _of_fixes(fix: Fix) -> tuple[np.ndarray, np.ndarray]:
    """Size of the third differences over STEP_S [m/s^2] on a regular grid from 0 on, and where they are known."""
    t = fix.t
    usual = float(np.median(np.diff(t)))
    step = max(STEP_S, usual)
    index = [np.arange(len(t))]
    for _ in range(3):
        index.append(np.searchsorted(t, t[np.minimum(index[-1], len(t) - 1)] + step - 0.1 * usual))
    good = index[3] < len(t)
    i, j, k, m = (x[good] for x in index)
    h1, h2, h3 = (t[b] - t[a] for a, b in ((i, j), (j, k), (k, m)))
    even = np.max([h1, h2, h3], axis=0) < 1.2 * step
    v1, v2, v3 = ((fix.position[b] - fix.position[a]) / h[:, None] for a, b, h in ((i, j, h1), (j, k, h2), (k, m, h3)))
    third = (v3 - v2) / (0.5 * (h2 + h3))[:, None] - (v2 - v1) / (0.5 * (h1 + h2))[:, None]
    middle = 0.25 * (t[i] + t[j] + t[k] + t[m])
    return _on_grid(middle[even], np.linalg.norm(third[even], axis=1), float(t[-1]), 1.5 * max(usual, 1.0 / GRID_HZ))


def _of_imu(imu: ImuData) -> tuple[np.ndarray, np.ndarray]:
    """The same of the readings, of which a window of 3 STEP_S has no gap."""
    t = imu.seconds
    carried = Carried.of(imu, (float(t[0]), float(t[-1])), 0.0, np.zeros(3), alone=True)
    middle = np.arange(0.0, float(t[-1]), 1.0 / GRID_HZ)
    x = [carried.doubles_at(middle + at * STEP_S) for at in (-1.5, -0.5, 0.5, 1.5)]
    third = (x[3] - 3.0 * x[2] + 3.0 * x[1] - x[0]) / STEP_S**2
    inside = imu.covers(middle - 1.5 * STEP_S, middle + 1.5 * STEP_S)
    return np.where(inside, np.linalg.norm(third, axis=1), 0.0), inside


def _on_grid(t: np.ndarray, x: np.ndarray, end: float, apart: float) -> tuple[np.ndarray, np.ndarray]:
    """x (n,) at t (n,) on the grid up to `end`, and where neighbours no more than `apart` s from each other tell it."""
    grid = np.arange(int(end * GRID_HZ) + 1) / GRID_HZ
    if len(t) < 2:
        return np.zeros(len(grid)), np.zeros(len(grid), dtype=bool)
    after = np.clip(np.searchsorted(t, grid), 1, len(t) - 1)
    known = (grid >= t[0]) & (grid <= t[-1]) & (t[after] - t[after - 1] <= apart)
    return np.interp(grid, t, x), known
