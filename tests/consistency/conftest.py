"""Normalised estimation error squared (NEES) of simulated calibrations, block by block."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest
from tests.consistency.recordings import make_robot

from icalib.data.measurements import Measurements
from icalib.pipeline import calibrate_measurements
from icalib.rig import Rig
from icalib.tools.montecarlo.record import RunRecord, compare
from icalib.tools.montecarlo.summary import Nees, Sample, nees
from icalib.tools.simulation import Scenario, simulate

BLOCKS = ("rotation", "translation", "time_offset", "intrinsics", "distortion")


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


@pytest.fixture(scope="session")
def robot() -> Callable[..., Scenario]:
    """Makes the scenario of a robot."""
    return make_robot
