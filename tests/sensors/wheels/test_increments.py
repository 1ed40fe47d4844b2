"""Increments of the wheels on the obvious path: residuals, accuracy of the integral, signs, losses."""

from dataclasses import replace

import numpy as np
import pytest

from icalib.optim.arrowhead import make_pieces
from icalib.optim.state import make_layout
from icalib.sensors.wheels.residual import IncrementFactor, WheelNoise

UNIT = WheelNoise(1.0, 1.0, 1.0)


def factor_on(world, noise=UNIT):
    return IncrementFactor.build("wheel0", world.seconds, world.angles, world.motion(), noise, world.layout)


def output(factor, state, sums=True):
    out = factor.output()
    pieces = make_pieces(len(state.seconds), factor.layout.size)
    return out, sum(factor.accumulate(state, p, out, sums) for p in pieces), pieces


def raw_residuals(factor, state):
    """(n, 4) rad, rad, m, m."""
    out, _, _ = output(factor, state, sums=False)
    return out.residual / np.diagonal(factor.whitening, axis1=1, axis2=2)


# What is left on hills is dt^3 w x w' / 12: the logarithm of a rotation is not the integral of its rate.
@pytest.mark.parametrize(("kind", "wheel", "slip"), [("planar", 2e-7, 1e-8), ("hills", 1e-5, 2e-6)])
def test_residuals_vanish_on_a_path_without_slip(drive_of_kind, world_of, kind, wheel, slip):
    world = world_of(drive_of_kind(kind, 1))
    r = raw_residuals(factor_on(world), world.state)
    assert len(r) > 70 and np.abs(world.angles).max() > 20.0
    assert np.abs(r[:, :2]).max() < wheel and np.abs(r[:, 2:]).max() < slip


def test_residuals_vanish_where_stamps_are_rarer_than_keyframes(drive_of_kind, world_of):
    world = world_of(drive_of_kind("planar", 2), wheel_hz=8.0, keyframe_s=0.025)
    r = raw_residuals(factor_on(world), world.state)
    assert len(r) > 28
    assert np.abs(r[:, :2]).max() < 2e-6 and np.abs(r[:, 2:]).max() < 1e-7


def brisk(drive_of_kind, waves):
    """60 deg/s and 5 m/s^2 at their largest; 20 Hz of vibration with 3 m/s^2 along the way besides."""
    speed = waves(1.0, (0.8, 3.0 / (40.0 * np.pi)), (1.0, 20.0), (0.3, 1.1))
    return replace(drive_of_kind("planar"), yaw=waves(0.0, (1.05,), (0.159,), (0.2,)), speed=speed)


@pytest.mark.parametrize(("keyframe_s", "bound"), [(0.05, 2e-5), (0.5, 2e-4)])
def test_the_integral_of_brisk_motion_is_good_to_hundredths_of_a_millimetre(
    drive_of_kind, world_of, waves, keyframe_s, bound
):
    """Against Gauss's four points every 2 ms. Readings at 1 kHz, so that they hold the vibration."""
    world = world_of(brisk(drive_of_kind, waves), imu_hz=1000.0, wheel_hz=100.0, keyframe_s=keyframe_s)
    t = np.linspace(0.0, 3.9, 4000)
    assert np.abs(world.drive.speed(t, 1)).max() > 5.0 and np.abs(world.drive.rate(t)).max() > np.deg2rad(59.0)
    r = raw_residuals(factor_on(world), world.state)
    assert np.abs(r[:, :2]).max() * 0.1 < bound and np.abs(r[:, 2:]).max() < bound


def test_a_wheel_that_turned_further_lowers_its_residual(drive_of_kind, world_of):
    world = world_of(drive_of_kind("planar"))
    dt = 1.0 / 70.0
    for wheel in range(2):
        angles = world.angles.copy()
        angles[100:, wheel] += 0.3
        change = raw_residuals(factor_on(replace(world, angles=angles)), world.state)
        hit = np.flatnonzero(change[:, wheel] < -0.29)
        assert len(hit) == 1
        assert change[hit[0], wheel] == pytest.approx(-0.3, abs=1e-6)
        assert abs(change[hit[0], 1 - wheel]) < 1e-6
        assert abs(world.state.seconds[hit[0]] - world.seconds[100] - 0.0123) < 0.05 + dt


def test_rows_are_whitened_by_the_root_of_the_interval(drive_of_kind, world_of):
    world = world_of(drive_of_kind("planar"))
    noise = WheelNoise(0.02, 3e-3, 7e-3)
    factor = factor_on(world, noise)
    moved = world.moved(rotation=[0.01, 0.02, 0.03], radii=np.array([1e-3, -1e-3]))
    root_dt = np.sqrt(world.seconds[factor.intervals.last] - world.seconds[factor.intervals.first])
    expected = raw_residuals(factor_on(world), moved) / root_dt[:, None] / [0.02, 0.02, 3e-3, 7e-3]
    np.testing.assert_allclose(output(factor, moved)[0].residual, expected, rtol=1e-12)


def test_sideways_and_upwards_rows_have_the_signs_of_the_wheels_axes(drive_of_kind, world_of):
    """A frame turned by +d about z sees forward motion to its right, one turned about y (nose down) sees it upwards."""
    world = world_of(drive_of_kind("planar"))
    factor = factor_on(world)
    ahead = raw_residuals(factor, world.state)
    dx = world.angles[factor.intervals.last].mean(1) - world.angles[factor.intervals.first].mean(1)
    yawed = raw_residuals(factor, world.moved(rotation=[0.0, 0.0, 1e-3])) - ahead
    pitched = raw_residuals(factor, world.moved(rotation=[0.0, 1e-3, 0.0])) - ahead
    assert np.all(yawed[dx > 0.1, 2] < 0.0) and np.all(pitched[dx > 0.1, 3] > 0.0)
    assert (dx > 0.1).sum() > 30


@pytest.mark.parametrize("loss", ["huber", "cauchy"])
def test_a_robust_loss_bends_the_row_that_slipped_alone(drive_of_kind, world_of, loss):
    world = world_of(drive_of_kind("planar"))
    angles = world.angles.copy()
    angles[100:, 0] += 0.5
    factor = factor_on(replace(world, angles=angles), WheelNoise(0.02, 5e-3, 5e-3, loss, 2.5))
    out, cost, _ = output(factor, world.state)
    hit = np.abs(out.residual) > 2.5
    assert hit.sum() == 1
    s = float(np.abs(out.residual[hit][0]))
    half, root = {
        "huber": (2.5 * s - 0.5 * 2.5**2, np.sqrt(2.5 / s)),
        "cauchy": (0.5 * 2.5**2 * np.log1p((s / 2.5) ** 2), 1.0 / np.sqrt(1.0 + (s / 2.5) ** 2)),
    }[loss]
    assert cost == pytest.approx(half, rel=1e-6)
    assert out.root[hit][0] == pytest.approx(root, rel=1e-12)
    np.testing.assert_allclose(out.root[~hit], 1.0, rtol=0, atol=1e-6)


def test_fixed_parameters_have_no_columns(drive_of_kind, world_of, dense):
    world = world_of(drive_of_kind("hills"))
    held = ("radii", "translation")
    entries = [
        (b.sensor, b.name, b.kind, b.size, b.start is not None and b.name not in held) for b in world.layout.blocks
    ]
    fewer = replace(world, layout=make_layout(entries))
    moved = world.moved(rotation=[0.01, 0.02, 0.03], radii=np.array([1e-3, -1e-3]))
    H, g = dense(output(factor_on(world), moved)[2], len(world.state.seconds))
    kept = [*range(15 * len(world.state.seconds))]
    kept += [kept[-1] + 1 + i for i in (0, 1, 2, 6, 9)]
    H1, g1 = dense(output(factor_on(fewer), moved)[2], len(world.state.seconds))
    np.testing.assert_allclose(H1, H[np.ix_(kept, kept)], rtol=1e-12, atol=1e-9)
    np.testing.assert_allclose(g1, g[kept], rtol=1e-12, atol=1e-9)
