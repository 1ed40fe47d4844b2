"""Kalibr's files: layout as Kalibr's own, numbers those of the calibration."""

from __future__ import annotations

import dataclasses
from pathlib import Path

import numpy as np
import pytest
import yaml
from scipy.spatial.transform import Rotation

from icalib.errors import CalibrationError
from icalib.export.kalibr import camchain, imu_yaml
from icalib.export.odometry import openvins
from icalib.geometry.cameras import camera_model
from icalib.motion.imu_data import correction_matrices
from icalib.result import Calibration, ParameterGroup, by_key
from icalib.sensors.imu.spec import INTRINSICS_LABELS


@pytest.fixture(scope="module")
def chain(calibration: Calibration) -> dict:
    return yaml.safe_load(camchain(calibration))


def with_intrinsics(calibration: Calibration, value: np.ndarray, mode: str) -> Calibration:
    zeros = np.zeros(24)
    group = ParameterGroup("imu0", "intrinsics", INTRINSICS_LABELS, "", value, zeros, zeros, ("fixed",) * 24, mode)
    others = tuple(g for g in calibration.groups if g.sensor != "imu0")
    return dataclasses.replace(calibration, groups=(*others, group))


def test_poses_are_inverses_and_chain(calibration: Calibration, chain: dict):
    for cam in ("cam0", "cam1"):
        np.testing.assert_allclose(chain[cam]["T_cam_imu"] @ calibration.T_imu_sensor(cam), np.eye(4), atol=1e-15)
    T0, T1 = (np.array(chain[cam]["T_cam_imu"]) for cam in ("cam0", "cam1"))
    np.testing.assert_allclose(chain["cam1"]["T_cn_cnm1"], T1 @ np.linalg.inv(T0), atol=1e-15)
    assert "T_cn_cnm1" not in chain["cam0"]
    # cam1 sits 110 mm to the right of cam0: seen from it, cam0 lies at -x.
    assert np.array(chain["cam1"]["T_cn_cnm1"])[0, 3] == pytest.approx(-0.110, abs=1e-3)


def test_numbers(calibration: Calibration, chain: dict):
    assert chain["cam1"]["timeshift_cam_imu"] == calibration.group("cam1", "time_offset").value[0]
    assert chain["cam1"]["intrinsics"] == [457.587, 456.134, 379.999, 255.238]
    assert chain["cam0"]["distortion_coeffs"] == calibration.group("cam0", "distortion").value.tolist()
    assert chain["cam0"]["resolution"] == [752, 480]


def test_models_are_kalibrs_names(calibration: Calibration, chain: dict):
    assert (chain["cam0"]["camera_model"], chain["cam0"]["distortion_model"]) == ("pinhole", "radtan")
    sensors = {
        n: s | ({"model": "pinhole-equidistant"} if n == "cam1" else {}) for n, s in calibration.rig["sensors"].items()
    }
    fisheye = dataclasses.replace(calibration, rig=calibration.rig | {"sensors": sensors})
    found = yaml.safe_load(camchain(fisheye))["cam1"]
    assert (found["camera_model"], found["distortion_model"]) == ("pinhole", "equidistant")


def test_a_model_that_kalibr_lacks_is_fitted_and_said(calibration: Calibration):
    sensors = {n: s | {"model": "pinhole-radtan5"} if n == "cam1" else s for n, s in calibration.rig["sensors"].items()}
    groups = tuple(
        dataclasses.replace(g, value=np.append(g.value, -0.002)) if (g.sensor, g.name) == ("cam1", "distortion") else g
        for g in calibration.groups
    )
    text = camchain(dataclasses.replace(calibration, rig=calibration.rig | {"sensors": sensors}, groups=groups))
    assert "# Kalibr has no pinhole-radtan5: cam1 is given as the nearest pinhole-radtan, which differs by" in text
    assert "cam0 is given" not in text
    fitted = yaml.safe_load(text)["cam1"]
    assert (fitted["distortion_model"], len(fitted["distortion_coeffs"])) == ("radtan", 4)
    rays = np.array([[0.2, -0.1, 1.0], [-0.3, 0.25, 1.0]])
    params = np.concatenate([calibration.group("cam1", "intrinsics").value, groups_of(groups, "cam1", "distortion")])
    ours, _ = camera_model("pinhole-radtan5").project(params, rays)
    theirs, _ = camera_model("pinhole-radtan").project(
        np.array(fitted["intrinsics"] + fitted["distortion_coeffs"]), rays
    )
    assert np.abs(ours - theirs).max() < 0.5


@pytest.mark.parametrize(
    ("model", "distortion", "expected"),
    [
        ("eucm", [0.6, 1.1], ("eucm", [0.6, 1.1], "none", [])),
        ("double-sphere", [-0.2, 0.6], ("ds", [-0.2, 0.6], "none", [])),
        ("omni-radtan", [0.9, -0.1, 0.02, 1e-3, 2e-3], ("omni", [0.9], "radtan", [-0.1, 0.02, 1e-3, 2e-3])),
    ],
)
def test_models_of_wide_lenses_are_kalibrs(calibration: Calibration, model: str, distortion: list, expected: tuple):
    """Kalibr's wiki, "supported models": xi, alpha and beta stand before the focal lengths."""
    sensors = {n: s | ({"model": model} if n == "cam1" else {}) for n, s in calibration.rig["sensors"].items()}
    groups = tuple(
        dataclasses.replace(g, value=np.array(distortion)) if (g.sensor, g.name) == ("cam1", "distortion") else g
        for g in calibration.groups
    )
    text = camchain(dataclasses.replace(calibration, rig=calibration.rig | {"sensors": sensors}, groups=groups))
    found, pinhole = yaml.safe_load(text)["cam1"], [457.587, 456.134, 379.999, 255.238]
    assert (found["camera_model"], found["intrinsics"]) == (expected[0], expected[1] + pinhole)
    assert (found["distortion_model"], found["distortion_coeffs"]) == expected[2:]


def groups_of(groups: tuple, sensor: str, name: str) -> np.ndarray:
    return next(g.value for g in groups if (g.sensor, g.name) == (sensor, name))


def test_layout_is_that_of_kalibr(euroc: Path, chain: dict, calibration: Calibration):
    text = (euroc / "kalibr-camchain-imucam.yaml").read_text()
    kalibr = yaml.safe_load(text)
    assert {cam: list(entry) for cam, entry in chain.items()} == {cam: list(entry) for cam, entry in kalibr.items()}

    def without_numbers(lines: list[str]) -> list[str]:
        return [line.split("[")[0].split(": ")[0] for line in lines if not line.startswith("#")]

    assert without_numbers(camchain(calibration).splitlines()) == without_numbers(text.splitlines())


def test_overlaps_are_common_points_at_the_same_instant(calibration: Calibration, chain: dict):
    assert (chain["cam0"]["cam_overlaps"], chain["cam1"]["cam_overlaps"]) == ([1], [0])
    first, second = calibration.corner_residuals
    left = dataclasses.replace(first, point=first.point % 72)
    right = dataclasses.replace(second, point=72 + second.point % 72)
    later = dataclasses.replace(second, seconds=second.seconds + 100.0)
    for pair in ((left, right), (first, later)):
        apart = yaml.safe_load(camchain(dataclasses.replace(calibration, residuals=by_key(pair))))
        assert (apart["cam0"]["cam_overlaps"], apart["cam1"]["cam_overlaps"]) == ([], [])


def test_comments_say_direction_and_names(calibration: Calibration):
    assert camchain(calibration).startswith("# Kalibr's camchain by icalib. T_cam_imu takes coordinates in the imu")
    assert imu_yaml(calibration).startswith("# Kalibr's imu file by icalib. T_i_b takes coordinates in the body frame")
    first, second = calibration.corner_residuals
    sensors = {{"cam1": "right"}.get(n, n): s for n, s in calibration.rig["sensors"].items()}
    renamed = dataclasses.replace(
        calibration,
        rig=calibration.rig | {"sensors": sensors},
        groups=tuple(dataclasses.replace(g, sensor=g.sensor.replace("cam1", "right")) for g in calibration.groups),
        residuals=by_key([first, dataclasses.replace(second, sensor="right")]),
    )
    text = camchain(renamed)
    assert "# cam1 is right." in text
    assert yaml.safe_load(text)["cam1"]["rostopic"] == "/right/image_raw"


def test_imu_that_is_taken_for_ideal(calibration: Calibration):
    assert yaml.safe_load(imu_yaml(calibration)) == {
        "imu0": {
            "T_i_b": np.eye(4).tolist(),
            "accelerometer_noise_density": 2.8e-3,
            "accelerometer_random_walk": 8.6e-4,
            "gyroscope_noise_density": 1.6e-4,
            "gyroscope_random_walk": 2.2e-5,
            "model": "calibrated",
            "rostopic": "/imu0",
            "time_offset": 0.0,
            "update_rate": 200.0,
        }
    }


@pytest.mark.parametrize("mode", ["prior", "fixed"])
def test_imu_intrinsics_and_poses_are_those_of_kalibrs_frame(calibration: Calibration, mode: str):
    """Kalibr's model predicts the same readings, and its poses the same points."""
    x = np.random.default_rng(3).normal(scale=0.05, size=24)
    c = with_intrinsics(calibration, x, mode)
    imu, chain = yaml.safe_load(imu_yaml(c))["imu0"], yaml.safe_load(camchain(c))
    assert imu["model"] == "scale-misalignment"
    rate, force = np.array([0.3, -0.7, 1.1]), np.array([1.0, 2.0, -9.0])  # in the axes of the gyroscope
    to_accel = Rotation.from_rotvec(x[12:15]).as_matrix()
    w, f, gyro = to_accel @ rate, to_accel @ force, imu["gyroscopes"]
    C = np.array(gyro["C_gyro_i"])
    reading = gyro["M"] @ C @ w + gyro["A"] @ C @ f  # Kalibr, IccSensors.py
    F, G, H, _ = correction_matrices(x)
    accel = imu["accelerometers"]["M"] @ f
    np.testing.assert_allclose(F @ accel, force, atol=1e-12)
    np.testing.assert_allclose(G @ reading + H @ accel, rate, atol=1e-12)
    for name, fields in chain.items():
        point = np.array([0.2, -0.1, 0.7])
        T_imu_cam, T_cam_kalibr = c.T_imu_sensor(name), np.array(fields["T_cam_imu"])
        in_imu = T_imu_cam[:3, :3] @ point + T_imu_cam[:3, 3]
        np.testing.assert_allclose(T_cam_kalibr[:3, :3] @ to_accel @ in_imu + T_cam_kalibr[:3, 3], point, atol=1e-12)
    np.testing.assert_allclose(
        chain["cam1"]["T_cn_cnm1"], chain["cam1"]["T_cam_imu"] @ np.linalg.inv(chain["cam0"]["T_cam_imu"]), atol=1e-12
    )


def test_unknown_rate_is_said(calibration: Calibration):
    with pytest.raises(CalibrationError, match="rate of imu0"):
        imu_yaml(dataclasses.replace(calibration, rates={}))


@pytest.mark.parametrize(("rolling", "size"), [("rows", 480), ("columns", 752)])
def test_a_rolling_shutter_has_a_line_delay(calibration: Calibration, rolling: str, size: int):
    cam1 = calibration.rig["sensors"]["cam1"] | {"shutter": {"rolling": rolling, "readout": "free"}}
    sensors = calibration.rig["sensors"] | {"cam1": cam1}
    one, zero = np.array([0.024]), np.zeros(1)
    group = ParameterGroup("cam1", "readout", ("readout",), "s", one, zero, zero, ("determined",), "free")
    rolled = dataclasses.replace(
        calibration, rig=calibration.rig | {"sensors": sensors}, groups=(*calibration.groups, group)
    )
    text = camchain(rolled)
    assert yaml.safe_load(text)["cam1"]["line_delay"] == pytest.approx(0.024 / size)
    assert "line_delay" not in yaml.safe_load(text)["cam0"]
    said = (
        f"# cam1: each {rolling[:-1]} is exposed line_delay [s] after the one before; timeshift_cam_imu is that of the "
    )
    assert said + f"middle {rolling[:-1]}." in text
    sentence = (
        f"cam1 has a rolling shutter, read out in 24.000 ms: its time offset is that of the middle {rolling[:-1]}."
    )
    assert sentence in openvins(rolled).sentences and text.count(sentence) == 1
