"""Positions in the frame of the target, of a pose sensor or of another position sensor: nothing is estimated of it."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.stats import chi2
from tests.sensors.position.test_position_runs import antenna, errors, pose

from icalib.data.measurements import PoseStream
from icalib.pipeline import calibrate_measurements
from icalib.sensors.pose.simulate import SimPoses
from icalib.sensors.position.stream import PositionStream
from icalib.tools.simulation import Drive, Room, Scenario, rig_for, simulate
from icalib.tools.simulation.scenario import SimCamera

pytestmark = pytest.mark.slow

OTHER = np.array([-0.5, 0.2, 0.3])
FRAME = pose([3.0, -1.0, 0.5], 2.1)
LENS = (460.0, 460.0, 375.5, 239.5), (-0.28, 0.07, 0.0, 0.0)
SILENT = {
    "imu_noise_enabled": False,
    "corner_noise_enabled": False,
    "robot_noise_enabled": False,
    "imu_rate_hz": 2000.0,
    "gyro_bias": (0.0,) * 3,
    "accel_bias": (0.0,) * 3,
}


def with_target(duration_s=12.0, **fields):
    """A camera moved by hand before a target, and a prism whose positions are in the target's frame."""
    camera = SimCamera("cam0", "pinhole-radtan", (752, 480), *LENS, np.eye(4), rate_hz=10.0)
    plain = Scenario((camera,), duration_s=duration_s, **fields)
    prism = antenna(rate_hz=10.0, position_noise=2e-3, T_world_frame=plain.T_world_board, shared_frame="target")
    return replace(plain, sensors=(prism,))


def in_a_room(*sensors, duration_s=20.0, **fields):
    room = Room((30.0, 20.0, 6.0))
    motion = Drive("free")
    return Scenario((), duration_s=duration_s, motion=motion, board=False, room=room, sensors=sensors, **fields)


def with_mocap(**fields):
    """A pose sensor, and a marker elsewhere on the rig in the same frame, which is tilted."""
    tilted = FRAME.copy()
    tilted[:3, :3] = tilted[:3, :3] @ np.array([[1.0, 0.0, 0.0], [0.0, 0.6, -0.8], [0.0, 0.8, 0.6]])
    poses = SimPoses("mocap0", pose([0.1, 0.1, 0.1]), T_world_frame=tilted)
    return in_a_room(poses, antenna(T_world_frame=tilted, shared_frame="mocap0"), **fields)


def with_another(**fields):
    """Two antennas that share east, north and up; the second one has the frame."""
    return in_a_room(antenna(shared_frame="gnss1"), antenna("gnss1", OTHER), **fields)


MADE = {"target": with_target, "mocap0": with_mocap, "gnss1": with_another}


def calibrated(scenario, seed=1):
    sim = simulate(scenario, seed)
    return calibrate_measurements(rig_for(scenario), sim.measurements), sim


@pytest.mark.parametrize("frame", ["target", *(pytest.param(x, marks=pytest.mark.full) for x in ("mocap0", "gnss1"))])
def test_exact_without_noise(frame):
    result, sim = calibrated(MADE[frame](**SILENT))
    error, _ = errors(result, sim)
    assert np.abs(error).max() < 1e-9


def test_a_shared_frame_may_have_its_origin_far_away():
    """As in UTM coordinates: poses and fixes get the same new origin."""
    sim = simulate(with_mocap(**SILENT), 1)
    far = [s.relative_to(np.array([-465_875.0, -5_248_232.0, 0.0])) for s in sim.measurements.of(PoseStream)]
    far += [s.relative_to(np.array([-465_875.0, -5_248_232.0, 0.0])) for s in sim.measurements.of(PositionStream)]
    result = calibrate_measurements(rig_for(sim.scenario), sim.measurements.with_streams(*far))
    assert np.abs(errors(result, sim)[0]).max() < 1e-7


def test_a_known_frame_tells_more_than_one_that_is_estimated():
    """A prism in the frame of a target: a frame of its own costs twice the standard deviation of the lever arm."""
    scenario = with_target()
    result, sim = calibrated(scenario)
    own = rig_for(scenario).with_("gnss0", frame="tilted")
    apart = calibrate_measurements(own, sim.measurements)
    assert (errors(result, sim)[1] < 0.5 * errors(apart, sim)[1])[:3].all()
    assert result.group("gnss0", "translation").verdict == ("determined",) * 3


@pytest.mark.full
@pytest.mark.parametrize("frame", MADE)
def test_errors_are_as_large_as_their_covariance_says(frame):
    nees = []
    for seed in range(30):
        result, sim = calibrated(MADE[frame](), seed)
        own = [k for k, name in enumerate(result.covariance_names) if name.startswith("gnss0.")]
        error, _ = errors(result, sim)
        nees.append(error @ np.linalg.solve(result.covariance[np.ix_(own, own)], error))
    low, high = chi2.ppf([0.005, 0.995], 4 * len(nees)) / len(nees)
    assert low < np.mean(nees) < high
