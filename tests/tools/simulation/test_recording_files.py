"""Simulated recordings as files: tables that read back exactly, bags that readers read, and all or nothing."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import yaml
from tests.typed import instance, not_none

from icalib.cli import main
from icalib.data.bag_recording import BagRecording
from icalib.data.measurements import ImuStream, WheelPoses
from icalib.data.recordings import open_recording
from icalib.errors import RecordingError, RigError
from icalib.geometry.targets import AprilGrid
from icalib.rig import ImuSensor
from icalib.rig.file import load_rig
from icalib.sensors.camera.read import corners as recorded_corners
from icalib.sensors.imu.read import readings as imu_readings
from icalib.sensors.lidar.read.point_clouds import point_clouds
from icalib.sensors.lidar.simulate import SimLidar
from icalib.sensors.wheels.read import read_joints
from icalib.sensors.wheels.simulate import SimWheels
from icalib.tools.simulation import ADIS16448, handheld, rig_for, simulate, write_sensors, write_tables

from .conftest import on_ground, pose


@pytest.fixture(scope="module")
def scenario(robot):
    """Drives past a board on the wall x = 5, small images."""
    cameras = tuple(
        replace(c, resolution=(200, 150), intrinsics=(90.0, 90.0, 99.5, 74.5), distortion=(0.0, 0.0, 0.0, 0.0))
        for c in robot.cameras
    )
    board = pose(np.array([[0.0, 0.0, -1.0], [-1.0, 0.0, 0.0], [0.0, 1.0, 0.0]]), [5.0, 1.5, 0.2])
    driving = replace(on_ground(robot, "standing"), cameras=cameras, duration_s=1.5, imu_clock_origin_ns=10**9)
    return replace(driving, board=True, target=AprilGrid(3, 3, 0.6, 0.3), T_world_board=board)


@pytest.fixture(scope="module")
def simulation(scenario):
    return simulate(scenario, 3)


@pytest.fixture(scope="module")
def folder(simulation, tmp_path_factory):
    path = tmp_path_factory.mktemp("tables") / "run"
    assert write_tables(simulation, 3, path) == ()
    return path


def test_the_rig_file_is_beside_the_tables(scenario, folder):
    rig = load_rig(folder / "rig.yaml")
    assert set(rig.sensors) == set(rig_for(scenario).sensors) and rig.target == rig_for(scenario).target
    assert all(c.intrinsics.value is None and c.distortion.value is None for c in rig.cameras)


def test_tables_read_back_exactly(simulation, folder):
    measured = simulation.measurements
    rig = rig_for(simulation.scenario)
    recording = open_recording(folder)
    imu = imu_readings(recording, not_none(rig.imu))
    np.testing.assert_array_equal(instance(imu, ImuStream).stamps_ns, measured.imu.stamps_ns)
    np.testing.assert_allclose(imu.accel, measured.imu.accel, rtol=1e-15)
    corners = measured.cameras[0]
    assert len(corners.uv) > 100
    found = recorded_corners(recording, rig.cameras[0], rig.target)
    for name in ("stamps_ns", "start", "point"):
        np.testing.assert_array_equal(getattr(found, name), getattr(corners, name))
    np.testing.assert_allclose(found.uv, corners.uv, rtol=1e-15)

    tracks, rows = measured.tracks[1], (folder / "cam1" / "tracks.csv").read_text().splitlines()
    assert rows[0].startswith("#") and len(rows) == 1 + len(tracks.uv)
    stamps, features, u, v = zip(*(row.split(",") for row in rows[1:]), strict=True)
    np.testing.assert_array_equal(np.array(stamps, dtype=np.int64), tracks.stamps_ns[tracks.image])
    np.testing.assert_array_equal(np.array(features, dtype=np.int64), tracks.feature)
    np.testing.assert_array_equal(np.array([u, v], dtype=np.float64).T, tracks.uv)

    with np.load(folder / "lidar0" / "scans.npz", allow_pickle=False) as scans:
        assert set(scans) == {"stamps_ns", "start", "offset_s", "xyz", "plane"}
        for name in scans:
            np.testing.assert_array_equal(scans[name], getattr(measured.lidars[0], name))
    rates = (folder / "wheel0" / "rates.csv").read_text().splitlines()
    assert "means since the stamp before" in rates[0]
    np.testing.assert_array_equal(np.loadtxt(rates, delimiter=",")[:, 1:], measured.wheels[0].rate)


def test_relative_poses_have_their_covariance_in_the_table(robot, tmp_path):
    sim = simulate(replace(robot, duration_s=1.0, sensors=robot.of(SimWheels), features=None), 1)
    write_tables(sim, 1, tmp_path / "run")
    header, *rows = (tmp_path / "run" / "wheel0" / "poses.csv").read_text().splitlines()
    numbers = np.array([[float(x) for x in row.split(",")] for row in rows])
    stream = sim.measurements.wheels[0]
    assert header.startswith("#from [ns],to [ns],yaw [rad],x [m],y [m]")
    assert [row.split(",")[:2] for row in rows[:2]] == [
        [str(a), str(b)] for a, b in zip(stream.stamps_ns[:2], stream.stamps_ns[1:3], strict=True)
    ]
    np.testing.assert_array_equal(numbers[:, 2:5], instance(stream, WheelPoses).pose)
    np.testing.assert_array_equal(
        numbers[:, 5:], [c[np.triu_indices(3)] for c in instance(stream, WheelPoses).covariance]
    )


def test_the_truth_is_beside_the_tables(simulation, folder):
    truth = yaml.safe_load((folder / "truth.yaml").read_text())
    assert truth["seed"] == 3 and set(truth["sensors"]) == {"imu0", "cam0", "cam1", "cam2", "lidar0", "wheel0"}
    np.testing.assert_array_equal(truth["planes"], simulation.truth.planes)
    np.testing.assert_array_equal(truth["T_world_bodies"], simulation.truth.T_world_bodies)
    for name, sensor in truth["sensors"].items():
        if name != "imu0":
            assert sensor["time_offset"] == simulation.truth.time_offset[name]
    assert truth["sensors"]["wheel0"]["radii"] == [0.1, 0.103] and truth["sensors"]["wheel0"]["baseline"] == 0.4
    np.testing.assert_array_equal(truth["sensors"]["lidar0"]["T_imu_sensor"], simulation.truth.T_imu_sensor["lidar0"])
    with np.load(folder / "truth.npz", allow_pickle=False) as arrays:
        np.testing.assert_array_equal(arrays["stamps_ns"], simulation.measurements.imu.stamps_ns)
        np.testing.assert_array_equal(arrays["rotation"], simulation.truth.R_world_imu)
        np.testing.assert_array_equal(arrays["points"], simulation.truth.points)


def test_the_truth_has_all_effects(simulation, tmp_path):
    scenario = replace(simulation.scenario, duration_s=1.0, imu_accel_delay_s=2e-3, imu_cutoff_hz=20.0)
    off = tuple(0.1 * np.arange(scenario.of(SimLidar)[0].rings))
    rings = {"elevation_errors_deg": off, "ring_offsets_m": off, "azimuth_errors_deg": off}
    lidars = (replace(x, range_offset_m=0.02, **rings) for x in scenario.of(SimLidar))
    write_tables(simulate(scenario.with_sensors(*lidars), 3), 3, tmp_path / "run")
    imu, lidar = (
        yaml.safe_load((tmp_path / "run" / "truth.yaml").read_text())["sensors"][x] for x in ("imu0", "lidar0")
    )
    assert (imu["accel_delay"], imu["cutoff"], lidar["range_offset"]) == (2e-3, 20.0, 0.02)
    assert imu["low_pass"] == pytest.approx(0.5 * (np.sqrt(np.log(2.0)) / (2.0 * np.pi * 20.0)) ** 2)
    assert lidar["ring_offsets"] == list(off) and lidar["ring_azimuths"] == pytest.approx(np.deg2rad(off))
    bands = lidar["ring_elevations"]  # 16: others have no ring
    assert (len(bands), [x for x in bands if x]) == (16, pytest.approx(np.deg2rad(off[1:])))


@pytest.mark.parametrize("name", ["run", "run.bag"])
def test_bags_hold_what_the_drivers_send(simulation, tmp_path, name, monkeypatch):
    pytest.importorskip("cv2")
    monkeypatch.setattr("icalib.tools.simulation.writing._AT_A_TIME", 70)
    write_sensors(simulation, 3, tmp_path / name)
    bag, measured = BagRecording(tmp_path / name), simulation.measurements
    imu = imu_readings(bag, ImuSensor("imu0", "", ADIS16448))
    np.testing.assert_array_equal(instance(imu, ImuStream).stamps_ns, measured.imu.stamps_ns)
    np.testing.assert_array_equal(imu.gyro, measured.imu.gyro)
    lidar = measured.lidars[0]
    clouds = list(point_clouds(bag, "/lidar0/points"))
    assert [cloud.stamp_ns for cloud in clouds] == lidar.stamps_ns.tolist()
    for i, cloud in enumerate(clouds):
        rows = slice(lidar.start[i], lidar.start[i + 1])
        np.testing.assert_array_equal(np.stack([cloud.points[c] for c in "xyz"], axis=1), lidar.xyz[rows])
        np.testing.assert_array_equal(cloud.points["time"], lidar.offset_s[rows])
    joints, wheels = read_joints(bag, "/wheel0/joint_states"), measured.wheels[0]
    assert joints.names == ("left_wheel", "right_wheel")
    np.testing.assert_array_equal(joints.velocity, wheels.rate)
    turned = np.diff(joints.position, axis=0) / (np.diff(joints.stamps_ns)[:, None] * 1e-9)
    np.testing.assert_allclose(turned, wheels.rate[1:], atol=1e-9)
    images = list(bag.images("/cam0/image_raw"))
    assert len(images) == len(measured.tracks[0].stamps_ns) and images[0].image.shape == (150, 200)
    assert images[0].image.std() > 10  # the board is in view; without it there is the noise of 2 grey levels
    assert (tmp_path / name / "truth.yaml").exists() == (name == "run")
    rig = load_rig(tmp_path / ("run/rig.yaml" if name == "run" else "run.rig.yaml"))
    assert set(rig.sensors) == {"imu0", *(s.name for s in measured.streams.values())}


def test_the_rig_file_beside_a_bag_is_never_overwritten(simulation, tmp_path):
    (tmp_path / "run.rig.yaml").write_text("mine")
    with pytest.raises(RecordingError, match="run.rig.yaml exists already"):
        write_sensors(simulation, 3, tmp_path / "run.bag")
    assert [path.read_text() for path in tmp_path.iterdir()] == ["mine"]


def test_a_bag_without_a_target_shows_the_room(robot, tmp_path):
    (camera, *_), (lidar,) = robot.cameras, robot.of(SimLidar)
    camera = replace(camera, resolution=(80, 60), intrinsics=(50.0, 50.0, 39.5, 29.5))
    lidar = replace(lidar, azimuth_steps=36)
    hilly = replace(on_ground(robot, "ramps").with_sensors(lidar), duration_s=0.5, cameras=(camera,))
    assert write_sensors(simulate(hilly, 1), 1, tmp_path / "run") == ()
    bag = BagRecording(tmp_path / "run")
    images = [image.image for image in bag.images("/cam0/image_raw")]
    assert len(images) == 9 and min(image.std() for image in images) > 10
    assert len(list(point_clouds(bag, "/lidar0/points"))) and len(read_joints(bag, "/wheel0/joint_states").stamps_ns)


def test_what_no_sensor_sends_is_said(robot, tmp_path):
    sim = simulate(replace(robot, duration_s=0.5, sensors=robot.of(SimWheels), features=None, cameras=()), 1)
    (note,) = write_sensors(sim, 1, tmp_path / "run")
    assert "wheel0 reports relative poses" in note
    (note,) = write_sensors(simulate(replace(handheld(0.5), board=False), 1), 1, tmp_path / "dark")
    assert "no images are written" in note
    rolling = on_ground(robot, "planar")
    wheels = tuple(replace(w, sampling="instantaneous") for w in rolling.of(SimWheels))
    instant = replace(rolling, duration_s=0.5, sensors=wheels, features=None, cameras=())
    write_sensors(simulate(instant, 1), 1, tmp_path / "instant")
    assert np.isnan(read_joints(BagRecording(tmp_path / "instant"), "/wheel0/joint_states").position).all()


def test_nothing_is_left_of_a_recording_that_fails(simulation, tmp_path, monkeypatch):
    def full(*_, **__):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr("icalib.tools.simulation.writing.np.savez", full)
    for write in (write_tables, write_sensors):
        with pytest.raises(RecordingError, match="run cannot be written \\(No space left on device\\)"):
            write(replace(simulation, scenario=replace(simulation.scenario, board=False)), 3, tmp_path / "run")
        assert list(tmp_path.iterdir()) == []
    (tmp_path / "run").mkdir()
    for write in (write_tables, write_sensors):
        with pytest.raises(RecordingError, match="run exists already"):
            write(simulation, 3, tmp_path / "run")
    assert list((tmp_path / "run").iterdir()) == []
    bent = replace(simulation, scenario=replace(simulation.scenario, bow=(1e-3, 0.0, 0.0)))
    with pytest.raises(RigError, match="rendered flat"):
        write_sensors(bent, 3, tmp_path / "bent")


SMALL = """\
duration: 1
seed: 5
motion: {kind: free}
sensors:
  imu0: {type: imu, rate: 100, noise: {gyro: 1e-4, gyro_walk: 1e-5, accel: 1e-3, accel_walk: 1e-4}}
  lidar0: {type: lidar, rate: 8, rings: 2, azimuth_steps: 30, T_imu_sensor: POSE}
room: {size: [12, 10, 3]}
""".replace("POSE", "[[1, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]]")


def test_the_command_line_makes_a_recording_from_a_scenario(tmp_path, capsys):
    file = tmp_path / "small.yaml"
    file.write_text(SMALL)
    assert main(["simulate", str(file), "-o", str(tmp_path / "a")]) == 0
    assert capsys.readouterr().out == f"Wrote {tmp_path / 'a'}, seed 5.\n"
    assert main(["simulate", str(file), "-o", str(tmp_path / "b"), "--seed", "5", "--quiet"]) == 0
    assert main(["simulate", str(file), "-o", str(tmp_path / "c"), "--seed", "6", "--quiet"]) == 0
    assert capsys.readouterr().out == ""
    a, b, c = ((tmp_path / name / "imu0" / "data.csv").read_bytes() for name in "abc")
    assert a == b != c
    assert main(["simulate", str(file), "-o", str(tmp_path / "d"), "--level", "sensor"]) == 0
    written = {p.name for p in (tmp_path / "d").iterdir()}
    assert written == {"d.mcap", "metadata.yaml", "rig.yaml", "truth.yaml", "truth.npz"}
    for name in "ad":
        rig = load_rig(tmp_path / name / "rig.yaml")
        assert set(rig.sensors) == {"imu0", "lidar0"}
        known = [spec.name for s in rig.lidars for spec in s.stated() if getattr(s, spec.name).value is not None]
        assert known == ["range_scale"]  # exact, as the simulation is; other values are not given away
    capsys.readouterr()
    assert main(["simulate", str(file), "-o", str(tmp_path / "a")]) == 1
    assert "a exists already; remove it" in capsys.readouterr().err
    file.write_text(SMALL.replace("rings: 2", "rings: two"))
    assert main(["simulate", str(file), "-o", str(tmp_path / "e")]) == 1
    assert f"icalib: {file}:6: sensors.lidar0.rings: must be a number" in capsys.readouterr().err
