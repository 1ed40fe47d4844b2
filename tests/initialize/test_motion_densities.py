"""Densities of the assumed motion from poses of which some are poor."""

from __future__ import annotations

import numpy as np
import pytest
from tests.cases import each

from icalib.initialize.assumed_motion import ASSUMED_IMU_STEP_S, MIN_DENSITY, motion_densities
from icalib.initialize.smooth_trajectory import BodyPoses

JERKING = 0.5  # m/s^3/sqrt(Hz)
GOOD, BAD = 1e-5, 0.05  # m


def walked(seconds: float, step: float, rests: float = 0.0) -> BodyPoses:
    """Poses at intervals of `step` of a body whose jerk is white; it stands for a share `rests` of the time first."""
    rng, dt = np.random.default_rng(0), 1e-3
    n = round(seconds / dt)
    jerk = JERKING / np.sqrt(dt) * rng.standard_normal((n, 3)) * (np.arange(n) >= rests * n)[:, None]
    position = np.cumsum(np.cumsum(np.cumsum(jerk, axis=0), axis=0), axis=0)[:: round(step / dt)] * dt**3
    seconds_of = step * np.arange(len(position))
    return BodyPoses(seconds_of, np.tile(np.eye(3), (len(position), 1, 1)), position, np.full(len(position), GOOD**2))


def density(poses: BodyPoses) -> float:
    at = np.arange(0.0, poses.seconds[-1], ASSUMED_IMU_STEP_S)
    turning, jerking = motion_densities([poses.at(at, narrow=True)])
    assert turning == MIN_DENSITY
    return jerking


def with_bad_poses(poses: BodyPoses, known: bool) -> BodyPoses:
    """A tenth of the poses, a second of every ten, are off by BAD; `known`: their variance says so."""
    bad, rng = poses.seconds % 10.0 < 1.0, np.random.default_rng(1)
    position = poses.position + BAD * bad[:, None] * rng.standard_normal(poses.position.shape)
    variance = np.where(bad, BAD**2, GOOD**2) if known else None
    return BodyPoses(poses.seconds, poses.rotation, position, variance)


@each("step", [0.01, 0.05])
def test_poses_that_are_known_to_be_poor_do_not_count(step: float):
    poses = walked(60.0, step)
    good, bad = density(poses), density(with_bad_poses(poses, True))
    assert 0.4 * JERKING < good < 1.1 * JERKING  # windows smooth some of it away
    assert bad == pytest.approx(good, rel=0.1)
    assert density(with_bad_poses(poses, False)) > 10.0 * good


@each("step", [0.01, 0.05, 0.1])
def test_rest_does_not_hide_the_motion(step: float):
    """The variances are alike, so the density is the RMS: a median would be zero."""
    assert density(walked(100.0, step, 0.9)) == pytest.approx(density(walked(100.0, step)) * np.sqrt(0.1), rel=0.3)


def test_a_body_at_rest_has_the_least_density():
    assert density(walked(10.0, 0.05, 1.0)) == pytest.approx(MIN_DENSITY, rel=1e-3)
