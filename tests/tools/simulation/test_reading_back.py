"""What a simulated robot's LiDAR and wheels wrote, read by way of a rig file: the same arrays."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from tests.cases import each
from tests.typed import instance

from icalib.data.measurements import WheelPoses, WheelStream
from icalib.data.recordings import open_recording, read_measurements
from icalib.rig.file import load_rig
from icalib.tools.simulation import simulate, write_sensors, write_tables

from .conftest import on_ground

RIG = """\
sensors:
  imu0: {type: imu}
  lidar0: {type: lidar, min_range: 0.1, max_range: 200}
  wheel0: {type: wheels, measures: MEASURES}
"""


@pytest.fixture(scope="module")
def simulation(robot):
    return simulate(replace(on_ground(robot, "planar"), duration_s=1.5, imu_clock_origin_ns=10**9), 3)


def rig(tmp_path, measures: str = "rates"):
    (tmp_path / "rig.yaml").write_text(RIG.replace("MEASURES", measures))
    return load_rig(tmp_path / "rig.yaml")


def same_scans(found, lidar, with_planes: bool):
    assert len(lidar.xyz) > 1000
    for name in ("stamps_ns", "start", "offset_s", "xyz"):
        np.testing.assert_array_equal(getattr(found, name), getattr(lidar, name), strict=True)
    np.testing.assert_array_equal(found.plane, lidar.plane if with_planes else np.full_like(lidar.plane, -1))


def test_tables(simulation, tmp_path):
    write_tables(simulation, 3, tmp_path / "run")
    found = read_measurements(open_recording(tmp_path / "run"), rig(tmp_path))
    same_scans(found.lidars[0], simulation.measurements.lidars[0], with_planes=True)
    (wheels,), (written,) = found.wheels, simulation.measurements.wheels
    assert isinstance(wheels, WheelStream) and (wheels.sampling, found.notes) == ("interval-mean", ())
    np.testing.assert_array_equal(wheels.stamps_ns, written.stamps_ns)
    np.testing.assert_allclose(wheels.rate, written.rate, rtol=1e-15)
    topics = {t.name: (t.type, t.kind, t.count) for t in open_recording(tmp_path / "run").topics()}
    assert topics["lidar0/scans.npz"] == ("scans", "points", len(found.lidars[0].stamps_ns))
    assert topics["wheel0/rates.csv"] == ("table of rates", "wheels", len(wheels.stamps_ns))
    stamps = open_recording(tmp_path / "run").stamps("lidar0/scans.npz")
    np.testing.assert_array_equal(stamps, found.lidars[0].stamps_ns)


def test_relative_poses(robot, tmp_path):
    written = simulate(replace(robot, duration_s=1.0, features=None), 1)
    write_tables(written, 1, tmp_path / "run")
    (wheels,), (truth,) = (
        read_measurements(open_recording(tmp_path / "run"), rig(tmp_path, "poses")).wheels,
        written.measurements.wheels,
    )
    assert isinstance(wheels, WheelPoses)
    for name in ("stamps_ns", "pose", "covariance"):
        np.testing.assert_allclose(getattr(wheels, name), getattr(truth, name), rtol=1e-14, atol=1e-30)
    assert len(open_recording(tmp_path / "run").stamps("wheel0/poses.csv")) == len(instance(truth, WheelPoses).pose)


@each("name", ["run", "run.bag"])
@each("measures", ["rates", "angles"])
def test_bags(simulation, tmp_path, name, measures):
    bare = replace(simulation, scenario=replace(simulation.scenario, board=False, cameras=()))  # images take long
    write_sensors(bare, 3, tmp_path / name)
    found = read_measurements(open_recording(tmp_path / name), rig(tmp_path, measures))
    same_scans(found.lidars[0], simulation.measurements.lidars[0], with_planes=False)
    (wheels,), (written,) = found.wheels, simulation.measurements.wheels
    assert isinstance(wheels, WheelStream) and found.notes == ()
    np.testing.assert_array_equal(wheels.stamps_ns, written.stamps_ns)
    first = 0 if measures == "rates" else 1
    np.testing.assert_allclose(wheels.rate[first:], written.rate[first:], atol=0 if measures == "rates" else 1e-9)
