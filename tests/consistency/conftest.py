"""Normalised estimation error squared (NEES) of simulated calibrations, block by block."""

from __future__ import annotations

import numpy as np
import pytest

from icalib.montecarlo.one_run import compare
from icalib.montecarlo.record import Record
from icalib.montecarlo.statistics import Nees, Sample, nees
from icalib.pipeline import calibrate_measurements
from icalib.rig import Rig
from icalib.simulation import Scenario, simulate

BLOCKS = ("rotation", "translation", "time_offset", "intrinsics", "distortion")


def mean_nees(
    scenario: Scenario, rig: Rig, seeds: range, probability: float, blocks: tuple[str, ...] = BLOCKS
) -> dict[str, Nees]:
    """Calibrates one simulated recording for each seed, from nothing. A block is that of all cameras together."""
    records = [_record(scenario, rig, seed) for seed in seeds]
    return {name: nees([_together(r, name) for r in records], probability) for name in blocks}


def _record(scenario: Scenario, rig: Rig, seed: int) -> Record:
    simulation = simulate(scenario, seed)
    result = calibrate_measurements(rig, simulation.measurements)
    assert result.converged, f"seed {seed}: {result.status}"
    return compare(seed, result, simulation.truth, [], 0.0)


def _together(record: Record, name: str) -> Sample:
    """The block `name` of all sensors, all else marginalised; every entry counts, whatever its verdict."""
    k = np.concatenate([record.columns(b.key) for b in record.blocks if b.name == name])
    return Sample(record.seed, record.error[k], record.covariance[np.ix_(k, k)])


@pytest.fixture
def consistency():
    """The function above, for tests that cannot import from here."""
    return mean_nees
