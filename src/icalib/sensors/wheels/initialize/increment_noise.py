"""Noise densities of distance and yaw of wheels, before their sizes are known."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from icalib.data.measurements import WheelStream
from icalib.initialize.steps.smooth_trajectory import SmoothTrajectory
from icalib.rig import Wheels


def wheel_noise(wheels: Wheels, streams: Sequence[object], paths: Sequence[SmoothTrajectory]) -> tuple[float, float]:
    """Noise densities of distance [m/sqrt(s)] and yaw [rad/sqrt(s)]; zeros if unknown.

    Radius and radius over baseline of a pair are approximated by ratios of RMS values: speed and angular rate of the
    trajectories `paths`, over those of the wheels. These ratios do not depend on the time offset.
    """
    if wheels.kind == "twist":
        return wheels.speed_noise, wheels.yaw_noise
    rates = [s.rate for s in streams if isinstance(s, WheelStream) and s.kind == "pair"]
    if not rates:
        return 0.0, 0.0
    rate = np.concatenate(rates)
    speed, turn = (np.concatenate([getattr(p, name)[p.near] for p in paths]) for name in ("velocity", "rate"))
    rolled, apart = _rms(rate.mean(axis=1)), _rms(rate[:, 1] - rate[:, 0])
    if not (rolled > 0.0 and apart > 0.0):
        return 0.0, 0.0
    radius, per_baseline = _rms(speed) / rolled, _rms(turn) / apart
    return wheels.wheel_noise * radius / np.sqrt(2.0), wheels.wheel_noise * np.sqrt(2.0) * per_baseline


def _rms(x: np.ndarray) -> float:
    """Root mean square of numbers (n,) or of the lengths of vectors (n, 3)."""
    return float(np.sqrt((x.reshape(len(x), -1) ** 2).sum(axis=1).mean()))
