"""Misfit that is concentrated at one time, or that follows the image speed because cameras are not exposed together."""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import dataclass

import numpy as np

from icalib.estimate.estimate import Estimate
from icalib.estimate.problem.inputs import Inputs
from icalib.motion.factor import pairs_of
from icalib.sensors.camera.corner_factor import CornerFactor

BINS, WINDOW = 64, 3  # bins of the recording, and bins of a window: a shock affects a few keyframes around it
SHAKEN = ("gyroscope", "accelerometer", "corners")  # kinds of residuals that a knock on the rig enlarges
AT_ONE_TIME = 0.5  # share of the misfit in one window
LARGE = 3.0  # times the median chi^2 of a window; below it, the number of measurements may explain the difference
FASTEST_GAP_S = 1.0  # s between images; over more, their difference does not show the image speed
FOLLOWS_SPEED = 0.25  # least share of the squared residuals that the lag explains, in each of both cameras


@dataclass(frozen=True)
class Disturbance:
    """A window with most of the misfit. start, end: [s, joined clock]; share: of the misfit; gain: its chi^2 beyond
    that of a usual window; sensors: those with large residuals in it."""

    start: float
    end: float
    share: float
    gain: float
    sensors: tuple[str, ...]


def disturbance(estimate: Estimate, misfit: float, misfits: Collection[str]) -> Disturbance | None:
    """The window with most of the `misfit` (chi^2 beyond the degrees of freedom) of the sensors `misfits`. None if no
    window has at least half of it."""
    state = estimate.outcome.state
    rows = {s: r for s, r in _chi2_over_time(estimate).items() if s in misfits}
    begin, end = float(state.seconds[0]), float(state.seconds[-1])
    edges = np.linspace(begin, end, BINS + 1)
    beyond = {}
    for sensor, (seconds, chi2) in rows.items():
        bin_chi2 = np.histogram(seconds, edges, weights=chi2)[0]
        usual = WINDOW * np.median(bin_chi2)
        window = np.convolve(bin_chi2, np.ones(WINDOW), "valid")
        beyond[sensor] = np.where(window > LARGE * usual, window - usual, 0.0)
    if not beyond or misfit <= 0.0:
        return None
    total = np.sum(list(beyond.values()), axis=0)
    k = int(np.argmax(total))
    share = float(total[k]) / misfit
    if share < AT_ONE_TIME:
        return None
    sensors = tuple(s for s, excess in beyond.items() if excess[k] > 0.1 * total[k])
    return Disturbance(float(edges[k]), float(edges[k + WINDOW]), min(share, 1.0), float(total[k]), sensors)


def _chi2_over_time(estimate: Estimate) -> dict[str, tuple[np.ndarray, np.ndarray]]:
    """By sensor: times (n,) s on the joined clock and chi^2 (n,) of residuals of the kinds SHAKEN."""
    outcome = estimate.outcome
    factors = outcome.problem.factors.items()
    rows = [r for key, f in factors for r in f.rows(outcome.residuals[key], outcome.state) if r.kind in SHAKEN]
    chi2: dict[str, list[tuple[np.ndarray, np.ndarray]]] = {r.sensor: [] for r in rows}
    for r in rows:
        chi2[r.sensor].append((r.seconds, (r.weighted.astype(np.float64) ** 2).sum(axis=1)))
    return {
        s: (np.concatenate([t for t, _ in pairs]), np.concatenate([c for _, c in pairs])) for s, pairs in chi2.items()
    }


@dataclass(frozen=True)
class Lag:
    """Camera `second` is exposed `seconds` after camera `first`, according to residuals that follow the image speed.
    share: of the squared residuals that the lag explains; gain: decrease of chi^2."""

    first: str
    second: str
    seconds: float
    share: float
    gain: float


def lag_between_cameras(inputs: Inputs, estimate: Estimate) -> Lag | None:
    """The lag between the first two cameras of a rig without an IMU, whose images are modelled as simultaneous. None if
    it explains less than FOLLOWS_SPEED of the squared residuals of either camera."""
    cameras = pairs_of(estimate.problem.factors, estimate.outcome.residuals, CornerFactor)
    if inputs.rig.imu is not None or len(cameras) < 2:
        return None
    lags = []
    for camera, out in cameras[:2]:
        v, known = _image_velocity(camera.stream.image, camera.stream.point, camera.stream.uv, camera.stream.seconds)
        known &= out.root > 0.0
        r, v = out.residual[known].astype(np.float64), v[known]
        square, along = float((r**2).sum()), float((r * v).sum())
        if not (known.any() and square > 0.0 and (v**2).sum() > 0.0):
            return None
        # Residuals are predicted minus measured. A late image shows points farther along their motion.
        coefficient = along / float((v**2).sum())
        weight = float((out.root[known].astype(np.float64) ** 2).mean())
        lags.append((-coefficient, along * coefficient / square, along * coefficient * weight))
    (a, share_a, gain_a), (b, share_b, gain_b) = lags
    if a * b >= 0.0 or min(share_a, share_b) < FOLLOWS_SPEED:
        return None
    return Lag(cameras[0][0].name, cameras[1][0].name, b - a, min(share_a, share_b), gain_a + gain_b)


def _image_velocity(
    image: np.ndarray, point: np.ndarray, uv: np.ndarray, seconds: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Velocity (N, 2) px/s of each corner, from the images before and after, and (N,) whether both show the corner."""
    count = int(point.max(initial=-1)) + 1
    table = np.full((len(seconds), count, 2), np.nan)
    table[image, point] = uv
    speed = np.full_like(table, np.nan)
    if len(seconds) > 2:
        step = seconds[2:] - seconds[:-2]
        speed[1:-1] = (table[2:] - table[:-2]) / step[:, None, None]
        speed[1:-1][step > 2.0 * FASTEST_GAP_S] = np.nan
    velocity = speed[image, point]
    known = np.asarray(np.isfinite(velocity).all(axis=1))
    return np.where(known[:, None], velocity, 0.0), known
