"""Normalised estimation error squared (NEES) of simulated calibrations, block by block."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from icalib.data.measurements import Measurements
from icalib.geometry.targets import AprilGrid, NoTarget
from icalib.pipeline import calibrate_measurements
from icalib.rig import Rig
from icalib.sensors.lidar.simulate import SimLidar
from icalib.sensors.wheels.simulate import SimWheels
from icalib.tools.montecarlo.record import RunRecord, compare
from icalib.tools.montecarlo.summary import Nees, Sample, nees
from icalib.tools.simulation import Scenario, load_scenario, simulate

BLOCKS = ("rotation", "translation", "time_offset", "intrinsics", "distortion")
PAPER = Path(__file__).parents[2] / "examples" / "paper"
WALL_GRID = AprilGrid(4, 10, 0.6, 0.3)
ENCODER = 0.005  # rad/sqrt(s), a good one's: with the paper's 0.03 it is chance whether hills show how wheels roll
ON_WALL = np.array([[0.0, 0.0, -1.0, 5.9], [-1.0, 0.0, 0.0, 3.9], [0.0, 1.0, 0.0, 0.1], [0.0, 0.0, 0.0, 1.0]])


def _as_measured(measurements: Measurements) -> Measurements:
    return measurements


def mean_nees(
    scenario: Scenario,
    rig: Rig,
    seeds: range,
    probability: float,
    blocks: tuple[str, ...] = BLOCKS,
    seen: Callable[[Measurements], Measurements] = _as_measured,
) -> dict[str, Nees]:
    """Calibrates what is `seen` of one simulated recording for each seed. A block is that of all sensors
    together."""
    records = [_record(scenario, rig, seed, seen) for seed in seeds]
    return {name: nees([_together(r, name) for r in records], probability) for name in blocks}


def _record(scenario: Scenario, rig: Rig, seed: int, seen: Callable[[Measurements], Measurements]) -> RunRecord:
    simulation = simulate(scenario, seed)
    result = calibrate_measurements(rig, seen(simulation.measurements))
    assert result.converged, f"seed {seed}: {result.status}"
    return compare(seed, result, simulation.truth, [], 0.0)


def _together(record: RunRecord, name: str) -> Sample:
    """The block `name` of all sensors, all else marginalised; every entry counts, whatever its verdict."""
    k = np.concatenate([record.columns(b.key) for b in record.blocks if b.name == name])
    return Sample(record.seed, record.error[k], record.covariance[np.ix_(k, k)])


@pytest.fixture
def consistency():
    """The function above, for tests that cannot import from here."""
    return mean_nees


def make_robot(example: str, seconds: float, parts: str, azimuth_steps: int = 150, **changes) -> Scenario:
    """The paper's robot with some of its `parts`: c a camera and a wall of tags, l a LiDAR of few points, w wheels."""
    scenario = load_scenario(PAPER / f"table2-{example}.yaml")
    lidars = tuple(replace(x, azimuth_steps=azimuth_steps) for x in scenario.of(SimLidar) if "l" in parts)
    wheels = tuple(replace(w, noise=ENCODER) for w in scenario.of(SimWheels) if "w" in parts)
    camera = replace(scenario.cameras[0], corner_noise_px=0.15)
    board = {"board": True, "T_world_board": ON_WALL, "target": WALL_GRID}
    if "c" not in parts:
        board = {"board": False, "target": NoTarget(), "T_world_bodies": np.zeros((0, 4, 4))}
    return replace(
        scenario,
        duration_s=seconds,
        features=None,
        cameras=(camera,) if "c" in parts else (),
        sensors=(*lidars, *wheels),
        **board,
        **changes,
    )


@pytest.fixture(scope="session")
def robot() -> Callable[..., Scenario]:
    """The function above, for tests that cannot import from here."""
    return make_robot
