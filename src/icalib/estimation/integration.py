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

import numpy as np
from numba import njit

from icalib.estimation.imu_model import correction_matrices, intrinsics_jacobians
from icalib.geometry import so3

# Work space of one integration: increments and what is known of them.
#   R (3, 3), v (3,), p (3,): the increments; J (9, 6 or 30): their derivative with respect to gyro bias, accelerometer
#   bias (and the 24 IMU intrinsics); P (15, 15): covariance, of no size where it is not wanted.


@njit(cache=True, nogil=True)
def _coefficient_slopes(x, s1, s2, s3):
    """Derivatives of the coefficients s1, s2, s3 of so3.jacobian_coefficients with respect to theta, over theta."""
    if x < so3.SERIES_BELOW:
        d1 = -1.0 / 12.0 + x / 180.0 * (1.0 - x * 3.0 / 112.0 * (1.0 - x * 2.0 / 135.0))
        d2 = -1.0 / 60.0 + x / 1260.0 * (1.0 - x / 48.0 * (1.0 - x * 2.0 / 165.0))
        d3 = -1.0 / 360.0 + x / 10080.0 * (1.0 - x / 60.0 * (1.0 - x / 99.0))
        return d1, d2, d3
    s0 = 1.0 - x * s2
    d1 = (s0 - 2.0 * s1) / x
    d2 = (s1 - 3.0 * s2) / x
    d3 = (s2 - 4.0 * s3) / x
    return d1, d2, d3


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
def _add_product(X, A, B, rows):
    """X[:rows] += A[:rows] B."""
    for i in range(rows):
        for k in range(A.shape[1]):
            a = A[i, k]
            if a != 0.0:
                for j in range(B.shape[1]):
                    X[i, j] += a * B[k, j]


@njit(cache=True, nogil=True)
def _propagate_covariance(E, A, B, dt, bias_step, P, P_t):
    """P <- F15 P F15^T, both halves through the same row operation."""
    for half in range(2):
        source, target = (P, P_t) if half == 0 else (P_t, P)
        _propagate_rows(E, A, B, dt, source[:9])
        _add_product(source[:9], bias_step, source[9:], 9)
        for i in range(15):
            for j in range(15):
                target[i, j] = source[j, i]


@njit(cache=True, nogil=True)
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
def step(rate, force, dt, dw_db, df_db, R, v, p, J, extra_w, extra_f, P, P_t, variance, walk):
    """Advances the increments (R, v, p) by dt (either sign) of constant body `rate` and specific `force`.

    dw_db, df_db (3, 6): derivatives of rate and force with respect to both biases; extra_w, extra_f (3, 24 or 0): to
    the IMU intrinsics. variance (3,): see ImuData; walk (2,): squared densities, gyro and accelerometer. All arrays
    change in place.
    """
    phi = rate * dt
    x = phi[0] * phi[0] + phi[1] * phi[1] + phi[2] * phi[2]
    _, s1, s2, s3 = so3.jacobian_coefficients(x)
    d1, d2, d3 = _coefficient_slopes(x, s1, s2, s3)
    g1, slope1 = np.empty(3), np.empty((3, 3))
    g2, slope2 = np.empty(3), np.empty((3, 3))
    _series_product(phi, force, 1.0, s1, s2, d1, d2, g1, slope1)
    _series_product(phi, force, 0.5, s2, s3, d2, d3, g2, slope2)
    E = so3.exp(phi)
    if J.shape[1] > 0:
        A, B, by_rate, by_force = _step_jacobians(R, phi, g1, g2, slope1, slope2, s1, s2, s3, dt)
        bias_step = np.zeros((9, 6))
        _add_product(bias_step, by_rate, dw_db, 9)
        _add_product(bias_step, by_force, df_db, 9)
        _propagate_rows(E, A, B, dt, J)
        for i in range(9):
            for j in range(6):
                J[i, j] += bias_step[i, j]
        if J.shape[1] > 6:
            _add_product(J[:, 6:], by_rate, extra_w, 9)
            _add_product(J[:, 6:], by_force, extra_f, 9)
        if P.shape[0] > 0:
            _propagate_covariance(E, A, B, dt, bias_step, P, P_t)
            _add_noise(P, bias_step, variance, walk, dt)
    for i in range(3):
        p[i] += v[i] * dt + dt * dt * (R[i, 0] * g2[0] + R[i, 1] * g2[1] + R[i, 2] * g2[2])
    for i in range(3):
        v[i] += dt * (R[i, 0] * g1[0] + R[i, 1] * g1[1] + R[i, 2] * g1[2])
    for i in range(3):
        a, b, c = R[i, 0], R[i, 1], R[i, 2]
        for j in range(3):
            R[i, j] = a * E[0, j] + b * E[1, j] + c * E[2, j]


@njit(cache=True, nogil=True)
def _step_jacobians(R, phi, g1, g2, slope1, slope2, s1, s2, s3, dt):
    """A, B: d v, d p / d rotation error; by_rate, by_force (9, 3): d increments / d rate, / d force of this step."""
    A, B = np.empty((3, 3)), np.empty((3, 3))
    by_rate, by_force = np.zeros((9, 3)), np.zeros((9, 3))
    Jr = so3.right_jacobian(phi)
    G1 = so3.left_jacobian(phi)
    H = so3.hat(phi)
    G2 = np.empty((3, 3))
    for i in range(3):
        for j in range(3):
            hh = H[i, 0] * H[0, j] + H[i, 1] * H[1, j] + H[i, 2] * H[2, j]
            G2[i, j] = s2 * H[i, j] + s3 * hh
        G2[i, i] += 0.5
    h1, h2 = so3.hat(g1), so3.hat(g2)
    for i in range(3):
        for j in range(3):
            a = b = w1 = w2 = f1 = f2 = 0.0
            for k in range(3):
                r = R[i, k]
                a += r * h1[k, j]
                b += r * h2[k, j]
                w1 += r * slope1[k, j]
                w2 += r * slope2[k, j]
                f1 += r * G1[k, j]
                f2 += r * G2[k, j]
            A[i, j], B[i, j] = -a * dt, -b * dt * dt
            by_rate[i, j] = Jr[i, j] * dt
            by_rate[3 + i, j], by_rate[6 + i, j] = w1 * dt * dt, w2 * dt * dt * dt
            by_force[3 + i, j], by_force[6 + i, j] = f1 * dt, f2 * dt * dt
    return A, B, by_rate, by_force


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
def _start(R, v, p, J, P):
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


@njit(cache=True, nogil=True)
def integrate(t0, t1, first, t, gyro, accel, bias, intrinsics, variance, walk, linear, R, v, p, J, P):
    """Integrates readings from t0 to t1 (seconds, imu clock; t1 < t0 runs backwards), starting at interval `first`.

    t (N,), gyro, accel (N, 3): readings; bias (6,); variance (N, 3): see ImuData;
    walk (2,). R, v, p, J, P are overwritten. Beyond the recording the first or last interval is continued.
    With `linear`, readings go linearly from stamp to stamp, and a part of an interval takes their mean over that part:
    whole intervals are the same, but the pose at t1 then has a continuous derivative, the rate at t1.
    Returns the corrected rate (3,) and specific force (3,) at t1.
    """
    P_t = np.zeros(P.shape)
    F, G, H = correction_matrices(intrinsics)
    dw_db, df_db = np.zeros((3, 6)), np.zeros((3, 6))
    _start(R, v, p, J, P)
    for i in range(3):
        for k in range(3):
            dw_db[i, k], dw_db[i, 3 + k], df_db[i, 3 + k] = -G[i, k], -H[i, k], -F[i, k]
    n_extra = max(J.shape[1] - 6, 0)
    extra_w, extra_f = np.zeros((3, n_extra)), np.zeros((3, n_extra))
    rate, force = np.empty(3), np.empty(3)
    backwards = t1 < t0
    j, now = first, t0
    while True:
        if backwards:
            last = j == 0 or t[j] <= t1
            end = t1 if last else t[j]
        else:
            last = j == len(t) - 2 or t[j + 1] >= t1
            end = t1 if last else t[j + 1]
        span = t[j + 1] - t[j]
        share = min(max((0.5 * (now + end) - t[j]) / span, 0.0), 1.0) if linear else 0.5
        _corrected(gyro, accel, j, share, bias, F, G, H, rate, force)
        if n_extra > 0:
            intrinsics_jacobians(intrinsics, F, G, force, rate, extra_w, extra_f)
        if end != now:
            step(rate, force, end - now, dw_db, df_db, R, v, p, J, extra_w, extra_f, P, P_t, variance[j], walk)
        if last:
            if linear:
                share = min(max((end - t[j]) / span, 0.0), 1.0)
                _corrected(gyro, accel, j, share, bias, F, G, H, rate, force)
            return rate, force
        now = end
        j += -1 if backwards else 1
