"""Matches poses of two sensors that were taken at the same stop of a robot."""

from __future__ import annotations

import numpy as np

from icalib.data.checks import moved
from icalib.initialize.steps.smooth_trajectory import BodyPoses
from icalib.motion.keyframe_placement import MERGED_WITHIN_S

MAX_CLOCK_OFFSET_S = 0.2  # largest clock offset; a sensor must be at rest this long before and after an instant
MAX_REST_GAP_S = 2.0  # longest gap between the two poses that decide whether a sensor is at rest
MAX_REST_MOTION = 0.03  # largest motion between these poses, as a share of the median motion between random poses
MAX_STOP_SHARE = 0.2  # share of the time between stops; stamps closer than this belong to the same stop
MIN_STOP_INTERVAL_S = 1.0  # least median step between poses of a sensor that measures at stops only
N_MOTION_SAMPLES = 500  # pairs of random poses


def matched_poses(body: BodyPoses, sensor: BodyPoses) -> tuple[np.ndarray, np.ndarray]:
    """Indices (n,) of poses of the body, increasing, and indices (n,) of the matching poses of the sensor, on one
    clock.

    A match has the same stamps. If most poses have no such match, there are two cases. If both sensors have poses at
    stops only, mutually nearest poses match. Otherwise they match if the sensor with more poses is at rest around them.
    """
    i, k = _mutually_nearest(body, sensor)
    apart = np.abs(body.seconds[i] - sensor.seconds[k])
    same = apart <= MERGED_WITHIN_S
    if same.sum() >= 0.5 * min(len(body.seconds), len(sensor.seconds)):
        return i[same], k[same]
    steps = [float(np.median(np.diff(poses.seconds))) if len(poses.seconds) > 1 else np.inf for poses in (body, sensor)]
    if min(steps) > MIN_STOP_INTERVAL_S:
        near = apart < MAX_STOP_SHARE * min(steps)
        return i[near], k[near]
    dense = body if steps[0] < steps[1] else sensor
    rest = same | _is_at_rest(dense, 0.5 * (body.seconds[i] + sensor.seconds[k]))
    rest &= apart <= MAX_CLOCK_OFFSET_S
    return i[rest], k[rest]


def _mutually_nearest(body: BodyPoses, sensor: BodyPoses) -> tuple[np.ndarray, np.ndarray]:
    """Indices (n,) of poses of the body and (n,) of the sensor that are mutually nearest in time."""
    k = np.searchsorted(0.5 * (sensor.seconds[1:] + sensor.seconds[:-1]), body.seconds)
    i = np.searchsorted(0.5 * (body.seconds[1:] + body.seconds[:-1]), sensor.seconds)
    matched = np.flatnonzero(i[k] == np.arange(len(k)))
    return matched, k[matched]


def _is_at_rest(poses: BodyPoses, seconds: np.ndarray) -> np.ndarray:
    """(n,) whether a sensor is at rest at `seconds` (n,). Its poses just outside +- MAX_CLOCK_OFFSET_S must be at most
    MAX_REST_GAP_S apart and nearly equal."""
    last = len(poses.seconds) - 1
    before = np.clip(np.searchsorted(poses.seconds, seconds - MAX_CLOCK_OFFSET_S, side="right") - 1, 0, last)
    after = np.clip(np.searchsorted(poses.seconds, seconds + MAX_CLOCK_OFFSET_S), 0, last)
    rng = np.random.default_rng(0)
    a, b = rng.integers(0, last + 1, (2, N_MOTION_SAMPLES))
    typical = float(np.median(moved(poses.rotation, poses.position, a, b)))
    covered = poses.seconds[after] - poses.seconds[before] <= MAX_REST_GAP_S
    return covered & (moved(poses.rotation, poses.position, before, after) < MAX_REST_MOTION * typical)
