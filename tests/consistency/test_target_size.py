"""A target of another size than the rig file says: the accelerometer tells how large it is."""

from __future__ import annotations

import re
from dataclasses import replace

import numpy as np
import pytest
from scipy.stats import chi2
from tests.remarks import names
from tests.typed import instance

from icalib.base.remark import Remark
from icalib.data.measurements import Measurements
from icalib.geometry.targets import AprilGrid, Markers
from icalib.initialize.rig_guess import guess_of_rig
from icalib.observability.determination import determine
from icalib.observability.prior_sensitivity import relaxed
from icalib.pipeline import calibrate_measurements
from icalib.result import Calibration
from icalib.rig import Parameter, Rig
from icalib.tools.simulation import handheld, rig_for, simulate, tag_map
from icalib.validation.guesses import TargetSize, felt_size

SECONDS = 10.0


def of_size(rig: Rig, size: float) -> Rig:
    """The rig with a target said to be `size` times as large as it is."""
    target = instance(rig.target, AprilGrid)
    return replace(rig, target=replace(target, tag_size=size * target.tag_size))


def size_of(rig: Rig, measured: Measurements) -> TargetSize:
    inputs, state, guess = guess_of_rig(rig, [measured])
    estimate = determine(inputs, state, guess=guess).estimate
    size = felt_size(inputs, relaxed(inputs, estimate), 1.0)
    assert size is not None
    return size


def found(seed: int, said: float, **scenario) -> TargetSize:
    made = handheld(SECONDS, **scenario)
    return size_of(of_size(rig_for(made), said), simulate(made, seed).measurements)


@pytest.mark.parametrize("said", [1.1, *(pytest.param(x, marks=pytest.mark.full) for x in (1.0, 0.97))])
def test_without_noise_the_size_is_found(said):
    """Off by the square of the error, times 0.13, and this is in its standard deviation."""
    size, error = found(0, said, noiseless=True), 1.0 / said - 1.0
    assert size.ratio == pytest.approx(1.0 / said, abs=2e-5 + 0.15 * error**2)
    assert size.std < 2e-3 + 1.1 * error**2


def test_of_tags_in_a_room_all_sizes_and_distances_grow_together():
    made = replace(tag_map(), duration_s=8.0)
    rig = rig_for(made)
    target = instance(rig.target, Markers)
    smaller = replace(rig, target=replace(target, size=0.99 * target.size))
    size = size_of(smaller, simulate(made, 0).measurements)
    assert size.std < 1e-3
    assert abs(size.ratio - 1.0 / 0.99) < 4.0 * size.std


@pytest.mark.full
def test_a_length_that_is_known_shows_the_size_too():
    """A baseline that the rig file fixes: better than any accelerometer."""
    made = handheld(SECONDS)
    simulation, rig = simulate(made, 0), of_size(rig_for(made), 0.99)
    cameras = tuple(
        replace(c, translation=replace(c.translation, mode="fixed", value=simulation.truth.T_imu_sensor[c.name][:3, 3]))
        for c in rig.cameras
    )
    size = size_of(rig.with_(cameras=cameras), simulation.measurements)
    assert size.std < 0.75 * found(0, 0.99).std
    assert abs(size.ratio - 1.0 / 0.99) < 4.0 * size.std


def excess(seeds: range, said: float) -> list[float]:
    sizes = [found(seed, said) for seed in seeds]
    return [(s.ratio - 1.0 / said) / s.std for s in sizes]


@pytest.mark.full
@pytest.mark.parametrize("said", [1.0, 0.99])
def test_with_noise_it_is_off_by_what_is_said(said):
    z = np.array(excess(range(6), said))
    assert chi2.ppf(0.001, len(z)) < z @ z < chi2.ppf(0.999, len(z))


@pytest.mark.full
@pytest.mark.parametrize("said", [1.0, 0.99])
def test_over_many_recordings_it_is_off_by_what_is_said(said):
    z = np.array(excess(range(100, 150), said))
    assert chi2.ppf(0.025, len(z)) < z @ z < chi2.ppf(0.975, len(z))


def remarks(said: float, **changes) -> tuple[Remark, ...]:
    """Warnings and notes on the size."""
    scenario = replace(handheld(SECONDS), **changes)
    result = calibrate_measurements(of_size(rig_for(scenario), said), simulate(scenario, 0).measurements)
    return on_the_size(result)


def on_the_size(result: Calibration) -> tuple[Remark, ...]:
    return tuple(r for r in (*result.warnings, *result.notes) if r.name.startswith("target_size_"))


def test_a_print_that_was_fitted_to_the_page_is_a_warning():
    (warning,) = remarks(0.95)
    assert warning.name == "target_size_wrong" and "the target is 1.05" in warning


@pytest.mark.parametrize(("said", "certain"), [(0.9, True), pytest.param(0.97, False, marks=pytest.mark.full)])
def test_what_no_accelerometer_could_be_is_wrong(said, certain):
    """Accelerometers are off by 3 % at most."""
    scenario = handheld(SECONDS)
    result = calibrate_measurements(of_size(rig_for(scenario), said), simulate(scenario, 0).measurements)
    assert names(result.warnings)[:1] == ["target_size_wrong"]
    assert result.wrong == (result.warnings[:1] if certain else ())


def test_the_right_size_is_a_note():
    (note,) = remarks(1.0)
    assert note.name == "target_size_by_accelerometer" and re.search("the target is (1.000|0.999)", note)


def test_a_recording_that_does_not_show_it_says_nothing():
    scenario = handheld(SECONDS)
    still = replace(scenario, motion=replace(scenario.motion, kind="motionless"))
    rig, simulation = rig_for(still), simulate(still, 0)
    cameras = []
    for c in rig.cameras:
        T, offset = simulation.truth.T_imu_sensor[c.name], simulation.truth.time_offset[c.name]
        known = {"rotation": Parameter("fixed", T[:3, :3]), "time_offset": Parameter("fixed", np.array([offset]))}
        cameras.append(replace(c, translation=Parameter("free", T[:3, 3]), **known))
    result = calibrate_measurements(rig.with_(cameras=tuple(cameras)), simulation.measurements)
    assert on_the_size(result) == ()
