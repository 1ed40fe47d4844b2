"""Poses of a sensor at the times of its measurements, and the chain rule from a pose to the parameters it depends on.

    R_world_sensor = R_world_imu(t) R_imu_sensor        p_world_sensor = p_world_imu(t) + R_world_imu(t) p_imu_sensor

Here t is the time of the measurement plus the time offset. Perturbations d = (d_R, d_p) of a sensor's pose, 6, are
along the sensor's axes: R <- R Exp(d_R), p <- p + R d_p. A factor differentiates its residual by d, and `add_chain`
gives the derivatives by

    keyframe 15 | next keyframe 15 | R_imu_sensor 3, p_imu_sensor 3, time offset 1, clock rate 1, IMU intrinsics 24 or 0

The last five are calibration parameters, in this order (`Kinematics.columns`).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple, Protocol

import numpy as np

from icalib.base.compiled import njit
from icalib.geometry import so3
from icalib.motion.imu_data import ImuData
from icalib.motion.poses import (
    Poses,
    drift_at,
    offset_at,
    pose_columns,
    poses_at,
    poses_of_keyframes,
    poses_without_jacobians,
)
from icalib.optim.rows import KEYFRAME_PAIR_DIM, Rows, UInt
from icalib.optim.state import KEYFRAME_DIM, Layout, State
from icalib.rig import Scheme

OFFSET_COLUMN = 6  # index of the time offset among the calibration parameters of a pose
RATE_COLUMN = 7  # that of the clock rate
N_POSE_PARAMETERS = 8  # extrinsics, time offset and clock rate; the IMU intrinsics follow
IDENTITY_6 = np.eye(6)  # Jacobian of a pose by itself


class _SensorFactor(Protocol):
    """Requirements of `Kinematics.of`: a factor of measurements by a sensor on the moving body."""

    @property
    def name(self) -> str: ...

    @property
    def layout(self) -> Layout: ...

    @property
    def imu(self) -> ImuData | None: ...

    @property
    def gravity(self) -> float: ...


@dataclass(frozen=True)
class Kinematics:
    """Fixed inputs of a sensor's pose. imu: None if measurements are at keyframes; gravity [m/s^2]; scheme: of poses
    between keyframes, see `poses`."""

    sensor: str
    layout: Layout
    imu: ImuData | None
    gravity: float
    scheme: Scheme = "inertial"

    @classmethod
    def of(cls, factor: _SensorFactor) -> Kinematics:
        """Kinematics of the sensor of a factor, in the `inertial` scheme."""
        return cls(factor.name, factor.layout, factor.imu, factor.gravity)

    def columns(self, clock: int = 0) -> np.ndarray:
        """Calibration columns (8 + 24 or 0,) of the sensor's pose, -1 where fixed; `clock`: number of its time
        offset."""
        columns = pose_columns(self.layout, self.sensor, clock)
        return np.concatenate([columns, self.layout.columns(self._imu, "intrinsics")]) if self._imu else columns

    @property
    def _imu(self) -> str:
        """Name of the IMU whose intrinsics are estimated; empty if there is none."""
        return self.imu.name if self.imu is not None and self.layout.is_free(self.imu.name, "intrinsics") else ""

    def imu_poses(self, seconds: np.ndarray, keyframe: np.ndarray, state: State, jacobians: bool = True) -> Poses:
        """IMU poses at `seconds` (n,) on the sensor's clock, each from its `keyframe` (n,)."""
        if self.imu is None:
            return poses_of_keyframes(keyframe, state)
        times = seconds + offset_at(state, self.sensor, keyframe, seconds)
        if self.scheme == "inertial" and not jacobians:
            return poses_without_jacobians(times, keyframe, state, self.imu, self.gravity)
        return poses_at(self.scheme, times, keyframe, state, self.imu, self.gravity, bool(self._imu))


class SensorPose(NamedTuple):
    """n poses of a sensor, and rate, velocity and Jacobians of the IMU pose as in `Poses`. drift (n,): derivative of
    its time by the clock rate [s/ppm]."""

    R_imu_sensor: np.ndarray
    p_imu_sensor: np.ndarray
    R_sensor_world: np.ndarray
    p_world_sensor: np.ndarray
    rate: np.ndarray
    velocity: np.ndarray
    J_keyframe: np.ndarray
    J_next: np.ndarray
    J_imu: np.ndarray
    drift: np.ndarray

    @classmethod
    def at(
        cls, kinematics: Kinematics, seconds: np.ndarray, keyframe: np.ndarray, state: State, jacobians: bool = True
    ) -> SensorPose:
        """Poses at `seconds` (n,) on the sensor's clock, each from its `keyframe` (n,). Without `jacobians` these may
        have length 0. A sensor without a rotation has the axes of the IMU."""
        name, imu = kinematics.sensor, kinematics.imu_poses(seconds, keyframe, state, jacobians)
        R_is = np.ascontiguousarray(state.values.get((name, "rotation"), np.eye(3)))
        p_is = state.values[name, "translation"]
        R_sw = np.ascontiguousarray((imu.rotation @ R_is).transpose(0, 2, 1))
        p_ws = imu.position + imu.rotation @ p_is
        timed = kinematics.imu is not None
        drift = drift_at(state, name, keyframe, seconds) if timed else np.zeros(len(keyframe))
        return cls(R_is, p_is, R_sw, p_ws, imu.rate, imu.velocity, imu.J_keyframe, imu.J_next, imu.J_imu, drift)

    @property
    def rotation(self) -> np.ndarray:
        """(n, 3, 3) R_world_sensor."""
        return self.R_sensor_world.transpose(0, 2, 1)

    @property
    def position(self) -> np.ndarray:
        """(n, 3) p_world_sensor [m]."""
        return self.p_world_sensor

    def part(self, indices: slice | np.ndarray) -> SensorPose:
        """The poses with the indices `indices`."""
        R_is, p_is, *each = self
        return SensorPose(R_is, p_is, *(x[indices] if len(x) else x for x in each))

    def velocity_of(self, X: np.ndarray) -> np.ndarray:
        """(n, 3) m/s: velocity in the frame of the sensor of points X (n, 3) m, one at each pose, at rest in the
        world."""
        lever = np.cross(self.rate, self.p_imu_sensor) @ self.R_imu_sensor
        moved = np.einsum("nij,nj->ni", self.R_sensor_world, self.velocity) + lever
        return -np.cross(self.rate @ self.R_imu_sensor, X) - moved

    @property
    def n_calib(self) -> int:
        """Number of calibration parameters that the poses depend on."""
        return N_POSE_PARAMETERS + self.J_imu.shape[2]


SLOPE_LAG_S = 0.1  # s: lag of the differences that give a slope; shorter ones would be noise, longer ones miss motion


def rate_slopes(state: State) -> np.ndarray:
    """(K, 6) slopes of rate [rad/s^2] and acceleration [m/s^3] at keyframes of assumed motion, whose biases are minus
    both: central differences over SLOPE_LAG_S, recording by recording."""
    slopes, half = np.zeros((len(state.seconds), 6)), 0.5 * SLOPE_LAG_S
    for k in state.recordings:
        t = state.seconds[k]
        before, after = np.clip(t - half, t[0], t[-1]), np.clip(t + half, t[0], t[-1])
        rise = [np.interp(before, t, b) - np.interp(after, t, b) for b in state.bias[k].T]
        slopes[k] = (np.array(rise) / (after - before)).T
    return slopes


def with_slopes(at: SensorPose, slopes: np.ndarray, elapsed: np.ndarray) -> SensorPose:
    """Poses `at` (n,), without Jacobians, with rates and accelerations that have changed by slopes (n, 6), see
    `rate_slopes`, times elapsed (n,) s since the keyframe. The poses themselves have constant ones."""
    t, p = elapsed[:, None], at.p_imu_sensor @ at.R_imu_sensor
    turn, move = slopes[:, :3] * t**2 / 2.0 @ at.R_imu_sensor, slopes[:, 3:] * t**3 / 6.0 @ at.R_imu_sensor
    shift = np.einsum("nji,nj->ni", at.R_sensor_world, np.cross(turn, p) + move)
    R_sensor_world, rate = so3.exp_many(-turn) @ at.R_sensor_world, at.rate + slopes[:, :3] * t
    return at._replace(R_sensor_world=R_sensor_world, p_world_sensor=at.p_world_sensor + shift, rate=rate)


def rows_at(
    residual: np.ndarray, J_pose: Sequence[np.ndarray], ends: Sequence[SensorPose], J_further: np.ndarray
) -> Rows:
    """Rows of n residuals (n, m), with Jacobians by a pair of keyframes and by calibration parameters.

    A residual depends on one or two sensor poses, `ends`; J_pose holds a Jacobian (n, m, 6) by each of them. A single
    pose belongs to the first keyframe of the pair; in the `pose` scheme it depends on the second one, too. With two
    poses, the earlier belongs to the first keyframe and the later to the second. J_further (n, m, c): Jacobians by c
    further calibration parameters, whose columns come last; of length 0 if no Jacobians are wanted.
    """
    n, m, n_pose = *residual.shape, ends[0].n_calib
    if not len(J_further):
        return Rows(residual, np.zeros((0, m, KEYFRAME_PAIR_DIM + n_pose)))
    J = np.zeros((n, m, KEYFRAME_PAIR_DIM + n_pose + J_further.shape[2]))
    J[:, :, KEYFRAME_PAIR_DIM + n_pose :] = J_further
    for k, (by_pose, at) in enumerate(zip(J_pose, ends, strict=True)):
        add_pose_chain(by_pose, at, KEYFRAME_DIM * k, KEYFRAME_PAIR_DIM, J)
    return Rows(residual, J)


@njit(cache=True, nogil=True)
def fill_imu_pose(i, at, A):
    """Fills A (6, 6): Jacobian of pose i of the sensor by that of the IMU (rotation on the right, position in the
    world)."""
    R, p, R_sw = at.R_imu_sensor, at.p_imu_sensor, at.R_sensor_world
    for a in range(3):
        r0, r1, r2 = R[0, a], R[1, a], R[2, a]
        for c in range(3):
            A[a, c], A[a, 3 + c], A[3 + a, 3 + c] = R[c, a], 0.0, R_sw[i, a, c]
        A[3 + a, 0], A[3 + a, 1], A[3 + a, 2] = r2 * p[1] - r1 * p[2], r0 * p[2] - r2 * p[0], r1 * p[0] - r0 * p[1]


@njit(cache=True, nogil=True)
def add_chain(i, at, J_pose, J_imu_pose, first, calib, T):
    """Adds to T (m, w) the derivatives of m rows by the parameters of pose i. J_pose (m, 6): Jacobians of the rows by
    the pose of the sensor; J_imu_pose (m, 6): by that of the IMU. Keyframe columns start at `first`, calibration
    columns at `calib`. Indices are unsigned, see `add_product`."""
    R, rate, velocity, J_keyframe, J_next, J_imu = (
        at.R_imu_sensor,
        at.rate,
        at.velocity,
        at.J_keyframe,
        at.J_next,
        at.J_imu,
    )
    n_imu, has_next, at_keyframe, mounted, x = UInt(J_imu.shape[2]), len(J_next) > 0, UInt(first), UInt(calib), UInt(i)
    imu, offset = mounted + UInt(N_POSE_PARAMETERS), mounted + UInt(OFFSET_COLUMN)
    for r in range(UInt(T.shape[0])):
        for k in range(UInt(6)):
            f = J_imu_pose[r, k]
            if f == 0.0:
                continue
            for j in range(UInt(KEYFRAME_DIM)):
                T[r, at_keyframe + j] += f * J_keyframe[x, k, j]
            if has_next:
                for j in range(UInt(KEYFRAME_DIM)):
                    T[r, at_keyframe + UInt(KEYFRAME_DIM) + j] += f * J_next[x, k, j]
            for j in range(n_imu):
                T[r, imu + j] += f * J_imu[x, k, j]
        by_time = 0.0
        for k in range(3):
            by_time += J_imu_pose[r, k] * rate[x, k] + J_imu_pose[r, UInt(3) + k] * velocity[x, k]
        T[r, offset] += by_time
        T[r, mounted + UInt(RATE_COLUMN)] += by_time * at.drift[x]
        for j in range(UInt(3)):
            T[r, mounted + j] += J_pose[r, j]
            for k in range(UInt(3)):
                T[r, mounted + UInt(3) + j] += J_pose[r, UInt(3) + k] * R[j, k]


@njit(cache=True, nogil=True)
def fill_chain(i, at, A, T):
    """Fills the first columns of T (6, w): Jacobian of pose i of the sensor by keyframe, next keyframe if it has an
    effect, and calibration parameters. A (6, 6) is workspace."""
    fill_imu_pose(i, at, A)
    for r in range(6):
        for j in range(T.shape[1]):
            T[r, j] = 0.0
    add_chain(i, at, IDENTITY_6, A, 0, chain_width(at), T)


@njit(cache=True, nogil=True)
def chain_width(at):
    """Number of keyframe columns: 30 if poses depend on two keyframes, else 15."""
    return KEYFRAME_PAIR_DIM if len(at.J_next) else KEYFRAME_DIM


@njit(cache=True, nogil=True)
def add_pose_chain(J_pose, at, first, calib, J):
    """Adds to J (n, m, w) the derivatives of rows with Jacobians J_pose (n, m, 6) by the poses `at`. Keyframe columns
    start at `first`, calibration columns at `calib`."""
    m = J_pose.shape[1]
    A, B = np.empty((6, 6)), np.empty((m, 6))
    for i in range(len(J_pose)):
        fill_imu_pose(i, at, A)
        for q in range(m):
            for c in range(6):
                B[q, c] = 0.0
                for k in range(6):
                    B[q, c] += J_pose[i, q, k] * A[k, c]
        add_chain(i, at, J_pose[i], B, first, calib, J[i])
