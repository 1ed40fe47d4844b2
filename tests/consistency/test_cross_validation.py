"""What one half of a recording makes of the other: as noise would where noise is all there is, and worse where not."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest
from tests.consistency.recordings import make_robot
from tests.consistency.test_several_recordings import pair
from tests.consistency.test_without_imu import alone, stereo
from tests.remarks import names

from icalib.data.measurements import Measurements
from icalib.pipeline import calibrate_measurements
from icalib.result import Calibration, CrossValidation
from icalib.rig import Camera, Rig, Settings
from icalib.tools.montecarlo.record import compare
from icalib.tools.simulation import Scenario, handheld, rig_for, simulate, with_drawn_guess

SEEDS = range(6)
PLAIN = Settings(loss="none", outlier_std=0.0, bloom=False, board_shape=False, blur_noise=False)


def run(
    scenario: Scenario, seed: int, changed: Callable[[Measurements], Measurements] = lambda m: m, **camera: float | None
) -> Calibration:
    """With intrinsics found too; `camera`: changes of the cameras in the rig file."""
    rig = rig_for(scenario, settings=PLAIN, intrinsics="start", distortion="start")
    rig = rig.with_(cameras=tuple(replace(c, **camera) for c in rig.cameras))
    return calibrate_measurements(rig, changed(simulate(scenario, seed).measurements))


def held(c: Calibration) -> CrossValidation:
    assert c.cross_validation is not None
    return c.cross_validation


@pytest.fixture(scope="module")
def honest() -> list[CrossValidation]:
    return [held(run(handheld(12.0), seed)) for seed in SEEDS]


@pytest.mark.full
def test_where_noise_is_all_there_is_it_is_as_expected(honest: list[CrossValidation]):
    """Over all seeds within 3 standard deviations, each within 4; and neither by being too wide."""
    excess, expected = (sum(getattr(h, name) for h in honest) for name in ("excess", "expected"))
    spread = float(np.sqrt(sum(h.spread**2 for h in honest)))
    assert abs(excess - expected) < 3.0 * spread < 0.4 * expected
    assert all(abs(h.excess - h.expected) < 4.0 * h.spread for h in honest)
    assert not any(h.optimistic for h in honest)
    assert all(0.5 < h.factor < 1.5 for h in honest)


@pytest.mark.full
def test_what_moves_without_a_part_is_as_allowed(honest: list[CrossValidation]):
    """Without each of 8 parts, 32 parameters that correlate: the mean square over 6 seeds has about 6 x 7 x 10 free."""
    z = np.concatenate([h.whitened for h in honest])
    assert np.isfinite(z).all()
    assert np.mean(z**2) == pytest.approx(1.0, abs=0.3)


@pytest.mark.full
def test_residuals_that_took_part_are_smaller_than_predicted_ones(honest: list[CrossValidation]):
    """Of corners, which carry most of it; RMS and chi^2 tell the same."""
    for h in honest:
        corners = [f for f in h.fits if f.kind == "corners"]
        assert [f.sensor for f in corners] == ["cam0", "cam1"]
        for f in corners:
            assert f.unit == "px" and f.rms_inside is not None and f.rms_outside is not None
            assert f.rms_outside**2 / f.rms_inside**2 == pytest.approx(f.chi2_outside / f.chi2_inside, rel=1e-4)
        assert sum(f.chi2_outside - f.chi2_inside for f in h.fits) == pytest.approx(h.excess, rel=0.02)


def test_noise_that_is_stated_too_small_shows():
    """By half: chi^2 rises four times as much, and the factor is two."""
    scenario = handheld(12.0)
    stated = 0.5 * scenario.cameras[0].corner_noise_px
    found = held(run(scenario, 1, corner_noise_px=stated))
    assert found.optimistic
    assert found.factor == pytest.approx(2.0, abs=0.5)


def test_errors_that_stay_for_a_second_show():
    """Each corner is off by the same 0.6 px for a second, 20 images: an error that does not average down. The
    size of the noise is found from residuals, and does not show it."""

    def off(m: Measurements) -> Measurements:
        rng, streams = np.random.default_rng(8), []
        for s in m.cameras:
            second = (s.seconds[s.image] - s.seconds[0]).astype(int)
            errors = 0.6 * rng.normal(size=(second.max() + 1, s.point.max() + 1, 2))
            streams.append(replace(s, uv=s.uv + errors[second, s.point]))
        return m.with_streams(*streams)

    result = run(handheld(12.0), 1, off, corner_noise_px=None)
    found, ratios = held(result), [f.chi2_per_dof for f in result.fits if f.kind == "corners"]
    assert ratios == pytest.approx([1.0, 1.0], abs=0.1)
    assert found.optimistic and found.excess > 2.0 * found.expected


@pytest.mark.full
def test_a_short_recording_is_split_into_as_many_parts_as_it_has():
    scenario = handheld(3.0)
    rig = rig_for(scenario, settings=replace(PLAIN, segments=25), intrinsics="start", distortion="start")
    result = calibrate_measurements(rig, simulate(scenario, 0).measurements)
    assert result.cross_validation is not None and 10 < result.cross_validation.segments < 25
    assert "recording_too_short" not in names(result.warnings)


def test_a_recording_that_is_not_split_says_so():
    scenario = handheld(3.0)
    rig = rig_for(scenario, settings=replace(PLAIN, segments=1), intrinsics="start", distortion="start")
    result = calibrate_measurements(rig, simulate(scenario, 0).measurements)
    assert result.cross_validation is None
    assert "recording_too_short" in names(result.warnings)


def as_noise_makes_it(found: CrossValidation) -> bool:
    return abs(found.excess - found.expected) < 4.0 * found.spread


@pytest.mark.full
def test_of_two_recordings_each_finds_how_its_board_leans():
    """A part each: each half has a tilt of its own, of which the other knows nothing."""
    simulations = pair(1)
    rig = rig_for(simulations[0].scenario, settings=replace(PLAIN, segments=2), intrinsics="start", distortion="start")
    result = calibrate_measurements(rig, [s.measurements for s in simulations])
    found = held(result)
    assert (found.segments, found.directions) == (2, len(result.covariance) - 4)
    assert as_noise_makes_it(found)


def test_without_an_imu_parts_are_runs_of_images():
    simulation = simulate(stereo(), 2)
    rig, measurements = alone(simulation)
    result = calibrate_measurements(replace(rig, settings=replace(PLAIN, segments=4)), measurements)
    found = held(result)
    assert (found.segments, found.directions) == (4, len(result.covariance))
    assert [f.kind for f in found.fits] == ["corners", "corners"]
    assert as_noise_makes_it(found)


@pytest.mark.full
def test_where_planes_are_in_the_world_is_nothing_to_predict(robot: Callable[..., Scenario]):
    """A LiDAR and an IMU: nobody sees where the world's origin is, nor which way it faces."""
    scenario = robot("3d", 15.0, "l")
    rig = rig_for(scenario, settings=replace(PLAIN, segments=8))
    result = calibrate_measurements(rig, simulate(scenario, 0).measurements)
    found = held(result)
    assert found.directions == len(result.covariance) - 4
    assert as_noise_makes_it(found)
    points = next(f for f in found.fits if f.kind == "points")
    assert points.unit == "m" and points.rms_inside == pytest.approx(points.rms_outside, rel=0.01)


@pytest.mark.full
def test_with_all_that_is_on_by_default_and_noise_alone():
    """The robust loss and noise found from residuals leave it near 1."""
    scenario = handheld(12.0)
    rig: Rig = replace(rig_for(scenario, intrinsics="start", distortion="start"), settings=Settings())
    rig = rig.with_(cameras=tuple(_unstated(c) for c in rig.cameras))
    found = [held(calibrate_measurements(rig, simulate(scenario, seed).measurements)) for seed in range(20)]
    excess, expected = (sum(getattr(h, name) for h in found) for name in ("excess", "expected"))
    assert excess == pytest.approx(expected, rel=0.2)


def _unstated(camera: Camera) -> Camera:
    return replace(camera, corner_noise_px=None)


@pytest.mark.full
def test_a_half_that_knows_planes_badly_is_no_alarm():
    """A LiDAR on a vehicle on a flat floor, its planes found in the clouds. Measured residuals of the other half rise
    by 175 where noise makes them rise by 167 +- 34, and all errors are honest."""
    scenario = make_robot("planar", 15.0, "l")
    simulation = simulate(scenario, 5)
    rig = with_drawn_guess(rig_for(scenario, settings=Settings()), scenario, 5)
    result = calibrate_measurements(rig, simulation.measurements.unassociated())
    record = compare(5, result, simulation.truth, [], 0.0)
    assert np.abs(record.error / np.sqrt(np.diag(record.covariance))).max() < 3.0
    assert not held(result).optimistic, held(result)
    assert "halves_disagree" not in names(result.warnings)
