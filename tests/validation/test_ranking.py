"""Reasons are ranked by what they explain, on made-up fits and causes."""

from __future__ import annotations

import numpy as np
from tests.remarks import remark

from icalib.observability.assessor import Cause
from icalib.result import SensorFit
from icalib.sensors.camera.assess import image_velocity
from icalib.validation.causes import Misfit, any_explains, are_noise, ranked


def fits(*ratios: float) -> list[SensorFit]:
    return [SensorFit(f"imu{k}", "gyroscope", 1000, 900.0, 900.0 * ratio) for k, ratio in enumerate(ratios)]


def test_the_largest_gain_comes_first_and_ties_keep_their_order():
    causes = [Cause(remark("a"), 1.0), Cause(remark("b"), 9.0), Cause(remark("c"), 1.0), Cause(remark("d"), np.inf)]
    assert [c.sentence for c in ranked(causes)] == ["d", "b", "a", "c"]


def test_a_cause_explains_a_misfit_by_its_gain_alone():
    misfit = Misfit.of(fits(1.0, 5.0))
    assert misfit.sensors == {"imu1"} and misfit.chi2 == 3600.0
    assert any_explains([Cause(remark("a"), 361.0)], misfit) and not any_explains(
        [Cause(remark("a"), 359.0), Cause(remark("b"), 10.0)], misfit
    )
    assert not any_explains([], misfit)


def test_a_misfit_is_grave_from_four_times_the_noise_on():
    assert not Misfit.of(fits(15.9)).is_grave and Misfit.of(fits(16.1)).is_grave
    assert Misfit.of(fits(4.0, 9.0)).words == "gyroscope of imu1 3x, gyroscope of imu0 2x"


def test_noise_is_white_and_constant():
    rng = np.random.default_rng(2)
    white = rng.normal(size=(400, 2))
    assert are_noise(white) and are_noise(7.0 * white)
    assert not are_noise(np.cumsum(white, axis=0)), "a walk"
    waves = np.sin(0.05 * np.arange(400))[:, None]
    assert not are_noise(white + 0.6 * waves), "a slow error far below the noise"
    assert not are_noise(np.diff(white, axis=0)), "steps of a noisy position"
    assert not are_noise(white * np.where(np.arange(400) < 50, 5.0, 1.0)[:, None]), "one part is noisier"
    assert not are_noise(np.zeros((400, 2))) and not are_noise(white[:10])


def test_image_velocity_is_that_of_points_that_neighbours_show():
    """Points that move by 30 px/s; one image lacks point 1."""
    seconds = np.array([0.0, 0.1, 0.2, 0.3])
    image, point = np.array([0, 0, 1, 1, 2, 3, 3]), np.array([0, 1, 0, 1, 0, 0, 1])
    uv = np.stack([30.0 * seconds[image] + 5.0 * point, np.zeros(7)], axis=1)
    velocity, known = image_velocity(image, point, uv, seconds)
    assert known.tolist() == [False, False, True, False, True, False, False]
    np.testing.assert_allclose(velocity[known], [[30.0, 0.0]] * 2)
