"""What changed between calibrations of a robot: found where it did, not found where it did not."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from math import sqrt
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from scipy.stats import norm
from tests.remarks import remark

from icalib.errors import CalibrationError
from icalib.result import Calibration, Verdict
from icalib.tools.fleet.result import Drift, by_chance, drift_of


def drift(calibrations: list[Calibration], limit: float = 3.0) -> Drift:
    return drift_of("anton", [f"job {k}" for k in range(len(calibrations))], _loader(calibrations), limit)


def _loader(calibrations: list[Calibration]) -> Callable[[str], Calibration]:
    return lambda name: calibrations[int(name.removeprefix("job "))]


def moved(c: Calibration, sensor: str, block: str, step: np.ndarray) -> Calibration:
    """The group with a step added; a rotation turned on the right."""
    g = c.group(sensor, block)
    value = g.value @ Rotation.from_rotvec(step).as_matrix() if g.value.ndim == 2 else g.value + step
    groups = tuple(dataclasses.replace(x, value=value) if x is g else x for x in c.groups)
    return dataclasses.replace(c, groups=groups)


def judged(c: Calibration, sensor: str, block: str, verdict: Verdict) -> Calibration:
    g = c.group(sensor, block)
    other = dataclasses.replace(g, verdict=(verdict, *g.verdict[1:]))
    return dataclasses.replace(c, groups=tuple(other if x is g else x for x in c.groups))


def test_a_camera_turned_by_ten_sigma_is_found_and_nothing_else(results: dict[str, Calibration]):
    found = drift([results["r0"], results["turned"]])
    assert found.sensors == ("cam1",)
    own, seen = found.changes
    assert {(c.difference.sensor, c.difference.what) for c in found.changes} == {("cam1", "rotation")}
    assert (own.at_its_sensor, seen.at_its_sensor) == (True, False) and seen.words.count("relative to cam0") == 1
    assert own.words.startswith("cam1 turned by 0.0") and "about its x axis" in own.words
    assert own.difference.sigmas is not None and 7.0 < own.difference.sigmas < 13.0
    assert (own.before, own.after) == ("job 0", "job 1")


def test_what_did_not_change_is_not_found(results: dict[str, Calibration]):
    found = drift([results["r0"], results["r1"]])
    assert (found.changes, found.unsure, found.notes) == ((), (), ()) and found.sensors == ()
    assert found.n_tested == 8  # two cameras' rotation, translation and time offset, and cam1 relative to cam0


def test_many_small_steps_are_found_from_the_first_to_the_last(results: dict[str, Calibration]):
    c = results["r0"]
    step = np.array([sqrt(2.0) * c.group("cam0", "time_offset").std[0]])
    slow = [moved(c, "cam0", "time_offset", k * step) for k in range(6)]
    found = drift(slow)
    (change,) = found.changes
    assert (change.before, change.after, change.difference.what) == ("job 0", "job 5", "time offset")
    assert change.difference.sigmas == pytest.approx(5.0, rel=1e-6)
    assert drift(slow, 5.5).changes == ()
    assert found.n_tested == 6 * 8


def test_a_step_is_told_once_however_many_follow(results: dict[str, Calibration]):
    c = results["r0"]
    step = np.array([0.0, 0.0, 20.0 * c.group("cam0", "translation").std[2]])
    other = moved(c, "cam0", "translation", step)
    found = [x for x in drift([c, c, other, other]).changes if x.difference.sensor == "cam0"]
    assert [(x.before, x.after) for x in found] == [("job 1", "job 2")]


def test_when_the_first_camera_moves_the_second_is_not_blamed(results: dict[str, Calibration]):
    c = results["r0"]
    found = drift([c, moved(c, "cam0", "rotation", np.array([0.01, 0.0, 0.0]))])
    assert {x.difference.sensor for x in found.changes} == {"cam0", "cam1"} and found.sensors == ("cam0",)


def test_what_is_unobservable_or_has_no_sigma_is_no_drift(results: dict[str, Calibration]):
    c = results["r0"]
    far = judged(moved(c, "cam0", "rotation", np.array([0.01, 0.0, 0.0])), "cam0", "rotation", "unobservable")
    found = drift([c, far])
    assert found.changes == () and {x.difference.sensor for x in found.unsure} == {"cam0", "cam1"}
    assert all("unobservable or too uncertain in B" in x.words for x in found.unsure)
    edited = moved(c, "cam0", "intrinsics", np.array([20.0, 20.0, 0.0, 0.0]))  # fixed in the rig file
    (lens,) = drift([c, edited]).unsure
    assert lens.difference.what == "lens" and "no standard deviation is known" in lens.words


def test_results_that_cannot_be_read_or_compared_are_notes(results: dict[str, Calibration]):
    c = results["r0"]

    def load(name: str) -> Calibration:
        if name == "b":
            raise CalibrationError("b is damaged; calibrate again.")
        return c

    found = drift_of("anton", ["a", "b", "c"], load, 3.0)
    assert found.notes == ("b is damaged; calibrate again.",) and found.n_tested == 8 and found.changes == ()
    alone = drift_of("anton", ["a"], load, 3.0)
    assert (alone.n_tested, alone.notes) == (0, ())


def test_a_result_that_is_not_usable_is_compared_with_nothing(results: dict[str, Calibration]):
    good = results["r0"]
    wrong = (remark("cam1 is wrong."),)
    bad = dataclasses.replace(results["turned"], wrong=wrong, warnings=wrong)
    found = drift([good, bad, good])
    assert (found.changes, found.unsure, found.n_tested) == ((), (), 8)
    assert found.notes == ("job 1 is not usable and is not compared: cam1 is wrong.",)


def test_chance_is_that_of_a_normal_deviate():
    assert by_chance(1000, 3.0) == pytest.approx(1000 * 2.0 * norm.sf(3.0))
    assert by_chance(0, 3.0) == 0.0


def test_results_on_disk_give_the_same(results: dict[str, Calibration], tmp_path: Path):
    from icalib.result import load_calibration

    for name in ("r0", "turned"):
        results[name].save(tmp_path / name)
    found = drift_of("anton", ["r0", "turned"], lambda name: load_calibration(tmp_path / name), 3.0)
    assert [c.words for c in found.changes] == [c.words for c in drift([results["r0"], results["turned"]]).changes]
