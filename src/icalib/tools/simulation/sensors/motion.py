"""True trajectories of the IMU in closed form.

Frames: world (z up), imu. Angular rates w and specific forces f are in the imu frame: R' = R [w]x, v' = R f + g,
p' = v.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from icalib.tools.simulation.scenario.scenario import GRAVITY_WORLD, HandheldMotion, Scenario

_ANGLES_RAD = np.array([[0.45, 0.22, 0.18], [0.12, 0.09, 0.08]])  # slow, fast sinusoid; about camera z, y, x
_YAW_RAD = np.array([[0.25, 0.0, 0.0], [0.10, 0.0, 0.0]])
_SHIFT_M = np.array([[0.15, 0.10, 0.15], [0.05, 0.04, 0.05]])
_FREQUENCY_HZ = np.array([[0.30, 0.55], [0.80, 1.20]])  # range of the slow, of the fast sinusoid
_AXIS_X, _AXIS_Y, _AXIS_Z = np.eye(3)


def skew(w: np.ndarray) -> np.ndarray:
    """(..., 3, 3) cross-product matrices of w (..., 3): skew(w) v = w x v."""
    W = np.zeros((*w.shape[:-1], 3, 3))
    W[..., 2, 1], W[..., 0, 2], W[..., 1, 0] = w[..., 0], w[..., 1], w[..., 2]
    return W - np.swapaxes(W, -1, -2)


def readings_of(rotation: np.ndarray, rotation_rate: np.ndarray, acceleration: np.ndarray) -> np.ndarray:
    """(N, 6) angular rate [rad/s] and specific force [m/s^2] in the imu frame, from R_world_imu and its time derivative
    (N, 3, 3), and the acceleration (N, 3) m/s^2 in the world."""
    spin = np.swapaxes(rotation, 1, 2) @ rotation_rate
    rate = 0.5 * np.stack([spin[:, i, j] - spin[:, j, i] for i, j in ((2, 1), (0, 2), (1, 0))], axis=1)
    return np.concatenate([rate, np.einsum("nji,nj->ni", rotation, acceleration - GRAVITY_WORLD)], axis=1)


@dataclass(frozen=True, eq=False)
class Waves:
    """Several channels, each a sum of sinusoids. amplitude, frequency [Hz], phase [rad]: all (sinusoids, channels)."""

    amplitude: np.ndarray
    frequency: np.ndarray
    phase: np.ndarray

    def derivative(self, order: int, seconds: np.ndarray) -> np.ndarray:
        """(N, channels) time derivative of the given order at seconds (N,)."""
        omega = 2.0 * np.pi * self.frequency
        angle = omega * seconds[:, None, None] + self.phase + 0.5 * np.pi * order
        return np.sum(self.amplitude * omega**order * np.sin(angle), axis=1)


@dataclass(frozen=True, eq=False)
class Reference:
    """Trajectory in closed form: R_world_imu = left Rz(a0) Ry(a1) Rx(a2) right, p_world_imu = center + axes s. Angles a
    [rad] and shifts s [m] are `Waves`."""

    left: np.ndarray
    right: np.ndarray
    center: np.ndarray
    axes: np.ndarray  # (3, 3) columns: the directions of the shifts in world
    angles: Waves
    shifts: Waves

    def pose_at(self, seconds: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """See `Trajectory.pose_at`."""
        Rz, Ry, Rx = self._factors(seconds)
        rotation = self.left @ Rz @ Ry @ Rx @ self.right
        position = self.center + self.shifts.derivative(0, seconds) @ self.axes.T
        return rotation, position, self.shifts.derivative(1, seconds) @ self.axes.T

    def readings_at(self, seconds: np.ndarray) -> np.ndarray:
        """(N, 6) true angular rate [rad/s] and specific force [m/s^2] in the IMU frame."""
        _, Ry, Rx = self._factors(seconds)
        da = self.angles.derivative(1, seconds)[:, :, None]
        # The axis of each angle, transformed by the rotations to its right.
        rate = da[:, 2] * _AXIS_X + da[:, 1] * (_AXIS_Y @ Rx) + da[:, 0] * (_AXIS_Z @ (Ry @ Rx))
        rotation, _, _ = self.pose_at(seconds)
        acceleration = self.shifts.derivative(2, seconds) @ self.axes.T
        force = np.einsum("nji,nj->ni", rotation, acceleration - GRAVITY_WORLD)
        return np.concatenate([rate @ self.right, force], axis=1)

    def rate_at(self, seconds: np.ndarray) -> np.ndarray:
        """See `Trajectory.rate_at`."""
        return self.readings_at(seconds)[:, :3]

    def _factors(self, seconds: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        angles = self.angles.derivative(0, seconds)
        return _turn(2, angles[:, 0]), _turn(1, angles[:, 1]), _turn(0, angles[:, 2])


def _turn(axis: int, angle: np.ndarray) -> np.ndarray:
    """(N, 3, 3) rotations by angle (N,) rad about the coordinate axis number `axis`."""
    i, j = (axis + 1) % 3, (axis + 2) % 3
    R = np.zeros((len(angle), 3, 3))
    R[:, axis, axis] = 1.0
    R[:, i, i] = R[:, j, j] = np.cos(angle)
    R[:, j, i] = np.sin(angle)
    R[:, i, j] = -R[:, j, i]
    return R


def _waves(amplitude: np.ndarray, rng: np.random.Generator) -> Waves:
    frequency = rng.uniform(_FREQUENCY_HZ[:, :1], _FREQUENCY_HZ[:, 1:], (2, 3))
    return Waves(amplitude, frequency, rng.uniform(0.0, 2.0 * np.pi, (2, 3)))


def basis_with_z(axis: np.ndarray) -> np.ndarray:
    """(3, 3) rotation with the unit vector along `axis` (3,) as its third column."""
    z = axis / np.linalg.norm(axis)
    x = np.cross(np.eye(3)[np.argmin(np.abs(z))], z)
    x /= np.linalg.norm(x)
    return np.stack([x, np.cross(z, x), z], axis=1)


def reference_motion(scenario: Scenario, rng: np.random.Generator) -> Reference:
    """The scenario's handheld motion in closed form. Its middle is the pose at which the first camera looks at the
    board's centre, or at the origin of T_world_board if the target has several bodies."""
    motion = scenario.motion
    assert isinstance(motion, HandheldMotion)
    T_imu_cam = scenario.cameras[0].T_imu_sensor
    R_world_board, origin = scenario.T_world_board[:3, :3], scenario.T_world_board[:3, 3]
    corners = scenario.target.points if scenario.T_world_bodies is None else np.zeros((1, 3))
    middle = 0.5 * (corners.min(axis=0) + corners.max(axis=0)) + [0.0, 0.0, motion.distance_m]
    # The board's tags face its +z, so the camera looks along -z, with its y down where the board's is up.
    R_world_cam = R_world_board @ np.diag([1.0, -1.0, -1.0])
    R_world_imu = R_world_cam @ T_imu_cam[:3, :3].T
    center = origin + R_world_board @ middle - R_world_imu @ T_imu_cam[:3, 3]

    left, right, axes = R_world_cam, T_imu_cam[:3, :3].T, R_world_board
    angles, shifts = _ANGLES_RAD, _SHIFT_M
    if motion.kind == "planar":
        left, right, axes = np.eye(3), R_world_imu, np.eye(3)
        angles, shifts = _YAW_RAD, _SHIFT_M * [1.0, 1.0, 0.0]
    elif motion.kind == "single_axis":
        basis = basis_with_z(np.array(motion.axis_imu))
        left, right, angles = R_world_imu @ basis, basis.T, _YAW_RAD
    elif motion.kind == "motionless":
        angles, shifts = 0.0 * angles, 0.0 * shifts
    return Reference(
        left,
        right,
        center,
        axes,
        _waves(motion.rotation_scale * angles, rng),
        _waves(motion.translation_scale * shifts, rng),
    )
