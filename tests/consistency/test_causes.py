"""The first reason is the true one: a clock that drifts or jumps, a mount that moves, a lens, a shock."""

from __future__ import annotations

import re
from dataclasses import replace

import numpy as np
import pytest

from icalib.data.measurements import CornerStream, Measurements
from icalib.pipeline import calibrate_measurements
from icalib.result import Calibration
from icalib.rig import Settings
from icalib.tools.simulation import Scenario, Simulation, handheld, rig_for, simulate

SECONDS = 15.0


@pytest.fixture(scope="module")
def simulation() -> Simulation:
    return simulate(handheld(SECONDS), 1)


def calibrated(simulation: Simulation, measured: Measurements, lens: str = "fixed") -> Calibration:
    rig = rig_for(simulation.scenario, settings=Settings(), intrinsics=lens, distortion=lens)  # pyright: ignore
    return calibrate_measurements(rig, measured)


def with_first(m: Measurements, stream: CornerStream) -> Measurements:
    return m.with_streams(stream, *m.cameras[1:])


def stamped(m: Measurements, late_s: np.ndarray) -> Measurements:
    """The images of cam0 stamped late by so much (M,)."""
    cam0 = m.cameras[0]
    return with_first(m, replace(cam0, stamps_ns=cam0.stamps_ns + np.round(1e9 * late_s).astype(np.int64)))


def spliced(simulation: Simulation, second: Scenario) -> Measurements:
    """cam0 as another scenario has it from two thirds of the recording on, with the same noise."""
    m, other = simulation.measurements, simulate(second, 1).measurements.cameras[0]
    own = m.cameras[0]
    k = 2 * len(own.stamps_ns) // 3
    counts = np.concatenate([np.diff(own.start)[:k], np.diff(other.start)[k:]])
    columns = {
        n: np.concatenate([getattr(own, n)[own.image < k], getattr(other, n)[other.image >= k]]) for n in COLUMNS
    }
    return with_first(m, replace(own, start=np.concatenate([[0], np.cumsum(counts)]), **columns))


COLUMNS = ("point", "uv")


def test_a_clean_recording_has_no_reason(simulation):
    assert calibrated(simulation, simulation.measurements).reasons == ()


@pytest.mark.parametrize(
    ("ppm", "verdict"), [(300.0, "not usable"), (-100.0, "usable with care"), (60.0, "usable with care")]
)
def test_a_clock_that_drifts(simulation, ppm, verdict):
    """The rate is that of the drift to a tenth; stamps that run fast need an offset that falls."""
    seconds = simulation.measurements.cameras[0].seconds
    result = calibrated(simulation, stamped(simulation.measurements, 1e-6 * ppm * seconds))
    words = result.reasons[0]
    match = re.search(r"the clock of cam0 .*drifts against the others by about ([+-]\d+) ppm", words)
    assert match is not None and result.verdict == verdict, result.reasons
    assert float(match[1]) == pytest.approx(-ppm, rel=0.15)


def test_a_clock_that_two_cameras_share(simulation):
    """Neither drifts against the other, both against the IMU."""
    late = [
        replace(c, stamps_ns=c.stamps_ns + np.round(3e5 * c.seconds).astype(np.int64))
        for c in simulation.measurements.cameras
    ]
    result = calibrated(simulation, simulation.measurements.with_streams(*late))
    assert "the clock of cam0 and cam1 drifts against the others by about -3" in result.reasons[0], result.reasons


def test_a_clock_that_jumps(simulation):
    seconds = simulation.measurements.cameras[0].seconds
    result = calibrated(simulation, stamped(simulation.measurements, np.where(seconds > 9.4, 0.004, 0.0)))
    assert re.search(r"the time offset of cam0 changes by about [+-](3|4)\S* ms near 9\.\d", result.reasons[0]), (
        result.reasons
    )


def test_a_camera_that_moves_on_its_mount(simulation):
    cam0, cam1 = simulation.scenario.cameras
    T = cam0.T_imu_sensor.copy()
    T[:3, 3] += [0.0, 0.003, 0.0]
    result = calibrated(
        simulation, spliced(simulation, replace(simulation.scenario, cameras=(replace(cam0, T_imu_sensor=T), cam1)))
    )
    assert re.search(r"cam\d changes near (9|10|11)\.\d+ s: it moves on its mount", result.reasons[0]), result.reasons


def test_a_lens_that_refocuses(simulation):
    """By 1 % of its focal length, which a shift along the axis explains nearly as well: both are named."""
    cam0, cam1 = simulation.scenario.cameras
    zoomed = replace(cam0, intrinsics=tuple(np.multiply(cam0.intrinsics, [1.01, 1.01, 1.0, 1.0])))
    measured = spliced(simulation, replace(simulation.scenario, cameras=(zoomed, cam1)))
    words = calibrated(simulation, measured, "start").reasons[0]
    assert re.search(r"cam0 changes near .*: .*its lens by up to (3|4)\.\d px", words) and "autofocus" in words


def test_a_shock_at_one_time(simulation):
    """Its time is that of the shock, and the parts that are named leave it out."""
    imu = simulation.measurements.imu
    assert imu is not None
    accel = imu.accel.copy()
    hit = imu.seconds.searchsorted(7.5)
    accel[hit : hit + 5] += [40.0, -25.0, 10.0]
    result = calibrated(simulation, simulation.measurements.with_streams(replace(imu, accel=accel)))
    match = re.search(r"comes at one time, near (\S+) s: .* --to (\S+), or --from (\S+)\.", result.reasons[0])
    assert match is not None and float(match[2]) < 7.5 < float(match[3]), result.reasons
    assert abs(float(match[1]) - 7.5) < 0.5 and "noise: {" not in " ".join(result.reasons)
