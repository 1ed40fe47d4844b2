"""Statistics over many recordings: the covariance is honest for every block of parameters and every kind of rig. Hours
all together; test_sigmas.py has what continuous integration runs of it."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
import pytest
from scipy.stats import chi2
from tests.consistency.cases import Case, Run, compared, heights_at_the_guess, known, planes_found, roll_at_the_guess
from tests.consistency.conftest import BLOCKS, mean_nees
from tests.consistency.recordings import MOUNTS, WHEEL_KINDS, make_robot, mocap, moving, reporting, steady, without_imu
from tests.consistency.test_boards import guessed
from tests.consistency.test_lidars import NEAR, displaced, drawn, passed_by, robust
from tests.consistency.test_vehicles import sliding

from icalib.data.measurements import Measurements
from icalib.pipeline import calibrate_measurements
from icalib.rig import Rig, drive_names
from icalib.sensors.sensor import CLOCK_RATE
from icalib.tools.simulation import Scenario, handheld, rig_for, simulate

pytestmark = pytest.mark.full

DRIVEN = (*MOUNTS, "radii", "baseline")
RIG_WITHOUT_IMU = np.array([0, 3, 5, 6, 7, 8, 9])  # roll, x, z, time offset, radii, baseline of wheels


def as_measured(measurements: Measurements) -> Measurements:
    return measurements


def rolling(scenario: Scenario) -> Rig:
    return steady(rig_for(scenario))


def lens_guessed(scenario: Scenario) -> Rig:
    return rig_for(scenario, intrinsics="start", distortion="start")


def clock_known(scenario: Scenario) -> Rig:
    return rig_for(scenario, time_offset="fixed")


@dataclass(frozen=True, eq=False)
class Study:
    """The mean NEES of each block over so many seeds lies within its chi^2 bounds of this probability."""

    scenario: Callable[[], Scenario]
    rig: Callable[[Scenario], Rig]
    seeds: int = 50
    probability: float = 0.999
    blocks: tuple[str, ...] = DRIVEN
    seen: Callable[[Measurements], Measurements] = as_measured


def noisy_imu() -> Scenario:
    scenario = make_robot("3d", 12.0, "l", 600)
    return replace(scenario, imu_noise=scenario.imu_noise.scaled(10.0))


STUDIES: dict[str, Study] = {
    **{
        f"{'asynchronous' if apart else 'synchronous'} cameras, {imu} IMU": Study(
            lambda apart=apart, imu=imu: handheld(12.0, asynchronous=apart, imu=imu), lens_guessed, 50, 0.95, BLOCKS
        )
        for apart in (False, True)
        for imu in ("datasheet", "noisy")
    },
    "camera and wheels": Study(lambda: make_robot("ramp", 30.0, "cw"), rolling),
    "LiDAR": Study(lambda: make_robot("3d", 16.0, "l"), rolling, blocks=MOUNTS),
    "LiDAR, planes found": Study(
        lambda: make_robot("3d", 16.0, "l", 600), rolling, blocks=MOUNTS, seen=Measurements.unassociated
    ),
    # Between keyframes the gyroscope loses as much as the LiDAR sees: taken for exact there, NEES is 3.8.
    "LiDAR, noisy IMU": Study(noisy_imu, clock_known, 12, 0.999, ("rotation", "translation")),
    "camera, LiDAR and wheels": Study(lambda: make_robot("ramp", 30.0, "clw", 200), rolling),
    **{
        f"wheels that report {reports}": Study(
            lambda reports=reports: reporting(make_robot("ramp", 30.0, "cw"), reports),
            rolling,
            blocks=(*MOUNTS, *drive_names(kind)),
        )
        for reports, kind in WHEEL_KINDS.items()
    },
}


@pytest.mark.parametrize("name", STUDIES)
def test_the_covariance_is_honest(name: str) -> None:
    study = STUDIES[name]
    scenario, seeds = study.scenario(), range(study.seeds)
    found = mean_nees(scenario, study.rig(scenario), seeds, study.probability, study.blocks, study.seen)
    print({block: (round(c.mean, 3), round(c.low, 3), round(c.high, 3)) for block, c in found.items()})
    assert {block: c for block, c in found.items() if not c.consistent} == {}


def errors(scenario: Scenario, seed: int, change: Callable[[Rig], Rig] = lambda rig: rig):
    """Of everything that is estimated without an IMU but rates of clocks, and their covariance."""
    rig, measurements, simulation = without_imu(scenario, seed)
    result = calibrate_measurements(change(rig), measurements)
    assert result.converged, seed
    e = np.concatenate([c.error for c in compared(Run(simulation, rig, result)) if c.name != CLOCK_RATE.name])
    groups = [g for g in result.groups if g.columns and g.sensor in rig.sensors and g.name != CLOCK_RATE.name]
    columns = [k for g in groups for k in g.columns or ()]
    assert len(columns) == len(e) == 10
    return e, result.covariance[np.ix_(columns, columns)]


@pytest.mark.parametrize(("parts", "seconds", "seeds"), [("w", 20.0, 20), ("cw", 30.0, 30)])
def test_without_imu_the_covariance_is_honest(parts: str, seconds: float, seeds: int) -> None:
    """Of what does not hang on the slip that the rig file allows for, and simulated wheels do not have: yaw, pitch and
    sideways are known far better than their standard deviations say. Beside the camera wheels are as free of slip as
    simulated ones."""
    scenario, runs = make_robot("ramp", seconds, parts), []
    scenario = scenario.with_sensors(mocap()) if parts == "w" else scenario
    for seed in range(seeds):
        e, P = errors(scenario, seed, steady if parts == "cw" else lambda rig: rig)
        k = RIG_WITHOUT_IMU
        runs.append(e[k] @ np.linalg.solve(P[np.ix_(k, k)], e[k]))
    low, high = chi2.ppf([0.005, 0.995], len(runs) * len(RIG_WITHOUT_IMU))
    assert low < np.sum(runs) < high, np.array(runs) / len(RIG_WITHOUT_IMU)


def test_the_clock_of_wheels_that_say_more_than_the_poses() -> None:
    """The rate of a keyframe is the mean until the next. Carried backwards as well, it goes with the noise of one
    neighbour more than with the other's, and the time offset is off by 0.6 ms, three standard deviations."""
    normal = []
    for seed in (15, 16, 17, 19):
        e, P = errors(make_robot("ramp", 20.0, "w").with_sensors(mocap()), seed)
        normal.append(e[6] / np.sqrt(P[6, 6]))
    assert abs(np.mean(normal)) < 1.3, normal  # 99 % of the mean of four


MANY: dict[str, Callable[[int], Case]] = {
    **{
        f"a flat floor, {parts}": lambda seed, parts=parts: Case(
            lambda: simulate(make_robot("planar", 30.0, parts, 600), seed),
            [known(), heights_at_the_guess, roll_at_the_guess],
            lambda s: drawn(s, seed),
            planes_found,
        )
        for parts in ("cw", "clw", "l")
    },
    **{
        f"points are {seen.__name__.replace('_', ' ')}": lambda seed, seen=seen: Case(
            lambda: simulate(make_robot("3d", 16.0, "l", 600), seed), [known(), *NEAR], robust, seen
        )
        for seen in (displaced, passed_by)
    },
    **{  # at the drives' 0.9 m/s or so 4 and 10 mm/s RMS
        f"wheels slide by {degrees} deg": lambda seed, degrees=degrees: Case(
            lambda: simulate(sliding(degrees), seed), [known()]
        )
        for degrees in (0.5, 1.25)
    },
}


@pytest.mark.parametrize("seed", range(10))
@pytest.mark.parametrize("name", MANY)
def test_what_is_called_known_is_right(name: str, seed: int) -> None:
    MANY[name](seed).verify()


@pytest.mark.parametrize("imu", ["datasheet", "noisy"])
@pytest.mark.parametrize("kind", ["handheld", "planar", "single_axis", "motionless"])
def test_no_confident_wrong_number_in_a_hundred(kind: str, imu) -> None:
    for seed in range(100):
        Case(
            lambda seed=seed: simulate(moving(handheld(20.0, imu=imu), kind), seed), [known()], guessed("prior", seed)
        ).verify()
