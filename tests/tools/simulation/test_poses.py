"""Simulated pose sensors: what they report without noise, how noise spreads, and what is written reads back."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from tests.cases import each
from tests.typed import random_rotations

from icalib.data.recordings import open_recording, read_measurements
from icalib.rig.file import load_rig
from icalib.sensors.pose.simulate import SimPoses, quaternion
from icalib.tools.simulation import Drive, Room, Scenario, simulate, write_sensors, write_tables

from .conftest import pose, turn

RIG = """\
sensors:
  imu0: {type: imu}
  mocap0: {type: pose}
  odom0: {type: pose, kind: relative}
"""


@pytest.fixture(scope="module")
def scenario() -> Scenario:
    mocap = SimPoses(
        "mocap0",
        pose(turn([1.0, 2.0, -1.0], 0.8), [0.1, -0.2, 0.3]),
        T_world_frame=pose(turn([0.1, 0.2, 1.0], 2.0), [3.0, 1.0, -0.5]),
        time_offset_s=0.02,
        phase_s=0.004,
        clock_origin_ns=10**9,
    )
    odom = replace(mocap, name="odom0", kind="relative", rate_hz=20.0, rotation_noise=0.02, position_noise=0.05)
    return Scenario(
        (),
        duration_s=5.0,
        motion=Drive("free"),
        board=False,
        room=Room((8.0, 6.0, 3.0)),
        sensors=(mocap, odom),
        imu_clock_origin_ns=2 * 10**9,
    )


def angles(R: np.ndarray) -> np.ndarray:
    return np.linalg.norm(Rotation.from_matrix(R).as_rotvec(), axis=1)


def test_points_seen_by_the_sensor_stand_where_it_says(scenario):
    """A point at x in the sensor's frame is at T_world_imu T_imu_sensor x in the world, and where the pose puts it."""
    sim = simulate(replace(scenario, robot_noise_enabled=False), 1)
    x = np.array([0.5, -0.7, 1.1])
    for sensor, stream in zip(scenario.of(SimPoses), sim.measurements.poses, strict=True):
        offset = sim.truth.time_offset[sensor.name]
        seconds = (stream.stamps_ns - sim.truth.imu_clock_origin_ns) * 1e-9 + offset
        R, p, _ = sim.truth.pose_at(seconds)
        on_imu = sensor.T_imu_sensor[:3, :3] @ x + sensor.T_imu_sensor[:3, 3]
        in_world = p + R @ on_imu
        T = sensor.T_world_frame
        seen = (stream.position + stream.rotation @ x) @ T[:3, :3].T + T[:3, 3]
        np.testing.assert_allclose(seen, in_world, atol=1e-6)  # stamps as float64 seconds
        assert len(seconds) == pytest.approx(4.9 * sensor.rate_hz, abs=2)
        assert offset == pytest.approx(0.02 + 1.0, abs=1e-12)


def test_noise_of_absolute_poses_is_white(scenario):
    sim = simulate(scenario, 1)
    stream, truth = sim.measurements.poses[0], sim.truth.reported["mocap0"]
    error = stream.position - truth.position
    assert error.std() == pytest.approx(1e-3, rel=0.05)
    assert abs(np.corrcoef(error[1:].ravel(), error[:-1].ravel())[0, 1]) < 0.1
    turned = Rotation.from_matrix(truth.rotation.transpose(0, 2, 1) @ stream.rotation).as_rotvec()
    assert turned.std() == pytest.approx(2e-3, rel=0.05)


def test_noise_of_relative_poses_adds_up(scenario):
    """Each step has its own; after n of them the drift has the root of n."""
    steps, ends, truth = [], [], None
    for seed in range(20):
        sim = simulate(scenario, seed)
        stream, truth = sim.measurements.poses[1], sim.truth.reported["odom0"]

        def way(rotation, position, k):
            return np.einsum("nji,nj->ni", rotation[:-k], position[k:] - position[:-k])

        steps.append(way(stream.rotation, stream.position, 1) - way(truth.rotation, truth.position, 1))
        ends.append(
            angles(
                (truth.rotation[-1:].transpose(0, 2, 1) @ truth.rotation[:1])
                @ (stream.rotation[:1].transpose(0, 2, 1) @ stream.rotation[-1:])
            )[0]
        )
    assert truth is not None and np.std(steps) == pytest.approx(0.05 * np.sqrt(0.05), rel=0.05)
    length = truth.seconds[-1] - truth.seconds[0]
    assert np.sqrt(np.mean(np.square(ends)) / 3.0) == pytest.approx(0.02 * np.sqrt(length), rel=0.35)


@each("form", ["tables", "run.bag", "run"])
def test_what_is_written_reads_back(scenario, form, tmp_path):
    simulation = simulate(scenario, 3)
    path = tmp_path / form
    (write_tables if form == "tables" else write_sensors)(simulation, 3, path)
    (tmp_path / "rig.yaml").write_text(RIG)
    recording = open_recording(path)
    found = read_measurements(recording, load_rig(tmp_path / "rig.yaml"))
    for stream, written in zip(found.poses, simulation.measurements.poses, strict=True):
        np.testing.assert_array_equal(stream.stamps_ns, written.stamps_ns)
        np.testing.assert_allclose(stream.position, written.position, rtol=1e-15)
        np.testing.assert_allclose(stream.rotation, written.rotation, atol=1e-14)
    kinds = {t.name: t.kind for t in recording.topics()}
    assert kinds["mocap0/poses.csv" if form == "tables" else "/mocap0/pose"] == "pose"
    assert len(recording.stamps("mocap0/poses.csv" if form == "tables" else "/mocap0/pose")) > 400


def test_quaternions_of_any_rotation():
    for R in random_rotations(50, seed=2).as_matrix():
        np.testing.assert_allclose(Rotation.from_quat(quaternion(R)).as_matrix(), R, atol=1e-13)
    for half in np.diag([1.0, -1.0, -1.0]), np.diag([-1.0, 1.0, -1.0]), np.eye(3):
        np.testing.assert_allclose(Rotation.from_quat(quaternion(half)).as_matrix(), half, atol=1e-13)
