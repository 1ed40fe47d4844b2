"""Simulated positions: those of the antenna by the truth, with noise; their table and their messages."""

from __future__ import annotations

import numpy as np
import pytest

from icalib.cli.commands import main
from icalib.data.recordings import open_recording, read_measurements
from icalib.rig.file import load_rig
from icalib.sensors.position.stream import PositionStream
from icalib.tools.simulation import load_scenario, simulate

SCENARIO = """
duration: 5
motion: {kind: free}
room: {size: [20, 15, 5]}
sensors:
  imu0: {type: imu, rate: 200, noise: {gyro: 1.0e-5, gyro_walk: 1.0e-7, accel: 1.0e-5, accel_walk: 1.0e-7}}
  gnss0:
    type: position
    T_imu_sensor: [[1, 0, 0, 0.4], [0, 1, 0, -0.25], [0, 0, 1, 0.6], [0, 0, 0, 1]]
    T_world_frame: [[0, -1, 0, 3], [1, 0, 0, -1], [0, 0, 1, 0.5], [0, 0, 0, 1]]
    rate: 5
    time_offset: 0.037
    position_noise: 0.02
    vertical_noise: 0.05
"""
RIG = """
sensors:
  imu0: {type: imu}
  gnss0: {type: position}
"""


@pytest.fixture(scope="module")
def scenario(tmp_path_factory):
    path = tmp_path_factory.mktemp("scenario") / "scenario.yaml"
    path.write_text(SCENARIO)
    return path


def test_positions_are_those_of_the_antenna_and_noise(scenario):
    sim = simulate(load_scenario(scenario), 3)
    (stream,), truth = sim.measurements.of(PositionStream), sim.truth.reported["gnss0"]
    R, p, _ = sim.truth.pose_at(truth.seconds)
    in_world = p + np.einsum("nij,j->ni", R, [0.4, -0.25, 0.6])
    # World x is the frame's -y, world y its x; the frame's origin is (3, -1, 0.5).
    expected = np.stack([in_world[:, 1] + 1.0, -(in_world[:, 0] - 3.0), in_world[:, 2] - 0.5], axis=1)
    np.testing.assert_allclose(truth.position, expected, atol=1e-12)
    noise = stream.position - truth.position
    assert 0.01 < noise[:, :2].std() < 0.03
    assert 0.025 < noise[:, 2].std() < 0.085
    stamps_s = 1e-9 * (stream.stamps_ns - sim.truth.imu_clock_origin_ns)
    np.testing.assert_allclose(truth.seconds - stamps_s, 0.037, atol=1e-8)


@pytest.mark.parametrize(("name", "level"), [("folder", "data"), ("run.bag", "sensor")])
def test_tables_and_messages_are_read_as_they_were_simulated(scenario, tmp_path, name, level):
    assert main(["simulate", str(scenario), "-o", str(tmp_path / name), "--level", level, "--seed", "3", "-q"]) == 0
    (tmp_path / "rig.yaml").write_text(RIG)
    read = read_measurements(open_recording(tmp_path / name), load_rig(tmp_path / "rig.yaml"))
    (stream,) = read.of(PositionStream)
    (expected,) = simulate(load_scenario(scenario), 3).measurements.of(PositionStream)
    np.testing.assert_array_equal(stream.stamps_ns, expected.stamps_ns)
    np.testing.assert_allclose(stream.position, expected.position, atol=1e-8)
