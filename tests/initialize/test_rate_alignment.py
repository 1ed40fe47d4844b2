"""Angular rates of a camera and an IMU side by side, with more noise in an image than motion between two."""

from __future__ import annotations

import numpy as np
import pytest
from tests.cases import each

from icalib.data.measurements import ImuStream
from icalib.errors import EstimationError
from icalib.initialize.rate_alignment import RateAlignment, align_rates, check_two_axes
from icalib.initialize.rate_correlation import SensorRates
from icalib.motion.imu_data import ImuData
from icalib.rig import ImuNoise
from icalib.tools.simulation.motion import rotation_from_vector

R_IMU_CAM = rotation_from_vector(np.array([0.4, -1.1, 0.7]))
OFFSET = 0.04
SPAN_S = 6.0  # of the camera
NOISE_RAD = 0.02  # of one image's rotation: at 20 Hz 0.57 rad/s of the rate, as fast as the motion


def _rate(seconds: np.ndarray) -> np.ndarray:
    """About 0.5 rad/s about each axis, of ten frequencies below 0.8 Hz."""
    rng = np.random.default_rng(0)
    omega, phase = rng.uniform(0.5, 5.0, (3, 10)), rng.uniform(0.0, 6.0, (3, 10))
    return 0.22 * np.sin(seconds[:, None, None] * omega + phase).sum(axis=2)


def _imu(scale: float) -> ImuData:
    seconds = np.arange(0.0, 40.0, 0.005)
    stream = ImuStream("imu0", (1e9 * seconds).astype(np.int64), scale * _rate(seconds), np.zeros((len(seconds), 3)))
    return ImuData.build(stream, ImuNoise(1e-3, 1e-2, 1e-5, 1e-4))


def _camera(seed: int) -> SensorRates:
    """20 Hz: an error of an image is in the rate before it and, the other way round, in the rate after it."""
    seconds = np.arange(0.5, 39.0, 0.05)
    error = np.random.default_rng(seed).normal(scale=NOISE_RAD, size=(len(seconds), 3))
    rate = _rate(0.5 * (seconds[:-1] + seconds[1:])) @ R_IMU_CAM + np.diff(error, axis=0) / 0.05
    return SensorRates(seconds[:-1] - OFFSET, seconds[1:] - OFFSET, rate, least_correlation=0.3)


@each("seed", range(5))
def test_noise_of_the_images_is_not_taken_for_another_scale(seed: int):
    found = align_rates(_imu(1.0), "cam0", _camera(seed), None)
    assert found.offset == pytest.approx(OFFSET, abs=0.02)
    assert np.trace(found.rotation.T @ R_IMU_CAM) > 2.99


@pytest.mark.parametrize(("scale", "words"), [(1.4, "turns 1.[34]"), (180.0 / np.pi, "deg/s")])
def test_another_scale_is_named(scale: float, words: str):
    with pytest.raises(EstimationError, match=words):
        align_rates(_imu(scale), "cam0", _camera(0), None)


def _found_where_alike(own: np.ndarray, another: np.ndarray, nearer: bool) -> None:
    """The camera's 6 s are `own` in the IMU's axes. 12 s into the recording, or 24 s, the IMU turns so, with a little
    noise in the size; at the other time as `another`, which is as fast."""
    seconds = np.arange(0.0, 40.0, 0.005)
    gyro = 0.3 * _rate(seconds + 100.0)
    here, there = (np.flatnonzero(seconds >= t)[: len(own)] for t in ((12.0, 24.0) if nearer else (24.0, 12.0)))
    gyro[here] = own * (1.0 + 0.05 * np.random.default_rng(3).normal(size=(len(own), 1)))
    gyro[there] = another
    imu = ImuStream("imu0", (1e9 * seconds).astype(np.int64), gyro, np.zeros((len(seconds), 3)))
    images = np.arange(0.0, SPAN_S - 0.01, 0.05)
    rates = SensorRates(images[:-1], images[1:], _rate(0.5 * (images[:-1] + images[1:])) @ R_IMU_CAM)
    found = align_rates(ImuData.build(imu, ImuNoise(1e-3, 1e-2, 1e-5, 1e-4)), "cam0", rates, None)
    assert found.offset == pytest.approx(12.0 if nearer else 24.0, abs=0.01)
    assert np.trace(found.rotation.T @ R_IMU_CAM) > 2.999


@pytest.mark.parametrize("nearer", [True, False])
def test_turns_of_the_same_size_about_other_axes_are_another_motion(nearer: bool):
    own = _rate(np.arange(0.0, SPAN_S, 0.005))
    _found_where_alike(own, np.linalg.norm(own, axis=1)[:, None] * _turning_axis(len(own)), nearer)


@pytest.mark.parametrize("nearer", [True, False])
def test_turns_far_more_alike_are_preferred_to_turns_more_alike_in_size(nearer: bool):
    """Axes 15 degrees off are alike, by what is unexplained; those that are not off are more so."""
    own = _rate(np.arange(0.0, SPAN_S, 0.005))
    off = [rotation_from_vector(np.deg2rad(15.0) * axis) for axis in _turning_axis(len(own))]
    _found_where_alike(own, np.einsum("nij,nj->ni", off, own), nearer)


def _turning_axis(count: int) -> np.ndarray:
    """(count, 3) unit vectors along a spiral."""
    t = np.linspace(0.0, 1.0, count)
    z, angle = 2.0 * t - 1.0, 25.0 * t
    return np.stack([np.sqrt(1.0 - z**2) * np.cos(angle), np.sqrt(1.0 - z**2) * np.sin(angle), z], axis=1)


@pytest.mark.parametrize(
    ("on_wheels", "advice"),
    [(False, "turn the rig about the x and y axes of imu0 as well"), (True, "drive over ramps")],
)
def test_turns_about_one_axis_are_refused_with_what_the_rig_can_do(on_wheels: bool, advice: str):
    seconds = np.arange(0.0, 10.0, 0.005)
    gyro = np.zeros((len(seconds), 3))
    gyro[:, 2] = np.sin(seconds)
    stream = ImuStream("imu0", (1e9 * seconds).astype(np.int64), gyro, np.zeros_like(gyro))
    imu = ImuData.build(stream, ImuNoise(1e-3, 1e-2, 1e-5, 1e-4))
    rates = SensorRates(seconds[100:-101:10], seconds[110:-91:10], gyro[105:-96:10], least_correlation=0.3)
    with pytest.raises(EstimationError, match=f"cam0 turned about one axis only.*; {advice}, or give `rotation`"):
        check_two_axes(imu, rates, RateAlignment(0.0, np.eye(3), np.zeros(3)), "cam0", on_wheels)
