"""True trajectories of the IMU: a reference in closed form, and the exact integral of piecewise constant readings.

Frames: world (z up), imu. Angular rates w and specific forces f are in the imu frame: R' = R [w]x, v' = R f + g,
p' = v.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from icalib.tools.simulation.scenario.scenario import GRAVITY_WORLD, HandheldMotion, Scenario
from icalib.tools.simulation.scenario.trajectory import AnalyticTrajectory

_ANGLES_RAD = np.array([[0.45, 0.22, 0.18], [0.12, 0.09, 0.08]])  # slow, fast sinusoid; about camera z, y, x
_YAW_RAD = np.array([[0.25, 0.0, 0.0], [0.10, 0.0, 0.0]])
_SHIFT_M = np.array([[0.15, 0.10, 0.15], [0.05, 0.04, 0.05]])
_FREQUENCY_HZ = np.array([[0.30, 0.55], [0.80, 1.20]])  # range of the slow, of the fast sinusoid
_STEER_ROTATION, _STEER_POSITION, _STEER_VELOCITY = 1.0, 1.0, 2.0  # 1/s, 1/s^2, 1/s
_TAYLOR_ORDER = 10  # 0.2^11 / 11! = 5e-16: exact to rounding for steps up to 0.2 rad
_AXIS_X, _AXIS_Y, _AXIS_Z = np.eye(3)


def skew(w: np.ndarray) -> np.ndarray:
    """(..., 3, 3) cross-product matrices of w (..., 3): skew(w) v = w x v."""
    W = np.zeros((*w.shape[:-1], 3, 3))
    W[..., 2, 1], W[..., 0, 2], W[..., 1, 0] = w[..., 0], w[..., 1], w[..., 2]
    return W - np.swapaxes(W, -1, -2)


def increments(rate: np.ndarray, force: np.ndarray, dt: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Increments of rotation (..., 3, 3), velocity (..., 3) m/s and position (..., 3) m over dt (...) [s], without
    gravity, in the body frame at the start.

    rate (..., 3) [rad/s] and force (..., 3) [m/s^2] are constant in the body frame. The increments are the upper rows
    of exp(A dt) with A = [[skew(rate), force, 0], [0, 0, 1], [0, 0, 0]], summed as a Taylor series.
    """
    A = np.zeros((*rate.shape[:-1], 5, 5))
    A[..., :3, :3], A[..., :3, 3], A[..., 3, 4] = skew(rate), force, 1.0
    A *= np.asarray(dt)[..., None, None]
    total = identity = np.eye(5)
    for order in range(_TAYLOR_ORDER, 0, -1):
        total = identity + A @ total / order
    return total[..., :3, :3], total[..., :3, 3], total[..., :3, 4]


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


@dataclass(frozen=True, eq=False)
class ExactTrajectory:
    """Exact integral of readings (N, 6) at seconds (N,); between two readings their mean is constant. rotation:
    R_world_imu; position [m] and velocity [m/s] in the world."""

    seconds: np.ndarray
    readings: np.ndarray
    rotation: np.ndarray  # (N, 3, 3)
    position: np.ndarray  # (N, 3)
    velocity: np.ndarray  # (N, 3)

    def pose_at(self, seconds: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """See `TrueTrajectory.pose_at`; beyond the ends, the readings of the outermost interval are constant."""
        i, mean = self._interval(seconds)
        dt = seconds - self.seconds[i]
        return _advance((self.rotation[i], self.position[i], self.velocity[i]), mean, dt)

    def rate_at(self, seconds: np.ndarray) -> np.ndarray:
        """See `TrueTrajectory.rate_at`; at a reading, the rate of the interval that begins there."""
        return self._interval(seconds)[1][:, :3]

    def _interval(self, seconds: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Number (N,) of the interval between readings that contains each instant, and its rates and forces (N, 6)."""
        i = np.clip(np.searchsorted(self.seconds, seconds, side="right") - 1, 0, len(self.seconds) - 2)
        return i, 0.5 * (self.readings[i] + self.readings[i + 1])


def _advance(
    state: tuple[np.ndarray, np.ndarray, np.ndarray], mean: np.ndarray, dt: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Rotation (..., 3, 3), position and velocity (..., 3) after dt (...) [s] from `state`, with constant angular rate
    and specific force mean (..., 6)."""
    R, p, v = state
    dR, dv, dp = increments(mean[..., :3], mean[..., 3:], dt)
    dt = np.asarray(dt)[..., None]
    return (
        R @ dR,
        p + v * dt + 0.5 * GRAVITY_WORLD * dt**2 + (R @ dp[..., None])[..., 0],
        v + GRAVITY_WORLD * dt + (R @ dv[..., None])[..., 0],
    )


def exact_motion(reference: AnalyticTrajectory, seconds: np.ndarray) -> ExactTrajectory:
    """Readings at seconds (N,) near those of the reference, and their exact integral.

    The integral would drift from the reference by the error of the trapezoidal rule. Each reading is therefore
    corrected by feedback of the state's error one reading earlier, so that the rig stays in front of the board.
    """
    R_ref, p_ref, v_ref = reference.pose_at(seconds)
    readings = reference.readings_at(seconds)
    rotation, position, velocity = R_ref.copy(), p_ref.copy(), v_ref.copy()
    for i in range(len(seconds) - 1):
        R, p, v = rotation[i], position[i], velocity[i]
        E = R.T @ R_ref[i]
        turn = 0.5 * np.array([E[2, 1] - E[1, 2], E[0, 2] - E[2, 0], E[1, 0] - E[0, 1]])
        readings[i + 1, :3] += _STEER_ROTATION * turn
        readings[i + 1, 3:] += (_STEER_POSITION * (p_ref[i] - p) + _STEER_VELOCITY * (v_ref[i] - v)) @ R
        mean = 0.5 * (readings[i] + readings[i + 1])
        rotation[i + 1], position[i + 1], velocity[i + 1] = _advance((R, p, v), mean, seconds[i + 1] - seconds[i])
    return ExactTrajectory(seconds, readings, rotation, position, velocity)
