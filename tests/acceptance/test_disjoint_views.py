"""Cameras that never see the board together: each is placed on the IMU, and so are the two to each other."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from tests.typed import not_none

from icalib.data.measurements import Measurements
from icalib.geometry import so3
from icalib.pipeline import calibrate_measurements
from icalib.rig import Camera, Rig
from icalib.rig.file import load_rig

from .conftest import EXAMPLE


def pose(camera: Camera) -> np.ndarray:
    T = np.eye(4)
    T[:3, :3], T[:3, 3] = camera.rotation.value, camera.translation.value
    return T


def test_cameras_that_see_the_board_in_turns_are_placed_as_published(
    rig_equidistant: Rig, excerpt: Measurements, cut: Callable[[Measurements, float, float], Measurements]
):
    cameras = cut(excerpt, 0.0, 0.5).cameras[0], cut(excerpt, 0.5, 1.0).cameras[1]
    result = calibrate_measurements(rig_equidistant, Measurements.of_streams(not_none(excerpt.imu), *cameras))
    assert result.converged, result.status
    published = [pose(c) for c in load_rig(EXAMPLE / "published.yaml").cameras]
    found = [result.T_imu_sensor(c) for c in ("cam0", "cam1")]
    (R, p), (Q, q) = ((T[:3, :3], T[:3, 3]) for T in (np.linalg.inv(a) @ b for a, b in (published, found)))
    angle_deg = np.rad2deg(np.linalg.norm(so3.log(np.ascontiguousarray(R.T @ Q))))
    assert angle_deg < 0.25
    assert np.linalg.norm(q - p) < 4e-3
