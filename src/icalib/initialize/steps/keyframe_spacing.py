"""How far apart keyframes may be where smooth motion is assumed in place of an IMU.

Between keyframes the motion is carried with constant rate and acceleration. White angular acceleration of density
`turning` [rad/s^2/sqrt(Hz)] turns the body by turning sqrt(t^3 / 3) beside that in t seconds, white jerk of density
`jerking` [m/s^3/sqrt(Hz)] moves it by jerking sqrt(t^5 / 20) (integrated Wiener processes). Both must stay
small against the noise of what is measured there: of poses, half a spacing away from their keyframe, and of wheels,
whose increments over a whole spacing h have noise that grows with sqrt(h).
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from icalib.data.measurements import Measurements, PoseStream, WheelStream
from icalib.geometry import so3
from icalib.initialize.steps.smooth_path import SmoothPath, smooth_path
from icalib.rig import Rig, Wheels

UNSEEN = 0.25  # of the noise: in squares, 6 % of it
LEAST_S = 0.02  # the same as with an IMU
MAD_SIGMA = 1.4826  # standard deviation of normal noise over its median absolute value


def keyframe_spacing(
    rig: Rig, recordings: Sequence[Measurements], paths: Sequence[SmoothPath], turning: float, jerking: float
) -> float:
    """Seconds, from LEAST_S to the rig's `keyframe_spacing_s`; the body's smooth `paths` are those of its first pose
    sensor."""
    turn, way = pose_noise([m.poses[0] for m in recordings])
    limits = [
        2.0 * (3.0 * (UNSEEN * turn / turning) ** 2) ** (1 / 3),
        2.0 * (20.0 * (UNSEEN * way / jerking) ** 2) ** 0.2,
    ]
    for k, wheels in enumerate(rig.wheels):
        way, turn = _wheel_noise(wheels, [m.wheels[k] for m in recordings], paths)
        limits += [np.sqrt(3.0) * UNSEEN * turn / turning, (20.0 * (UNSEEN * way / jerking) ** 2) ** 0.25]
    return float(np.clip(min(limits), LEAST_S, max(rig.settings.keyframe_spacing_s, LEAST_S)))


def pose_noise(streams: Sequence[PoseStream]) -> tuple[float, float]:
    """Of rotation [rad] and position [m], the noisiest axis: scatter of poses about a smooth path through them."""
    turns, offsets = [], []
    for s in streams:
        path = smooth_path(s.seconds, s.rotation, s.position, s.seconds, narrow=True)
        turns.append(so3.log_many(np.ascontiguousarray(path.rotation.transpose(0, 2, 1) @ s.rotation)))
        offsets.append(s.position - path.position)
    turn, way = (MAD_SIGMA * np.median(np.abs(np.concatenate(x)), axis=0).max() for x in (turns, offsets))
    return float(turn), float(way)


def _wheel_noise(wheels: Wheels, streams: Sequence[object], paths: Sequence[SmoothPath]) -> tuple[float, float]:
    """Densities of path [m/sqrt(s)] and yaw [rad/sqrt(s)]; zeros where they are not known beforehand. Radius and
    baseline of a pair are those that the sizes of speeds and turns ask for, whatever the time offset."""
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
    """Of numbers (n,), or of the lengths of vectors (n, 3)."""
    return float(np.sqrt((x.reshape(len(x), -1) ** 2).sum(axis=1).mean()))
