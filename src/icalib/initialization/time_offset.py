"""Time offset of a camera from nothing: its angular rate correlated with the gyroscope's at every possible lag.

The clocks may start anywhere: both are counted from their own first stamp, and all lags with enough overlap are tried.
The magnitude of the rate needs no rotation between the sensors; the best lags are then compared as vectors.
"""

from __future__ import annotations

import numpy as np

from icalib.errors import EstimationError
from icalib.initialization.rates import CameraRates, GyroMeans
from icalib.initialization.rotation import vector_correlation

GRID_S = 0.01
_MIN_OVERLAP_S = 5.0  # or half of the shorter stream
_CANDIDATES = 6
_APART_S = 0.3  # candidates
MIN_CORRELATION = 0.75


def correlate(rates: CameraRates, gyro: GyroMeans, camera_name: str, imu_name: str) -> float:
    """Lag [s] with t_imu = t_cam + lag on the relative clocks, to about 5 ms.

    Raises EstimationError where at no lag the rates agree.
    """
    camera, seen = _camera_signal(rates)
    imu, covered = _gyro_signal(gyro, float(np.median(rates.length)))
    lags, correlation, overlap_s = _all_lags(camera, seen, imu, covered)
    best_lag, best, best_score = 0.0, 0.0, -np.inf
    for i in _peaks(_score(correlation, overlap_s)):
        agreement = vector_correlation(rates, gyro, lags[i])
        score = float(_score(np.array(agreement), overlap_s[i]))
        if score > best_score:
            best_lag, best, best_score = float(lags[i]), agreement, score
    if best < MIN_CORRELATION:
        raise EstimationError(
            f"the clocks of {imu_name} and {camera_name} never overlap, or they did not move together: at no lag do "
            f"their angular rates agree (best correlation {best:.2f}, at {best_lag:+.2f} s between the first stamps, "
            f"{MIN_CORRELATION} needed); check that both are of the same recording and rigidly mounted."
        )
    return best_lag


def _camera_signal(rates: CameraRates) -> tuple[np.ndarray, np.ndarray]:
    """|rate| on the grid from the first image on, and where it was seen."""
    grid = np.arange(0.0, rates.t1[-1], GRID_S)
    k = np.clip(np.searchsorted(rates.t0, grid, side="right") - 1, 0, len(rates.t0) - 1)
    seen = (grid >= rates.t0[k]) & (grid <= rates.t1[k])
    return np.interp(grid, rates.middle, np.linalg.norm(rates.rate, axis=1)), seen


def _gyro_signal(gyro: GyroMeans, window_s: float) -> tuple[np.ndarray, np.ndarray]:
    """|rate|, averaged as the camera averages it, on the grid from the first reading on, and where there are readings.

    The mean over the recording, mostly bias, is taken off: waving comes back to where it began.
    """
    grid = np.arange(0.0, gyro.duration, GRID_S)
    t0, t1 = grid - 0.5 * window_s, grid + 0.5 * window_s
    rate = gyro.mean(t0, t1)
    covered = gyro.covered(t0, t1)
    return np.linalg.norm(rate - rate[covered].mean(axis=0), axis=1), covered


def _all_lags(
    a: np.ndarray, has_a: np.ndarray, b: np.ndarray, has_b: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Lags [s], normalised correlation of a(t) with b(t + lag) where both exist (-1 where too little), overlap [s].

    Masked normalised cross-correlation (Padfield 2012): every sum over the overlap is a correlation by FFT.
    """
    n = 1 << (len(a) + len(b) - 1).bit_length()
    a, b = np.where(has_a, a - a[has_a].mean(), 0.0), np.where(has_b, b - b[has_b].mean(), 0.0)
    fa, fa2, fm = (np.conj(np.fft.rfft(x, n)) for x in (a, a * a, has_a.astype(np.float64)))
    gb, gb2, gm = (np.fft.rfft(x, n) for x in (b, b * b, has_b.astype(np.float64)))
    count, sum_a, sum_b, sum_aa, sum_bb, sum_ab = (
        np.fft.irfft(product, n) for product in (fm * gm, fa * gm, fm * gb, fa2 * gm, fm * gb2, fa * gb)
    )
    needed = min(_MIN_OVERLAP_S / GRID_S, 0.5 * min(has_a.sum(), has_b.sum()))
    enough = count > max(needed, 1.0)
    count = np.where(enough, count, 1.0)
    var_a, var_b = sum_aa - sum_a**2 / count, sum_bb - sum_b**2 / count
    floor_a, floor_b = 1e-3 * (a**2).sum() / has_a.sum() * count, 1e-3 * (b**2).sum() / has_b.sum() * count
    r = (sum_ab - sum_a * sum_b / count) / np.sqrt(np.maximum(var_a, floor_a) * np.maximum(var_b, floor_b) + 1e-300)
    lag = np.arange(n)
    lag = np.where(lag < len(b), lag, lag - n)
    order = np.argsort(lag)
    return lag[order] * GRID_S, np.where(enough, r, -1.0)[order], (count * GRID_S)[order]


def _score(correlation: np.ndarray, overlap_s: np.ndarray) -> np.ndarray:
    """How unlikely by chance: Fisher's z in its standard deviations, up to a constant; little overlap agrees easily."""
    return np.arctanh(np.clip(correlation, -0.9999, 0.9999)) * np.sqrt(overlap_s)


def _peaks(score: np.ndarray) -> list[int]:
    """Indices of the highest scores, no two within _APART_S."""
    left, found = score.copy(), []
    apart = int(_APART_S / GRID_S)
    for _ in range(_CANDIDATES):
        i = int(np.argmax(left))
        found.append(i)
        left[max(i - apart, 0) : i + apart + 1] = -np.inf
    return found
