"""Integration of readings against the matrix exponential, a motion in closed form, differences and sampling."""

import numpy as np
import pytest
from scipy.linalg import expm
from scipy.spatial.transform import Rotation
from tests.cases import each

from icalib.data.measurements import ImuStream
from icalib.geometry import so3
from icalib.motion.imu_data import ImuData
from icalib.motion.integration import (
    Increment,
    Readings,
    empty_prefix,
    finish,
    in_order_of_keyframes,
    integrate,
    integrate_from_keyframe,
    integration_workspace,
)
from icalib.motion.integration_step import COVARIANCE_SIZE, RUN_SIZE, correction
from icalib.rig import ImuNoise
from icalib.tools.simulation import handheld
from icalib.tools.simulation.motion import reference_motion

BIAS = np.array([0.01, -0.02, 0.03, 0.1, -0.2, 0.15])
INTRINSICS = np.random.default_rng(5).normal(size=24) * np.repeat([0.01, 0.01, 0.02, 2e-3], [6, 6, 3, 9])
LOWER = ([0, 1, 1, 2, 2, 2], [0, 0, 1, 0, 1, 2])
UNIT = np.array([0.48, -0.6, 0.64])
# Angles of one step around the border between series and closed forms, at both extremes and in between.
ANGLES = [0.0, 1e-12, 1e-8, 1e-4, 1e-2, 0.0999999, 0.1, 0.1000001, 0.5, 2.0, np.pi - 1e-6, 3.5]


class Irregular:
    """Irregular stamps with random readings; between two stamps each is a parabola of any mean, or constant."""

    def __init__(self, n=12, seed=0):
        rng = np.random.default_rng(seed)
        self.t = np.cumsum(rng.uniform(0.002, 0.011, n)) - 0.004
        self.values = np.hstack([rng.normal(size=(n, 3)), rng.normal(size=(n, 3)) * 3.0 + [0.0, 0.0, 9.8]])
        self.means = 0.5 * (self.values[1:] + self.values[:-1]) + 0.1 * rng.normal(size=(n - 1, 6))
        self.variance = np.tile([1e-4**2, 2e-3**2, 0.0], (n - 1, 1)) * rng.uniform(0.5, 2.0, (n - 1, 1))
        self.walk = np.array([1e-3**2, 2e-2**2])

    @classmethod
    def constant(cls, t, rate, force):
        """The same rate and force at all times t."""
        r = cls(len(t))
        r.t, r.values = t, np.tile(np.concatenate([rate, force]), (len(t), 1))
        r.means = r.values[1:]
        return r

    def readings(self):
        gyro, accel = self.values[:, :3].copy(), self.values[:, 3:].copy()
        return Readings(self.t, gyro, accel, self.means, self.variance, self.walk)

    def at(self, t):
        """Rate and force (6,) at t, those of the end beyond it."""
        j = self.interval(t)
        u = np.clip((t - self.t[j]) / (self.t[j + 1] - self.t[j]), 0.0, 1.0)
        x0, x1, mean = self.values[j], self.values[j + 1], self.means[j]
        return x0 + u * (x1 - x0) + (6.0 * mean - 3.0 * (x0 + x1)) * u * (1.0 - u)

    def interval(self, t):
        return int(np.clip(np.searchsorted(self.t, t, side="right") - 1, 0, len(self.t) - 2))


def run(r, t0, t1, bias=BIAS, intrinsics=None, first=None, width=6, covariance=False):
    """R, v, p, J, P, and rate and force at the end."""
    R, v, p, J = np.empty((3, 3)), np.empty(3), np.empty(3), np.empty((9, width))
    P = np.empty((15, 15) if covariance else (0, 0))
    first = r.interval(t0) if first is None else first
    x = np.zeros(24) if intrinsics is None else intrinsics
    room = integration_workspace(COVARIANCE_SIZE if covariance else 0)
    end = integrate(t0, t1, first, tuple(bias), r.readings(), correction(x), room, Increment(R, v, p, J, P))
    return R, v, p, J, P, end


def corrected_at(r, t, bias, intrinsics):
    """Body rate and specific force (3,) at t."""
    x = r.at(t)
    w, f = corrected(x[None, :3], x[None, 3:], bias, intrinsics)
    return w[0], f[0]


def corrected(gyro, accel, bias, intrinsics):
    M_a, M_g = np.eye(3), np.eye(3)
    M_a[LOWER] += intrinsics[:6]
    M_g[LOWER] += intrinsics[6:12]
    C = Rotation.from_rotvec(intrinsics[12:15]).as_matrix()
    f = np.linalg.solve(M_a @ C, (accel - bias[3:]).T).T
    gyro = gyro - bias[:3] - f @ intrinsics[15:].reshape(3, 3).T
    return np.linalg.solve(M_g, gyro.T).T, f


def generator(w, f):
    A = np.zeros((5, 5))
    A[:3, :3], A[:3, 3], A[3, 4] = np.cross(np.eye(3), w), f, 1.0
    return A


def by_expm(r, t0, t1, bias=BIAS, intrinsics=None, parts=60):
    """The same increments as a product of matrix exponentials over short steps: [R v p; 0 1 t; 0 0 1]."""
    intrinsics = np.zeros(24) if intrinsics is None else intrinsics
    inner = r.t[(r.t > min(t0, t1)) & (r.t < max(t0, t1))]
    stops = [t0, *sorted(inner, reverse=bool(t1 < t0)), t1]
    X = np.eye(5)
    for a, b in zip(stops[:-1], stops[1:], strict=True):
        x = np.array([r.at(a + (k + 0.5) * (b - a) / parts) for k in range(parts)])
        rates, forces = corrected(x[:, :3], x[:, 3:], bias, intrinsics)
        for step in expm(np.stack([generator(w, f) for w, f in zip(rates, forces, strict=True)]) * (b - a) / parts):
            X = X @ step
    return X[:3, :3], X[:3, 3], X[:3, 4]


def assert_same(got, want, atol):
    for a, b in zip(got[:3], want, strict=True):
        np.testing.assert_allclose(a, b, rtol=0, atol=atol)


def difference(plus, minus, R, h):
    """(9,) central difference of (rotation on the right, v, p)."""
    turn = so3.log(R.T @ plus[0]) - so3.log(R.T @ minus[0])
    return np.concatenate([turn, plus[1] - minus[1], plus[2] - minus[2]]) / (2.0 * h)


R0 = Irregular()
SPANS = {
    "between stamps": (R0.t[1] + 1e-3, R0.t[8] + 2e-3),
    "stamp to stamp": (R0.t[2], R0.t[9]),
    "within one interval": (R0.t[4] + 2e-4, R0.t[4] + 1.1e-3),
    "whole": (R0.t[0], R0.t[-1]),
    "no time": (R0.t[3] + 1e-4, R0.t[3] + 1e-4),
}


@each("intrinsics", [None, INTRINSICS])
@each("backwards", [False, True])
@each("span", SPANS)
def test_increments_are_products_of_matrix_exponentials(span, backwards, intrinsics):
    """Steps of 2 to 11 ms, whose rates change by up to 3 rad/s. Second-order terms, here 2e-4 m/s, are those of
    readings as recorded, and the intrinsics are errors of 2 %."""
    t0, t1 = SPANS[span][::-1] if backwards else SPANS[span]
    bias = BIAS if intrinsics is not None else np.zeros(6)
    if span == "whole":  # and a little beyond the last reading, which holds there
        t1 += np.copysign(0.004, t1 - t0)
    found, expected = (of(R0, t0, t1, bias, intrinsics=intrinsics) for of in (run, by_expm))
    assert_same(found, expected, 5e-6 if intrinsics is None else 3e-5)


@each("angle", ANGLES)
@each("backwards", [False, True])
def test_one_step_at_every_angle_with_unit_force(angle, backwards):
    r = Irregular.constant(np.array([0.0, 1.0]), angle * UNIT, UNIT[[1, 2, 0]])
    t0, t1 = (1.0, 0.0) if backwards else (0.0, 1.0)
    zero = np.zeros(6)
    assert_same(run(r, t0, t1, zero), by_expm(r, t0, t1, zero, parts=1), 1e-14)


def wave_errors(rate_hz, sampling):
    """(3,) RMS error of rotation [rad], velocity [m/s] and position [m] over 50 ms of a motion in closed form."""
    reference = reference_motion(handheld(), np.random.default_rng(0))
    period = 1.0 / rate_hz
    t = np.arange(0.0, 6.0, period)
    nodes, weights = np.polynomial.legendre.leggauss(6)
    spread = [0.0] if sampling == "instantaneous" else 0.5 * period * (nodes - 1.0)
    weights = [1.0] if sampling == "instantaneous" else 0.5 * weights
    x = np.sum([w * reference.readings_at(t + s) for w, s in zip(weights, spread, strict=True)], axis=0)
    stream = ImuStream("imu0", np.round(t * 1e9).astype(np.int64), x[:, :3].copy(), x[:, 3:].copy())
    r = Irregular()
    imu = ImuData.build(stream, ImuNoise(1e-4, 1e-5, 1e-3, 1e-4), sampling=sampling)
    gyro, accel, r.means = imu.signals
    r.t, r.values = t, np.hstack([gyro, accel])
    r.variance, gravity, errors = imu.variance, np.array([0.0, 0.0, -9.81]), []
    for t0 in np.arange(1.0013, 5.0, 0.3):
        for begin, end in ((t0, t0 + 0.05), (t0 + 0.05, t0)):
            (R0_, R1), (p0, p1), (v0, v1) = reference.pose_at(np.array([begin, end]))
            R, v, p, *_ = run(r, begin, end, np.zeros(6), width=0)
            dt = end - begin
            moved = v1 - v0 - gravity * dt, p1 - p0 - v0 * dt - 0.5 * gravity * dt**2
            turn = Rotation.from_matrix(R.T @ R0_.T @ R1).as_rotvec()
            errors.append([turn, v - R0_.T @ moved[0], p - R0_.T @ moved[1]])
    return np.sqrt((np.array(errors) ** 2).mean(axis=(0, 2)))


@pytest.mark.parametrize("sampling", ["instantaneous", "interval-mean"])
def test_errors_are_far_below_noise_and_fall_with_the_period(sampling):
    """The mean of two readings as a constant step leaves 1e-4 rad at 100 Hz, and falls with the square."""
    slow, fast = wave_errors(100.0, sampling), wave_errors(200.0, sampling)
    assert (slow < [1e-7, 1e-6, 1e-7]).all(), slow
    assert (fast < slow / 5.0).all(), (slow, fast)


def test_forwards_and_back_is_nothing():
    t0, t1 = SPANS["between stamps"]
    R, v, p, *_ = run(R0, t0, t1)
    Rb, vb, pb, *_ = run(R0, t1, t0)
    np.testing.assert_allclose(R @ Rb, np.eye(3), atol=1e-14)
    np.testing.assert_allclose(v + R @ vb, 0.0, atol=1e-14)
    # dt^4 w^2 e / 24 with dt = 0.01 s, w = 2 rad/s, e = 10 m/s^2: the change of the force has the axes of the start
    np.testing.assert_allclose(p + v * (t0 - t1) + R @ pb, 0.0, atol=3e-8)


@pytest.mark.parametrize("backwards", [False, True])
def test_starting_in_either_interval_at_a_stamp_is_the_same(backwards):
    t0, t1 = (R0.t[6], R0.t[3]) if backwards else (R0.t[3], R0.t[6])
    i = R0.interval(t0)
    for a, b in zip(run(R0, t0, t1, first=i)[:4], run(R0, t0, t1, first=i - 1)[:4], strict=True):
        np.testing.assert_allclose(a, b, atol=1e-15)


@each("order", ["of keyframes", "of time", "any"])
@each("width", [0, 6, 30])
def test_what_is_carried_on_is_what_starts_anew(order, width):
    """Bit by bit, whatever the order; instants lie on stamps and keyframes, between, and beyond both ends."""
    rng = np.random.default_rng(3)
    seconds = np.array([R0.t[2], 0.5 * (R0.t[5] + R0.t[6]), R0.t[9]])
    times = np.sort(np.concatenate([rng.uniform(R0.t[0] - 0.01, R0.t[-1] + 0.01, 60), R0.t[3:8], seconds]))
    keyframe = np.clip(np.searchsorted(0.5 * (seconds[1:] + seconds[:-1]), times), 0, 2)
    ways = {
        "of keyframes": in_order_of_keyframes(times, keyframe, seconds),
        "of time": np.arange(68),
        "any": rng.permutation(68),
    }
    readings = R0.readings()
    by, carried, x, none = correction(INTRINSICS), empty_prefix(), np.empty(RUN_SIZE), np.empty(0)
    for i in ways[order]:
        k = keyframe[i]
        out = Increment(np.empty((3, 3)), np.empty(3), np.empty(3), np.empty((9, width)), np.empty((0, 0)))
        first, bias = R0.interval(seconds[k]), tuple(BIAS)
        end = integrate_from_keyframe(k, seconds[k], times[i], first, bias, readings, by, carried, x, width)
        finish(x, none, out)
        anew = run(R0, seconds[k], times[i], intrinsics=INTRINSICS, width=width)
        for a, b in zip((*out[:4], *end), (*anew[:4], *anew[5]), strict=True):
            np.testing.assert_array_equal(a, b)


def test_instants_lead_away_from_their_keyframes():
    times, keyframe = np.array([0.1, 0.4, 0.5, 0.7, 0.9, 1.2]), np.array([0, 0, 0, 1, 1, 1])
    assert in_order_of_keyframes(times, keyframe, np.array([0.5, 1.0])).tolist() == [2, 5, 4, 3, 1, 0]


@pytest.mark.parametrize("backwards", [False, True])
def test_rate_and_force_at_the_end_are_those_of_the_signal(backwards):
    t0, t1 = SPANS["between stamps"][::-1] if backwards else SPANS["between stamps"]
    w, f = corrected_at(R0, t1, BIAS, INTRINSICS)
    rate, force = run(R0, t0, t1, intrinsics=INTRINSICS)[5]
    np.testing.assert_allclose(rate, w, atol=1e-14)
    np.testing.assert_allclose(force, f, atol=1e-13)


@each("intrinsics", [np.zeros(24), INTRINSICS])
@each("backwards", [False, True])
@each("span", ["between stamps", "stamp to stamp", "within one interval", "whole"])
def test_jacobians_by_central_differences(span, backwards, intrinsics):
    t0, t1 = SPANS[span][::-1] if backwards else SPANS[span]
    R, _, _, J, _, _ = run(R0, t0, t1, intrinsics=intrinsics, width=30)
    h = 1e-5
    for n in range(30):
        d = h * np.eye(30)[n]
        plus = run(R0, t0, t1, BIAS + d[:6], intrinsics + d[6:])
        minus = run(R0, t0, t1, BIAS - d[:6], intrinsics - d[6:])
        np.testing.assert_allclose(J[:, n], difference(plus, minus, R, h), rtol=1e-7, atol=1e-9, err_msg=str(n))


@each("angle", ANGLES)
def test_bias_jacobian_of_one_step_at_every_angle(angle):
    r = Irregular.constant(np.array([0.0, 1.0]), angle * UNIT, UNIT[[1, 2, 0]])
    zero, h = np.zeros(6), 1e-5
    R, _, _, J, _, _ = run(r, 0.0, 1.0, zero)
    for n in range(6):
        d = h * np.eye(6)[n]
        numeric = difference(run(r, 0.0, 1.0, d), run(r, 0.0, 1.0, -d), R, h)
        np.testing.assert_allclose(J[:, n], numeric, rtol=0, atol=1e-9, err_msg=str(n))


def test_narrow_and_wide_jacobian_agree():
    t0, t1 = SPANS["between stamps"]
    narrow, wide = run(R0, t0, t1, intrinsics=INTRINSICS), run(R0, t0, t1, intrinsics=INTRINSICS, width=30)
    np.testing.assert_array_equal(narrow[3], wide[3][:, :6])


def test_a_larger_bias_means_less_rotation_velocity_and_position():
    J = run(R0, R0.t[0], R0.t[-1])[3]
    assert (np.diag(J[:3, :3]) < 0).all()
    assert (np.diag(J[3:6, 3:6]) < 0).all()
    assert (np.diag(J[6:9, 3:6]) < 0).all()


def noise_columns(r, t0, t1, intrinsics):
    """(15, m): what each unit noise does to the errors at t1: readings of each interval, then steps of the biases."""
    R = run(r, t0, t1, intrinsics=intrinsics)[0]
    first, last = r.interval(t0), r.interval(t1 - 1e-12)
    h, columns = 1e-4, []

    def moved(bias_of):
        # One interval after the other, each with its own bias, composed by hand.
        steps = []
        for j in range(first, last + 1):
            begin, end = max(t0, r.t[j]), min(t1, r.t[j + 1])
            steps.append(generator(*corrected_at(r, 0.5 * (begin + end), bias_of(j), intrinsics)) * (end - begin))
        X = np.linalg.multi_dot(expm(np.array(steps)))
        return X[:3, :3], X[:3, 3], X[:3, 4]

    for j in range(first, last + 1):
        dt = min(t1, r.t[j + 1]) - max(t0, r.t[j])
        for k in range(6):
            d = h * np.eye(6)[k]
            white = difference(
                moved(lambda i, j=j, d=d: BIAS - d * (i == j)), moved(lambda i, j=j, d=d: BIAS + d * (i == j)), R, h
            )
            walk = difference(
                moved(lambda i, j=j, d=d: BIAS + d * (i > j)), moved(lambda i, j=j, d=d: BIAS - d * (i > j)), R, h
            )
            columns.append(np.concatenate([white, np.zeros(6)]) * np.sqrt(r.variance[j, k // 3] / dt))
            columns.append(np.concatenate([walk, np.eye(6)[k]]) * np.sqrt(r.walk[k // 3] * dt))
    return np.array(columns).T


@pytest.mark.parametrize("intrinsics", [np.zeros(24), INTRINSICS], ids=["ideal", "intrinsics"])
def test_covariance_is_that_of_all_noises_one_by_one(intrinsics):
    t0, t1 = R0.t[1] + 1e-3, R0.t[5] + 2e-3
    r = Irregular()
    r.values[:], r.means[:] = R0.values[3], R0.values[3]  # constant, so that a step is a matrix exponential
    P = run(r, t0, t1, intrinsics=intrinsics, covariance=True)[4]
    C = noise_columns(r, t0, t1, intrinsics)
    scale = np.sqrt(np.diag(P))
    np.testing.assert_allclose(P / np.outer(scale, scale), C @ C.T / np.outer(scale, scale), atol=1e-7)


def test_covariance_against_sampled_readings():
    """Readings at rate f have noise of density times sqrt(f); biases walk from reading to reading."""
    rate, n, samples = 200.0, 100, 4000
    rng = np.random.default_rng(3)
    r = Irregular(n + 1)
    r.t = np.arange(n + 1) / rate
    phase = 2 * np.pi * r.t[:, None] * [1.1, 0.7, 0.9]
    r.values = np.hstack([np.sin(phase + 1.0), 2.0 * np.cos(phase) + [0.0, 0.0, 9.8]])
    r.means = 0.5 * (r.values[1:] + r.values[:-1])
    r.variance = np.tile([1e-3**2, 1e-2**2, 0.0], (n, 1))
    r.walk = np.array([2e-3**2, 2e-2**2])
    R, v, p, _, P, _ = run(r, 0.0, r.t[-1], covariance=True)

    density, walk = np.sqrt(np.repeat(r.variance[0, :2], 3)), np.sqrt(np.repeat(r.walk, 3))
    readings = r.values + density * np.sqrt(rate) * rng.normal(size=(samples, n + 1, 6))
    steps = walk / np.sqrt(rate) * rng.normal(size=(samples, n + 1, 6))
    steps[:, 0] = 0.0
    wander = np.cumsum(steps, axis=1)
    readings += wander
    mean = 0.5 * (readings[:, 1:] + readings[:, :-1]) - BIAS
    Rs, vs, ps = Rotation.identity(samples), np.zeros((samples, 3)), np.zeros((samples, 3))
    dt = 1.0 / rate
    for i in range(n):
        middle = Rs * Rotation.from_rotvec(0.5 * dt * mean[:, i, :3])
        force = middle.apply(mean[:, i, 3:])
        ps += vs * dt + 0.5 * force * dt**2
        vs += force * dt
        Rs = Rs * Rotation.from_rotvec(dt * mean[:, i, :3])
    # The error of the factor is predicted - measured: the noiseless increments are the true ones here.
    turned = (Rs.inv() * Rotation.from_matrix(R)).as_rotvec()
    errors = np.concatenate([turned, v - vs, p - ps, wander[:, -1]], axis=1)
    errors -= errors.mean(axis=0)
    nees = np.einsum("ni,ij,nj->n", errors, np.linalg.inv(P), errors).mean()
    # 4.5 standard deviations of the mean of 4000 chi^2 of 15 degrees of freedom.
    assert abs(nees - 15.0) < 0.4
    np.testing.assert_allclose(errors.var(axis=0) / np.diag(P), 1.0, atol=0.1)
