"""Where the IMU was at a sensor's instant: three schemes, their Jacobians and time derivatives."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation, Slerp
from tests.cases import each

from icalib.geometry import so3
from icalib.motion.poses import assign_keyframes, poses_and_velocity_derivatives, poses_at
from icalib.motion.sensor_pose import Kinematics, SensorPose, rate_slopes, rows_at, with_slopes
from icalib.optim.state import KEYFRAME_DIM, State

SCHEMES = ("inertial", "kinematic", "pose")


@pytest.fixture(scope="module")
def setup(unlike, setup_of):
    """Keyframes off the stamps of the IMU as well as on them."""
    setup = setup_of(unlike, imu_free=True)
    seconds = np.array([0.05, 0.1013, 0.1487, 0.2, 0.2471])
    R, p, v = setup.truth_at(seconds)
    state = replace(setup.state, seconds=seconds, rotation=R, position=p, velocity=v, bias=setup.state.bias[:5].copy())
    return replace(setup, state=state)


# Between keyframes, on stamps of the IMU, at keyframes, before the first keyframe and after the last.
TIMES = np.array([0.0312, 0.05, 0.0521, 0.0913, 0.105, 0.1251, 0.1488, 0.17, 0.2, 0.2219, 0.26])


def evaluate(setup, scheme, state=None, times=TIMES, imu_free=True):
    keyframe = assign_keyframes(scheme, setup.state.seconds, TIMES)
    return poses_at(scheme, times, keyframe, state or setup.state, setup.imu, 9.81, imu_free), keyframe


def difference(plus, minus, at, h):
    """(n, 6) central difference: rotation on the right, position."""
    Rt = at.rotation.transpose(0, 2, 1)
    turn = so3.log_many(np.ascontiguousarray(Rt @ plus.rotation)) - so3.log_many(
        np.ascontiguousarray(Rt @ minus.rotation)
    )
    return np.concatenate([turn, plus.position - minus.position], axis=1) / (2 * h)


@each("scheme", SCHEMES)
def test_jacobians_of_every_keyframe_by_central_differences(setup, scheme):
    state = setup.perturbed(np.random.default_rng(1))
    at, keyframe = evaluate(setup, scheme, state)
    h, calib = 1e-6, np.zeros(setup.layout.size)
    for k in range(len(state.seconds)):
        for j in range(KEYFRAME_DIM):
            chain = np.zeros((len(state.seconds), KEYFRAME_DIM))
            chain[k, j] = h
            plus, _ = evaluate(setup, scheme, state.retract(setup.layout, chain, calib))
            minus, _ = evaluate(setup, scheme, state.retract(setup.layout, -chain, calib))
            analytic = at.J_keyframe[:, :, j] * (keyframe == k)[:, None]
            if scheme == "pose":
                analytic = analytic + at.J_next[:, :, j] * (keyframe + 1 == k)[:, None]
            np.testing.assert_allclose(analytic, difference(plus, minus, at, h), rtol=0, atol=5e-9, err_msg=f"{k} {j}")


@each("scheme", SCHEMES)
def test_jacobians_of_the_imu_intrinsics_by_central_differences(setup, scheme):
    state = setup.perturbed(np.random.default_rng(2))
    at, _ = evaluate(setup, scheme, state)
    h, chain = 1e-5, np.zeros((len(state.seconds), KEYFRAME_DIM))
    assert at.J_imu.shape == (len(TIMES), 6, 24)
    for n, column in enumerate(setup.layout.columns("imu0", "intrinsics")):
        calib = h * np.eye(setup.layout.size)[column]
        plus, _ = evaluate(setup, scheme, state.retract(setup.layout, chain, calib))
        minus, _ = evaluate(setup, scheme, state.retract(setup.layout, chain, -calib))
        np.testing.assert_allclose(at.J_imu[:, :, n], difference(plus, minus, at, h), rtol=0, atol=5e-9, err_msg=str(n))


@each("scheme", SCHEMES)
def test_the_chain_rule_of_a_sensor_pose_by_central_differences(setup, scheme):
    """Through random rows of a camera's pose, along its own axes: by all keyframes, extrinsics and IMU intrinsics, and
    by the time offset as far as the rate says."""
    rng, h = np.random.default_rng(4), 1e-6
    state, n, o = setup.perturbed(rng), len(TIMES), KEYFRAME_DIM * len(setup.state.seconds)
    kinematics = Kinematics("cam1", setup.layout, setup.imu, 9.81, scheme)
    seconds = TIMES - state.values["cam1", "time_offset"][0]
    keyframe = assign_keyframes(scheme, state.seconds, TIMES)

    def poses(d):
        return SensorPose.at(
            kinematics, seconds, keyframe, state.retract(setup.layout, d[:o].reshape(-1, KEYFRAME_DIM), d[o:])
        )

    at, J_pose = poses(np.zeros(o + setup.layout.size)), rng.normal(size=(n, 2, 6))
    rows = rows_at(np.zeros((n, 2)), (J_pose,), (at,), np.zeros((n, 2, 0)))
    J, columns = np.zeros((n, 2, o + setup.layout.size)), kinematics.columns()
    for i, k in enumerate(keyframe):
        last = min(KEYFRAME_DIM * (k + 2), o)
        J[i, :, KEYFRAME_DIM * k : last] = rows.J[i, :, : last - KEYFRAME_DIM * k]
    J[:, :, o + columns] = rows.J_calib
    offset = o + columns[6]
    assert len(columns) == 32
    for column in [*range(o), *(o + columns)]:
        d = h * np.eye(o + setup.layout.size)[column]
        found = difference(poses(d), poses(-d), at, h)
        found[:, 3:] = np.einsum("nij,nj->ni", at.R_sensor_world, found[:, 3:])
        expected = np.einsum("nqk,nk->nq", J_pose, found)
        atol = 2e-3 if column == offset else 5e-8
        np.testing.assert_allclose(J[:, :, column], expected, rtol=0, atol=atol, err_msg=str(column))


def motion(setup, state=None, times=TIMES, imu_free=True):
    keyframe = assign_keyframes("inertial", setup.state.seconds, TIMES)
    return *poses_and_velocity_derivatives(times, keyframe, state or setup.state, setup.imu, 9.81, imu_free), keyframe


def test_motion_has_the_inertial_poses(setup):
    at, _ = evaluate(setup, "inertial")
    poses, _, _ = motion(setup)
    for name in ("rotation", "position", "rate", "velocity", "J_keyframe", "J_next", "J_imu"):
        np.testing.assert_array_equal(getattr(poses, name), getattr(at, name))


def test_jacobians_of_the_velocity_by_central_differences(setup):
    state = setup.perturbed(np.random.default_rng(5))
    _, moving, keyframe = motion(setup, state)
    n, h = len(state.seconds), 1e-6
    for column in range(n * KEYFRAME_DIM + setup.layout.size):
        d = h * np.eye(1, n * KEYFRAME_DIM + setup.layout.size, column)[0]
        chain, calib = d[: n * KEYFRAME_DIM].reshape(n, KEYFRAME_DIM), d[n * KEYFRAME_DIM :]
        plus, minus = (motion(setup, state.retract(setup.layout, s * chain, s * calib))[0] for s in (1.0, -1.0))
        numeric = (plus.velocity - minus.velocity) / (2.0 * h)
        if column < n * KEYFRAME_DIM:
            analytic = moving.J_keyframe[:, :, column % KEYFRAME_DIM] * (keyframe == column // KEYFRAME_DIM)[:, None]
        elif (k := column - n * KEYFRAME_DIM) in (own := list(setup.layout.columns("imu0", "intrinsics"))):
            analytic = moving.J_imu[:, :, own.index(k)]
        elif k in setup.layout.columns("board0", "tilt"):
            continue  # turns the whole state with it
        else:
            analytic = np.zeros((len(TIMES), 3))
        np.testing.assert_allclose(analytic, numeric, rtol=0, atol=5e-9, err_msg=str(column))


def test_acceleration_is_the_time_derivative_of_the_velocity(setup):
    """To within the part of an interval (2.5 ms at most) times how fast the force changes: see below."""
    state, h = setup.perturbed(np.random.default_rng(6)), 1e-6
    _, moving, _ = motion(setup, state)
    plus, minus = (motion(setup, state, TIMES + d)[0] for d in (h, -h))
    np.testing.assert_allclose(moving.acceleration, (plus.velocity - minus.velocity) / (2 * h), rtol=0, atol=2e-3)


# Rate and velocity of `inertial` are those at the end, without the third-order terms of the step (readings 5 ms apart).
@each(("scheme", "rate", "velocity"), [("inertial", 2e-6, 2e-5), ("kinematic", 1e-8, 1e-8), ("pose", 1e-8, 1e-8)])
def test_rate_and_velocity_are_the_time_derivative(setup, scheme, rate, velocity):
    state, h = setup.perturbed(np.random.default_rng(3)), 1e-6
    at, _ = evaluate(setup, scheme, state)
    plus, minus = (evaluate(setup, scheme, state, TIMES + d)[0] for d in (h, -h))
    numeric = difference(plus, minus, at, h)
    np.testing.assert_allclose(at.rate, numeric[:, :3], rtol=0, atol=rate)
    np.testing.assert_allclose(at.velocity, numeric[:, 3:], rtol=0, atol=velocity)


def test_inertial_has_no_jumps_at_the_stamps_of_the_imu(setup):
    stamps = setup.imu.seconds[(setup.imu.seconds > 0.06) & (setup.imu.seconds < 0.24)]
    keyframe = assign_keyframes("inertial", setup.state.seconds, stamps)
    before, after = (
        poses_at("inertial", stamps + d, keyframe, setup.state, setup.imu, 9.81, False) for d in (-1e-9, 1e-9)
    )
    np.testing.assert_allclose(after.rotation, before.rotation, rtol=0, atol=1e-7)
    np.testing.assert_allclose(after.rate, before.rate, rtol=0, atol=1e-6)


def test_shapes_without_what_is_not_wanted(setup):
    inertial, _ = evaluate(setup, "inertial", imu_free=False)
    assert inertial.J_imu.shape == (len(TIMES), 6, 0)
    assert inertial.J_next.shape == (0, 6, KEYFRAME_DIM)


def parabola(imu, t):
    """Readings (n, 6) at t (n,): between stamps those of the parabola through both and of the signal's mean."""
    gyro, accel, means = imu.signals
    values = np.hstack([gyro, accel])
    j = imu.interval(t)
    u = ((t - imu.seconds[j]) / (imu.seconds[j + 1] - imu.seconds[j]))[:, None]
    bend = 6.0 * means[j] - 3.0 * (values[j] + values[j + 1])
    return values[j] + u * (values[j + 1] - values[j]) + bend * u * (1.0 - u)


def test_inertial_follows_the_true_trajectory(setup):
    keyframes = np.array([0.05, 0.2])
    R, p, v = setup.truth_at(keyframes)
    state = replace(setup.state, seconds=keyframes, rotation=R, position=p, velocity=v, bias=setup.state.bias[:2])
    times = setup.imu.seconds[setup.imu.seconds < 0.3]
    at = poses_at("inertial", times, assign_keyframes("inertial", keyframes, times), state, setup.imu, 9.81, False)
    R, p, v = setup.truth_at(times)
    np.testing.assert_allclose(at.rotation, R, rtol=0, atol=1e-7)
    np.testing.assert_allclose(at.position, p, rtol=0, atol=3e-8)
    np.testing.assert_allclose(at.velocity, v, rtol=0, atol=1e-6)


def test_inertial_follows_readings_between_stamps(setup):
    """3.7 ms into an interval, against 200 small steps of the interpolated readings."""
    state, imu, dt = setup.state, setup.imu, 3.7e-3 / 200
    R, p, v = state.rotation[3], state.position[3], state.velocity[3]
    for i in range(200):
        raw = parabola(imu, np.array([0.2 + (i + 0.5) * dt]))[0] - state.bias[3]
        intrinsics = state.values["imu0", "intrinsics"]
        rate, force = corrected_rate(intrinsics, raw[None])[0], corrected_force(intrinsics, raw[None])[0]
        force = R @ Rotation.from_rotvec(0.5 * dt * rate).apply(force) + [0.0, 0.0, -9.81]
        p = p + v * dt + 0.5 * force * dt**2
        v = v + force * dt
        R = R @ Rotation.from_rotvec(rate * dt).as_matrix()
    at = poses_at("inertial", np.array([0.2037]), np.array([3]), state, imu, 9.81, False)
    np.testing.assert_allclose(at.rotation[0], R, rtol=0, atol=1e-7)
    np.testing.assert_allclose(at.position[0], p, rtol=0, atol=1e-6)
    np.testing.assert_allclose(at.velocity[0], v, rtol=0, atol=1e-5)


def test_pose_interpolates_rotation_on_the_geodesic_and_position_linearly(setup):
    at, _ = evaluate(setup, "pose")
    state = setup.state
    inside = np.clip(TIMES, state.seconds[0], state.seconds[-1]) == TIMES
    expected = Slerp(state.seconds, Rotation.from_matrix(state.rotation))(TIMES[inside]).as_matrix()
    np.testing.assert_allclose(at.rotation[inside], expected, rtol=0, atol=1e-14)
    position = np.array([np.interp(TIMES[inside], state.seconds, x) for x in state.position.T]).T
    np.testing.assert_allclose(at.position[inside], position, rtol=0, atol=1e-15)


def test_kinematic_keeps_the_rate_and_velocity_of_the_keyframe(setup):
    at, keyframe = evaluate(setup, "kinematic")
    state = setup.state
    dt = TIMES - state.seconds[keyframe]
    raw = parabola(setup.imu, state.seconds[keyframe])
    rate = corrected_rate(state.values["imu0", "intrinsics"], raw - state.bias[keyframe])
    np.testing.assert_allclose(at.rate, rate, rtol=0, atol=1e-13)
    np.testing.assert_allclose(at.velocity, state.velocity[keyframe], rtol=0, atol=0)
    expected = state.rotation[keyframe] @ Rotation.from_rotvec(rate * dt[:, None]).as_matrix()
    np.testing.assert_allclose(at.rotation, expected, rtol=0, atol=1e-13)
    np.testing.assert_allclose(
        at.position, state.position[keyframe] + state.velocity[keyframe] * dt[:, None], atol=1e-15
    )


LOWER = ([0, 1, 1, 2, 2, 2], [0, 0, 1, 0, 1, 2])


def corrected_force(intrinsics, readings):
    M_a, C = np.eye(3), Rotation.from_rotvec(intrinsics[12:15]).as_matrix()
    M_a[LOWER] += intrinsics[:6]
    return np.linalg.solve(M_a @ C, readings[:, 3:].T).T


def corrected_rate(intrinsics, readings):
    M_g = np.eye(3)
    M_g[LOWER] += intrinsics[6:12]
    sensed = corrected_force(intrinsics, readings) @ intrinsics[15:].reshape(3, 3).T
    return np.linalg.solve(M_g, (readings[:, :3] - sensed).T).T


@each("scheme", SCHEMES)
def test_at_a_keyframe_every_scheme_gives_the_keyframe(setup, scheme):
    state = setup.perturbed(np.random.default_rng(4))
    keyframe = assign_keyframes(scheme, state.seconds, state.seconds)
    at = poses_at(scheme, state.seconds, keyframe, state, setup.imu, 9.81, False)
    np.testing.assert_allclose(at.rotation, state.rotation, rtol=0, atol=1e-14)
    np.testing.assert_allclose(at.position, state.position, rtol=0, atol=1e-15)


N_KEYFRAMES = np.array([0.0, 1.0, 3.0])


@each("scheme", ["inertial", "kinematic"])
@each(
    ("time", "keyframe"),
    [(-5.0, 0), (0.0, 0), (0.4, 0), (0.6, 1), (1.0, 1), (1.9, 1), (2.1, 2), (3.0, 2), (9.0, 2)],
)
def test_nearest_keyframe(scheme, time, keyframe):
    assert assign_keyframes(scheme, N_KEYFRAMES, np.array([time]))[0] == keyframe


@each("rounding", [-1e-9, 0.0, 1e-9])
@each("time", [0.5, 2.0])
def test_in_the_middle_the_earlier_keyframe_is_taken_whatever_the_rounding(time, rounding):
    nearest = assign_keyframes("inertial", N_KEYFRAMES, np.array([time + rounding]))[0]
    assert N_KEYFRAMES[nearest] < time


@each(("time", "keyframe"), [(-1.0, 0), (0.0, 0), (0.9, 0), (1.0, 1), (2.9, 1), (3.0, 1), (4.0, 1)])
def test_pose_takes_the_keyframe_before_that_has_one_after(time, keyframe):
    assert assign_keyframes("pose", N_KEYFRAMES, np.array([time]))[0] == keyframe


def test_slopes_are_the_change_of_a_rate_within_an_image():
    """Angular acceleration about z and jerk along x of a sensor beside the body, from rest."""
    slope, t, arm = np.array([0.0, 0.0, 3.0, 6.0, 0.0, 0.0]), np.array([-0.015, 0.0, 0.01]), np.array([0.2, 0.0, 0.0])
    seconds = np.array([0.0, 0.05, 0.1, 0.15, 0.2])
    nothing = np.zeros((5, 0))
    state = State(seconds, nothing, nothing, nothing, -seconds[:, None] * slope, {})
    slopes = rate_slopes(state)
    np.testing.assert_allclose(slopes, np.tile(slope, (5, 1)), atol=1e-12)
    still, eyes, none = np.zeros((3, 3)), np.tile(np.eye(3), (3, 1, 1)), np.zeros((0, 6, 15))
    at = SensorPose(np.eye(3), arm, eyes, still + arm, still, still, none, none, np.zeros((3, 6, 0)), np.zeros(3))
    moved = with_slopes(at, slopes[:3], t)
    turn = so3.exp_many(np.outer(t**2 / 2.0, slope[:3]))
    np.testing.assert_allclose(moved.rotation, turn, atol=1e-12)
    np.testing.assert_allclose(moved.rate, np.outer(t, slope[:3]), atol=1e-12)
    np.testing.assert_allclose(moved.position, turn @ arm + np.outer(t**3 / 6.0, slope[3:]), atol=1e-7)
