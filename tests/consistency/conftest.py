"""Normalised estimation error squared (NEES) of simulated calibrations, block by block."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from scipy.stats import chi2

from icalib.calibration import Calibration, ParameterGroup
from icalib.pipeline import calibrate_measurements
from icalib.rig import Rig
from icalib.simulation import Scenario, Truth, simulate

BLOCKS = ("rotation", "translation", "time_offset", "intrinsics", "distortion")


@dataclass(frozen=True)
class Consistency:
    """One block over all seeds, the cameras together.

    nees: mean over the seeds of e^T P^-1 e, per degree of freedom; low, high: where a consistent estimate's lies with
    the given probability; rms_error: over seeds and entries, rad, m, s or px; rms_std: what the covariance says of it.
    """

    nees: float
    low: float
    high: float
    rms_error: float
    rms_std: float

    @property
    def consistent(self) -> bool:
        return self.low <= self.nees <= self.high


def errors(result: Calibration, truth: Truth, group: ParameterGroup) -> np.ndarray:
    """(n,) estimated minus true; of rotations e of R_estimated = R_true Exp(e)."""
    name, value = group.sensor, group.value
    if group.name == "rotation":
        return Rotation.from_matrix(truth.T_imu_cam[name][:3, :3].T @ value).as_rotvec()
    true = {
        "translation": truth.T_imu_cam[name][:3, 3],
        "time_offset": np.array([truth.time_offset[name]]),
        "intrinsics": truth.intrinsics[name],
        "distortion": truth.distortion[name],
        "bloom": np.array([truth.bloom_px[name]]),
    }
    return value - true[group.name]


def block_errors(result: Calibration, truth: Truth, block: str) -> tuple[np.ndarray, np.ndarray]:
    """Errors (n,) of one block of all cameras, and their formal covariance (n, n), all else marginalised."""
    groups = [g for g in result.groups if g.name == block and g.sensor in truth.T_imu_cam and g.columns is not None]
    columns = np.concatenate([np.array(g.columns) for g in groups])
    return np.concatenate([errors(result, truth, g) for g in groups]), result.covariance[np.ix_(columns, columns)]


def mean_nees(
    scenario: Scenario, rig: Rig, seeds: range, probability: float, blocks: tuple[str, ...] = BLOCKS
) -> dict[str, Consistency]:
    """Calibrates one simulated recording for each seed, from nothing. Blocks that are fixed have no place in
    `blocks`."""
    found = {b: [] for b in blocks}
    for seed in seeds:
        simulation = simulate(scenario, seed)
        result = calibrate_measurements(rig, simulation.measurements)
        assert result.converged, f"seed {seed}: {result.status}"
        for b in blocks:
            found[b].append(block_errors(result, simulation.truth, b))
    return {b: _summary(found[b], probability) for b in blocks}


def _summary(found: list[tuple[np.ndarray, np.ndarray]], probability: float) -> Consistency:
    nees = [float(e @ np.linalg.solve(P, e)) for e, P in found]
    dof = sum(len(e) for e, _ in found)
    low, high = chi2.ppf([0.5 - 0.5 * probability, 0.5 + 0.5 * probability], dof) / dof
    errors, variances = np.array([e for e, _ in found]), np.array([np.diag(P) for _, P in found])
    return Consistency(
        sum(nees) / dof, low, high, float(np.sqrt(np.mean(errors**2))), float(np.sqrt(np.mean(variances)))
    )


@pytest.fixture
def consistency():
    """The function above, for tests that cannot import from here."""
    return mean_nees
