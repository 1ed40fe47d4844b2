"""Poses between keyframes, against a motion that is known in closed form."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from icalib.result.path import CubicPath
from icalib.tools.view import by_value


def _pose(t: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """A circle of 1 m about z at 2 rad/s, nodding at 3 rad/s by 0.3 rad."""
    yaw, nod = 2.0 * t, 0.3 * np.sin(3.0 * t)
    R = Rotation.from_rotvec(np.outer(yaw, [0, 0, 1])) * Rotation.from_rotvec(np.outer(nod, [0, 1, 0]))
    return R.as_matrix(), np.stack([np.cos(yaw), np.sin(yaw), 0.1 * t], axis=1)


@pytest.fixture
def keyframes(shown):
    """The trajectory of a result, which is moved as above, at uneven times."""

    def make(seconds: np.ndarray, recordings=()):
        c = shown.calibration
        R, p = _pose(seconds)
        zeros = np.zeros_like(p)
        path = dataclasses.replace(
            c.trajectory, seconds=seconds, rotation=R, position=p, velocity=zeros, gyro_bias=zeros, accel_bias=zeros
        )
        return CubicPath.of(dataclasses.replace(c, trajectory=path, recordings=recordings))

    return make


@pytest.mark.parametrize("step", [0.05, 0.025])
def test_between_keyframes_the_error_falls_with_the_third_power_of_their_distance(keyframes, step):
    """A parabola's slope is off by f''' h^2 / 6, and what a cubic makes of that is at most 0.0963 h times as large.

    The third derivative of the position is 8 m/s^3, that of the rotation below 15 rad/s^3; keyframes are up to 1.2
    steps apart."""
    seconds = np.arange(0.0, 3.0, step)
    seconds[1:-1] += 0.2 * step * np.sin(np.arange(len(seconds) - 2))
    path = keyframes(seconds)
    t = np.linspace(seconds[2], seconds[-3], 2001)
    R, p, known = path.at(t)
    R_true, p_true = _pose(t)
    assert known.all()
    scale = 0.0963 * (1.2 * step) ** 3 / 6.0
    assert np.linalg.norm(p - p_true, axis=1).max() < 8.0 * scale
    assert Rotation.from_matrix(R @ R_true.transpose(0, 2, 1)).magnitude().max() < 15.0 * scale


def test_at_a_keyframe_the_pose_is_that_of_the_keyframe(keyframes):
    seconds = np.arange(0.0, 1.0, 0.05)
    R, p, known = keyframes(seconds).at(seconds)
    R_true, p_true = _pose(seconds)
    assert known.all()
    np.testing.assert_allclose(R, R_true, atol=1e-12)
    np.testing.assert_allclose(p, p_true, atol=1e-12)


def test_beyond_the_ends_and_in_gaps_nothing_is_known(keyframes):
    """Beside them the slope is that of the one interval: off by h / 2 times the acceleration, 4 m/s^2 and below
    6 rad/s^2, of which a cubic makes 0.149 h times as much."""
    seconds = np.array([0.0, 0.05, 0.1, 1.1, 1.15, 1.2])
    t = np.array([-0.01, 0.02, 0.099, 0.1, 0.3, 1.0999, 1.1, 1.12, 1.21])
    R, p, known = keyframes(seconds).at(t)
    assert known.tolist() == [False, True, True, True, False, False, True, True, False]
    assert np.isfinite(R).all()
    assert np.isfinite(p).all()
    R_true, p_true = _pose(t[known])
    np.testing.assert_allclose(p[known], p_true, atol=4.0 * 0.149 * 0.05**2 / 2.0)
    np.testing.assert_allclose(R[known], R_true, atol=6.0 * 0.149 * 0.05**2 / 2.0)


def test_one_recording_does_not_go_over_into_the_next(keyframes, shown):
    only = shown.calibration.recordings[0]
    spans = (dataclasses.replace(only, start=0.0, end=0.1), dataclasses.replace(only, start=0.4, end=0.5))
    _, _, known = keyframes(np.array([0.0, 0.05, 0.1, 0.4, 0.45, 0.5]), spans).at(np.array([0.07, 0.2, 0.3, 0.42]))
    assert known.tolist() == [True, False, False, True]


def test_colours_run_from_dark_to_bright():
    colors = by_value(np.array([-1.0, 0.0, 0.5, 1.0, 2.0]), 0.0, 1.0)
    assert colors.tolist() == [[68, 1, 84], [68, 1, 84], [33, 145, 140], [253, 231, 37], [253, 231, 37]]
    assert by_value(np.array([3.0]), 3.0, 3.0).tolist() == [[68, 1, 84]]
