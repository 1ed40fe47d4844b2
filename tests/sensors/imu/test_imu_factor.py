"""The IMU factor against its formula, written out with numpy, at keyframes of uneven spacing."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from icalib.model.bodies import SIZE
from icalib.motion.integration import Increment, integrate, integration_workspace, readings_of
from icalib.motion.integration_step import COVARIANCE_SIZE, correction
from icalib.optim.arrowhead import make_pieces
from icalib.sensors.imu.residual import ImuFactor

GRAVITY = np.array([0.0, 0.0, -9.81])


@pytest.fixture(scope="module")
def setup(unlike, setup_of):
    setup = setup_of(unlike, imu_free=True)
    seconds = np.array([0.05, 0.0713, 0.1487, 0.2, 0.2771, 0.3])
    R, p, v = setup.truth_at(seconds)
    bias = setup.state.bias[: len(seconds)].copy()
    return replace(setup, state=replace(setup.state, seconds=seconds, rotation=R, position=p, velocity=v, bias=bias))


@pytest.fixture(scope="module")
def factor(setup):
    return ImuFactor.build(setup.imu, setup.state, 9.81, setup.layout)


def whitened(factor, setup, state):
    """Half the chi^2, and the whitened residuals."""
    out = factor.output()
    pieces = make_pieces(len(state.seconds), setup.layout.size)
    return sum(factor.accumulate(state, p, out, sums=False) for p in pieces), out.residual


def test_no_residual_at_the_truth(factor, setup):
    """Unwhitened, in rad, m/s, m: the interpolation between readings leaves 1 % of their noise at most."""
    _, out = whitened(factor, setup, setup.state)
    np.testing.assert_allclose(np.linalg.solve(factor.increments.W, out[..., None]), 0.0, atol=3e-7)


def test_residual_is_the_formula(factor, setup):
    state = setup.perturbed(np.random.default_rng(1))
    cost, out = whitened(factor, setup, state)
    dx = state.values["imu0", "intrinsics"] - setup.state.values["imu0", "intrinsics"]
    for k, dt in enumerate(np.diff(state.seconds)):
        change = factor.increments.J[k] @ np.concatenate([state.bias[k] - factor.increments.bias0[k], dx])
        dR = factor.increments.dR[k] @ Rotation.from_rotvec(change[:3]).as_matrix()
        Rt, v = state.rotation[k].T, state.velocity
        turn = Rotation.from_matrix(dR.T @ Rt @ state.rotation[k + 1]).as_rotvec()
        gained_v = Rt @ (v[k + 1] - v[k] - GRAVITY * dt)
        gained_p = Rt @ (state.position[k + 1] - state.position[k] - v[k] * dt - GRAVITY * dt**2 / 2)
        residual = np.concatenate(
            [
                turn,
                gained_v - factor.increments.dv[k] - change[3:6],
                gained_p - factor.increments.dp[k] - change[6:],
                state.bias[k + 1] - state.bias[k],
            ]
        )
        np.testing.assert_allclose(np.linalg.solve(factor.increments.W[k], out[k]), residual, rtol=0, atol=1e-13)
    assert cost == pytest.approx(0.5 * (out**2).sum(), rel=1e-13)


def test_residuals_are_whitened_with_the_covariance_of_the_increments(factor, setup):
    imu, t = setup.imu, setup.state.seconds
    for k, first in enumerate(imu.interval(t[:-1])):
        P, J = np.empty((15, 15)), np.empty((9, 6))
        out = Increment(np.empty((3, 3)), np.empty(3), np.empty(3), J, P)
        by, room, bias = (
            correction(setup.state.values["imu0", "intrinsics"]),
            integration_workspace(COVARIANCE_SIZE),
            tuple(setup.state.bias[k]),
        )
        integrate(t[k], t[k + 1], first, bias, readings_of(imu), by, room, out)
        np.testing.assert_allclose(factor.increments.W[k] @ P @ factor.increments.W[k].T, np.eye(15), rtol=0, atol=1e-9)
        assert (np.triu(factor.increments.W[k], 1) == 0).all()
        np.testing.assert_allclose(factor.increments.J[k, :, :6], J, rtol=0, atol=1e-15)


@pytest.mark.parametrize("scale", [0.8, 1.3])
def test_an_assumed_motion_that_is_larger_in_a_larger_unit_has_the_same_residuals(setup, scale):
    """Noise in metres would prefer the smaller one."""
    imu = replace(setup.imu, gyro=np.zeros_like(setup.imu.gyro), accel=np.zeros_like(setup.imu.accel), unit=SIZE)
    values = setup.state.values | {SIZE: np.ones(1), ("imu0", "intrinsics"): np.zeros(24)}
    state = replace(setup.perturbed(np.random.default_rng(3)), values=values)
    factor = ImuFactor.build(imu, state, 0.0, setup.layout)
    size = {"position": scale * state.position, "velocity": scale * state.velocity}
    bias = state.bias * np.repeat([1.0, scale], 3)
    scaled = replace(state, **size, bias=bias, values=state.values | {SIZE: np.array([scale])})
    _, expected = whitened(factor, setup, state)
    _, found = whitened(factor, setup, scaled)
    assert np.abs(expected).max() > 1.0
    np.testing.assert_allclose(found, expected, rtol=1e-9, atol=1e-9 * np.abs(expected).max())


def test_corrections_by_bias_and_intrinsics_are_right_to_first_order(factor, setup):
    """Half the change leaves a quarter of the error against preintegration anew."""
    rng = np.random.default_rng(2)
    chain = np.zeros((len(setup.state.seconds), 15))
    chain[:, 9:] = rng.normal(size=(1, 6)) * np.repeat([1e-2, 1e-1], 3)
    calib = np.zeros(setup.layout.size)
    calib[setup.layout.columns("imu0", "intrinsics")] = 1e-2 * rng.normal(size=24)
    left = []
    for size in (1.0, 0.5):
        state = setup.state.retract(setup.layout, size * chain, size * calib)
        anew = ImuFactor.build(setup.imu, state, 9.81, setup.layout)
        a, b = (np.linalg.solve(f.increments.W, whitened(f, setup, state)[1][..., None]) for f in (factor, anew))
        left.append(np.abs(a - b).max())
    assert 0.2 < left[1] / left[0] < 0.3
