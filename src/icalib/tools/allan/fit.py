"""White noise and random walk of a bias, by maximum likelihood of the differences of successive readings.

With readings y_i = b_i + w_i, w white with variance N^2 / T and b a random walk with steps of variance K^2 T (T: the
period), the differences have the covariance K^2 T I + N^2 / T tridiag(-1, 2, -1). The discrete sine transform (type I)
makes it diagonal, so the likelihood is exact: coefficients z_k are independent, of variance

    s_k = c + a (2 - 2 cos(pi k / (n + 1))),     a = N^2 / T,  c = K^2 T.

Differences lose no information but the constant bias. Coefficients are averaged in frequency bands; the model is linear
in (a, c).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields

import numpy as np

_PER_OCTAVE = 8  # bands
_HIGHEST = 0.05  # highest frequency over the rate: above it, the sensor's filter and rounding shape the spectrum
_LEAST_IN_BAND = 8  # coefficients, which make the mean power of a band about Gaussian
_RESOLVED = 9.0  # twice the gain in log-likelihood by the walk: 3 sigma
_UPPER = 2.71  # twice the loss in log-likelihood at the upper bound: one-sided 95 %
_SURE = 5.0  # chi^2 above its mean by this many standard deviations shows that the model does not fit
_RATIOS = np.concatenate([[0.0], np.geomspace(1e-16, 1e4, 401)])  # grid of c / a


@dataclass(frozen=True)
class Bands:
    """Power spectrum of the differences in j bands. frequency (j,): mean [Hz]; count (j,): number of coefficients;
    power (j,): their mean square; slope (j,): mean of 2 - 2 cos, the factor of a in the model."""

    frequency: np.ndarray
    count: np.ndarray
    power: np.ndarray
    slope: np.ndarray


@dataclass(frozen=True)
class AllanFit:
    """Fitted noise. white: density N [unit/sqrt(Hz)]; walk: density K [unit s^-1/sqrt(Hz)]; _std: standard deviations.

    resolved: whether the walk is significant (3 sigma). walk_upper: upper bound of K (95 %). misfit: relative standard
    deviation of the bands about the model, beyond their sampling noise; the standard deviations include it. lacking:
    factor by which the recording must be longer to know K to 20 %; below 1 it is long enough.
    """

    white: float
    white_std: float
    walk: float
    walk_std: float
    walk_upper: float
    resolved: bool
    misfit: float
    lacking: float


def bands_of_all(stretches: Sequence[np.ndarray], period: float) -> Bands:
    """Bands of several stretches of readings, each (n,), one every `period` seconds. The bands of all stretches are
    concatenated, as their likelihoods multiply. No difference spans two stretches."""
    bands = [bands_of(part, period) for part in stretches]
    return Bands(*(np.concatenate([getattr(b, f.name) for b in bands]) for f in fields(Bands)))


def bands_of(readings: np.ndarray, period: float) -> Bands:
    """Bands of readings (n,), one every `period` seconds, up to a frequency of a twentieth of the rate."""
    differences = np.diff(readings)
    n = _smooth_size(len(differences) + 1) - 1
    odd = np.concatenate([[0.0], differences[:n], [0.0], -differences[:n][::-1]])
    squares = (np.fft.rfft(odd).imag[1 : n + 1] / 2.0) ** 2 * 2.0 / (n + 1)
    last = max(3, int(2.0 * _HIGHEST * n))
    k = np.arange(1, last + 1)
    edges = np.unique(np.concatenate([[0], np.round(np.geomspace(1, last, 1 + int(_PER_OCTAVE * np.log2(last))))]))
    starts = edges[:-1].astype(np.int64)
    count = np.diff(edges)
    angle = np.pi * k / (n + 1)
    power, slope, middle = (np.add.reduceat(x, starts) / count for x in (squares[:last], _slope(angle), angle))
    return Bands(middle / (2.0 * np.pi * period), count, power, slope)


def pooled(axes: list[Bands]) -> Bands:
    """Mean spectrum of several axes; its a and c are the means of those of the axes. The effective `count` is smaller
    if the axes differ in power."""
    power = np.array([b.power for b in axes])
    weight = np.array([(b.power * b.count).sum() / b.count.sum() for b in axes])
    return Bands(axes[0].frequency, axes[0].count * weight.sum() ** 2 / (weight**2).sum(), power.mean(0), axes[0].slope)


def fit_noise(bands: Bands, period: float) -> AllanFit:
    """Maximum-likelihood N and K from `bands` of readings one every `period` seconds. The weights of the bands are
    reduced until the misfit is consistent with them."""
    misfit, weight = 0.0, 0.5 * bands.count
    ratio, a = _most_likely(bands, weight)
    for _ in range(20):
        new_misfit = _misfit(bands, a * (bands.slope + ratio))
        if abs(new_misfit - misfit) <= 0.01 * misfit:
            break
        misfit, weight = new_misfit, 1.0 / (2.0 / bands.count + new_misfit**2)
        ratio, a = _most_likely(bands, weight)
    floor = _cost(bands, weight, ratio)
    upper = _upper_ratio(bands, weight, ratio, floor)
    c = ratio * a
    std_a, std_c = _std(bands, weight, a, c)
    resolved = bool(2.0 * (_cost(bands, weight, 0.0) - floor) > _RESOLVED)
    known_c = c if resolved else upper * a
    relative = 0.5 * _std(bands, weight, a, known_c)[1] / known_c if known_c > 0 else np.inf
    walk = np.sqrt(c / period)
    return AllanFit(
        white=float(np.sqrt(a * period)),
        white_std=float(0.5 * std_a / a * np.sqrt(a * period)),
        walk=float(walk),
        walk_std=float(0.5 * std_c / c * walk) if c > 0 else float(np.sqrt(upper * a / period)),
        walk_upper=float(np.sqrt(upper * a / period)),
        resolved=resolved,
        misfit=float(misfit),
        lacking=float((relative / 0.2) ** 2),
    )


def _slope(angle: np.ndarray) -> np.ndarray:
    return 4.0 * np.sin(0.5 * angle) ** 2


def _cost(bands: Bands, weight: np.ndarray, ratio: float) -> float:
    """Negative log-likelihood at c / a = ratio, maximised over a."""
    shape = bands.slope + ratio
    a = (weight * bands.power / shape).sum() / weight.sum()
    return float((weight * np.log(a * shape)).sum())


def _most_likely(bands: Bands, weight: np.ndarray) -> tuple[float, float]:
    """c / a and a of the highest likelihood, by a grid search and then golden-section search."""
    costs = [_cost(bands, weight, float(r)) for r in _RATIOS]
    best = int(np.argmin(costs))
    low, high = (float(_RATIOS[min(max(best + side, 0), len(_RATIOS) - 1)]) for side in (-1, 1))
    golden = 0.5 * (np.sqrt(5.0) - 1.0)
    for _ in range(60):
        left, right = high - golden * (high - low), low + golden * (high - low)
        if _cost(bands, weight, left) < _cost(bands, weight, right):
            high = right
        else:
            low = left
    ratio = 0.0 if best == 0 else 0.5 * (low + high)
    return ratio, float((weight * bands.power / (bands.slope + ratio)).sum() / weight.sum())


def _upper_ratio(bands: Bands, weight: np.ndarray, ratio: float, floor: float) -> float:
    """Upper bound (95 %) of c / a on the grid, from the likelihood ratio. ratio, floor: estimate and its cost."""
    for r in _RATIOS[np.searchsorted(_RATIOS, ratio, "right") :]:
        if 2.0 * (_cost(bands, weight, float(r)) - floor) > _UPPER:
            return float(r)
    return float(_RATIOS[-1])


def _std(bands: Bands, weight: np.ndarray, a: float, c: float) -> tuple[float, float]:
    """Standard deviations of a and c, from the Fisher information."""
    variance = c + a * bands.slope
    gradient = np.stack([bands.slope, np.ones_like(bands.slope)], axis=1) / variance[:, None]
    covariance = np.linalg.inv(gradient.T @ (weight[:, None] * gradient))
    return float(np.sqrt(covariance[0, 0])), float(np.sqrt(covariance[1, 1]))


def _misfit(bands: Bands, variance: np.ndarray) -> float:
    """Relative standard deviation of the bands about the model `variance` (j,), beyond their sampling noise; 0 if chi^2
    is as expected."""
    wide = bands.count >= _LEAST_IN_BAND
    off = (bands.power[wide] / variance[wide] - 1.0) ** 2
    noise, dof = 2.0 / bands.count[wide], max(1, int(wide.sum()) - 2)
    # The mean of m squares has an excess kurtosis of 12 / m, so that its whitened square has the variance 2 + 12 / m.
    if (off / noise).sum() < dof + _SURE * np.sqrt((2.0 + 6.0 * noise).sum()):
        return 0.0
    low, high = 0.0, 10.0
    for _ in range(40):
        middle = 0.5 * (low + high)
        low, high = (middle, high) if (off / (noise + middle**2)).sum() > dof else (low, middle)
    return 0.5 * (low + high)


def _smooth_size(n: int) -> int:
    """The largest number up to n without a prime factor above 5: an FFT of this size is fast."""
    best = 1
    five = 1
    while five <= n:
        three = five
        while three <= n:
            best = max(best, three << ((n // three).bit_length() - 1))
            three *= 3
        five *= 5
    return best
