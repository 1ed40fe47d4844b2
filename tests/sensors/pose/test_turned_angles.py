"""Streams of one image or pose a second, in which rates change much: clocks and rotations by how far was turned."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from icalib.data.measurements import CornerStream, PoseStream
from icalib.data.recordings import open_recording, read_measurements
from icalib.errors import EstimationError
from icalib.estimate.inputs import inputs_for
from icalib.geometry import so3
from icalib.initialize.rate_correlation import ChainedRates, max_rate_step, offsets_by_angle
from icalib.pipeline import calibrate_measurements
from icalib.rig import Parameter, Wheels
from icalib.sensors.pose.simulate import SimPoses
from icalib.tools.simulation import handheld, load_scenario, rig_for, simulate

ORIGIN_NS = 1_700_000_000_000_000_000  # of all clocks of the scenario
SCENARIO = Path(__file__).parents[3] / "examples" / "paper" / "table2-3d.yaml"


def thinned(stream, every: int):
    """Each `every`-th image or pose."""
    kept = np.arange(0, len(stream.stamps_ns), every)
    if isinstance(stream, PoseStream):
        arrays = {name: getattr(stream, name)[kept] for name in ("stamps_ns", "rotation", "position")}
        return replace(stream, **arrays)
    assert isinstance(stream, CornerStream)
    rows = np.concatenate([np.arange(stream.start[k], stream.start[k + 1]) for k in kept])
    start = np.concatenate([[0], np.cumsum(np.diff(stream.start)[kept])])
    return replace(stream, stamps_ns=stream.stamps_ns[kept], start=start, point=stream.point[rows], uv=stream.uv[rows])


@pytest.mark.parametrize("every", [pytest.param(5, marks=pytest.mark.full), 20])
def test_a_camera_of_4_and_1_images_a_second(every):
    simulation = simulate(handheld(30.0), 2)
    m, rig = simulation.measurements, rig_for(simulation.scenario)
    found = calibrate_measurements(rig, m.with_streams(*(thinned(c, every) for c in m.cameras)))
    for camera in simulation.scenario.cameras:
        translation = found.group(camera.name, "translation")
        error = found.T_imu_sensor(camera.name)[:3, 3] - camera.T_imu_sensor[:3, 3]
        assert (np.abs(error) < 5.0 * translation.std).all() and translation.std.max() < 0.01
        offset = found.group(camera.name, "time_offset")
        assert abs(offset.value[0] - camera.time_offset_s) < 5.0 * offset.std[0] < 1e-3


@pytest.fixture(scope="module")
def with_poses():
    """The motion of the paper, an IMU and a pose sensor on another clock."""
    scenario = load_scenario(SCENARIO)
    pose = load_pose_scenario()
    return simulate(replace(scenario, duration_s=40.0, cameras=(), sensors=pose, features=None), 5)


def load_pose_scenario():
    T = np.eye(4)
    T[:3, :3], T[:3, 3] = so3.exp(np.array([0.1, -0.2, 0.5])), (0.1, -0.05, 0.2)
    return (
        SimPoses(
            "mocap0",
            T,
            rate_hz=50.0,
            time_offset_s=0.012,
            clock_origin_ns=ORIGIN_NS,
            position_noise=1e-3,
            rotation_noise=2e-3,
        ),
    )


@pytest.mark.parametrize("every", [pytest.param(25, marks=pytest.mark.full), 50])
def test_poses_once_or_twice_a_second(with_poses, every):
    m, rig = with_poses.measurements, rig_for(with_poses.scenario)
    sensor = replace(rig.poses[0], rotation=Parameter(), translation=Parameter(), time_offset=Parameter())
    (stream,) = m.poses
    late = replace(stream, stamps_ns=stream.stamps_ns + 7_000_000_000)
    found = calibrate_measurements(rig.with_(poses=(sensor,)), m.with_streams(thinned(late, every)))
    truth = with_poses.scenario.of(SimPoses)[0]
    translation, offset = found.group("mocap0", "translation"), found.group("mocap0", "time_offset")
    assert (np.abs(found.T_imu_sensor("mocap0")[:3, 3] - truth.T_imu_sensor[:3, 3]) < 5.0 * translation.std).all()
    assert translation.std.max() < 0.02
    assert abs(offset.value[0] + 7.0 - truth.time_offset_s) < 5.0 * offset.std[0] < 5e-3


def test_too_slow_is_said(with_poses, tmp_path):
    m, rig = with_poses.measurements, rig_for(with_poses.scenario)
    sensor = replace(rig.poses[0], rotation=Parameter(), translation=Parameter(), time_offset=Parameter())
    slow = m.with_streams(thinned(m.poses[0], 200))
    with pytest.raises(EstimationError, match=r"mocap0: the rate of 0\.25 poses per second is too low"):
        calibrate_measurements(rig.with_(poses=(sensor,)), slow)
    other = replace(m.poses[0], rotation=m.poses[0].rotation[::-1].copy())
    with pytest.raises(EstimationError, match=r"of mocap0.* not match that.* of imu0 at any time offset"):
        calibrate_measurements(rig.with_(poses=(sensor,)), m.with_streams(thinned(other, 50)))
    (tmp_path / "wheel0").mkdir()
    (tmp_path / "wheel0" / "rates.csv").write_text("".join(f"{k * 10**9},1,{1 + k % 3}\n" for k in range(60)))
    wheels = rig.with_(imu=None, poses=(), wheels=(Wheels("wheel0", "wheel0/rates.csv"),))
    with pytest.raises(
        Exception, match=r"wheel0/rates\.csv \(wheel0\): the rate of 1 Hz is too low to follow the wheels"
    ):
        read_measurements(open_recording(tmp_path), wheels)


def test_offsets_by_angles(with_poses):
    m = with_poses.measurements
    inputs = inputs_for(rig_for(with_poses.scenario), [m.with_streams(thinned(m.poses[0], 50))])
    assert inputs.imu is not None
    start = np.arange(5.0, 30.0)
    exact = ChainedRates.of(inputs.imu)
    rate = exact.over(start, start + 1.0)
    offset, left = offsets_by_angle(inputs.imu, start - 3.2, start - 2.2, rate)[0]
    assert abs(offset - 3.2) < 0.03 and left < 0.1
    slope = (exact.over(start + 1e-3, start + 1.001) - rate) / 1e-3
    np.testing.assert_allclose(exact.slope(start, start + 1.0), slope, atol=0.1 * np.abs(slope).max())


def test_how_far_apart_neighbours_may_be():
    assert max_rate_step("a", 0.05 * np.arange(9), "images") == 0.25
    assert max_rate_step("a", 1.0 * np.arange(9), "images") == 1.5
    assert max_rate_step("a", 1.9 * np.arange(9), "images") == 2.0
