"""The lag between two signals: masked, normalised cross-correlation over all shifts, by FFT (Padfield, IEEE Trans.
Image Processing, 2012)."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

MaskedSignal = tuple[np.ndarray, np.ndarray]  # values, and bool: which of them are known


class CorrelationPeak(NamedTuple):
    """Signal b(t) is most like a(t + samples). correlation: Pearson's coefficient at this shift; largest: at
    any shift."""

    samples: int
    correlation: float
    largest: float


def best_shift(a: MaskedSignal, b: MaskedSignal, least: float) -> CorrelationPeak:
    """The shift between the signals a (n,) and b (m,), sampled on one regular grid, at which they are most alike. Only
    samples where both masks are true count. At least `least` samples must overlap, or half of the known ones if these
    are fewer."""
    return best_shifts(a, b, least, 1, 0)[0]


def best_shifts(
    signal_a: MaskedSignal, signal_b: MaskedSignal, least: float, most: int, apart: int
) -> list[CorrelationPeak]:
    """At most `most` peaks, the best first, each more than `apart` samples from the better ones. See `best_shift`.
    Peaks are ranked by Fisher's z (atanh of the correlation) times the root of the overlap, so that a long overlap
    outweighs a short one."""
    (a, mask_a), (b, mask_b) = signal_a, signal_b
    n = len(a) + len(b) - 1
    size = 1 << (n - 1).bit_length()

    def correlate(x: np.ndarray, y: np.ndarray) -> np.ndarray:
        """sum_t x(t + lag) y(t) for lags from -(len(y) - 1) to len(x) - 1."""
        product = np.fft.irfft(np.fft.rfft(x, size) * np.conj(np.fft.rfft(y, size)), size)
        return np.concatenate([product[-(len(b) - 1) :], product[: len(a)]]) if len(b) > 1 else product[: len(a)]

    ma, mb = mask_a.astype(float), mask_b.astype(float)
    count = np.maximum(correlate(ma, mb), 1e-9)
    sa, sb = correlate(a * ma, mb), correlate(ma, b * mb)
    saa, sbb = correlate(a * a * ma, mb), correlate(ma, b * b * mb)
    covariance = correlate(a * ma, b * mb) - sa * sb / count
    variance = np.maximum(saa - sa**2 / count, 0.0) * np.maximum(sbb - sb**2 / count, 0.0)
    fewer = min(mask_a.sum(), mask_b.sum())
    enough = count > min(least, 0.5 * fewer)
    # The floor, a share of the whole variance, keeps a short overlap with little motion from winning.
    floor = 1e-3 * (a[mask_a].var() * b[mask_b].var()) * count**2
    r = np.where(enough, covariance / np.sqrt(variance + floor), 0.0)
    score = np.arctanh(np.clip(r, 0.0, 0.999999)) * np.sqrt(count)
    peaks = []
    for _ in range(most):
        k = int(np.argmax(score))
        peaks.append(CorrelationPeak(k - (len(b) - 1), float(r[k]), float(r.max())))
        score[max(k - apart, 0) : k + apart + 1] = -np.inf
        if not np.isfinite(score).any():
            break
    return peaks
