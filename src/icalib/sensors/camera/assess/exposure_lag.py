"""Cameras that are modelled as simultaneous, but are not exposed together: their residuals follow the image speed."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from icalib.estimate.estimate import Estimate
from icalib.estimate.problem.inputs import Inputs
from icalib.motion.factor import pairs_of
from icalib.observability.cause import Cause
from icalib.sensors.camera.corner_factor import CornerFactor

FASTEST_GAP_S = 1.0  # s between images; over more, their difference does not show the image speed
FOLLOWS_SPEED = 0.25  # least share of the squared residuals that the lag explains, in each of both cameras


def clock_causes(inputs: Inputs, estimate: Estimate) -> Iterator[Cause]:
    """A cause if the first two cameras of a rig without an IMU are not exposed together."""
    lag = _lag_between_cameras(inputs, estimate)
    if lag is not None:
        yield Cause(_words(lag), lag.gain, True)


@dataclass(frozen=True)
class _Lag:
    """Camera `second` is exposed `seconds` after camera `first`, according to residuals that follow the image speed.
    share: of the squared residuals that the lag explains; gain: decrease of chi^2."""

    first: str
    second: str
    seconds: float
    share: float
    gain: float


def _lag_between_cameras(inputs: Inputs, estimate: Estimate) -> _Lag | None:
    """The lag between the first two cameras of a rig without an IMU, whose images are modelled as simultaneous. None if
    it explains less than FOLLOWS_SPEED of the squared residuals of either camera."""
    cameras = pairs_of(estimate.problem.factors, estimate.outcome.residuals, CornerFactor)
    if inputs.rig.imu is not None or len(cameras) < 2:
        return None
    lags = []
    for camera, out in cameras[:2]:
        v, known = image_velocity(camera.stream.image, camera.stream.point, camera.stream.uv, camera.stream.seconds)
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
    return _Lag(cameras[0][0].name, cameras[1][0].name, b - a, min(share_a, share_b), gain_a + gain_b)


def image_velocity(
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


def _words(lag: _Lag) -> str:
    """A sentence that two cameras are not exposed together."""
    first, second = (lag.first, lag.second) if lag.seconds > 0.0 else (lag.second, lag.first)
    return (
        f"{first} and {second} are not exposed together: residuals follow the image speed, as if {second} were about "
        f"{1e3 * abs(lag.seconds):.0f} ms late. Trigger the cameras together, hold the rig still for each pair of "
        "images, or record an IMU too: each camera then has a time offset of its own."
    )
