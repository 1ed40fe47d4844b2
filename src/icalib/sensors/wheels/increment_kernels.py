"""Kernels of the increments of wheels, and rows by drive parameters."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from icalib.base.compiled import njit
from icalib.geometry import so3
from icalib.geometry.small import cross3, mulv3, tmul3, tmulv3
from icalib.motion.poses import PPM
from icalib.motion.sensor_pose import OFFSET_COLUMN
from icalib.optim.rows import KEYFRAME_PAIR_DIM
from icalib.optim.state import KEYFRAME_DIM
from icalib.rig import WheelKind

# Compiled kernels of the increment factor: residuals and Jacobians of the motion between two instants.
#
# An increment is compared with a displacement X [m] and a rotation vector T [rad] in wheel axes. Both follow from the
# motion of the IMU over the interval from s_0 to s_1. With D the integral of R_world_imu^T v over the interval and Y =
# D + Theta x p_imu_wheel:
#
#     X = R_imu_wheel^T Y,  T = R_imu_wheel^T Theta,  Theta = Log(R_world_imu(s_0)^T R_world_imu(s_1))
#
# A row of the model (`drive_rows`) is g_X X + g_T T = a_Y Y + a_T Theta. All rows share the Jacobians J (6, ...) of
# (D, Theta): rows 0 to 2 for D, rows 3 to 5 for Theta. J_calib (6, 2 + 24 or 0): by time offset, clock rate and IMU
# intrinsics.


class WheelParameters(NamedTuple):
    """Extrinsics R = R_imu_wheel (3, 3), p = p_imu_wheel (3,) [m], and drive (N_DRIVE,), see `coefficients`; for a
    pair left radius, right radius, baseline and unit of length [m]. pace: see
    `pace_of`."""

    R: np.ndarray
    p: np.ndarray
    drive: np.ndarray
    pace: float


class MotionSamples(NamedTuple):
    """The motion of the IMU at m instants, each propagated from a keyframe: keyframe (m,), fields of `Poses`, and drift
    (m,), the derivative of the instant by the clock rate [s/ppm]."""

    keyframe: np.ndarray
    rotation: np.ndarray
    position: np.ndarray
    rate: np.ndarray
    velocity: np.ndarray
    J_keyframe: np.ndarray
    J_imu: np.ndarray
    drift: np.ndarray


@njit(cache=True, nogil=True)
def _rotation_between(a, b, samples, J_first, J_second, J_calib, with_jacobians):
    """Theta (3,) between samples a and b. Adds its derivatives by the two keyframes to rows 3: of J_first and J_second
    (6, 15), and those by time offset, clock rate and IMU intrinsics to rows 3: of J_calib."""
    theta = so3.log(tmul3(samples.rotation[a], samples.rotation[b]))
    if not with_jacobians:
        return theta
    J_left, J_right = so3.left_jacobian_inverse(theta), so3.right_jacobian_inverse(theta)
    for i in range(3):
        for j in range(3):
            at_end, at_start = J_right[i, j] * samples.rate[b, j], J_left[i, j] * samples.rate[a, j]
            J_calib[3 + i, 0] += at_end - at_start
            J_calib[3 + i, 1] += at_end * samples.drift[b] - at_start * samples.drift[a]
            for c in range(KEYFRAME_DIM):
                J_first[3 + i, c] -= J_left[i, j] * samples.J_keyframe[a, j, c]
                J_second[3 + i, c] += J_right[i, j] * samples.J_keyframe[b, j, c]
            for c in range(samples.J_imu.shape[2]):
                J_calib[3 + i, 2 + c] += (
                    J_right[i, j] * samples.J_imu[b, j, c] - J_left[i, j] * samples.J_imu[a, j, c]
                )  # fmt: skip
    return theta


@njit(cache=True, nogil=True)
def _add_displacement(j, duration, pace, samples, velocities, D, J_keyframe, J_calib, with_jacobians):
    """Adds pace * duration * R^T v of sample j to D (3,), and its derivatives to rows :3 of J_keyframe (6, 15) and
    J_calib."""
    R, weight = samples.rotation[j], pace * duration
    u = tmulv3(R, samples.velocity[j])
    for i in range(3):
        D[i] += weight * u[i]
    if not with_jacobians:
        return
    # u = R^T v: du/dt = u x rate + R^T acceleration.
    turning = cross3(u, samples.rate[j])
    acceleration = tmulv3(R, velocities.acceleration[j])
    J_u_rotation = so3.hat(u)
    for i in range(3):
        by_time = weight * (turning[i] + acceleration[i])
        J_calib[i, 0] += by_time
        J_calib[i, 1] += by_time * samples.drift[j] + PPM * duration * u[i]
        for k in range(3):
            for c in range(KEYFRAME_DIM):
                J_keyframe[i, c] += weight * (
                    J_u_rotation[i, k] * samples.J_keyframe[j, k, c] + R[k, i] * velocities.J_keyframe[j, k, c]
                )
            for c in range(samples.J_imu.shape[2]):
                J_calib[i, 2 + c] += weight * (
                    J_u_rotation[i, k] * samples.J_imu[j, k, c] + R[k, i] * velocities.J_imu[j, k, c]
                )


@njit(cache=True, nogil=True)
def _fill_motion(i, q, gX, gT, aY, aT, X, T, J_first, J_second, J_calib, rows):
    """Fills the derivatives of row q of interval i by keyframes, R_imu_wheel, time offset, clock rate and IMU
    intrinsics."""
    # R <- R Exp(d) rotates X and T by -d: dX = X x d, dT = T x d.
    x, t = cross3(gX, X), cross3(gT, T)
    for c in range(3):
        rows.J[i, q, KEYFRAME_PAIR_DIM + c] = x[c] + t[c]
    for k in range(3):
        for c in range(KEYFRAME_DIM):
            rows.J[i, q, c] += aY[k] * J_first[k, c] + aT[k] * J_first[3 + k, c]
            rows.J[i, q, KEYFRAME_DIM + c] += aY[k] * J_second[k, c] + aT[k] * J_second[3 + k, c]
        for c in range(J_calib.shape[1]):
            rows.J[i, q, KEYFRAME_PAIR_DIM + OFFSET_COLUMN + c] += (
                aY[k] * J_calib[k, c] + aT[k] * J_calib[3 + k, c]
            )  # fmt: skip


@njit(cache=True, nogil=True)
def _to_imu_axes(wheels, gX, gT):
    """Coefficients a_Y, a_T (3,) of a row in IMU axes, from g_X, g_T (3,) in wheel axes: a_Y = R g_X, and
    a_T = R g_T + p x a_Y, as Y = D + Theta x p."""
    aY = mulv3(wheels.R, gX)
    return aY, mulv3(wheels.R, gT) + cross3(wheels.p, aY)


@njit(cache=True, nogil=True)
def _fill_drive(i, q, J_gX, J_gT, X, T, rows):
    """Fills the derivatives of row q of interval i by the drive parameters; J_gX, J_gT (N_DRIVE, 3): derivatives of the
    row's coefficients, by parameter and axis."""
    for d in range(N_DRIVE):
        s = 0.0
        for k in range(3):
            s += J_gX[d, k] * X[k] + J_gT[d, k] * T[k]
        rows.J[i, q, rows.J.shape[2] - N_DRIVE + d] = s


@njit(cache=True, nogil=True)
def increment_rows(start, weights, samples, velocities, wheels, coefficients, measured, rows):
    """Fills the four rows g_X X + g_T T - measured of each of n increments, not whitened; see the module and
    `drive_rows`.

    start (n + 1,), weights (m,) s: see `Instants`; samples, velocities: the motion of the IMU at these m instants;
    measured (n, 4). Jacobians are skipped if those of `rows` are empty.
    """
    with_jacobians = len(rows.J) > 0
    n_calib = 2 + samples.J_imu.shape[2]
    J_first, J_second, J_calib = np.empty((6, KEYFRAME_DIM)), np.empty((6, KEYFRAME_DIM)), np.empty((6, n_calib))
    D = np.empty(3)
    for i in range(len(start) - 1):
        a, b, g = start[i], start[i + 1] - 1, min(i, len(coefficients.g_X) - 1)
        J_first[:], J_second[:], J_calib[:], D[:] = 0.0, 0.0, 0.0, 0.0
        for j in range(a + 1, b):
            J_keyframe = J_first if samples.keyframe[j] == samples.keyframe[a] else J_second
            _add_displacement(j, weights[j], wheels.pace, samples, velocities, D, J_keyframe, J_calib, with_jacobians)
        theta = _rotation_between(a, b, samples, J_first, J_second, J_calib, with_jacobians)
        X, T = tmulv3(wheels.R, D + cross3(theta, wheels.p)), tmulv3(wheels.R, theta)
        for q in range(4):
            gX, gT = coefficients.g_X[g, q], coefficients.g_T[g, q]
            s = 0.0
            for k in range(3):
                s += gX[k] * X[k] + gT[k] * T[k]
            rows.residual[i, q] = s - measured[i, q]
            if not with_jacobians:
                continue
            aY, aT = _to_imu_axes(wheels, gX, gT)
            _fill_motion(i, q, gX, gT, aY, aT, X, T, J_first, J_second, J_calib, rows)
            J_lever_arm = cross3(aY, theta)
            for k in range(3):
                rows.J[i, q, KEYFRAME_PAIR_DIM + 3 + k] = J_lever_arm[k]
            _fill_drive(i, q, coefficients.J_g_X[g, q], coefficients.J_g_T[g, q], X, T, rows)


# Residual rows of the increment factor for each kind of wheels.
#
# A row is g_X X + g_T T - measured. X [m] is the displacement and T [rad] the rotation vector of the wheel frame over
# an interval, in its axes at the start. The first two rows of each kind, with names and units of their residuals:
#
#     pair      (e_1 X -+ b/2 e_3 T) / r - angle             left, right                [rad]
#     twist     e_1 X / s_v - distance,  e_3 T / s_w - yaw   speed, yaw                 [m], [rad]
#     steered   e_1 X / r - angle                            wheel                      [rad]
#               L cos(d) e_3 T - sin(d) e_1 X                steering                   [m]
#
# b: baseline; r: radius; s_v, s_w: scales of speed and yaw rate; -+: left, right wheel. The steering row is the
# kinematic bicycle model: the front axle, a wheelbase L ahead, moves along its wheels, which point to d = steering
# angle + offset. The model L e_3 T = tan(d) e_1 X is multiplied by cos(d), so that it also holds for steep angles and
# standstill. The noise of the angle then enters the derivative by L through cos(d) alone. cos and sin are means over
# the interval.
#
# All kinds have the rows e_2 X and e_3 X, the lateral and the vertical slip [m]. Their noise and that of steering are
# lengths that no sensor measures. The rows are divided by the unit of length of an assumed motion, see `ImuData`; else
# it is 1 m.

N_DRIVE = 4  # largest number of parameters of a kind, and the unit of length
UNIT = N_DRIVE - 1  # its index
LEFT, RIGHT = -0.5, 0.5  # factor of baseline * e_3 T in the row of each wheel
Kinds = dict[str, slice]
SLIP: Kinds = {"lateral slip": slice(2, 3), "vertical slip": slice(3, 4)}
KINDS: dict[WheelKind, Kinds] = {
    "pair": {"wheels": slice(0, 2), **SLIP},
    "twist": {"speed": slice(0, 1), "yaw": slice(1, 2), **SLIP},
    "steered": {"wheel": slice(0, 1), "steering": slice(1, 2), **SLIP},
}
UNITS = {
    "wheels": "rad", "speed": "m", "yaw": "rad", "wheel": "rad", "steering": "m", "lateral slip": "m",
    "vertical slip": "m",
}  # fmt: skip


class Coefficients(NamedTuple):
    """Coefficients of the four rows in wheel axes, for each of k = n intervals, or for all of them (k = 1).

    g_X, g_T (k, 4, 3); J_g_X, J_g_T (k, 4, N_DRIVE, 3): their derivatives by the drive parameters, indexed by interval,
    row, parameter and axis.
    """

    g_X: np.ndarray
    g_T: np.ndarray
    J_g_X: np.ndarray
    J_g_T: np.ndarray


def coefficients(kind: WheelKind, drive: np.ndarray, mean: np.ndarray) -> Coefficients:
    """The coefficients at the drive parameters `drive` (N_DRIVE,), padded with zeros, the last the unit of length.

    mean (n, m - 1): means over each interval of the signals whose integrals are columns 1: of `integrals_of`.
    """
    k = len(mean) if kind == "steered" else 1
    g, J_g = (k, 4, 3), (k, 4, N_DRIVE, 3)
    c = Coefficients(np.zeros(g), np.zeros(g), np.zeros(J_g), np.zeros(J_g))
    {"pair": _pair, "twist": _twist, "steered": _steered}[kind](c, drive, mean)
    c.g_X[:, 2, 1] = c.g_X[:, 3, 2] = 1.0
    for row in (1, 2, 3) if kind == "steered" else (2, 3):
        for x, J in ((c.g_X[:, row], c.J_g_X[:, row]), (c.g_T[:, row], c.J_g_T[:, row])):
            x /= drive[UNIT]
            J /= drive[UNIT]
            J[:, UNIT] = -x / drive[UNIT]
    return c


def _pair(c: Coefficients, drive: np.ndarray, mean: np.ndarray) -> None:
    """Fills the first two rows of a pair."""
    b = drive[2]
    for q, side in enumerate((LEFT, RIGHT)):
        r = drive[q]
        c.g_X[:, q, 0], c.g_T[:, q, 2] = 1.0 / r, side * b / r
        c.J_g_X[:, q, q, 0], c.J_g_T[:, q, q, 2] = -1.0 / r**2, -side * b / r**2
        c.J_g_T[:, q, 2, 2] = side / r


def _twist(c: Coefficients, drive: np.ndarray, mean: np.ndarray) -> None:
    """Fills the first two rows of a twist."""
    speed, yaw = drive[:2]
    c.g_X[:, 0, 0], c.g_T[:, 1, 2] = 1.0 / speed, 1.0 / yaw
    c.J_g_X[:, 0, 0, 0], c.J_g_T[:, 1, 1, 2] = -1.0 / speed**2, -1.0 / yaw**2


def _steered(c: Coefficients, drive: np.ndarray, mean: np.ndarray) -> None:
    """Fills the first two rows of a steered vehicle; mean (n, 2 or more): mean cos and sin of the steering angle."""
    r, base, offset = drive[:UNIT]
    c.g_X[:, 0, 0], c.J_g_X[:, 0, 0, 0] = 1.0 / r, -1.0 / r**2
    cosine = mean[:, 0] * np.cos(offset) - mean[:, 1] * np.sin(offset)
    sine = mean[:, 1] * np.cos(offset) + mean[:, 0] * np.sin(offset)
    c.g_X[:, 1, 0], c.g_T[:, 1, 2] = -sine, base * cosine
    c.J_g_T[:, 1, 1, 2] = cosine
    c.J_g_X[:, 1, 2, 0], c.J_g_T[:, 1, 2, 2] = -cosine, -base * sine
