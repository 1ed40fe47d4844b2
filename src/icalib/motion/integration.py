"""Closed-form integration of IMU readings, forwards or backwards, with Jacobians and covariance (ACI^2, paper
(16)-(18)).

Between two IMU stamps the body rate and the specific force are constant, the mean of the two readings. Then, with
phi = w dt, the increments of that stretch are exact:

    dR = Exp(phi)    dv = G1(phi) f dt    dp = G2(phi) f dt^2     G_m(phi) = sum_n hat(phi)^n / (n + m)!

Increments relative to the start of the interval: R_0^T R_1; R_0^T (v_1 - v_0 - g T); R_0^T (p_1 - p_0 - v_0 T - g
T^2/2).
Errors are perturbed as the states are: rotation on the right, velocity and position added, in the order
rotation, velocity, position, gyro bias, accelerometer bias.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from icalib.base.compiled import njit
from icalib.geometry import so3
from icalib.motion.imu_data import ImuData
from icalib.motion.imu_model import correction_matrices, intrinsics_jacobians

_1_12, _1_48, _1_60, _1_99, _1_180, _1_360 = (1.0 / n for n in (12.0, 48.0, 60.0, 99.0, 180.0, 360.0))
_1_1260, _1_10080, _3_112, _2_135, _2_165 = 1.0 / 1260.0, 1.0 / 10080.0, 3.0 / 112.0, 2.0 / 135.0, 2.0 / 165.0

# Functions between the loop over instants and the innermost ones are inlined: a call counts references to every array
# that it hands on, and these counts took as long as the sums.


@njit(cache=True, nogil=True, inline="always")
def _coefficient_slopes(x, s1, s2, s3):
    """Derivatives of the coefficients s1, s2, s3 of so3.jacobian_coefficients with respect to theta, over theta."""
    if x < so3.SERIES_BELOW:
        d1 = -_1_12 + x * _1_180 * (1.0 - x * _3_112 * (1.0 - x * _2_135))
        d2 = -_1_60 + x * _1_1260 * (1.0 - x * _1_48 * (1.0 - x * _2_165))
        d3 = -_1_360 + x * _1_10080 * (1.0 - x * _1_60 * (1.0 - x * _1_99))
        return d1, d2, d3
    s0 = 1.0 - x * s2
    d1 = (s0 - 2.0 * s1) / x
    d2 = (s1 - 3.0 * s2) / x
    d3 = (s2 - 4.0 * s3) / x
    return d1, d2, d3


@njit(cache=True, nogil=True)
def _series(phi, c0, c1, c2, out):
    """out = c0 I + c1 hat(phi) + c2 hat(phi)^2."""
    x, y, z = phi[0], phi[1], phi[2]
    out[0, 0] = c0 - c2 * (y * y + z * z)
    out[1, 1] = c0 - c2 * (x * x + z * z)
    out[2, 2] = c0 - c2 * (x * x + y * y)
    out[0, 1], out[1, 0] = c2 * x * y - c1 * z, c2 * x * y + c1 * z
    out[0, 2], out[2, 0] = c2 * x * z + c1 * y, c2 * x * z - c1 * y
    out[1, 2], out[2, 1] = c2 * y * z - c1 * x, c2 * y * z + c1 * x


@njit(cache=True, nogil=True)
def _series_product(phi, f, c0, c1, c2, d1, d2, value, slope):
    """value = (c0 I + c1 hat(phi) + c2 hat(phi)^2) f and slope = d value / d phi; d1, d2 are c1'/theta, c2'/theta."""
    cx = phi[1] * f[2] - phi[2] * f[1]
    cy = phi[2] * f[0] - phi[0] * f[2]
    cz = phi[0] * f[1] - phi[1] * f[0]
    cross = (cx, cy, cz)
    pf = phi[0] * f[0] + phi[1] * f[1] + phi[2] * f[2]
    pp = phi[0] * phi[0] + phi[1] * phi[1] + phi[2] * phi[2]
    for i in range(3):
        twice = phi[i] * pf - f[i] * pp
        value[i] = c0 * f[i] + c1 * cross[i] + c2 * twice
        for j in range(3):
            s = (d1 * cross[i] + d2 * twice) * phi[j] + c2 * (phi[i] * f[j] - 2.0 * f[i] * phi[j])
            slope[i, j] = s
        slope[i, i] += c2 * pf
    slope[0, 1] += c1 * f[2]
    slope[0, 2] -= c1 * f[1]
    slope[1, 0] -= c1 * f[2]
    slope[1, 2] += c1 * f[0]
    slope[2, 0] += c1 * f[1]
    slope[2, 1] -= c1 * f[0]


@njit(cache=True, nogil=True)
def _propagate_rows(E, A, B, dt, X):
    """X (9, m) <- F X with F = [[E^T, 0, 0], [A, I, 0], [B, dt I, I]]."""
    for j in range(X.shape[1]):
        a, b, c = X[0, j], X[1, j], X[2, j]
        for i in range(3):
            X[6 + i, j] += dt * X[3 + i, j] + B[i, 0] * a + B[i, 1] * b + B[i, 2] * c
        for i in range(3):
            X[3 + i, j] += A[i, 0] * a + A[i, 1] * b + A[i, 2] * c
        for i in range(3):
            X[i, j] = E[0, i] * a + E[1, i] * b + E[2, i] * c


@njit(cache=True, nogil=True)
def _add_product(X, A, B):
    """The last columns of X (9, n) += A (9, k) B (k, m <= n)."""
    o = X.shape[1] - B.shape[1]
    for i in range(9):
        for k in range(A.shape[1]):
            a = A[i, k]
            if a != 0.0:
                for j in range(B.shape[1]):
                    X[i, o + j] += a * B[k, j]


@njit(cache=True, nogil=True, inline="always")
def _propagate_covariance(E, A, B, dt, bias_step, P, P_t):
    """P <- F15 P F15^T, both halves through the same row operation."""
    for half in range(2):
        source, target = (P, P_t) if half == 0 else (P_t, P)
        _propagate_rows(E, A, B, dt, source[:9])
        _add_product(source[:9], bias_step, source[9:])
        for i in range(15):
            for j in range(15):
                target[i, j] = source[j, i]


@njit(cache=True, nogil=True, inline="always")
def _add_noise(P, bias_step, variance, walk, dt):
    """Adds white noise of the readings (density^2 / dt through the bias columns) and the biases' random walk."""
    for i in range(9):
        for j in range(9):
            s = 0.0
            for k in range(6):
                s += bias_step[i, k] * bias_step[j, k] * variance[k // 3]
            P[i, j] += s / dt
    for i in range(3):
        # A force that is not constant within the stretch: white, it moves the position by dt^3 / 3, its mean by
        # dt^3 / 4. Without it position follows velocity exactly where a stretch holds no other stamp (a bridged gap).
        P[6 + i, 6 + i] += variance[2] * dt * dt * dt / 12.0
    for k in range(6):
        P[9 + k, 9 + k] += walk[k // 3] * dt


@njit(cache=True, nogil=True)
def step(rate, force, dt, dw_db, df_db, R, v, p, J, extra_w, extra_f, P, P_t, variance, n, walk, room):
    """Advances the increments (R, v, p) by dt (either sign) of constant body `rate` and specific `force`.

    dw_db, df_db (3, 6): derivatives of rate and force with respect to both biases; extra_w, extra_f (3, 24 or 0): to
    the IMU intrinsics. variance (N, 3): see ImuData, row n
    counts; walk (2,): squared densities, gyro and accelerometer; room: a
    `Workspace`. All arrays change in place.
    """
    w = room
    x = 0.0
    for i in range(3):
        w.phi[i] = rate[i] * dt
        x += w.phi[i] * w.phi[i]
    s0, s1, s2, s3 = so3.jacobian_coefficients(x)
    d1, d2, d3 = _coefficient_slopes(x, s1, s2, s3)
    _series_product(w.phi, force, 1.0, s1, s2, d1, d2, w.g1, w.slope1)
    _series_product(w.phi, force, 0.5, s2, s3, d2, d3, w.g2, w.slope2)
    _series(w.phi, 1.0, s0, s1, w.E)
    if J.shape[1] > 0:
        _step_jacobians(R, w, s1, s2, s3, dt)
        _bias_step(w, dw_db, df_db)
        _propagate_rows(w.E, w.A, w.B, dt, J)
        for i in range(9):
            for j in range(6):
                J[i, j] += w.bias_step[i, j]
        if J.shape[1] > 6:
            _add_product(J, w.by_rate, extra_w)
            _add_product(J, w.by_force, extra_f)
        if P.shape[0] > 0:
            _propagate_covariance(w.E, w.A, w.B, dt, w.bias_step, P, P_t)
            _add_noise(P, w.bias_step, variance[n], walk, dt)
    for i in range(3):
        p[i] += v[i] * dt + dt * dt * (R[i, 0] * w.g2[0] + R[i, 1] * w.g2[1] + R[i, 2] * w.g2[2])
    for i in range(3):
        v[i] += dt * (R[i, 0] * w.g1[0] + R[i, 1] * w.g1[1] + R[i, 2] * w.g1[2])
    for i in range(3):
        a, b, c = R[i, 0], R[i, 1], R[i, 2]
        for j in range(3):
            R[i, j] = a * w.E[0, j] + b * w.E[1, j] + c * w.E[2, j]


@njit(cache=True, nogil=True, inline="always")
def _step_jacobians(R, w, s1, s2, s3, dt):
    """Fills A, B, by_rate and by_force of the workspace `w`."""
    _series(w.phi, 1.0, s1, s2, w.G1)
    _series(w.phi, 0.5, s2, s3, w.G2)
    g1, g2 = w.g1, w.g2
    for i in range(3):
        r0, r1, r2 = R[i, 0], R[i, 1], R[i, 2]
        # R hat(g)
        w.A[i, 0] = -dt * (r1 * g1[2] - r2 * g1[1])
        w.A[i, 1] = -dt * (r2 * g1[0] - r0 * g1[2])
        w.A[i, 2] = -dt * (r0 * g1[1] - r1 * g1[0])
        w.B[i, 0] = -dt * dt * (r1 * g2[2] - r2 * g2[1])
        w.B[i, 1] = -dt * dt * (r2 * g2[0] - r0 * g2[2])
        w.B[i, 2] = -dt * dt * (r0 * g2[1] - r1 * g2[0])
        for j in range(3):
            w.by_rate[i, j] = dt * w.G1[j, i]  # J_r = J_l^T
            w.by_rate[3 + i, j] = dt * dt * (r0 * w.slope1[0, j] + r1 * w.slope1[1, j] + r2 * w.slope1[2, j])
            w.by_rate[6 + i, j] = dt * dt * dt * (r0 * w.slope2[0, j] + r1 * w.slope2[1, j] + r2 * w.slope2[2, j])
            w.by_force[3 + i, j] = dt * (r0 * w.G1[0, j] + r1 * w.G1[1, j] + r2 * w.G1[2, j])
            w.by_force[6 + i, j] = dt * dt * (r0 * w.G2[0, j] + r1 * w.G2[1, j] + r2 * w.G2[2, j])


@njit(cache=True, nogil=True, inline="always")
def _bias_step(w, dw_db, df_db):
    """Fills bias_step of the workspace `w`: by_rate dw_db + by_force df_db."""
    for i in range(9):
        for j in range(6):
            s = 0.0
            for k in range(3):
                s += w.by_rate[i, k] * dw_db[k, j]
            w.bias_step[i, j] = s
    for i in range(3, 9):
        for j in range(3, 6):  # the rate alone depends on both biases
            for k in range(3):
                w.bias_step[i, j] += w.by_force[i, k] * df_db[k, j]


@njit(cache=True, nogil=True)
def _corrected(gyro, accel, j, s, bias, F, G, H, rate, force):
    """Body rate and specific force from the readings a share s of the way from stamp j to stamp j + 1."""
    for i in range(3):
        rate[i] = force[i] = 0.0
    for k in range(3):
        w = gyro[j, k] + s * (gyro[j + 1, k] - gyro[j, k]) - bias[k]
        f = accel[j, k] + s * (accel[j + 1, k] - accel[j, k]) - bias[3 + k]
        for i in range(3):
            rate[i] += G[i, k] * w + H[i, k] * f
            force[i] += F[i, k] * f


@njit(cache=True, nogil=True)
def start(R, v, p, J, P):
    """No motion yet. In loops: array expressions take seconds to compile."""
    for i in range(3):
        v[i] = p[i] = 0.0
        for k in range(3):
            R[i, k] = 1.0 if i == k else 0.0
    for i in range(J.shape[0]):
        for k in range(J.shape[1]):
            J[i, k] = 0.0
    for i in range(P.shape[0]):
        for k in range(P.shape[1]):
            P[i, k] = 0.0


class Readings(NamedTuple):
    """t (N,) seconds on the IMU's clock; gyro, accel (N, 3); variance (N, 3): see ImuData; walk (2,).

    linear: readings go linearly from stamp to stamp, and a part of an interval takes their mean over that part: whole
    intervals are the same, but the pose at the end then has a continuous derivative, the rate there.
    """

    t: np.ndarray
    gyro: np.ndarray
    accel: np.ndarray
    variance: np.ndarray
    walk: np.ndarray
    linear: bool


class Correction(NamedTuple):
    """How readings are corrected by the IMU intrinsics, see imu_model; derivatives (3, 6) of rate and force by both
    biases, and room for those by the intrinsics, (3, 24 or 0)."""

    intrinsics: np.ndarray
    F: np.ndarray
    G: np.ndarray
    H: np.ndarray
    dw_db: np.ndarray
    df_db: np.ndarray
    extra_w: np.ndarray
    extra_f: np.ndarray
    room: Workspace


class Workspace(NamedTuple):
    """What `step` computes on its way, kept so that no step allocates memory: phi (3,); E (3, 3): Exp(phi); G1, G2
    (3, 3) and g1, g2 (3,): G_m(phi) and G_m(phi) f; slope1, slope2 (3, 3): of the latter by phi; A, B (3, 3): d v, d p
    / d rotation error; by_rate, by_force (9, 3) and bias_step (9, 6): d increments / d rate, d force, d biases; rate,
    force (3,): for callers."""

    phi: np.ndarray
    E: np.ndarray
    G1: np.ndarray
    G2: np.ndarray
    g1: np.ndarray
    g2: np.ndarray
    slope1: np.ndarray
    slope2: np.ndarray
    A: np.ndarray
    B: np.ndarray
    by_rate: np.ndarray
    by_force: np.ndarray
    bias_step: np.ndarray
    rate: np.ndarray
    force: np.ndarray


@njit(cache=True, nogil=True, inline="always")
def workspace():
    """An empty one; the rotation does not depend on the force."""
    return Workspace(
        np.empty(3),
        np.empty((3, 3)),
        np.empty((3, 3)),
        np.empty((3, 3)),
        np.empty(3),
        np.empty(3),
        np.empty((3, 3)),
        np.empty((3, 3)),
        np.empty((3, 3)),
        np.empty((3, 3)),
        np.empty((9, 3)),
        np.zeros((9, 3)),
        np.empty((9, 6)),
        np.empty(3),
        np.empty(3),
    )


class Increment(NamedTuple):
    """R (3, 3), v (3,), p (3,): the increments; J (9, 6 or 30): their derivative with respect to gyro bias,
    accelerometer bias (and the 24 IMU intrinsics), of no columns where it is not wanted; P (15, 15): covariance, of no
    size where it is not wanted."""

    R: np.ndarray
    v: np.ndarray
    p: np.ndarray
    J: np.ndarray
    P: np.ndarray


@njit(cache=True, nogil=True)
def correction(intrinsics, n_extra):
    """n_extra: 24 where derivatives by the intrinsics are wanted, else 0."""
    F, G, H = correction_matrices(intrinsics)
    dw_db, df_db = np.zeros((3, 6)), np.zeros((3, 6))
    for i in range(3):
        for k in range(3):
            dw_db[i, k], dw_db[i, 3 + k], df_db[i, 3 + k] = -G[i, k], -H[i, k], -F[i, k]
    return Correction(intrinsics, F, G, H, dw_db, df_db, np.zeros((3, n_extra)), np.zeros((3, n_extra)), workspace())


@njit(cache=True, nogil=True, inline="always")
def _part(j, now, end, bias, readings, by, out, P_t, rate, force):
    """From `now` to `end` (seconds), both in interval j; rate, force (3,): those of that part."""
    t = readings.t
    span = t[j + 1] - t[j]
    share = min(max((0.5 * (now + end) - t[j]) / span, 0.0), 1.0) if readings.linear else 0.5
    _corrected(readings.gyro, readings.accel, j, share, bias, by.F, by.G, by.H, rate, force)
    if by.extra_w.shape[1] > 0:
        intrinsics_jacobians(by.intrinsics, by.F, by.G, force, rate, by.extra_w, by.extra_f)
    if end != now:
        step(
            rate, force, end - now, by.dw_db, by.df_db, out.R, out.v, out.p, out.J, by.extra_w, by.extra_f, out.P, P_t,
            readings.variance, j, readings.walk, by.room,
        )  # fmt: skip


@njit(cache=True, nogil=True, inline="always")
def whole(t1, backwards, j, now, bias, readings, by, out, P_t, rate, force):
    """From `now` in interval j through whole intervals to the one that holds t1, or is the last; that one, and where
    it begins."""
    t = readings.t
    while (j > 0 and t[j] > t1) if backwards else (j < len(t) - 2 and t[j + 1] < t1):
        end = t[j] if backwards else t[j + 1]
        _part(j, now, end, bias, readings, by, out, P_t, rate, force)
        now = end
        j += -1 if backwards else 1
    return j, now


@njit(cache=True, nogil=True, inline="always")
def to_the_end(t1, j, now, bias, readings, by, out, P_t, rate, force):
    """From `now` to t1, both in interval j; rate, force (3,): those at t1."""
    _part(j, now, t1, bias, readings, by, out, P_t, rate, force)
    if readings.linear:
        t = readings.t
        share = min(max((t1 - t[j]) / (t[j + 1] - t[j]), 0.0), 1.0)
        _corrected(readings.gyro, readings.accel, j, share, bias, by.F, by.G, by.H, rate, force)


@njit(cache=True, nogil=True)
def integrate(t0, t1, first, bias, readings, by, out):
    """Integrates `readings` from t0 to t1 (seconds, imu clock; t1 < t0 runs backwards), starting at interval `first`.

    bias (6,). `out` is overwritten. Beyond the recording the first or last interval is continued.
    Returns the corrected rate (3,) and specific force (3,) at t1.
    """
    P_t, rate, force = np.zeros(out.P.shape), np.empty(3), np.empty(3)
    start(out.R, out.v, out.p, out.J, out.P)
    j, now = whole(t1, t1 < t0, first, t0, bias, readings, by, out, P_t, rate, force)
    to_the_end(t1, j, now, bias, readings, by, out, P_t, rate, force)
    return rate, force


def readings_of(imu: ImuData, linear: bool) -> Readings:
    """Those of `imu`, with its noise."""
    return Readings(imu.seconds, imu.gyro, imu.accel, imu.variance, imu.walk, linear)
