"""Small robots in a room, for the tests of the sensors."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from tests.typed import not_none

from icalib.sensors.lidar.simulate import SimLidar
from icalib.sensors.wheels.simulate import SimWheels
from icalib.tools.simulation import Drive, Features, Obstacle, Room, Scenario, SimCamera, hills_of_slope
from icalib.tools.simulation.trajectory import DriveKind

CAMERA_AXES = np.array([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]])  # R_imu_cam of one that looks ahead


def lens(model: str, f: float, distortion: tuple[float, ...], resolution: tuple[int, int] = (160, 120)) -> SimCamera:
    """A camera of about that focal length [px], its axis nearly in the middle of a small image."""
    width, height = resolution
    middle = 0.5 * width + 0.3, 0.5 * height - 0.4
    return SimCamera("cam0", model, resolution, (f, 1.01 * f, *middle), distortion, np.eye(4))


DISTORTED = [
    lens("pinhole-radtan", 110.0, (-0.28, 0.07, 0.002, -0.001)),
    lens("pinhole-equidistant", 90.0, (0.03, -0.01, 0.004, -0.001)),
    lens("eucm", 110.0, (0.62, 1.1)),
    lens("double-sphere", 70.0, (-0.2, 0.59)),
    lens("pinhole-rational", 100.0, (0.5, 0.1, 0.002, -0.001, 0.02, 0.8, 0.1, 0.01)),
    lens("omni-radtan", 200.0, (1.2, -0.1, 0.03, 3e-4, -2e-4)),
]


def turn(axis: np.ndarray | list[float], angle: float) -> np.ndarray:
    """Rotation about an axis, by the power series of its cross matrix."""
    x, y, z = angle * np.asarray(axis, dtype=np.float64) / np.linalg.norm(axis)
    K = np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
    total = term = np.eye(3)
    for n in range(1, 25):
        term = term @ K / n
        total = total + term
    return total


def pose(rotation: np.ndarray, translation: list[float]) -> np.ndarray:
    T = np.eye(4)
    T[:3, :3], T[:3, 3] = rotation, translation
    return T


@pytest.fixture(scope="session")
def robot() -> Scenario:
    """Three cameras, a LiDAR and wheels, all mounted askew, with clocks of their own."""
    cameras = tuple(
        SimCamera(
            f"cam{i}",
            "pinhole-radtan",
            (752, 480),
            (458.0, 457.0, 367.0, 248.0),
            (-0.28, 0.07, 2e-4, 2e-5),
            pose(turn([0.1, 0.2, 1.0], yaw) @ CAMERA_AXES, [0.1, 0.1 * i, 0.05]),
            time_offset_s=offset,
            rate_hz=rate,
            phase_s=0.013 * i,
            clock_origin_ns=1_000_000_000 * i,
            corner_noise_px=1.0,
        )
        for i, (yaw, offset, rate) in enumerate([(0.1, 0.01, 20.0), (0.9, -0.01, 10.0), (-1.0, 0.0, 10.0)])
    )
    lidar = SimLidar(
        "lidar0",
        pose(turn([1.0, -2.0, 3.0], 0.3), [0.05, 0.02, 0.2]),
        time_offset_s=-0.01,
        clock_origin_ns=77,
        azimuth_steps=180,
        rings=8,
    )
    wheels = SimWheels(
        "wheel0",
        pose(turn([3.0, -1.0, 2.0], 0.1), [-0.15, 0.04, -0.33]),
        radii=(0.1, 0.103),
        time_offset_s=0.004,
        reports="poses",
    )
    blocks = (
        Obstacle((4.6, 3.6), (1.6, 1.2, 1.6), 0.3),
        Obstacle((-4.7, -3.6), (1.4, 1.0, 1.1), -0.5),
        Obstacle((-4.4, 3.4), (2.2, 1.2, 0.7), 0.2, ramp=True),
    )
    return Scenario(
        cameras,
        duration_s=4.0,
        motion=Drive("free"),
        imu_rate_hz=300.0,
        gyro_bias=(0.0, 0.0, 0.0),
        accel_bias=(0.0, 0.0, 0.0),
        imu_noise_enabled=False,
        board=False,
        room=Room(blocks=blocks),
        features=Features(count=800, persistent=100),
        sensors=(lidar, wheels),
    )


def on_ground(robot: Scenario, kind: DriveKind, **motion) -> Scenario:
    """The robot with wheels that report rates, on the floor or, for ramps, on hills."""
    hills = hills_of_slope(12.0) if kind == "ramps" else None
    wheels = tuple(replace(w, reports="rates") for w in robot.of(SimWheels))
    room = replace(not_none(robot.room), hills=hills)
    return replace(robot, motion=Drive(kind, **motion), room=room, sensors=(*robot.of(SimLidar), *wheels))


def alone(robot: Scenario) -> Scenario:
    """The robot without what takes time: cameras' points and the LiDAR."""
    return replace(robot, features=None, sensors=robot.of(SimWheels))


def wheel_path(truth, T_imu_wheel: np.ndarray, seconds: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """R_world_wheel and p_world_wheel at seconds (N,), one pose at a time."""
    rotations, positions = [], []
    for R, p in zip(*truth.pose_at(seconds)[:2], strict=True):
        T = pose(R, p) @ T_imu_wheel
        rotations.append(T[:3, :3])
        positions.append(T[:3, 3])
    return np.array(rotations), np.array(positions)
