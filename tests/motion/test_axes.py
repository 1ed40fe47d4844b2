"""The axes about which a body hardly turned are named."""

from __future__ import annotations

from itertools import accumulate

import numpy as np
from tests.cases import each

from icalib.geometry import so3
from icalib.motion.imu_data import hardly_turned, other_axes


def keyframes(amplitude: list[float]) -> tuple[np.ndarray, np.ndarray]:
    """Rates about its own x, y and z of such amplitudes [rad/s], each at a frequency of its own."""
    t = np.linspace(0.0, 10.0, 400)
    rate = np.column_stack([a * np.cos(f * t[1:]) for a, f in zip(amplitude, (1.0, 1.3, 1.7), strict=True)])
    steps = so3.exp_many(rate * t[1])
    return t, np.array(list(accumulate(steps, np.matmul, initial=np.eye(3))))


@each(
    ("amplitude", "words"),
    [
        ([0.4, 0.3, 0.2], ""),
        ([0.4, 0.0, 0.2], "the y axis of imu0"),
        ([0.0, 0.4, 0.0], "the x and z axes of imu0"),
        ([0.4, 0.4, 0.0], "the z axis of imu0"),
    ],
)
def test_axes_without_turns_are_named(amplitude: list[float], words: str):
    seconds, rotation = keyframes(amplitude)
    assert hardly_turned(seconds, rotation, "imu0") == words


def test_recordings_in_a_row_are_no_turn():
    """Between two recordings time goes on or back, and the body is anywhere."""
    t, R = keyframes([0.4, 0.0, 0.2])
    other = so3.exp_many(np.array([[0.0, 2.0, 0.0]]))[0] @ R
    joined = np.concatenate([R, other])
    assert hardly_turned(np.concatenate([t, t]), joined, "imu0") == "the y axis of imu0"
    assert hardly_turned(np.concatenate([t, t + 1e3]), joined, "imu0") == "the y axis of imu0"


def test_an_oblique_axis_is_given_in_numbers():
    n = np.ones(3) / np.sqrt(3.0)
    assert other_axes("imu0", n) == "two axes perpendicular to the direction (0.58, 0.58, 0.58) in the axes of imu0"
