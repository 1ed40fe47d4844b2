"""Exports to ORB-SLAM3, FAST-LIVO2, LIO-SAM, Autoware and COLMAP, read back as these programs read them.

Each test maps a point, a pixel or an instant by the program's own formula and compares it with the calibration's.
"""

from __future__ import annotations

import dataclasses
import json
from pathlib import Path

import cv2
import numpy as np
import pytest
import yaml
from scipy.spatial.transform import Rotation

from icalib.base.files import is_ours, sealed_texts
from icalib.cli import main
from icalib.errors import CalibrationError
from icalib.export.formats import export
from icalib.geometry.cameras import camera_model
from icalib.result import Calibration

POINT = np.array([0.3, -0.2, 1.5, 1.0])
RAY = np.array([[0.31, -0.22, 1.0]])


def with_lens(c: Calibration, model: str, distortion: list[float], names: tuple[str, ...]) -> Calibration:
    sensors = {n: s | ({"model": model} if n in names else {}) for n, s in c.rig["sensors"].items()}
    groups = tuple(
        dataclasses.replace(g, value=np.array(distortion)) if g.sensor in names and g.name == "distortion" else g
        for g in c.groups
    )
    return dataclasses.replace(c, rig=c.rig | {"sensors": sensors}, groups=groups)


def without_imu(c: Calibration) -> Calibration:
    rig = {"sensors": {n: s for n, s in c.rig["sensors"].items() if n != "imu0"}}
    return dataclasses.replace(c, rig=rig, groups=tuple(g for g in c.groups if g.sensor != "imu0"))


def our_pixel(c: Calibration, name: str) -> np.ndarray:
    params = np.concatenate([c.group(name, "intrinsics").value, c.group(name, "distortion").value])
    return camera_model(c.rig["sensors"][name]["model"]).project(params, RAY)[0][0]


def opencv_pixel(params: list[float], fisheye: bool) -> np.ndarray:
    """params: fx, fy, cx, cy and OpenCV's coefficients."""
    fx, fy, cx, cy = params[:4]
    K, zero = np.array([[fx, 0.0, cx], [0.0, fy, cy], [0.0, 0.0, 1.0]]), np.zeros(3)
    project = cv2.fisheye.projectPoints if fisheye else cv2.projectPoints
    return project(RAY[None], zero, zero, K, np.array(params[4:]))[0].ravel()


def storage_of(text: str, tmp_path: Path) -> cv2.FileStorage:
    (tmp_path / "file.yaml").write_text(text)
    return cv2.FileStorage(str(tmp_path / "file.yaml"), cv2.FILE_STORAGE_READ)


FISHEYE = ("pinhole-equidistant", [-0.01, 0.02, -0.01, 1e-3])


@pytest.mark.parametrize(
    ("model", "distortion", "kind", "names"),
    [
        ("pinhole-radtan", [-0.28, 0.07, 2e-4, 1e-5], "PinHole", ("k1", "k2", "p1", "p2")),
        ("pinhole-radtan5", [-0.28, 0.07, 2e-4, 1e-5, 3e-3], "PinHole", ("k1", "k2", "p1", "p2", "k3")),
        (*FISHEYE, "KannalaBrandt8", ("k1", "k2", "k3", "k4")),
    ],
)
def test_orb_slam3(robot: Calibration, tmp_path: Path, model: str, distortion: list[float], kind: str, names: tuple):
    c = with_lens(robot, model, distortion, ("cam0", "cam1"))
    found = export(c, "orb-slam3")
    read = storage_of(found.files["orb_slam3.yaml"], tmp_path)
    assert read.getNode("File.version").string() == "1.0" and read.getNode("Camera.type").string() == kind
    for i in (1, 2):
        params = [read.getNode(f"Camera{i}.{n}").real() for n in ("fx", "fy", "cx", "cy", *names)]
        pixel = opencv_pixel(params, kind == "KannalaBrandt8")
        np.testing.assert_allclose(pixel, our_pixel(c, f"cam{i - 1}"), atol=1e-9)
    T_b_c1, T_c1_c2 = (read.getNode(name).mat() for name in ("IMU.T_b_c1", "Stereo.T_c1_c2"))
    assert T_b_c1.dtype == T_c1_c2.dtype == np.float32  # what its converter reads
    np.testing.assert_allclose(T_b_c1 @ POINT, c.T_imu_sensor("cam0") @ POINT, atol=1e-6)
    np.testing.assert_allclose(T_b_c1 @ T_c1_c2 @ POINT, c.T_imu_sensor("cam1") @ POINT, atol=1e-6)
    assert all(read.getNode(f"Camera.{n}").isInt() for n in ("width", "height", "fps"))
    noise = [read.getNode(f"IMU.{n}").real() for n in ("NoiseGyro", "NoiseAcc", "GyroWalk", "AccWalk", "Frequency")]
    assert noise == [1.6e-4, 2.8e-3, 2.2e-5, 8.6e-4, 200.0]
    end = read.getNode("Camera2.overlappingEnd")
    assert end.empty() if kind == "PinHole" else end.real() == 751
    assert "ORB-SLAM3 has no place for lidar0, wheel0, the time offset of cam0 (-0.135 ms)" in found.sentences[0]


def test_orb_slam3_of_one_camera_and_without_an_imu(calibration: Calibration):
    """Two cameras of different types do not fit into one file."""
    found = export(with_lens(without_imu(calibration), *FISHEYE, ("cam1",)), "orb-slam3")
    text = found.files["orb_slam3.yaml"]
    assert "Camera2" not in text and "IMU." not in text and "Stereo.T_c1_c2" not in text
    assert found.sentences[0].startswith("ORB-SLAM3 has no place for cam1")
    with pytest.raises(CalibrationError, match="the rate of imu0 is not known, and ORB-SLAM3 needs it"):
        export(dataclasses.replace(calibration, rates={}), "orb-slam3")


@pytest.mark.parametrize(
    ("model", "distortion", "kind", "names"),
    [
        ("pinhole-radtan", [-0.28, 0.07, 2e-4, 1e-5], "Pinhole", ("cam_d0", "cam_d1", "cam_d2", "cam_d3")),
        (*FISHEYE, "EquidistantCamera", ("k1", "k2", "k3", "k4")),
    ],
)
def test_fast_livo2(robot: Calibration, model: str, distortion: list[float], kind: str, names: tuple):
    c = with_lens(robot, model, distortion, ("cam0",))
    found = export(c, "fast-livo2")
    data = yaml.safe_load(found.files["lidar0.yaml"])
    calib = data["extrin_calib"]
    R, t = np.reshape(calib["extrinsic_R"], (3, 3)), np.array(calib["extrinsic_T"])
    in_imu = R @ POINT[:3] + t
    np.testing.assert_allclose(in_imu, (c.T_imu_sensor("lidar0") @ POINT)[:3], atol=1e-12)
    in_camera = np.reshape(calib["Rcl"], (3, 3)) @ POINT[:3] + calib["Pcl"]
    np.testing.assert_allclose((c.T_imu_sensor("cam0") @ [*in_camera, 1.0])[:3], in_imu, atol=1e-12)
    # One instant on three clocks: FAST-LIVO2 subtracts from stamps of the IMU, and adds to those of images.
    t_imu = 100.0
    t_lidar = t_imu - c.group("lidar0", "time_offset").value[0]
    t_camera = t_imu - c.group("cam0", "time_offset").value[0]
    assert t_imu - data["time_offset"]["imu_time_offset"] == pytest.approx(t_lidar, abs=1e-12)
    assert t_camera + data["time_offset"]["img_time_offset"] == pytest.approx(t_lidar, abs=1e-12)
    lens = yaml.safe_load(found.files["camera_cam0.yaml"])
    assert (lens["cam_model"], lens["cam_width"], lens["cam_height"], lens["scale"]) == (kind, 752, 480, 1.0)
    params = [lens[n] for n in ("cam_fx", "cam_fy", "cam_cx", "cam_cy", *names)]
    np.testing.assert_allclose(opencv_pixel(params, kind != "Pinhole"), our_pixel(c, "cam0"), atol=1e-9)
    assert found.sentences[0] == "FAST-LIVO2 has no place for cam1, wheel0; see calibration.yaml."


def test_lio_sam(robot: Calibration):
    found = export(robot, "lio-sam")
    data = yaml.safe_load(found.files["lidar0.yaml"])["lio_sam"]
    R, t = np.reshape(data["extrinsicRot"], (3, 3)), np.array(data["extrinsicTrans"])
    T = robot.T_imu_sensor("lidar0")
    # LIO-SAM turns readings of the IMU into the frame of the LiDAR by extrinsicRot.
    np.testing.assert_allclose(R @ (T[:3, :3] @ POINT[:3]), POINT[:3], atol=1e-12)
    # T_lidar_imu takes the IMU's origin to extrinsicTrans: T_imu_lidar takes that back.
    np.testing.assert_allclose(T[:3, :3] @ t + T[:3, 3], np.zeros(3), atol=1e-12)
    # Its attitude of the LiDAR: R_world_imu times the inverse of extrinsicRPY.
    R_world_imu = Rotation.from_euler("xyz", [0.1, 0.2, 0.3]).as_matrix()
    R_world_lidar = R_world_imu @ np.linalg.inv(np.reshape(data["extrinsicRPY"], (3, 3)))
    np.testing.assert_allclose(R_world_lidar, R_world_imu @ T[:3, :3], atol=1e-12)
    names = ("imuAccNoise", "imuGyrNoise", "imuAccBiasN", "imuGyrBiasN", "imuGravity")
    assert [data[n] for n in names] == [2.8e-3, 1.6e-4, 8.6e-4, 2.2e-5, 9.806]
    assert "the time offset of lidar0 (-10.000 ms)" in found.sentences[0]


def matrix_of(entry: dict[str, float]) -> np.ndarray:
    """As xacro and URDF read x, y, z, roll, pitch, yaw: fixed axes."""
    T = np.eye(4)
    T[:3, :3] = Rotation.from_euler("xyz", [entry[n] for n in ("roll", "pitch", "yaw")]).as_matrix()
    T[:3, 3] = [entry[n] for n in "xyz"]
    return T


def test_autoware(robot: Calibration):
    found = export(robot, "autoware", {"lidar0": "velodyne_top_base_link"})
    kit = yaml.safe_load(found.files["sensor_kit_calibration.yaml"])["sensor_kit_base_link"]
    assert list(kit) == ["imu0_link", "cam0/camera_link", "cam1/camera_link", "velodyne_top_base_link"]
    np.testing.assert_array_equal(matrix_of(kit["imu0_link"]), np.eye(4))
    np.testing.assert_allclose(matrix_of(kit["velodyne_top_base_link"]), robot.T_imu_sensor("lidar0"), atol=1e-12)
    # Autoware's camera macro sets camera_optical_link on camera_link with rpy = -90, 0, -90 deg.
    optical = matrix_of(dict.fromkeys("xyz", 0.0) | {"roll": -np.pi / 2, "pitch": 0.0, "yaw": -np.pi / 2})
    for name in robot.cameras:
        np.testing.assert_allclose(
            matrix_of(kit[f"{name}/camera_link"]) @ optical, robot.T_imu_sensor(name), atol=1e-12
        )
    vehicle = yaml.safe_load(found.files["sensors_calibration.yaml"])["base_link"]["sensor_kit_base_link"]
    wheel_origin = matrix_of(vehicle) @ robot.T_imu_sensor("wheel0") @ [0.0, 0.0, 0.0, 1.0]
    np.testing.assert_allclose(wheel_origin, [0.0, 0.0, 0.101, 1.0], atol=1e-12)  # radii 0.1 and 0.102 m
    assert "Autoware has no place for radii and baseline of wheel0" in found.sentences[0]


def test_autoware_without_wheels_has_no_vehicle(calibration: Calibration):
    assert list(export(calibration, "autoware").files) == ["sensor_kit_calibration.yaml"]


@pytest.mark.parametrize(
    ("model", "distortion", "kind"),
    [
        ("pinhole-radtan", [-0.28, 0.07, 2e-4, 1e-5], "OPENCV"),
        ("pinhole-radtan5", [-0.28, 0.07, 2e-4, 1e-5, 3e-3], "FULL_OPENCV"),
        ("pinhole-rational", [0.5, -2.5, 4e-4, -2e-4, 1.5, 0.4, -2.4, 1.4], "FULL_OPENCV"),
        (*FISHEYE, "OPENCV_FISHEYE"),
    ],
)
def test_colmap(robot: Calibration, model: str, distortion: list[float], kind: str):
    c = with_lens(robot, model, distortion, ("cam0", "cam1"))
    found = export(c, "colmap")
    (cameras,) = (entry["cameras"] for entry in json.loads(found.files["rig_config.json"]))
    rows = [row.split() for row in found.files["cameras.txt"].splitlines() if not row.startswith("#")]
    assert [row[:4] for row in rows] == [[str(i), kind, "752", "480"] for i in (1, 2)]
    for name, row, entry in zip(c.cameras, rows, cameras, strict=True):
        params = [float(x) for x in row[4:]]
        assert (entry["camera_params"], entry["camera_model_name"]) == (params, kind)
        assert entry["image_prefix"] == f"{name}/"
        # In COLMAP the centre of the top-left pixel is (0.5, 0.5).
        np.testing.assert_allclose(opencv_pixel(params, "FISH" in kind) - 0.5, our_pixel(c, name), atol=1e-9)
    assert cameras[0]["ref_sensor"] is True and "cam_from_rig_rotation" not in cameras[0]
    w, x, y, z = cameras[1]["cam_from_rig_rotation"]
    in_cam1 = Rotation.from_quat([x, y, z, w]).apply(POINT[:3]) + cameras[1]["cam_from_rig_translation"]
    np.testing.assert_allclose(c.T_imu_sensor("cam1") @ [*in_cam1, 1.0], c.T_imu_sensor("cam0") @ POINT, atol=1e-12)
    (rig,) = (row.split() for row in found.files["rigs.txt"].splitlines() if not row.startswith("#"))
    assert rig[:7] == ["1", "2", "CAMERA", "1", "CAMERA", "2", "1"]
    assert [float(v) for v in rig[7:]] == [w, x, y, z, *cameras[1]["cam_from_rig_translation"]]


def test_a_lens_that_colmap_does_not_have_is_fitted_and_said(calibration: Calibration):
    found = export(with_lens(calibration, "eucm", [0.6, 1.1], ("cam1",)), "colmap")
    assert found.sentences[0].startswith("COLMAP has no eucm: cam1 is given as the nearest pinhole-equidistant,")


def test_a_list_in_json_is_sealed_and_stays_json(calibration: Calibration, tmp_path: Path):
    calibration.save(tmp_path / "out")
    for _ in range(2):  # the second time it replaces its own files
        assert main(["export", str(tmp_path / "out"), "--to", "colmap", "-o", str(tmp_path / "colmap"), "-q"]) == 0
    file = tmp_path / "colmap" / "rig_config.json"
    assert is_ours(file) and len(json.loads(file.read_text())[0]["cameras"]) == 2
    file.write_text(file.read_text().replace("cam1/", "left/"))
    assert not is_ours(file)
    text = export(calibration, "colmap").files["rig_config.json"]
    assert json.loads(sealed_texts({"a.json": text})["a.json"])[0].keys() == {"cameras", "icalib_sha256"}
