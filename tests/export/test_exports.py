"""Exports read back by other parsers: YAML by PyYAML, ruamel and OpenCV, launch files by Python; every pose again."""

from __future__ import annotations

import ast
import dataclasses
import json
import re
from collections.abc import Callable
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
import yaml
from ruamel.yaml import YAML
from scipy.spatial.transform import Rotation

from icalib.base.files import sealed_texts
from icalib.cli import main
from icalib.errors import CalibrationError
from icalib.export.common import guesses, quaternion
from icalib.export.formats import FORMATS, export
from icalib.geometry.cameras import camera_model
from icalib.motion.imu_data import correction_matrices
from icalib.result import Calibration, ParameterGroup
from icalib.sensors.imu.spec import EFFECTS, INTRINSICS_LABELS


def by_opencv(text: str, tmp_path: Path) -> cv2.FileStorage:
    file = tmp_path / "file.yaml"
    file.write_text(text)
    storage = cv2.FileStorage(str(file), cv2.FILE_STORAGE_READ)
    assert storage.isOpened()
    return storage


def numbers(node: Any) -> Any:
    """A node of OpenCV as lists and numbers."""
    if node.isSeq():
        return [numbers(node.at(i)) for i in range(node.size())]
    return node.real() if node.isReal() or node.isInt() else node.string()


def by_yaml(text: str) -> Any:
    """PyYAML and ruamel (YAML 1.2) agree."""
    text = text.removeprefix("%YAML:1.0\n")
    found = yaml.safe_load(text)
    assert YAML(typ="safe", pure=True).load(text) == found
    return found


CAMERAS_ONLY = ("kalibr", "openvins", "vins-fusion", "orb-slam3", "camera-info", "colmap")


def with_model(c: Calibration, name: str, model: str, distortion: list[float]) -> Calibration:
    sensors = {n: s | ({"model": model} if n == name else {}) for n, s in c.rig["sensors"].items()}
    groups = tuple(
        dataclasses.replace(g, value=np.array(distortion)) if (g.sensor, g.name) == (name, "distortion") else g
        for g in c.groups
    )
    return dataclasses.replace(c, rig=c.rig | {"sensors": sensors}, groups=groups)


def with_offset(c: Calibration, name: str, offset: float) -> Calibration:
    groups = tuple(
        dataclasses.replace(g, value=np.array([offset])) if (g.sensor, g.name) == (name, "time_offset") else g
        for g in c.groups
    )
    return dataclasses.replace(c, groups=groups)


def with_imu_intrinsics(c: Calibration, value: np.ndarray) -> Calibration:
    zeros = np.zeros(24)
    group = ParameterGroup("imu0", "intrinsics", INTRINSICS_LABELS, "", value, zeros, zeros, ("fixed",) * 24, "fixed")
    return dataclasses.replace(c, groups=(*(g for g in c.groups if g.sensor != "imu0"), group))


def without_imu(c: Calibration) -> Calibration:
    """Two cameras, the first of which is the body."""
    rig = {"sensors": {n: s for n, s in c.rig["sensors"].items() if n != "imu0"}}
    return dataclasses.replace(c, rig=rig, groups=tuple(g for g in c.groups if g.sensor != "imu0"))


def test_what_is_too_uncertain_is_not_called_a_guess(robot: Calibration):
    groups = tuple(
        dataclasses.replace(g, verdict=("too uncertain", "unobservable", "weak"))
        if (g.sensor, g.name) == ("cam1", "translation")
        else g
        for g in robot.groups
    )
    assert guesses(dataclasses.replace(robot, groups=groups), ("cam0", "cam1")) == (
        "cam1: translation y is unobservable, so the value depends on the initial guess.",
        "cam1: translation x is too uncertain, with a standard deviation above 10 tolerances.",
    )


@pytest.mark.parametrize("to", FORMATS)
def test_every_format_says_which_way_its_transform_goes(robot: Calibration, to: str):
    said = {"kalibr": "takes coordinates in", "camera-info": "no pose", "json": "p_imu = T_imu_sensor p_sensor"}
    said |= {"fast-lio": "p_imu = extrinsic_R p_lidar + extrinsic_T", "mins": "p_imu = T_imu_cam p_cam"}
    said |= {"openvins": "p_imu = T_imu_cam p_cam", "vins-fusion": "p_imu = body_T_cam p_cam"}
    said |= {"orb-slam3": "p_imu = T_b_c1 p_c1", "lio-sam": "p_lidar = extrinsicRot p_imu + extrinsicTrans"}
    said |= {"fast-livo2": "p_cam = Rcl p_lidar + Pcl", "colmap": "p_cam = T p_rig"}
    found = export(robot, to)
    assert any(said.get(to, "p_parent = T p_child") in text for text in found.files.values())
    # What is printed stands in the files, too: in one of them at least.
    texts = " ".join(found.files.values())
    guessed = "cam1: translation y is unobservable, so the value depends on the initial guess."
    for sentence in found.sentences:
        assert sentence in texts or to == "json"
    assert (guessed in found.sentences) == (to not in ("camera-info", "fast-lio", "fast-livo2", "lio-sam"))


@pytest.mark.parametrize(
    "to", ["kalibr", "openvins", "vins-fusion", "orb-slam3", "camera-info", "mins", "fast-lio", "lio-sam", "colmap"]
)
def test_a_pose_sensor_is_said_to_have_no_place(robot: Calibration, to: str):
    sensors = robot.rig["sensors"] | {"mocap0": {"type": "pose"}}
    sentences = export(dataclasses.replace(robot, rig=robot.rig | {"sensors": sensors}), to).sentences
    assert any(re.search(r"has no place for .*\bmocap0\b.*; see calibration.yaml.$", s) for s in sentences)
    assert "mocap0" not in " ".join(export(robot, to).sentences)


def test_openvins(robot: Calibration, tmp_path: Path):
    found = export(with_offset(robot, "cam1", 2e-3), "openvins")
    assert list(found.files) == ["kalibr_imucam_chain.yaml", "kalibr_imu_chain.yaml"]
    text = found.files["kalibr_imucam_chain.yaml"]
    assert text.startswith("%YAML:1.0\n#")
    chain, storage = by_yaml(text), by_opencv(text, tmp_path)
    for name, entry in chain.items():
        T = np.array(entry["T_imu_cam"])
        np.testing.assert_array_equal(T, robot.T_imu_sensor(name))
        np.testing.assert_array_equal(numbers(storage.getNode(name).getNode("T_imu_cam")), T)
        assert entry["intrinsics"] == robot.group(name, "intrinsics").value.tolist()
        assert numbers(storage.getNode(name).getNode("distortion_coeffs")) == entry["distortion_coeffs"]
        assert (entry["camera_model"], entry["distortion_model"]) == ("pinhole", "radtan")
        assert (entry["resolution"], entry["rostopic"]) == ([752, 480], f"/{name}/image_raw")
    between = np.array(chain["cam1"]["T_cn_cnm1"])
    expected = np.linalg.inv(robot.T_imu_sensor("cam1")) @ robot.T_imu_sensor("cam0")
    np.testing.assert_allclose(between, expected, atol=1e-12)
    assert (chain["cam0"]["timeshift_cam_imu"], chain["cam1"]["timeshift_cam_imu"]) == (-1.354e-4, 2e-3)
    assert "time offset of cam0 for all cameras; from it differ cam1 by +2.135 ms." in " ".join(found.sentences)
    assert "OpenVINS has no place for lidar0, wheel0; see calibration.yaml." in found.sentences


def test_openvins_imu_model_gives_the_readings(calibration: Calibration, tmp_path: Path):
    x = np.random.default_rng(3).normal(scale=0.05, size=24)
    text = export(with_imu_intrinsics(calibration, x), "openvins").files["kalibr_imu_chain.yaml"]
    imu, storage = by_yaml(text)["imu0"], by_opencv(text, tmp_path)
    node = storage.getNode("imu0")
    M = {key: np.array(imu[key]) for key in ("Tw", "R_IMUtoGYRO", "Ta", "R_IMUtoACC", "Tg")}
    for key, matrix in M.items():
        np.testing.assert_array_equal(numbers(node.getNode(key)), matrix)
    rate, force = np.array([0.3, -0.7, 1.1]), np.array([1.0, 2.0, -9.0])
    gyro = M["Tw"] @ M["R_IMUtoGYRO"] @ rate + M["Tg"] @ force  # OpenVINS' documentation, "IMU intrinsics"
    accel = M["Ta"] @ M["R_IMUtoACC"] @ force
    F, G, H, _ = correction_matrices(x)
    np.testing.assert_allclose(F @ accel, force, atol=1e-12)
    np.testing.assert_allclose(G @ gyro + H @ accel, rate, atol=1e-12)
    assert imu["gyroscope_noise_density"] == 1.6e-4 and imu["update_rate"] == 200.0
    ideal = by_yaml(export(calibration, "openvins").files["kalibr_imu_chain.yaml"])["imu0"]
    assert (ideal["Tw"], ideal["Tg"]) == (np.eye(3).tolist(), np.zeros((3, 3)).tolist())


def test_vins_fusion(robot: Calibration, tmp_path: Path):
    found = export(robot, "vins-fusion")
    assert list(found.files) == ["vins.yaml", "cam0.yaml", "cam1.yaml"]
    storage = by_opencv(found.files["vins.yaml"], tmp_path)
    for i in range(2):
        np.testing.assert_array_equal(storage.getNode(f"body_T_cam{i}").mat(), robot.T_imu_sensor(f"cam{i}"))
        assert storage.getNode(f"cam{i}_calib").string() == f"cam{i}.yaml"
    assert storage.getNode("td").real() == -1.354e-4 and storage.getNode("imu_topic").string() == "/imu0"
    assert (storage.getNode("image_width").real(), storage.getNode("image_height").real()) == (752, 480)
    # Of a reading at 200 Hz.
    assert storage.getNode("acc_n").real() == pytest.approx(2.8e-3 * 200**0.5, rel=1e-12)
    assert storage.getNode("gyr_w").real() == pytest.approx(2.2e-5 * 200**0.5, rel=1e-12)
    assert storage.getNode("g_norm").real() == 9.806


@pytest.mark.parametrize(
    ("model", "distortion", "kind", "project"),
    [
        ("pinhole-radtan", [-0.28, 0.07, 2e-4, 1e-5], "PINHOLE", lambda p, ray: _radtan(p, ray, 0.0)),
        ("omni-radtan", [0.9, -0.1, 0.02, 1e-3, 2e-3], "MEI", lambda p, ray: _radtan(p, ray, p["xi"])),
        ("pinhole-equidistant", [-0.01, 0.02, -0.01, 1e-3], "KANNALA_BRANDT", lambda p, ray: _kannala(p, ray)),
    ],
)
def test_cameras_of_vins_fusion_project_as_ours(
    calibration: Calibration,
    tmp_path: Path,
    model: str,
    distortion: list[float],
    kind: str,
    project: Callable[[dict[str, float], np.ndarray], np.ndarray],
):
    c = with_model(calibration, "cam1", model, distortion)
    storage = by_opencv(export(c, "vins-fusion").files["cam1.yaml"], tmp_path)
    assert storage.getNode("model_type").string() == kind and storage.getNode("image_width").real() == 752
    values = {}
    for part in ("mirror", "distortion", "projection"):
        node = storage.getNode(f"{part}_parameters")
        values |= {} if node.empty() else {key: node.getNode(key).real() for key in node.keys()}  # noqa: SIM118
    ray = np.array([[0.31, -0.22, 1.0]])
    params = np.concatenate([c.group("cam1", "intrinsics").value, c.group("cam1", "distortion").value])
    ours, _ = camera_model(model).project(params, ray)
    np.testing.assert_allclose(project(values, ray[0]), ours[0], atol=1e-9)


def _radtan(p: dict[str, float], ray: np.ndarray, xi: float) -> np.ndarray:
    """camodocal's PINHOLE (xi = 0) and MEI."""
    x, y = ray[:2] / (ray[2] + xi * np.linalg.norm(ray))
    r2 = x * x + y * y
    radial = 1.0 + p["k1"] * r2 + p["k2"] * r2 * r2
    u = x * radial + 2 * p["p1"] * x * y + p["p2"] * (r2 + 2 * x * x)
    v = y * radial + 2 * p["p2"] * x * y + p["p1"] * (r2 + 2 * y * y)
    names = (("fx", "gamma1"), ("fy", "gamma2"), ("cx", "u0"), ("cy", "v0"))
    fx, fy, cx, cy = (p.get(pinhole, p.get(mei, 0.0)) for pinhole, mei in names)
    return np.array([fx * u + cx, fy * v + cy])


def _kannala(p: dict[str, float], ray: np.ndarray) -> np.ndarray:
    t = np.arctan2(np.hypot(ray[0], ray[1]), ray[2])
    r = t + p["k2"] * t**3 + p["k3"] * t**5 + p["k4"] * t**7 + p["k5"] * t**9
    x, y = ray[:2] / np.hypot(ray[0], ray[1])
    return np.array([p["mu"] * r * x + p["u0"], p["mv"] * r * y + p["v0"]])


def test_vins_fusion_says_what_a_second_camera_loses(calibration: Calibration):
    found = export(with_offset(calibration, "cam1", 1e-3), "vins-fusion")
    assert found.sentences[0].startswith("VINS-Fusion has one td for both cameras, that of cam0; cam1 differs from it")
    assert f"# {found.sentences[0]}" in found.files["vins.yaml"]


def test_mins(robot: Calibration, tmp_path: Path):
    files = export(robot, "mins").files
    assert sorted(files) == ["config_camera.yaml", "config_imu.yaml", "config_lidar.yaml", "config_wheel.yaml"]
    places = {"cam0": "camera", "cam1": "camera", "lidar0": "lidar", "wheel": "wheel"}
    for name, file in places.items():
        ours, key = {"wheel": "wheel0"}.get(name, name), f"T_imu_{name.rstrip('01')}"
        text = files[f"config_{file}.yaml"]
        entry, storage = by_yaml(text)[name], by_opencv(text, tmp_path)
        node = storage.getNode(name)
        np.testing.assert_array_equal(entry[key], robot.T_imu_sensor(ours))
        np.testing.assert_array_equal(numbers(node.getNode(key)), robot.T_imu_sensor(ours))
        assert entry["timeoffset"] == robot.group(ours, "time_offset").value[0] == node.getNode("timeoffset").real()
    assert by_yaml(files["config_wheel.yaml"])["wheel"]["intrinsics"] == [0.1, 0.102, 0.42]
    imu = by_yaml(files["config_imu.yaml"])["imu"]
    assert imu == {
        "accel_noise": 2.8e-3,
        "accel_bias": 8.6e-4,
        "gyro_noise": 1.6e-4,
        "gyro_bias": 2.2e-5,
        "topic": "/imu0",
    }


def test_fast_lio(robot: Calibration):
    found = export(robot, "fast-lio")
    data = by_yaml(found.files["lidar0.yaml"])
    T = robot.T_imu_sensor("lidar0")
    np.testing.assert_array_equal(np.reshape(data["mapping"]["extrinsic_R"], (3, 3)), T[:3, :3])
    assert data["mapping"]["extrinsic_T"] == T[:3, 3].tolist() and data["mapping"]["extrinsic_est_en"] is False
    assert data["common"]["time_offset_lidar_to_imu"] == -0.01
    assert "FAST-LIO has no place for cam0, cam1, wheel0; see calibration.yaml." in found.sentences


def transforms_of(launch: str) -> dict[str, tuple[str, np.ndarray]]:
    """Child -> (parent, T_parent_child) of what the launch file's nodes are given, run with stand-ins for ROS."""
    compile(launch, "static.launch.py", "exec")
    stand_in = {"LaunchDescription": lambda nodes: nodes, "Node": lambda **fields: fields}
    lines = [line for line in launch.splitlines() if not line.startswith("from launch")]
    exec("\n".join(lines), stand_in)  # noqa: S102
    found = {}
    for node in stand_in["generate_launch_description"]():  # type: ignore[operator]
        assert (node["package"], node["executable"]) == ("tf2_ros", "static_transform_publisher")
        assert all(isinstance(a, str) for a in node["arguments"])
        given = dict(zip(node["arguments"][::2], node["arguments"][1::2], strict=True))
        T = np.eye(4)
        T[:3, 3] = [float(given[f"--{axis}"]) for axis in "xyz"]
        T[:3, :3] = Rotation.from_quat([float(given[f"--q{axis}"]) for axis in "xyzw"]).as_matrix()
        found[given["--child-frame-id"]] = (given["--frame-id"], T)
    return found


def test_ros2_static_transforms(robot: Calibration):
    found = export(robot, "ros2-static", {"imu0": "imu_link", "cam0": "camera/left-optical"})
    launch = found.files["static_transforms.launch.py"]
    imports = [node for node in ast.walk(ast.parse(launch)) if isinstance(node, ast.ImportFrom)]
    assert sorted(str(node.module) for node in imports) == ["launch", "launch_ros.actions"]
    transforms = transforms_of(launch)
    assert list(transforms) == ["camera/left-optical", "cam1", "lidar0", "wheel0"]
    for child, (parent, T) in transforms.items():
        assert parent == "imu_link"
        np.testing.assert_allclose(T, robot.T_imu_sensor({"camera/left-optical": "cam0"}.get(child, child)), atol=1e-12)
    assert re.search(r"tf has no place for the time offset of cam0 \(-0\.135 ms\), .*wheel0", found.sentences[0])
    names = re.findall(r"static_tf_\{\}", launch)
    assert names and '.replace("/", "_").replace("-", "_")' in launch


def test_ros2_static_transforms_without_an_imu(calibration: Calibration):
    c = without_imu(calibration)
    transforms = transforms_of(export(c, "ros2-static").files["static_transforms.launch.py"])
    assert list(transforms) == ["cam1"] and transforms["cam1"][0] == "cam0"
    np.testing.assert_allclose(transforms["cam1"][1], c.T_imu_sensor("cam1"), atol=1e-12)


@pytest.mark.parametrize(
    ("model", "distortion", "expected"),
    [
        ("pinhole-radtan", [-0.28, 0.07, 2e-4, 1e-5], ("plumb_bob", [-0.28, 0.07, 2e-4, 1e-5, 0.0])),
        ("pinhole-radtan5", [-0.28, 0.07, 2e-4, 1e-5, 3e-3], ("plumb_bob", [-0.28, 0.07, 2e-4, 1e-5, 3e-3])),
        (
            "pinhole-rational",
            [0.5, -2.5, 4e-4, -2e-4, 1.5, 0.4, -2.4, 1.4],
            ("rational_polynomial", [0.5, -2.5, 4e-4, -2e-4, 1.5, 0.4, -2.4, 1.4]),
        ),
        ("pinhole-equidistant", [-0.01, 0.02, -0.01, 1e-3], ("equidistant", [-0.01, 0.02, -0.01, 1e-3])),
    ],
)
def test_camera_info(calibration: Calibration, model: str, distortion: list[float], expected: tuple):
    """OpenCV, which image_proc calls with these numbers, projects as our model does."""
    c = with_model(calibration, "cam1", model, distortion)
    info = by_yaml(export(c, "camera-info").files["cam1.yaml"])
    assert (info["distortion_model"], info["distortion_coefficients"]["data"]) == expected
    assert (info["image_width"], info["image_height"], info["camera_name"]) == (752, 480, "cam1")
    shapes = {"camera_matrix": (3, 3), "rectification_matrix": (3, 3), "projection_matrix": (3, 4)}
    K, R, P = (np.reshape(info[key]["data"], shape) for key, shape in shapes.items())
    assert all((info[key]["rows"], info[key]["cols"]) == shape for key, shape in shapes.items())
    np.testing.assert_array_equal(P, np.hstack([K, np.zeros((3, 1))]))
    np.testing.assert_array_equal(R, np.eye(3))
    ray, zero, D = np.array([[[0.31, -0.22, 1.0]]]), np.zeros(3), np.array(expected[1])
    project = cv2.fisheye.projectPoints if expected[0] == "equidistant" else cv2.projectPoints
    theirs = project(ray, zero, zero, K, D)[0]
    params = np.concatenate([c.group("cam1", "intrinsics").value, distortion])
    np.testing.assert_allclose(theirs.ravel(), camera_model(model).project(params, ray[0])[0][0], atol=1e-9)


@pytest.mark.parametrize("to", ["openvins", "camera-info", "vins-fusion", "mins"])
def test_a_lens_that_a_format_does_not_have_is_fitted_and_said(calibration: Calibration, to: str):
    found = export(with_model(calibration, "cam1", "eucm", [0.6, 1.1]), to)
    program = {"openvins": "OpenVINS", "camera-info": "CameraInfo", "vins-fusion": "VINS-Fusion", "mins": "MINS"}[to]
    assert found.sentences[0].startswith(f"{program} has no eucm: cam1 is given as the nearest pinhole-equidistant,")
    near = float(found.sentences[0].split("equidistant, which differs by ")[1].split(" px")[0])
    assert near < 0.5


def test_plain_json(robot: Calibration):
    data = json.loads(export(robot, "json").files["calibration.json"])
    for name in robot.mounted:
        sensor, T = data["sensors"][name], robot.T_imu_sensor(name)
        np.testing.assert_array_equal(sensor["T_imu_sensor"], T)
        np.testing.assert_allclose(Rotation.from_quat(sensor["quaternion_xyzw"]).as_matrix(), T[:3, :3], atol=1e-12)
        assert sensor["translation"] == T[:3, 3].tolist()
        assert sensor["std"]["rotation"] == robot.group(name, "rotation").std.tolist()
    assert data["sensors"]["cam1"]["verdict"]["translation"] == ["determined", "unobservable", "weak"]
    assert "T_lidar0_wheel0" in data["relative"]


def test_kalibr_says_what_it_leaves_out(robot: Calibration, without_cameras: Calibration):
    found = export(robot, "kalibr")
    assert list(found.files) == ["camchain-imucam.yaml", "imu.yaml"]
    assert "Kalibr has no place for lidar0, wheel0; see calibration.yaml." in found.sentences
    T = np.array(by_yaml(found.files["camchain-imucam.yaml"])["cam1"]["T_cam_imu"])
    np.testing.assert_allclose(T @ robot.T_imu_sensor("cam1"), np.eye(4), atol=1e-12)
    assert list(export(without_cameras, "kalibr").files) == ["imu.yaml"]


@pytest.mark.parametrize("to", FORMATS)
def test_a_clock_that_restarts_has_no_offset_to_give(robot: Calibration, to: str):
    """What it will be next time nobody knows."""
    restarting = robot
    for name in ("cam0", "lidar0"):
        group = dataclasses.replace(
            robot.group(name, "time_offset"),
            labels=("in recording 1", "in recording 2"),
            value=np.array([0.01, -3.2]),
            std=np.full(2, 1e-4),
            std_formal=np.full(2, 1e-4),
            verdict=("determined", "unobservable"),
            factor=np.ones(2),
        )
        groups = (*(g for g in restarting.groups if (g.sensor, g.name) != (name, "time_offset")), group)
        restarting = dataclasses.replace(restarting, groups=groups)
    if to in ("openvins", "vins-fusion", "mins", "fast-lio", "fast-livo2"):
        with pytest.raises(
            CalibrationError, match="the clock of (cam0|lidar0) restarts, so each recording has its own time offset"
        ):
            export(restarting, to)
        return
    texts = " ".join(export(restarting, to).files.values())
    if to == "kalibr":
        assert "timeshift_cam_imu" not in by_yaml(export(restarting, to).files["camchain-imucam.yaml"])["cam0"]
        assert "# cam0 has no timeshift_cam_imu: its clock restarts" in texts
    elif to == "json":
        assert json.loads(texts)["sensors"]["cam0"]["time_offset"] == [0.01, -3.2]
    else:
        sensor = "lidar0" if to == "lio-sam" else "cam0"
        assert f"the time offsets of {sensor} (one for each recording)" in texts


@pytest.mark.parametrize("to", FORMATS)
def test_a_rolling_shutter_and_a_drifting_clock_are_said(robot: Calibration, to: str):
    """cam0 reads its rows in 24 ms, and the clock of lidar0 is slow. No format but json has a field for a rate."""
    cam0 = robot.rig["sensors"]["cam0"] | {"shutter": {"rolling": "rows", "readout": "free"}}
    one, zero = np.ones(1), np.zeros(1)
    values = {("cam0", "readout"): 0.024 * one, ("lidar0", "clock_rate"): 80.0 * one, ("cam1", "clock_rate"): zero}
    more = [ParameterGroup(s, n, (n,), "", v, zero, zero, ("determined",), "free") for (s, n), v in values.items()]
    groups, rig = (*robot.groups, *more), robot.rig | {"sensors": robot.rig["sensors"] | {"cam0": cam0}}
    found = export(dataclasses.replace(robot, groups=groups, rig=rig), to)
    texts = " ".join(found.files.values())
    expected = {
        "cam0": "cam0 has a rolling shutter, read out in 24.000 ms: its time offset is that of the middle row.",
        "lidar0": "The clock of lidar0 has a rate of +80.0 ppm: its time offset is that of the middle of the "
        "recording, and changes by +0.0800 ms each second.",
    }
    without = {name: f"no place for .*{name}" for name in expected if expected[name] not in found.sentences}
    for sentence in found.sentences:
        assert sentence in texts or to == "json"
    for pattern in without.values():  # the whole sensor has no place in the format
        assert re.search(pattern, " ".join(found.sentences))
    assert set(without) == {"fast-lio": {"cam0"}, "lio-sam": {"cam0"}}.get(
        to, {"lidar0"} if to in CAMERAS_ONLY else set()
    )
    assert "clock of cam1" not in texts
    if to == "json":
        data = json.loads(texts)
        assert data["sensors"]["lidar0"]["parameters"]["clock_rate"] == 80.0
        assert {"clock_rate", "readout"} <= data["conventions"].keys()
        assert "clock_rate" not in export(robot, to).files["calibration.json"]


@pytest.mark.parametrize("to", ["ros2-static", "urdf", "autoware", "mins", "fast-lio", "fast-livo2", "lio-sam"])
def test_errors_of_ranges_are_said(robot: Calibration, to: str):
    one, names = np.full(1, 1e-3), ("range_offset", "range_scale")
    more = [ParameterGroup("lidar0", n, (n,), "", one, one, one, ("determined",), "prior") for n in names]
    found = export(dataclasses.replace(robot, groups=(*robot.groups, *more)), to)
    assert "range offset and range scale of lidar0" in " ".join(found.sentences)


@pytest.mark.parametrize("to", FORMATS)
def test_effects_on_the_imu_are_said(robot: Calibration, to: str):
    """Kalibr has a field for the size effect, json for all, and COLMAP none for IMUs."""
    values = (np.full(6, 1e-3), np.full(1, 5e-3), np.zeros(1))
    more = [
        ParameterGroup("imu0", spec.name, spec.labels, spec.unit, v, v, v, ("determined",) * spec.size, "prior")
        for spec, v in zip(EFFECTS, values, strict=True)
    ]
    found = export(dataclasses.replace(robot, groups=(*robot.groups, *more)), to)
    said, texts = " ".join(found.sentences), " ".join(found.files.values())
    assert ("accel delay of imu0" in said) == (to not in ("colmap", "json"))
    assert ("size effect of imu0" in said) == (to not in ("colmap", "json", "kalibr"))
    assert "low pass of imu0" not in said
    if to == "json":
        assert json.loads(texts)["sensors"]["imu0"]["parameters"]["accel_delay"] == 5e-3
    elif to == "kalibr":
        assert "accel delay of imu0" in found.files["imu.yaml"] and "rz_i" in found.files["imu.yaml"]
    else:
        assert all(sentence in texts for sentence in found.sentences)


def test_imu_intrinsics_that_have_no_place_are_said(robot: Calibration):
    c = with_imu_intrinsics(robot, np.full(24, 0.01))
    for to in ("vins-fusion", "mins", "fast-lio", "lio-sam", "orb-slam3", "ros2-static", "camera-info", "urdf"):
        assert any("scale and misalignment of imu0" in s for s in export(c, to).sentences)
    for to in ("kalibr", "openvins"):
        assert not any("scale and misalignment" in s for s in export(c, to).sentences)


def test_quaternions_of_rotations():
    """Random ones, half turns, and pitch of 90 deg."""
    angles = [[y, p, r] for p in (90, -90, 89.9999999) for y, r in ((30, 20), (-170, 5))]
    special = [Rotation.from_euler("ZYX", a, degrees=True) for a in angles]
    special += [Rotation.from_rotvec(np.pi * np.eye(3)[k]) for k in range(3)] + [Rotation.identity()]
    for rotation in [*special, *Rotation.random(50, rng=np.random.default_rng(1))]:
        x, y, z, w = quaternion(rotation.as_matrix())
        np.testing.assert_allclose(Rotation.from_quat([x, y, z, w]).as_matrix(), rotation.as_matrix(), atol=1e-12)
        assert w >= 0


@pytest.mark.parametrize(
    ("to", "words"),
    [
        ("openvins", "OpenVINS needs an IMU, and this calibration has none; export to kalibr"),
        ("vins-fusion", "VINS-Fusion needs an IMU"),
        ("mins", "MINS needs an IMU"),
        ("fast-lio", "FAST-LIO needs an IMU"),
    ],
)
def test_an_imu_that_is_not_there(calibration: Calibration, to: str, words: str):
    with pytest.raises(CalibrationError, match=words):
        export(without_imu(calibration), to)


@pytest.mark.parametrize(
    ("to", "words"),
    [
        ("openvins", "this calibration has no camera, so there is nothing to export to OpenVINS"),
        ("vins-fusion", "has no camera"),
        ("camera-info", "has no camera"),
    ],
)
def test_cameras_that_are_not_there(without_cameras: Calibration, to: str, words: str):
    with pytest.raises(CalibrationError, match=words):
        export(without_cameras, to)


def test_a_lidar_and_a_rate_that_are_not_there(calibration: Calibration):
    with pytest.raises(CalibrationError, match="has no LiDAR, so there is nothing to export to FAST-LIO"):
        export(calibration, "fast-lio")
    for to in ("openvins", "vins-fusion"):
        with pytest.raises(CalibrationError, match="the rate of imu0 is not known"):
            export(dataclasses.replace(calibration, rates={}), to)


def test_options_of_other_formats(calibration: Calibration, tmp_path: Path):
    with pytest.raises(CalibrationError, match="there is no format kalibur; available are kalibr, openvins"):
        export(calibration, "kalibur")
    with pytest.raises(CalibrationError, match="--frame belongs to ros2-static, urdf, autoware; json names no frames"):
        export(calibration, "json", {"cam0": "left"})
    with pytest.raises(CalibrationError, match="--urdf belongs to --to urdf, not to json"):
        export(calibration, "json", existing_urdf=tmp_path / "robot.urdf")
    with pytest.raises(CalibrationError, match="--joint names joints of an existing file; give it as --to urdf --urdf"):
        export(calibration, "urdf", joints={"cam0": "a"})
    with pytest.raises(
        CalibrationError, match="there is no sensor cam9, did you mean 'cam.'; this calibration has imu0, cam0, cam1."
    ):
        export(calibration, "ros2-static", {"cam9": "left"})


@pytest.mark.parametrize("to", FORMATS)
def test_the_command(robot: Calibration, tmp_path: Path, capsys: pytest.CaptureFixture[str], to: str):
    robot.save(tmp_path / "out")
    before = sorted((tmp_path / "out").iterdir())
    path = tmp_path / "there" / "file"
    assert main(["export", str(tmp_path / "out"), "--to", to, "-o", str(path)]) == 0
    printed, found = capsys.readouterr().out, export(robot, to)
    assert all(f"Note: {sentence}\n" in printed for sentence in found.sentences)
    written = [path] if to in ("ros2-static", "urdf", "json") else [path / name for name in found.files]
    assert [p.read_text() for p in written] == list(sealed_texts(found.files).values())
    assert all(str(p) in printed.splitlines()[-1] for p in written)
    assert sorted(p for p in path.parent.rglob("*") if p.is_file()) == sorted(written)
    assert sorted((tmp_path / "out").iterdir()) == before


def test_an_export_into_the_result_leaves_it_whole(robot: Calibration, tmp_path: Path):
    robot.save(tmp_path)
    before = {p.name: p.read_bytes() for p in tmp_path.iterdir()}
    assert main(["export", str(tmp_path), "--to", "kalibr", "-o", str(tmp_path), "-q"]) == 0
    assert {name: (tmp_path / name).read_bytes() for name in before} == before


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["export", "nowhere", "--to", "json", "-o", "x.json"], "nowhere is not a folder"),
        (["export", "{out}", "--to", "json", "-o", "{out}/result.npz/x.json"], "cannot be written"),
        (["export", "{out}", "--to", "urdf", "-o", "x.urdf", "--urdf", "{out}/no.urdf"], "no.urdf cannot be read"),
        (["export", "{out}", "--to", "fast-lio", "-o", "x"], "has no LiDAR"),
    ],
)
def test_bad_input_is_one_sentence(
    calibration: Calibration,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
    arguments: list[str],
    words: str,
):
    calibration.save(tmp_path / "out")
    monkeypatch.chdir(tmp_path)
    assert main([a.format(out="out") for a in arguments]) == 1
    error = capsys.readouterr().err
    assert words in error and error.count("\n") == 1 and "Traceback" not in error


def test_a_pair_that_is_none_is_wrong_usage(capsys: pytest.CaptureFixture[str]):
    with pytest.raises(SystemExit):
        main(["export", "out", "--to", "urdf", "-o", "x", "--frame", "cam0"])
    assert "must be SENSOR=NAME, but is 'cam0'" in capsys.readouterr().err
