"""Images whose stamps jitter: removed where the camera runs evenly, else estimated, named, and in the sigmas."""

from __future__ import annotations

import re
from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from tests.remarks import named, names

from icalib.base.remark import Remark
from icalib.pipeline import calibrate_measurements
from icalib.result import Calibration
from icalib.rig import Settings
from icalib.sensors.camera.read.detected_corners import with_even_stamps
from icalib.tools.simulation import Simulation, handheld, rig_for, simulate

pytestmark = pytest.mark.slow


def calibrated(simulation: Simulation, late_s: np.ndarray) -> tuple[Calibration, tuple[Remark, ...]]:
    stream = simulation.measurements.cameras[0]
    stamped = replace(stream, stamps_ns=stream.stamps_ns + np.round(1e9 * late_s).astype(np.int64))
    ((found, notes),) = with_even_stamps([(stamped, ())], {"cam0": "here (cam0)"})
    result = calibrate_measurements(
        rig_for(simulation.scenario, settings=Settings()), simulation.measurements.with_streams(found)
    )
    return result, (*notes, *result.notes)


def filmed(jitter_s: float) -> Simulation:
    scenario = handheld(20.0)
    camera = replace(scenario.cameras[0], jitter_s=jitter_s)
    return simulate(replace(scenario, cameras=(camera,)), 2)


def errors(simulation: Simulation, result: Calibration) -> np.ndarray:
    """(6,) errors of rotation and translation over their standard deviations."""
    T, found = simulation.scenario.cameras[0].T_imu_sensor, result.T_imu_sensor("cam0")
    turn = Rotation.from_matrix(T[:3, :3].T @ found[:3, :3]).as_rotvec()
    std = {g.name: g.std for g in result.groups if g.sensor == "cam0"}
    return np.concatenate([turn / std["rotation"], (found[:3, 3] - T[:3, 3]) / std["translation"]])


@pytest.mark.parametrize("size_ms", [3.0, pytest.param(0.5, marks=pytest.mark.full)])
def test_jitter_of_an_even_camera_is_removed(size_ms):
    simulation = filmed(0.0)
    late_s = 1e-3 * size_ms * np.random.default_rng(1).normal(size=len(simulation.measurements.cameras[0].stamps_ns))
    result, notes = calibrated(simulation, late_s)
    assert "at 20.00 Hz" in named("stamps_jitter", notes) and result.reasons == ()
    assert np.abs(errors(simulation, result)).max() < 4.0
    (offset,) = (g for g in result.groups if (g.sensor, g.name) == ("cam0", "time_offset"))
    assert offset.std[0] < 3e-5


def test_jitter_of_an_uneven_camera_is_named_and_in_the_sigmas():
    """1 ms, which leaves a time offset of 1 ms / sqrt(images) at best."""
    simulation = filmed(8e-3)
    late_s = 1e-3 * np.random.default_rng(1).normal(size=len(simulation.measurements.cameras[0].stamps_ns))
    result, notes = calibrated(simulation, late_s)
    assert "stamps_jitter" not in names(notes)
    found = re.search(r"of cam0 jitter by ([\d.]+) \+- ([\d.]+) ms", named("image_stamps_jitter", notes))
    assert found is not None and float(found[1]) == pytest.approx(1.0, abs=4.0 * float(found[2]))
    assert result.reasons == () and np.abs(errors(simulation, result)).max() < 4.0
    (offset,) = (g for g in result.groups if (g.sensor, g.name) == ("cam0", "time_offset"))
    assert offset.std[0] == pytest.approx(1e-3 / np.sqrt(len(late_s)), rel=0.2)
    assert all(0.7 < fit.chi2_per_dof < 1.3 for fit in result.fits if fit.chi2_per_dof)
