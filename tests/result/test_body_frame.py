"""`body` of the rig file: results and files give poses, with their covariance, relative to that sensor."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import yaml
from tests.typed import not_none

from icalib.export.formats import export
from icalib.geometry import so3
from icalib.result import Calibration
from icalib.result.quantities import in_body_frame, rows
from icalib.result.saving import calibration_yaml

STEP = 1e-6


@pytest.fixture
def of_cam0(calibration: Calibration) -> Calibration:
    return replace(calibration, rig={**calibration.rig, "body": "cam0"})


def imu_in_cam0(c: Calibration, step: np.ndarray) -> np.ndarray:
    """T_cam0_imu with the rotation and translation of cam0 moved by `step` (6,)."""
    T = c.T_imu_sensor("cam0")
    T[:3, :3] = T[:3, :3] @ so3.exp(step[:3])
    T[:3, 3] += step[3:]
    return np.linalg.inv(T)


def columns_of(c: Calibration, sensor: str) -> list[int]:
    return [k for name in ("rotation", "translation") for k in not_none(c.group(sensor, name).columns)]


def test_the_pose_of_the_imu_has_the_covariance_of_the_inverse(of_cam0: Calibration):
    c = of_cam0
    found, T = in_body_frame(c), imu_in_cam0(c, np.zeros(6))
    np.testing.assert_allclose(found.T_imu_sensor("imu0"), T, atol=1e-12)
    J = np.zeros((6, 6))
    for k in range(6):
        ahead, behind = (imu_in_cam0(c, s * STEP * np.eye(6)[k]) for s in (1.0, -1.0))
        turn = so3.log(np.ascontiguousarray(behind[:3, :3].T @ ahead[:3, :3]))
        J[:, k] = np.concatenate([turn, ahead[:3, 3] - behind[:3, 3]]) / (2.0 * STEP)
    columns = columns_of(c, "cam0")
    wanted = J @ c.covariance[np.ix_(columns, columns)] @ J.T
    at = columns_of(found, "imu0")
    np.testing.assert_allclose(found.covariance[np.ix_(at, at)], wanted, rtol=1e-6, atol=1e-8 * wanted.max())
    formal = np.concatenate([found.group("imu0", name).std_formal for name in ("rotation", "translation")])
    np.testing.assert_allclose(formal, np.sqrt(np.diag(wanted)), rtol=1e-6)


def test_relative_poses_are_the_same_in_either_frame(of_cam0: Calibration):
    found = in_body_frame(of_cam0)
    for pair in (("cam0", "cam1"), ("imu0", "cam1"), ("cam1", "imu0")):
        a, b = of_cam0.T(*pair), found.T(*pair)
        np.testing.assert_allclose(b.T, a.T, atol=1e-12)
        np.testing.assert_allclose(b.covariance, a.covariance, atol=1e-9 * a.covariance.max())
    still, moved = found.group("cam0", "rotation"), found.group("cam1", "translation")
    assert still.columns is None and (still.value == np.eye(3)).all() and set(still.verdict) == {"fixed"}
    np.testing.assert_allclose(moved.std, of_cam0.T("cam0", "cam1").std[3:], rtol=1e-9)
    assert "unobservable" in moved.verdict  # as that of cam1 relative to the IMU


def test_poses_are_unobservable_where_the_null_space_moves_them(of_cam0: Calibration):
    """Both cameras move in the IMU's frame together, so that only the IMU moves in the frame of cam0. Small standard
    deviations, as a prior gives them, do not hide it."""
    step = np.array([0.28, 0.96, 0.0])  # in the frame of cam0; squares 0.08, 0.92, 0
    null = np.zeros((len(of_cam0.covariance), 1))
    for camera in ("cam0", "cam1"):
        null[columns_of(of_cam0, camera)[3:], 0] = np.sqrt(0.5) * of_cam0.T_imu_sensor("cam0")[:3, :3] @ step
    small = replace(of_cam0, covariance=1e-2 * of_cam0.covariance, null_space=null)
    found = in_body_frame(small)
    assert found.group("imu0", "translation").verdict == ("determined", "unobservable", "determined")
    for sensor, name in (("imu0", "rotation"), ("cam1", "rotation"), ("cam1", "translation")):
        assert set(found.group(sensor, name).verdict) == {"determined"}
    moved = np.zeros(len(found.covariance))
    moved[columns_of(found, "imu0")[3:]] = step
    np.testing.assert_allclose(np.abs(found.null_space.T @ moved), 1.0)
    failed = in_body_frame(replace(small, converged=False))
    assert set(failed.group("imu0", "rotation").verdict) == {"too uncertain"}


def test_without_a_body_of_its_own_nothing_changes(calibration: Calibration):
    same = replace(calibration, rig={**calibration.rig, "body": "imu0"})
    assert in_body_frame(calibration) is calibration and in_body_frame(same) is same
    assert calibration_yaml(same) == calibration_yaml(calibration)


def test_files_and_tables_name_the_body(of_cam0: Calibration):
    data = yaml.safe_load(calibration_yaml(of_cam0))["sensors"]
    np.testing.assert_allclose(data["imu0"]["T_cam0_sensor"], of_cam0.T("cam0", "imu0").T)
    np.testing.assert_allclose(data["cam1"]["std"]["translation"], of_cam0.T("cam0", "cam1").std[3:])
    assert data["cam0"]["T_cam0_sensor"] == np.eye(4).tolist()
    assert {r.sensor for r in rows(of_cam0) if r.name == "translation x"} == {"imu0", "cam1"}
    assert '<link name="cam0"/>' in export(of_cam0, "urdf").files["sensors.urdf"].split("<joint")[0]
    launch = export(of_cam0, "ros2-static").files["static_transforms.launch.py"]
    assert "'imu0': ('cam0'," in launch and "'cam1': ('cam0'," in launch
