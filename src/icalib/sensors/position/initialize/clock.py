"""Candidate time offsets by cross-correlation of the norms of third differences of position, from fixes and from IMU.

Third differences over equal steps contain neither gravity nor velocity, and their norms do not depend on the attitude.
The IMU's readings give them by integrating rotations over three steps only.
"""

from __future__ import annotations

import numpy as np

from icalib.initialize.steps.cross_correlation import CorrelationPeak, best_shifts
from icalib.motion.imu_data import ImuData
from icalib.sensors.position.initialize.attitude import Fix
from icalib.sensors.position.initialize.triples import IntegratedReadings

SIGNAL_RATE_HZ = 20.0  # of the correlated signals: the offset is found to 50 ms, and refined later
DIFFERENCE_STEP_S = 1.0  # s: with 2 cm of noise a third difference has 9 cm/s^2
MIN_JERK_OVERLAP_S = 10.0  # s: shorter overlaps correlate by chance
MAX_JERK_PEAKS = 6  # candidates
PEAK_SPACING_S = 0.3  # s: closer peaks lead to the same offset once it is refined
MIN_JERK_CORRELATION = 0.3  # of a candidate
MIN_SIGNAL_RANGE = 1e-4  # m/s^2 or m/s: less is rounding
# Third differences of fixes are rejected above this ratio to the largest of the IMU, and above this limit. The ratio
# leaves room for a long lever arm, which adds to them when the rig turns.
MAX_JERK_RATIO, MIN_JERK_LIMIT_M_S2 = 1.5, 5.0


def likely_offsets(imu: ImuData, fix: Fix) -> list[CorrelationPeak]:
    """Candidate offsets t_imu - t_sensor in samples of 1 / SIGNAL_RATE_HZ s, the highest correlation first."""
    fix_signal, fix_known = _of_fixes(fix)
    imu_signal, imu_known = _of_imu(imu)
    fix_known &= fix_signal <= max(MAX_JERK_RATIO * imu_signal.max(initial=0.0), MIN_JERK_LIMIT_M_S2)
    if not (varies(fix_signal, fix_known) and varies(imu_signal, imu_known)):
        return []
    least, apart = MIN_JERK_OVERLAP_S * SIGNAL_RATE_HZ, round(PEAK_SPACING_S * SIGNAL_RATE_HZ)
    return best_shifts((imu_signal, imu_known), (fix_signal, fix_known), least, MAX_JERK_PEAKS, apart)


def varies(signal: np.ndarray, known: np.ndarray) -> bool:
    """Whether a signal (n,), where it is `known` (n,), changes by more than rounding, so that it can be correlated."""
    return bool(known.any()) and float(np.ptp(signal[known])) > MIN_SIGNAL_RANGE


def _of_fixes(fix: Fix) -> tuple[np.ndarray, np.ndarray]:
    """Norms (m,) of third differences of the fixes over DIFFERENCE_STEP_S [m/s^2], at SIGNAL_RATE_HZ from 0 s on; and
    (m,) bool: which of them are known."""
    t = fix.t
    usual = float(np.median(np.diff(t)))
    step = max(DIFFERENCE_STEP_S, usual)
    index = [np.arange(len(t))]
    for _ in range(3):
        index.append(np.searchsorted(t, t[np.minimum(index[-1], len(t) - 1)] + step - 0.1 * usual))
    good = index[3] < len(t)
    i, j, k, m = (x[good] for x in index)
    h1, h2, h3 = (t[b] - t[a] for a, b in ((i, j), (j, k), (k, m)))
    even = (np.max([h1, h2, h3], axis=0) < 1.2 * step) & (fix.run[i] == fix.run[m])
    v1, v2, v3 = ((fix.position[b] - fix.position[a]) / h[:, None] for a, b, h in ((i, j, h1), (j, k, h2), (k, m, h3)))
    third = (v3 - v2) / (0.5 * (h2 + h3))[:, None] - (v2 - v1) / (0.5 * (h1 + h2))[:, None]
    middle = 0.25 * (t[i] + t[j] + t[k] + t[m])
    longest = 1.5 * max(usual, 1.0 / SIGNAL_RATE_HZ)
    return _on_grid(middle[even], np.linalg.norm(third[even], axis=1), float(t[-1]), longest)


def _of_imu(imu: ImuData) -> tuple[np.ndarray, np.ndarray]:
    """As `_of_fixes`, from the readings; known where 3 DIFFERENCE_STEP_S about an instant have no gap."""
    t = imu.seconds
    integrated = IntegratedReadings.of(imu, (float(t[0]), float(t[-1])), 0.0, np.zeros(3), forces_only=True)
    middle = np.arange(0.0, float(t[-1]), 1.0 / SIGNAL_RATE_HZ)
    x = [integrated.doubles_at(middle + at * DIFFERENCE_STEP_S) for at in (-1.5, -0.5, 0.5, 1.5)]
    third = (x[3] - 3.0 * x[2] + 3.0 * x[1] - x[0]) / DIFFERENCE_STEP_S**2
    inside = imu.covers(middle - 1.5 * DIFFERENCE_STEP_S, middle + 1.5 * DIFFERENCE_STEP_S)
    return np.where(inside, np.linalg.norm(third, axis=1), 0.0), inside


def _on_grid(t: np.ndarray, x: np.ndarray, end: float, apart: float) -> tuple[np.ndarray, np.ndarray]:
    """x (n,) at t (n,) s, linearly interpolated at SIGNAL_RATE_HZ from 0 to `end` s, and where it is known: between
    samples at most `apart` s from each other."""
    grid = np.arange(int(end * SIGNAL_RATE_HZ) + 1) / SIGNAL_RATE_HZ
    if len(t) < 2:
        return np.zeros(len(grid)), np.zeros(len(grid), dtype=bool)
    after = np.clip(np.searchsorted(t, grid), 1, len(t) - 1)
    known = (grid >= t[0]) & (grid <= t[-1]) & (t[after] - t[after - 1] <= apart)
    return np.interp(grid, t, x), known
