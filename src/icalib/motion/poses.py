"""Pose of the IMU at the time of a measurement: three schemes behind one function, `poses_at`.

    inertial    IMU readings integrated from the nearest keyframe to t, forwards or backwards
    kinematic   constant angular rate and velocity from the nearest keyframe, iCalib paper (8)-(9)
    pose        between the two neighbouring keyframes, iCalib paper (10)-(12); position interpolated linearly

A measurement stays assigned to its keyframe while the solver runs; only its time moves with the time offset.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from icalib.base.compiled import njit
from icalib.geometry import so3
from icalib.motion.imu_data import ImuData
from icalib.motion.imu_model import correction_matrices
from icalib.motion.integration import bias_of, readings_of
from icalib.motion.integration_step import (
    AT_INTRINSICS,
    AT_J,
    AT_P,
    AT_V,
    J_STRIDE,
    RUN_SIZE,
    correction,
    fill_intrinsics,
)
from icalib.motion.propagation import (
    Moving,
    empty_prefix,
    integrate_from_keyframe,
    keyframes_of,
    place,
    propagation_query,
    rotation_of,
)
from icalib.optim.state import KEYFRAME_DIM, State
from icalib.rig import Scheme
from icalib.sensors.imu.spec import N_INTRINSICS


@dataclass(frozen=True)
class Poses:
    """IMU poses at n instants with Jacobians. Rows of the Jacobians: rotation (on the right), position (world).

    rotation (n, 3, 3), position (n, 3) m; rate (n, 3) body rad/s and velocity (n, 3) world m/s, the time derivative;
    J_keyframe, J_next (n, 6, 15): by the keyframe and, for `pose` alone, the next one (else of length 0); J_imu (n, 6,
    24 or 0): by the IMU intrinsics.
    """

    rotation: np.ndarray
    position: np.ndarray
    rate: np.ndarray
    velocity: np.ndarray
    J_keyframe: np.ndarray
    J_next: np.ndarray
    J_imu: np.ndarray


class VelocityDerivatives(NamedTuple):
    """Derivatives of the velocity in `Poses` (world, m/s), in the `inertial` scheme.

    acceleration (n, 3) world m/s^2: by time; J_keyframe (n, 3, 15), J_imu (n, 3, 24 or 0): by the keyframe and the IMU
    intrinsics. All of length 0 if not wanted.
    """

    acceleration: np.ndarray
    J_keyframe: np.ndarray
    J_imu: np.ndarray

    @classmethod
    def empty(cls, n: int, n_imu: int) -> VelocityDerivatives:
        """Arrays for n instants and `n_imu` intrinsics, Jacobians zero."""
        return cls(np.empty((n, 3)), np.zeros((n, 3, KEYFRAME_DIM)), np.zeros((n, 3, n_imu)))


def assign_keyframes(scheme: Scheme, keyframes: np.ndarray, times: np.ndarray, forwards: bool = False) -> np.ndarray:
    """Keyframe (n,) of each time: the nearest one. For `pose`, or if motion is propagated `forwards` only (see
    `ImuData`), the one before."""
    after = np.clip(np.searchsorted(keyframes, times, side="right"), 1, len(keyframes) - 1)
    if scheme == "pose" or forwards:
        return after - 1
    return after - (times - keyframes[after - 1] < keyframes[after] - times)


@njit(cache=True, nogil=True)
def _velocity(i, R, run, force, g, at, moving):
    """Fills entry i of `moving`: acceleration, and Jacobians of the velocity, at instant i of `at`. run: increments
    since the keyframe (see `integration_step`); R: rotation of the keyframe; force: specific force at the instant."""
    first = 0 * i  # first row of the Jacobians; not a literal, see `_fill_pose`
    _fill_start(i, first, R, run, AT_J + 3 * J_STRIDE, moving.J_keyframe, moving.J_imu)
    _fill_turn(i, first, R, run, AT_V, moving.J_keyframe)
    for a in range(3):
        row = at.rotation[i, a, 0], at.rotation[i, a, 1], at.rotation[i, a, 2]
        moving.acceleration[i, a] = row[0] * force[0] + row[1] * force[1] + row[2] * force[2]
        moving.J_keyframe[i, a, 6 + a] = 1.0
    moving.acceleration[i, 2] -= g


@njit(cache=True, nogil=True)
def _fill_pose(i, dt, R, run, Jn, Jx):
    """Fills entry i of the pose Jacobians Jn (keyframe) and Jx (intrinsics) from increments `run` (see
    `integration_step`). dt: elapsed time; R: rotation of the keyframe."""
    first = 0 * i  # not a literal: numba would compile the callees once more for a literal type
    _fill_start(i, first + 3, R, run, AT_J + 6 * J_STRIDE, Jn, Jx)
    _fill_turn(i, first + 3, R, run, AT_P, Jn)
    for a in range(3):
        Jn[i, 3 + a, 3 + a] = 1.0
        Jn[i, 3 + a, 6 + a] = dt
        for c in range(3):
            Jn[i, a, c] = run[3 * c + a]
        for c in range(6):
            Jn[i, a, 9 + c] = run[AT_J + J_STRIDE * a + c]
        for c in range(Jx.shape[2]):
            Jx[i, a, c] = run[AT_J + J_STRIDE * a + 6 + c]


@njit(cache=True, nogil=True)
def _fill_turn(i, r, R, run, o, Jn):
    """Rows r.. of Jn[i], by the rotation R of the keyframe, of an increment d (3,) = run[o:] in its axes: -R hat(d)."""
    d = run[o], run[o + 1], run[o + 2]
    for a in range(3):
        R0, R1, R2 = R[3 * a], R[3 * a + 1], R[3 * a + 2]
        Jn[i, r + a, 0] = R2 * d[1] - R1 * d[2]
        Jn[i, r + a, 1] = R0 * d[2] - R2 * d[0]
        Jn[i, r + a, 2] = R1 * d[0] - R0 * d[1]


@njit(cache=True, nogil=True)
def _fill_start(i, r, R, x, o, Jn, Jx):
    """Rows r.. of Jn[i] and Jx[i], by biases and intrinsics: R times three rows of J, which start at x[o]."""
    for a in range(3):
        R0, R1, R2 = R[3 * a], R[3 * a + 1], R[3 * a + 2]
        for c in range(6):
            Jn[i, r + a, 9 + c] = R0 * x[o + c] + R1 * x[o + J_STRIDE + c] + R2 * x[o + 2 * J_STRIDE + c]
        for c in range(Jx.shape[2]):
            Jx[i, r + a, c] = R0 * x[o + 6 + c] + R1 * x[o + J_STRIDE + 6 + c] + R2 * x[o + 2 * J_STRIDE + 6 + c]


@njit(cache=True, nogil=True)
def _inertial(ways, keyframes, readings, intrinsics, at, Jn, Jx, moving):
    """The `inertial` scheme for the query `ways`: fills `at`, a `Moving`, and, unless they are empty, Jacobians and
    `moving`."""
    width = 6 + Jx.shape[2] if len(Jn) else 0
    by, carried, run = correction(intrinsics), empty_prefix(), np.empty(RUN_SIZE)
    for i in ways.order:
        k, t = ways.keyframe[i], ways.times[i]
        t0, bias = keyframes.seconds[k], bias_of(keyframes.bias, k)
        rate, force = integrate_from_keyframe(k, t0, t, ways.first[i], bias, readings, by, carried, run, width)
        place(i, t - t0, k, keyframes, run, rate, at)
        if len(Jn):
            _fill_pose(i, t - t0, rotation_of(keyframes, k), run, Jn, Jx)
        if len(moving.acceleration):
            _velocity(i, rotation_of(keyframes, k), run, force, keyframes.gravity, at, moving)


@njit(cache=True, nogil=True)
def _kinematic(
    times, keyframe, first, keyframes, R, p, v, b, t, gyro, accel, intrinsics, out_R, out_p, rate, vel, Jn, Jx
):
    """The `kinematic` scheme: fills poses, rates, velocities and Jacobians by keyframe (Jn) and IMU intrinsics (Jx)."""
    F, G, H = correction_matrices(intrinsics)
    n_x = Jx.shape[2]
    by, run = correction(intrinsics), np.zeros(RUN_SIZE)
    w, f = np.empty(3), np.empty(3)
    for i in range(len(times)):
        k, j = keyframe[i], first[i]
        dt = times[i] - keyframes[k]
        s = (keyframes[k] - t[j]) / (t[j + 1] - t[j])
        for a in range(3):
            w[a] = f[a] = 0.0
            for c in range(3):
                raw_w = gyro[j, c] + s * (gyro[j + 1, c] - gyro[j, c]) - b[k, c]
                raw_f = accel[j, c] + s * (accel[j + 1, c] - accel[j, c]) - b[k, 3 + c]
                w[a] += G[a, c] * raw_w + H[a, c] * raw_f
                f[a] += F[a, c] * raw_f
        turn = w * dt
        turned, Jr = so3.exp(turn), so3.right_jacobian(turn)
        if n_x:
            fill_intrinsics((w[0], w[1], w[2]), (f[0], f[1], f[2]), by, run)
        for a in range(3):
            rate[i, a] = w[a]
            vel[i, a] = v[k, a]
            out_p[i, a] = p[k, a] + v[k, a] * dt
            Jn[i, 3 + a, 3 + a] = 1.0
            Jn[i, 3 + a, 6 + a] = dt
            for c in range(3):
                out_R[i, a, c] = R[k, a, 0] * turned[0, c] + R[k, a, 1] * turned[1, c] + R[k, a, 2] * turned[2, c]
                Jn[i, a, c] = turned[c, a]
                for d in range(3):
                    Jn[i, a, 9 + c] -= dt * Jr[a, d] * G[d, c]
                    Jn[i, a, 12 + c] -= dt * Jr[a, d] * H[d, c]
            for c in range(n_x):
                by_w = run[AT_INTRINSICS + c], run[AT_INTRINSICS + J_STRIDE + c], run[AT_INTRINSICS + 2 * J_STRIDE + c]
                Jx[i, a, c] = dt * (Jr[a, 0] * by_w[0] + Jr[a, 1] * by_w[1] + Jr[a, 2] * by_w[2])


@njit(cache=True, nogil=True)
def _between(times, keyframe, keyframes, R, p, out_R, out_p, rate, vel, Jn, Jm):
    """The `pose` scheme: fills poses, rates, velocities and Jacobians by keyframe (Jn) and the next one (Jm)."""
    for i in range(len(times)):
        k = keyframe[i]
        span = keyframes[k + 1] - keyframes[k]
        s = (times[i] - keyframes[k]) / span
        R01 = np.ascontiguousarray(R[k].T) @ R[k + 1]
        phi = so3.log(R01)
        turned = so3.exp(s * phi)
        slide = s * (so3.right_jacobian(s * phi) @ so3.right_jacobian_inverse(phi))
        back = slide @ np.ascontiguousarray(R01.T)
        out_R[i] = R[k] @ turned
        for a in range(3):
            rate[i, a] = phi[a] / span
            vel[i, a] = (p[k + 1, a] - p[k, a]) / span
            out_p[i, a] = p[k, a] + s * (p[k + 1, a] - p[k, a])
            Jn[i, 3 + a, 3 + a] = 1.0 - s
            Jm[i, 3 + a, 3 + a] = s
            for c in range(3):
                Jn[i, a, c] = turned[c, a] - back[a, c]
                Jm[i, a, c] = slide[a, c]


def poses_of_keyframes(keyframe: np.ndarray, state: State) -> Poses:
    """IMU poses at keyframes, with zero rate and velocity. In a rig without IMU measurements are at keyframes, and time
    offsets have no effect."""
    n = len(keyframe)
    J_keyframe, still = np.zeros((n, 6, KEYFRAME_DIM)), np.zeros((n, 3))
    J_keyframe[:, range(6), range(6)] = 1.0
    nothing = np.zeros((0, 6, KEYFRAME_DIM))
    return Poses(
        state.rotation[keyframe], state.position[keyframe], still, still, J_keyframe, nothing, np.zeros((n, 6, 0))
    )


def poses_at(
    scheme: Scheme, times: np.ndarray, keyframe: np.ndarray, state: State, imu: ImuData, gravity: float, imu_free: bool
) -> Poses:
    """IMU poses at `times` (n,) seconds on the IMU clock, each from its `keyframe` (n,), see `assign_keyframes`.
    gravity [m/s^2]; imu_free: whether IMU intrinsics are estimated."""
    n = len(times)
    if scheme == "inertial":
        return _carried(_empty(n, n, imu_free), times, keyframe, state, imu, gravity, VelocityDerivatives.empty(0, 0))
    out, J_keyframe, J_imu = (
        Moving.empty(n),
        np.zeros((n, 6, KEYFRAME_DIM)),
        np.zeros((n, 6, N_INTRINSICS if imu_free else 0)),
    )
    J_next = np.zeros((n if scheme == "pose" else 0, 6, KEYFRAME_DIM))
    if scheme == "pose":
        _between(times, keyframe, state.seconds, state.rotation, state.position, *out, J_keyframe, J_next)
    else:
        _kinematic(
            times, keyframe, imu.interval(state.seconds[keyframe]), state.seconds, state.rotation, state.position,
            state.velocity, state.bias, imu.seconds, imu.gyro, imu.accel, state.values[imu.name, "intrinsics"],
            *out, J_keyframe, J_imu,
        )  # fmt: skip
    return Poses(*out, J_keyframe, J_next, J_imu)


def poses_without_jacobians(
    times: np.ndarray, keyframe: np.ndarray, state: State, imu: ImuData, gravity: float
) -> Poses:
    """The `inertial` poses of `poses_at`, with Jacobians of length 0."""
    return _carried(_empty(len(times), 0, False), times, keyframe, state, imu, gravity, VelocityDerivatives.empty(0, 0))


def poses_and_velocity_derivatives(
    times: np.ndarray, keyframe: np.ndarray, state: State, imu: ImuData, gravity: float, imu_free: bool
) -> tuple[Poses, VelocityDerivatives]:
    """The `inertial` poses of `poses_at`, and derivatives of their velocities."""
    n = len(times)
    moving = VelocityDerivatives.empty(n, N_INTRINSICS if imu_free else 0)
    return _carried(_empty(n, n, imu_free), times, keyframe, state, imu, gravity, moving), moving


def _empty(n: int, n_jacobians: int, imu_free: bool) -> Poses:
    """Arrays for n `inertial` poses; n_jacobians: n, or 0 for no Jacobians. imu_free: whether IMU intrinsics are
    estimated."""
    J_imu = np.zeros((n_jacobians, 6, N_INTRINSICS if imu_free else 0))
    return Poses(*Moving.empty(n), np.zeros((n_jacobians, 6, KEYFRAME_DIM)), np.zeros((0, 6, KEYFRAME_DIM)), J_imu)


def _carried(
    out: Poses,
    times: np.ndarray,
    keyframe: np.ndarray,
    state: State,
    imu: ImuData,
    gravity: float,
    moving: VelocityDerivatives,
) -> Poses:
    """Fills `out` with the `inertial` poses, and `moving` with derivatives of the velocity unless it is empty; returns
    `out`."""
    ways, keyframes = propagation_query(state, times, keyframe, imu), keyframes_of(state, gravity)
    at = Moving(out.rotation, out.position, out.rate, out.velocity)
    intrinsics = state.values[imu.name, "intrinsics"]
    _inertial(ways, keyframes, readings_of(imu, True), intrinsics, at, out.J_keyframe, out.J_imu, moving)
    return out
