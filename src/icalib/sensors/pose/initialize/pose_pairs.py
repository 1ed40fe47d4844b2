"""Which poses of two sensors belong together, where both were taken at rest."""

from __future__ import annotations

import numpy as np

from icalib.data.checks.stops import moved
from icalib.initialize.steps.smooth_trajectory import BodyPoses
from icalib.motion.keyframe_placement import MERGED_WITHIN_S

AROUND_S = 0.2  # before and behind an instant at which a sensor must be at rest: clocks may be so far apart
SEEN_S = 2.0  # between poses that show whether it is
AT_REST = 0.03  # of the motion between instants
NEAR = 0.2  # of the time between instants: stamps so near each other are of one stop
STOPS_S = 1.0  # between instants, at least, for that
TYPICAL = 500  # pairs of instants that tell how much is moved between them


def partners(body: BodyPoses, sensor: BodyPoses) -> tuple[np.ndarray, np.ndarray]:
    """Indices (n,) of poses of the body, increasing, and (n,) of poses of the sensor that belong together, both on one
    clock: those with the same stamps; or if most have none, those around which the denser of the two is at rest; or,
    where both have stops only, those nearest to each other."""
    i, k = _nearest(body, sensor)
    apart = np.abs(body.seconds[i] - sensor.seconds[k])
    same = apart <= MERGED_WITHIN_S
    if same.sum() >= 0.5 * min(len(body.seconds), len(sensor.seconds)):
        return i[same], k[same]
    steps = [float(np.median(np.diff(own.seconds))) if len(own.seconds) > 1 else np.inf for own in (body, sensor)]
    if min(steps) > STOPS_S:
        near = apart < NEAR * min(steps)
        return i[near], k[near]
    dense = body if steps[0] < steps[1] else sensor
    rest = same | _is_at_rest(dense, 0.5 * (body.seconds[i] + sensor.seconds[k]))
    rest &= apart <= AROUND_S
    return i[rest], k[rest]


def _nearest(body: BodyPoses, sensor: BodyPoses) -> tuple[np.ndarray, np.ndarray]:
    """Pairs of poses each of which is the other's nearest."""
    k = np.searchsorted(0.5 * (sensor.seconds[1:] + sensor.seconds[:-1]), body.seconds)
    i = np.searchsorted(0.5 * (body.seconds[1:] + body.seconds[:-1]), sensor.seconds)
    own = np.flatnonzero(i[k] == np.arange(len(k)))
    return own, k[own]


def _is_at_rest(own: BodyPoses, seconds: np.ndarray) -> np.ndarray:
    """(n,) whether the poses just outside +- AROUND_S of each of `seconds` (n,) are at most SEEN_S apart and nearly
    equal."""
    last = len(own.seconds) - 1
    before = np.clip(np.searchsorted(own.seconds, seconds - AROUND_S, side="right") - 1, 0, last)
    behind = np.clip(np.searchsorted(own.seconds, seconds + AROUND_S), 0, last)
    rng = np.random.default_rng(0)
    a, b = rng.integers(0, last + 1, (2, TYPICAL))
    typical = float(np.median(moved(own.rotation, own.position, a, b)))
    seen = own.seconds[behind] - own.seconds[before] <= SEEN_S
    return seen & (moved(own.rotation, own.position, before, behind) < AT_REST * typical)
