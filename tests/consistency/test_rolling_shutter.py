"""Cameras whose rows, or columns, are exposed one after the other."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest
from scipy.stats import chi2
from tests.consistency.cases import Case, Run, compared, exact, known, no_imu, parameters
from tests.consistency.recordings import PAPER
from tests.remarks import names

from icalib.pipeline import calibrate_measurements
from icalib.rig import Rig
from icalib.tools.simulation import Scenario, Simulation, handheld, load_scenario, rig_for, simulate

pytestmark = pytest.mark.slow
READOUT_S = 20e-6  # largest error of a readout time


def rolling(scenario: Scenario, *readouts: float, **changes) -> Scenario:
    """The first cameras have these readout times, by rows and columns in turn."""
    ways = ("rows", "columns") * 2
    cameras = zip(scenario.cameras, readouts, ways, strict=False)
    rolled = (replace(c, readout_s=s, rolling=way, **changes) for c, s, way in cameras)
    return replace(scenario, cameras=tuple(rolled))


def in_a_room(*readouts: float, **changes) -> Scenario:
    """The cameras of the paper's robot, which track points."""
    scenario = replace(load_scenario(PAPER / "table2-3d.yaml"), sensors=(), board=False, **changes)
    return rolling(scenario, *readouts, corner_noise_px=0.3)


def all_free(simulation: Simulation) -> Rig:
    return rig_for(simulation.scenario, intrinsics="free", distortion="free")


def without_imu(simulation: Simulation) -> Rig:
    return all_free(simulation).with_(imu=None)


def warned(run: Run) -> None:
    assert "rolling_shutter_without_imu" in names(run.result.warnings)


def readout_within(bound: float):
    """Errors of readout times are below `bound` [s]."""

    def check(run: Run) -> None:
        assert max(abs(c.error[0]) for c in compared(run) if c.name == "readout") < bound

    return check


NOISELESS = {"imu_noise_enabled": False, "robot_noise_enabled": False, "imu_rate_hz": 2000.0}
CASES: dict[str, Case] = {
    "without noise": Case(
        lambda: simulate(rolling(handheld(8.0, noiseless=True), 0.03, -0.01), 0), [exact(2e-8), known(16)]
    ),
    "tracks, without noise": Case(
        lambda: simulate(in_a_room(0.03, 0.01, duration_s=8.0, **NOISELESS), 0), [exact(2e-8), known(16)]
    ),
    "tracks": Case(lambda: simulate(in_a_room(0.02, 0.01, duration_s=20.0), 1), [known()], all_free),
    "one camera without IMU": Case(
        lambda: simulate(rolling(handheld(20.0), 0.01, time_offset_s=0.0), 1),
        [exact(1e-4, 3e-3, 2e-3), warned],
        without_imu,
        no_imu,
    ),
    "two cameras without IMU": Case(
        lambda: simulate(rolling(handheld(20.0), 0.03, 0.03, time_offset_s=0.0), 1),
        [exact(5e-4, 3e-3, 2e-3), warned],
        without_imu,
        no_imu,
    ),
    "slow images without IMU": Case(
        lambda: simulate(rolling(handheld(20.0), 0.01, rate_hz=5.0), 1),
        rig=without_imu,
        seen=no_imu,
        refused=r"^cam0: without an IMU a rolling shutter needs 10 images in a second, and has 5; record faster",
    ),
}


@pytest.mark.parametrize("case", parameters(CASES))
def test_a_case(case: Case) -> None:
    case.verify()


@pytest.mark.parametrize("readout_s", [0.01, 0.03])
def test_standard_deviations_are_those_of_a_global_shutter(readout_s: float) -> None:
    """To a factor of 1.5, of all that both estimate; nothing is given but the target."""
    runs = []
    for scenario in (rolling(handheld(20.0), readout_s, readout_s), handheld(20.0)):
        simulation = simulate(scenario, 2)
        rig = all_free(simulation)
        runs.append(Run(simulation, rig, calibrate_measurements(rig, simulation.measurements)))
    known(32)(runs[0])
    readout_within(READOUT_S)(runs[0])
    rolled, still = ({(c.sensor, c.name): c.std for c in compared(run)} for run in runs)
    for key, std in still.items():
        assert (rolled[key] < 1.5 * std).all(), key


@pytest.mark.full
@pytest.mark.parametrize("readout_s", [0.01, 0.03])
def test_the_covariance_is_honest(readout_s: float) -> None:
    square, count = 0.0, 0
    for seed in range(12):
        simulation = simulate(rolling(handheld(15.0), readout_s, readout_s), seed)
        rig = all_free(simulation)
        result = calibrate_measurements(rig, simulation.measurements)
        found = list(compared(Run(simulation, rig, result)))
        e = np.concatenate([c.error for c in found])
        columns = [k for c in found for k in result.group(c.sensor, c.name).columns or ()]
        square += e @ np.linalg.solve(result.covariance[np.ix_(columns, columns)], e)
        count += len(e)
    low, high = chi2.ppf([0.005, 0.995], count)
    assert low < square < high, square / count


def by_rows(scenario: Scenario, readout_s: float) -> Scenario:
    """The second camera has this readout time."""
    first, second = scenario.cameras
    return replace(scenario, cameras=(first, replace(second, readout_s=readout_s, rolling="rows")))


FOUND = [(lambda: handheld(6.0), 0.0, False), (lambda: handheld(6.0), 0.004, True)]
FOUND_TOO = [
    (lambda: handheld(6.0), -0.03, True),
    (lambda: in_a_room(0.0, 0.0, duration_s=8.0), 0.01, True),
    (lambda: in_a_room(0.0, 0.0, duration_s=8.0), 0.0, False),
]


@pytest.mark.parametrize(
    ("make", "readout_s", "named"), [*FOUND, *(pytest.param(*x, marks=pytest.mark.full) for x in FOUND_TOO)]
)
def test_it_is_estimated_where_the_rig_file_has_none(
    make: Callable[[], Scenario], readout_s: float, named: bool
) -> None:
    simulation = simulate(by_rows(make(), readout_s), 3)
    rig = all_free(simulation).with_("settings", segments=8)
    rig = rig.with_(cameras=tuple(replace(c, rolling=None) for c in rig.cameras))
    result = calibrate_measurements(rig, simulation.measurements)
    said = [note for note in result.notes if note.name == "rolling_shutter_estimated"]
    assert [note.split()[0] for note in said] == (["cam1"] if named else [])
    assert "rolling_shutter" not in names(result.reasons)
    if named:
        readout = result.group("cam1", "readout")
        assert abs(readout.value[0] - readout_s) < min(4.0 * readout.std[0], 1e-4)
