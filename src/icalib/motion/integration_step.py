"""One step of the closed-form integration, with Jacobians and covariance (ACI^2, iCalib paper (16)-(18)).

Body rate w and specific force f are constant over dt. With phi = w dt and G_m(phi) = sum_n hat(phi)^n / (n + m)!, the
increments since the start of the interval become, exactly,

    R <- R Exp(phi)    v <- v + R G1(phi) f dt    p <- p + v dt + R G2(phi) f dt^2

Vectors and matrices within a step are tuples, and the running integral is one array. numba counts references to each
array argument, and with separate arrays that took longer than the arithmetic.
"""

from __future__ import annotations

import numpy as np

from icalib.base.compiled import njit
from icalib.geometry import so3
from icalib.motion.imu_data import correction_matrices

_1_12, _1_48, _1_60, _1_99, _1_180, _1_360 = (1.0 / n for n in (12.0, 48.0, 60.0, 99.0, 180.0, 360.0))
_1_1260, _1_10080, _3_112, _2_135, _2_165 = 1.0 / 1260.0, 1.0 / 10080.0, 3.0 / 112.0, 2.0 / 135.0, 2.0 / 165.0
ROW_F, ROW_G, ROW_H, ROW_C, ROW_JR, ROW_GA = range(6)  # rows of a `correction`
# The running integral is one array, `run`, with these parts at these indices:
# - 0: R row by row; AT_V: v; AT_P: p
# - AT_STEP: derivatives of the current step by rate, force and both biases, STEP_STRIDE numbers a row
# - AT_INTRINSICS: derivatives of rate and force by the IMU intrinsics, J_STRIDE numbers a row
# - AT_J: J, J_STRIDE numbers a row, of which the first `width` are in use: 6 biases, 24 IMU intrinsics
# Strides are compile-time constants, so that the compiler can vectorise over columns.
AT_V, AT_P, AT_STEP, AT_INTRINSICS, AT_J, STEP_STRIDE, J_STRIDE = 9, 12, 15, 128, 320, 12, 32
RUN_SIZE = AT_J + 9 * J_STRIDE
# The covariance of rotation, velocity, position and biases is laid out like J, with 15 rows.
COVARIANCE_SIZE = AT_J + 15 * J_STRIDE


@njit(cache=True, nogil=True)
def start(run):
    """Resets `run` to no motion."""
    for i in range(RUN_SIZE):
        run[i] = 0.0
    run[0] = run[4] = run[8] = 1.0


@njit(cache=True, nogil=True)
def correction(intrinsics):
    """Matrices (6, 9), row by row: F, G, H (see `correction_matrices`); C = Exp(r), J_r(r) and G A_g (see
    `imu_model`)."""
    r, by = intrinsics[12:15], np.empty((6, 9))
    F_, G_, H_, GA = correction_matrices(intrinsics)
    matrices = F_, G_, H_, so3.exp(r), so3.right_jacobian(r), GA
    for n in range(6):
        for i in range(3):
            for j in range(3):
                by[n, 3 * i + j] = matrices[n][i, j]
    return by


@njit(cache=True, nogil=True)
def matrix(by, n):
    """Row n as a matrix: nine numbers, row by row."""
    return by[n, 0], by[n, 1], by[n, 2], by[n, 3], by[n, 4], by[n, 5], by[n, 6], by[n, 7], by[n, 8]


@njit(cache=True, nogil=True)
def times(m, x):
    """m x of a matrix and a vector."""
    return (
        m[0] * x[0] + m[1] * x[1] + m[2] * x[2],
        m[3] * x[0] + m[4] * x[1] + m[5] * x[2],
        m[6] * x[0] + m[7] * x[1] + m[8] * x[2],
    )


@njit(cache=True, nogil=True)
def cross(x, y):
    """x x y of two vectors."""
    return x[1] * y[2] - x[2] * y[1], x[2] * y[0] - x[0] * y[2], x[0] * y[1] - x[1] * y[0]


@njit(cache=True, nogil=True)
def row_times(x, m):
    """x^T m of a vector and a matrix."""
    return (
        x[0] * m[0] + x[1] * m[3] + x[2] * m[6],
        x[0] * m[1] + x[1] * m[4] + x[2] * m[7],
        x[0] * m[2] + x[1] * m[5] + x[2] * m[8],
    )


@njit(cache=True, nogil=True)
def _cross_product(x, m):
    """hat(x) m of a vector and a matrix."""
    a, b, c = x
    return (
        b * m[6] - c * m[3], b * m[7] - c * m[4], b * m[8] - c * m[5],
        c * m[0] - a * m[6], c * m[1] - a * m[7], c * m[2] - a * m[8],
        a * m[3] - b * m[0], a * m[4] - b * m[1], a * m[5] - b * m[2],
    )  # fmt: skip


@njit(cache=True, nogil=True)
def _series(phi, c0, c1, c2):
    """c0 I + c1 hat(phi) + c2 hat(phi)^2."""
    x, y, z = phi
    return (
        c0 - c2 * (y * y + z * z), c2 * x * y - c1 * z, c2 * x * z + c1 * y,
        c2 * x * y + c1 * z, c0 - c2 * (x * x + z * z), c2 * y * z - c1 * x,
        c2 * x * z - c1 * y, c2 * y * z + c1 * x, c0 - c2 * (x * x + y * y),
    )  # fmt: skip


@njit(cache=True, nogil=True)
def _coefficient_slopes(x, s1, s2, s3):
    """Derivatives of the coefficients s1, s2, s3 of so3.jacobian_coefficients with respect to theta, over theta."""
    if x < so3.SERIES_BELOW:
        d1 = -_1_12 + x * _1_180 * (1.0 - x * _3_112 * (1.0 - x * _2_135))
        d2 = -_1_60 + x * _1_1260 * (1.0 - x * _1_48 * (1.0 - x * _2_165))
        d3 = -_1_360 + x * _1_10080 * (1.0 - x * _1_60 * (1.0 - x * _1_99))
        return d1, d2, d3
    s0 = 1.0 - x * s2
    return (s0 - 2.0 * s1) / x, (s1 - 3.0 * s2) / x, (s2 - 4.0 * s3) / x


@njit(cache=True, nogil=True)
def _products(phi, f):
    """hat(phi) f, hat(phi)^2 f and phi . f."""
    x, y, z = phi
    a, b, c = f
    pf, pp = x * a + y * b + z * c, x * x + y * y + z * z
    return (y * c - z * b, z * a - x * c, x * b - y * a), (x * pf - a * pp, y * pf - b * pp, z * pf - c * pp), pf


@njit(cache=True, nogil=True)
def _sum3(c0, f, c1, g, c2, h):
    """c0 f + c1 g + c2 h of vectors."""
    return (
        c0 * f[0] + c1 * g[0] + c2 * h[0], c0 * f[1] + c1 * g[1] + c2 * h[1], c0 * f[2] + c1 * g[2] + c2 * h[2]
    )  # fmt: skip


@njit(cache=True, nogil=True)
def _series_slope(phi, f, products, c1, c2, d1, d2):
    """Derivative by phi of (c0 I + c1 hat(phi) + c2 hat(phi)^2) f; d1, d2 are c1'/theta, c2'/theta."""
    x, y, z = phi
    a, b, c = f
    once, twice, pf = products
    h0, h1, h2 = d1 * once[0] + d2 * twice[0], d1 * once[1] + d2 * twice[1], d1 * once[2] + d2 * twice[2]
    return (
        h0 * x + c2 * (x * a - 2.0 * a * x) + c2 * pf,
        h0 * y + c2 * (x * b - 2.0 * a * y) + c1 * c,
        h0 * z + c2 * (x * c - 2.0 * a * z) - c1 * b,
        h1 * x + c2 * (y * a - 2.0 * b * x) - c1 * c,
        h1 * y + c2 * (y * b - 2.0 * b * y) + c2 * pf,
        h1 * z + c2 * (y * c - 2.0 * b * z) + c1 * a,
        h2 * x + c2 * (z * a - 2.0 * c * x) + c1 * b,
        h2 * y + c2 * (z * b - 2.0 * c * y) - c1 * a,
        h2 * z + c2 * (z * c - 2.0 * c * z) + c2 * pf,
    )


@njit(cache=True, nogil=True)
def step(rate, force, beyond, dt, by, run, width):
    """Advances `run` by dt (either sign) of constant body `rate` and specific `force`, and by the displacement `beyond`
    (3,) [m] that their variation adds. Returns the arguments that `carry` needs.

    run: increments and derivatives, laid out as above. by: see `correction`, read only if derivatives are wanted.
    width: columns of J to advance: 0 none, 6 biases, more: IMU intrinsics too.
    """
    phi = rate[0] * dt, rate[1] * dt, rate[2] * dt
    x = phi[0] * phi[0] + phi[1] * phi[1] + phi[2] * phi[2]
    s0, s1, s2, s3 = so3.jacobian_coefficients(x)
    products = _products(phi, force)
    g1, p = _sum3(1.0, force, s1, products[0], s2, products[1]), _sum3(0.5, force, s2, products[0], s3, products[1])
    p = _sum3(dt * dt, p, 1.0, beyond, 0.0, beyond)
    turn, R = _series(phi, 1.0, s0, s1), (run[0], run[1], run[2], run[3], run[4], run[5], run[6], run[7], run[8])
    by_turn = _scaled(-dt, _times_cross(R, g1)), _scaled(-1.0, _times_cross(R, p))
    if width > 0:
        d1, d2, d3 = _coefficient_slopes(x, s1, s2, s3)
        slope1 = _series_slope(phi, force, products, s1, s2, d1, d2)
        slope2 = _series_slope(phi, force, products, s2, s3, d2, d3)
        _fill_step(dt, _series(phi, 1.0, s1, s2), _series(phi, 0.5, s2, s3), slope1, slope2, by, run)
        carry(turn, by_turn, dt, width, run)
        _add_biases(run)
        if width > 6:
            fill_intrinsics(rate, force, by, run)
            _add_intrinsics(run)
    v, p = times(R, g1), times(R, p)
    for i in range(3):
        row = run[3 * i], run[3 * i + 1], run[3 * i + 2]
        run[3 * i], run[3 * i + 1], run[3 * i + 2] = row_times(row, turn)
    for i in range(3):
        run[AT_P + i] += run[AT_V + i] * dt + p[i]
        run[AT_V + i] += dt * v[i]
    return turn, by_turn


@njit(cache=True, nogil=True)
def _times_cross(R, g):
    """R hat(g) of a matrix and a vector."""
    return (
        R[1] * g[2] - R[2] * g[1], R[2] * g[0] - R[0] * g[2], R[0] * g[1] - R[1] * g[0],
        R[4] * g[2] - R[5] * g[1], R[5] * g[0] - R[3] * g[2], R[3] * g[1] - R[4] * g[0],
        R[7] * g[2] - R[8] * g[1], R[8] * g[0] - R[6] * g[2], R[6] * g[1] - R[7] * g[0],
    )  # fmt: skip


@njit(cache=True, nogil=True)
def _scaled(s, m):
    """The matrix m, a tuple of 9 numbers, times the scalar s."""
    return s * m[0], s * m[1], s * m[2], s * m[3], s * m[4], s * m[5], s * m[6], s * m[7], s * m[8]


@njit(cache=True, nogil=True)
def _fill_step(dt, G1, G2, slope1, slope2, by, run):
    """Fills the Jacobian of one step of dt [s] in `run`, from AT_STEP on.

    Its 9 rows are the increments of rotation, velocity and position. Its 12 columns are rate, force, gyroscope bias and
    accelerometer bias. by: matrices of `correction`. slope1, slope2: derivatives of G1 f and G2 f by phi. `run` also
    supplies the rotation since the start of the interval.
    """
    C_f, C_w, C_wf = matrix(by, ROW_F), matrix(by, ROW_G), matrix(by, ROW_H)
    for i in range(3):
        R = run[3 * i], run[3 * i + 1], run[3 * i + 2]
        # The right Jacobian is the transpose of the left one, G1.
        turn = (G1[0], G1[3], G1[6]) if i == 0 else ((G1[1], G1[4], G1[7]) if i == 1 else (G1[2], G1[5], G1[8]))
        v, p, v_force, p_force = row_times(R, slope1), row_times(R, slope2), row_times(R, G1), row_times(R, G2)
        _fill_row(AT_STEP + STEP_STRIDE * i, dt, turn, 0.0, turn, C_f, C_w, C_wf, run)
        _fill_row(AT_STEP + STEP_STRIDE * (3 + i), dt * dt, v, dt, v_force, C_f, C_w, C_wf, run)
        _fill_row(AT_STEP + STEP_STRIDE * (6 + i), dt * dt * dt, p, dt * dt, p_force, C_f, C_w, C_wf, run)


@njit(cache=True, nogil=True)
def _fill_row(o, s, by_rate, t, by_force, C_f, C_w, C_wf, run):
    """A row of derivatives, from number o on: s by_rate, t by_force, and from both by the biases."""
    a0, a1, a2 = s * by_rate[0], s * by_rate[1], s * by_rate[2]
    b0, b1, b2 = t * by_force[0], t * by_force[1], t * by_force[2]
    w, f = row_times((-a0, -a1, -a2), C_w), row_times((-a0, -a1, -a2), C_wf)
    run[o], run[o + 1], run[o + 2], run[o + 3], run[o + 4], run[o + 5] = a0, a1, a2, b0, b1, b2
    run[o + 6], run[o + 7], run[o + 8] = w
    run[o + 9] = f[0] - b0 * C_f[0] - b1 * C_f[3] - b2 * C_f[6]
    run[o + 10] = f[1] - b0 * C_f[1] - b1 * C_f[4] - b2 * C_f[7]
    run[o + 11] = f[2] - b0 * C_f[2] - b1 * C_f[5] - b2 * C_f[8]


@njit(cache=True, nogil=True)
def carry(turn, by_turn, dt, width, x):
    """Multiplies J (9, width), which x holds at AT_J, from the left by the transition matrix of one step.

    turn: Exp(phi) of the step; by_turn: derivatives of the increments of velocity and position by a rotation before the
    step. The derivatives of the step itself are added later, by `_add_biases` and `_add_intrinsics`.
    """
    E0, E1, E2, E3, E4, E5, E6, E7, E8 = turn
    A0, A1, A2, A3, A4, A5, A6, A7, A8 = by_turn[0]
    B0, B1, B2, B3, B4, B5, B6, B7, B8 = by_turn[1]
    for j in range(width):
        a, b, c = x[AT_J + j], x[AT_J + J_STRIDE + j], x[AT_J + 2 * J_STRIDE + j]
        v0, v1, v2 = x[AT_J + 3 * J_STRIDE + j], x[AT_J + 4 * J_STRIDE + j], x[AT_J + 5 * J_STRIDE + j]
        x[AT_J + 6 * J_STRIDE + j] += dt * v0 + B0 * a + B1 * b + B2 * c
        x[AT_J + 7 * J_STRIDE + j] += dt * v1 + B3 * a + B4 * b + B5 * c
        x[AT_J + 8 * J_STRIDE + j] += dt * v2 + B6 * a + B7 * b + B8 * c
        x[AT_J + 3 * J_STRIDE + j] = v0 + (A0 * a + A1 * b + A2 * c)
        x[AT_J + 4 * J_STRIDE + j] = v1 + (A3 * a + A4 * b + A5 * c)
        x[AT_J + 5 * J_STRIDE + j] = v2 + (A6 * a + A7 * b + A8 * c)
        x[AT_J + j] = E0 * a + E3 * b + E6 * c
        x[AT_J + J_STRIDE + j] = E1 * a + E4 * b + E7 * c
        x[AT_J + 2 * J_STRIDE + j] = E2 * a + E5 * b + E8 * c


@njit(cache=True, nogil=True)
def _add_biases(run):
    """Adds the derivatives of the step itself by the biases to their columns of J."""
    for i in range(9):
        for j in range(6):
            run[AT_J + J_STRIDE * i + j] += run[AT_STEP + STEP_STRIDE * i + 6 + j]


@njit(cache=True, nogil=True)
def fill_intrinsics(rate, force, by, run):
    """Fills the derivatives of corrected rate (three rows) and force (three rows) by the 24 IMU intrinsics, from
    run[AT_INTRINSICS] on, see `imu_model`. Elements that are always zero stay zero."""
    u, turn = times(matrix(by, ROW_C), force), _cross_product(force, matrix(by, ROW_JR))
    f, w = force, rate
    for i in range(3):
        F0, F1, F2 = by[ROW_F, 3 * i], by[ROW_F, 3 * i + 1], by[ROW_F, 3 * i + 2]
        o = AT_INTRINSICS + J_STRIDE * (3 + i)
        run[o], run[o + 1], run[o + 2] = -F0 * u[0], -F1 * u[0], -F1 * u[1]
        run[o + 3], run[o + 4], run[o + 5] = -F2 * u[0], -F2 * u[1], -F2 * u[2]
        run[o + 12], run[o + 13], run[o + 14] = turn[3 * i], turn[3 * i + 1], turn[3 * i + 2]
    for i in range(3):
        S0, S1, S2 = by[ROW_GA, 3 * i], by[ROW_GA, 3 * i + 1], by[ROW_GA, 3 * i + 2]
        G0, G1, G2 = by[ROW_G, 3 * i], by[ROW_G, 3 * i + 1], by[ROW_G, 3 * i + 2]
        o, q = AT_INTRINSICS + J_STRIDE * i, AT_INTRINSICS + J_STRIDE * 3
        for n in range(15):
            run[o + n] = -(S0 * run[q + n] + S1 * run[q + J_STRIDE + n] + S2 * run[q + 2 * J_STRIDE + n])
        run[o + 6], run[o + 7], run[o + 8] = -G0 * w[0], -G1 * w[0], -G1 * w[1]
        run[o + 9], run[o + 10], run[o + 11] = -G2 * w[0], -G2 * w[1], -G2 * w[2]
        run[o + 15], run[o + 16], run[o + 17] = -G0 * f[0], -G0 * f[1], -G0 * f[2]
        run[o + 18], run[o + 19], run[o + 20] = -G1 * f[0], -G1 * f[1], -G1 * f[2]
        run[o + 21], run[o + 22], run[o + 23] = -G2 * f[0], -G2 * f[1], -G2 * f[2]


@njit(cache=True, nogil=True)
def _add_intrinsics(run):
    """Adds the derivatives of the step itself by the IMU intrinsics to their columns of J."""
    for i in range(9):
        o, d = J_STRIDE * i + 6, AT_STEP + STEP_STRIDE * i
        a, b, c = run[d], run[d + 1], run[d + 2]
        for j in range(24):
            x = run[AT_J + o + j] + a * run[AT_INTRINSICS + j]
            run[AT_J + o + j] = x + b * run[AT_INTRINSICS + J_STRIDE + j] + c * run[AT_INTRINSICS + 2 * J_STRIDE + j]
    for i in range(3, 9):
        o, d = J_STRIDE * i + 6, AT_STEP + STEP_STRIDE * i + 3
        a, b, c = run[d], run[d + 1], run[d + 2]
        for j in range(15):  # those of the accelerometer, and its rotation
            x = run[AT_J + o + j] + a * run[AT_INTRINSICS + 3 * J_STRIDE + j]
            run[AT_J + o + j] = (
                x + b * run[AT_INTRINSICS + 4 * J_STRIDE + j] + c * run[AT_INTRINSICS + 5 * J_STRIDE + j]
            )


@njit(cache=True, nogil=True)
def add_covariance(turn, by_turn, dt, variance, walk, run, cov, cov_t):
    """Propagates the covariance `cov` (layout: see COVARIANCE_SIZE) through the step of `run` that returned turn and
    by_turn; cov_t: workspace.

    F cov F^T takes the same row operation twice, with transpositions, and noise is added. variance (3,): squared
    densities, see `ImuData`; walk (2,): squared densities of the bias random walks.
    """
    for half in range(2):
        source, target = (cov, cov_t) if half == 0 else (cov_t, cov)
        carry(turn, by_turn, dt, 15, source)
        for i in range(9):
            for k in range(6):
                d = run[AT_STEP + STEP_STRIDE * i + 6 + k]
                for j in range(15):
                    source[AT_J + J_STRIDE * i + j] += d * source[AT_J + J_STRIDE * (9 + k) + j]
        for i in range(15):
            for j in range(15):
                target[AT_J + J_STRIDE * i + j] = source[AT_J + J_STRIDE * j + i]
    for i in range(9):
        for j in range(9):
            s = 0.0
            for k in range(6):
                s += run[AT_STEP + STEP_STRIDE * i + 6 + k] * run[AT_STEP + STEP_STRIDE * j + 6 + k] * variance[k // 3]
            cov[AT_J + J_STRIDE * i + j] += s / dt
    for i in range(6, 9):
        # Variation of the force within the interval: white noise has the position variance dt^3 / 3, its mean over the
        # interval dt^3 / 4. Without the rest, position and velocity errors would be collinear across a bridged gap.
        cov[AT_J + J_STRIDE * i + i] += variance[2] * dt * dt * dt / 12.0
    for k in range(6):
        cov[AT_J + (J_STRIDE + 1) * (9 + k)] += walk[k // 3] * dt
