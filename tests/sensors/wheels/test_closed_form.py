"""The classical closed form for differential drives as a cross-check of the increments.

Censi, Franchi, Marchionni and Oriolo, "Simultaneous calibration of odometry and sensor parameters for mobile robots",
IEEE Trans. on Robotics 29(2), 2013: a robot that drives stretches at constant rates, and a sensor on it that sees its
own way (x, y, yaw) over each. First the yaws give J21 = -r_l / b and J22 = r_r / b linearly; then

    R(l_yaw) s + l = R(yaw) l + b c      (sensor and robot go the same way round)

is linear in (b, l_x, l_y, cos l_yaw, sin l_yaw), and least squares of it under cos^2 + sin^2 = 1 a quadratic equation
for the multiplier.
"""

from dataclasses import replace

import numpy as np
from tests.typed import not_none

from icalib.sensors.wheels.residual import WheelNoise

from .test_calibration import FREE, PINNED, Slipping, away, level_drive, noisy, pinned, solve

NOISE = WheelNoise(2e-3, 1e-4, 1e-4)
POSE_SIGMA = 2e-4, 3e-4  # rad, m
STRIDE = 5  # keyframes from one end of a stretch to the other: 0.25 s


def closed_form(turned, ways):
    """(6,) left and right radius, baseline, and x, y, yaw of the sensor in the robot's frame; turned (n, 2) rad of the
    wheels and ways (n, 3) x, y, yaw of the sensor over n stretches."""
    J21, J22 = np.linalg.lstsq(turned, ways[:, 2], rcond=None)[0]
    yaw = turned @ [J21, J22]
    path = 0.5 * turned @ [-J21, J22]  # over b
    cx, cy = path * np.sinc(yaw / np.pi), path * np.sinc(0.5 * yaw / np.pi) * np.sin(0.5 * yaw)
    one, none = 1.0 - np.cos(yaw), np.sin(yaw)
    x, y = ways[:, 0], ways[:, 1]
    Q = np.concatenate([np.stack([-cx, one, none, x, -y], axis=1), np.stack([-cy, -none, one, y, x], axis=1)])
    M = Q.T @ Q
    candidates = [normalised(M, multiplier) for multiplier in multipliers(M)]
    b, lx, ly, c, s = min(candidates, key=lambda phi: phi @ M @ phi)
    return np.array([-b * J21, b * J22, b, lx, ly, np.arctan2(s, c)])


def multipliers(M):
    """det(M + m diag(0, 0, 0, 1, 1)) = 0: two roots, of the Schur complement of the first three."""
    S = M[3:, 3:] - M[3:, :3] @ np.linalg.solve(M[:3, :3], M[:3, 3:])
    return -np.linalg.eigvalsh(S)


def normalised(M, multiplier):
    """The vector that M + m W maps to nothing, of length one in cos and sin, with a baseline above zero."""
    phi = np.linalg.svd(M + multiplier * np.diag([0.0, 0.0, 0.0, 1.0, 1.0]))[2][-1]
    phi = phi / np.hypot(phi[3], phi[4])
    return np.copysign(1.0, phi[0]) * phi


def ways_of(R, p):
    """(n, 3) x, y, yaw from each pose to the next, seen from the first."""
    steps = np.einsum("nji,nj->ni", R[:-1], np.diff(p, axis=0))
    turn = np.einsum("nji,njk->nik", R[:-1], R[1:])
    return np.column_stack([steps[:, :2], np.arctan2(turn[:, 1, 0], turn[:, 0, 0])])


def sensor_on_robot(R_imu_wheel, p_imu_wheel):
    """(3,) x, y, yaw of the IMU in the wheels' frame."""
    lever = -R_imu_wheel.T @ p_imu_wheel
    return np.array([lever[0], lever[1], np.arctan2(R_imu_wheel[0, 1], R_imu_wheel[0, 0])])


def truth_of(world):
    drive = world.drive
    return np.concatenate([drive.radii, [drive.baseline], sensor_on_robot(drive.R_imu_wheel, drive.p_imu_wheel)])


def by_closed_form(world, angles, R, p):
    """Over stretches of 0.25 s, their rates not quite constant."""
    at = world.state.seconds[::STRIDE] - world.state.values["wheel0", "time_offset"][0]
    turned = np.stack([np.interp(at, world.seconds, wheel) for wheel in angles.T], axis=1)
    inside = (at[:-1] >= world.seconds[0]) & (at[1:] <= world.seconds[-1])
    return closed_form(np.diff(turned, axis=0)[inside], ways_of(R[::STRIDE], p[::STRIDE])[inside])


def slow_world(world_of, drive_of_kind, waves, seed, noise_seed=None):
    """Rates that hardly change within a stretch, with clocks that agree: the closed form knows of no offset."""
    rng = np.random.default_rng(seed)
    drive = replace(
        level_drive(drive_of_kind, seed, duration=20.0),
        yaw=waves(0.3, (1.5,), (0.07,), tuple(rng.uniform(0, 6, 1))),
        speed=waves(0.8, (0.5,), (0.05,), tuple(rng.uniform(0, 6, 1))),
    )
    return world_of(drive, noise_seed=noise_seed)


def by_increments(world, problem_of, angles, slip, R, p):
    """With roll and height, of which a plane says nothing and the closed form knows nothing, where they are."""
    priors = pinned(world, [PINNED, FREE, FREE], PINNED)
    factor = Slipping(world, angles, slip, NOISE)
    values = not_none(solve(problem_of, world, factor, (R, p), POSE_SIGMA, priors, away(world, True))).state.values
    drive = np.concatenate([values["wheel0", "radii"], values["wheel0", "baseline"]])
    return np.concatenate([drive, sensor_on_robot(values["wheel0", "rotation"], values["wheel0", "translation"])])


def test_the_closed_form_finds_the_truth_from_arcs():
    """Stretches at constant rates, by hand: a sensor at (0.2, -0.1) m that looks 0.7 rad to the left."""
    rng = np.random.default_rng(0)
    radii, base, (lx, ly, yaw) = np.array([0.1, 0.11]), 0.5, (0.2, -0.1, 0.7)
    turned = rng.uniform(-2.0, 4.0, (60, 2))
    turn, path = turned @ [-radii[0], radii[1]] / base, 0.5 * turned @ radii
    arc = path / turn
    x, y = arc * np.sin(turn), arc * (1.0 - np.cos(turn))
    end_x = x + np.cos(turn) * lx - np.sin(turn) * ly - lx
    end_y = y + np.sin(turn) * lx + np.cos(turn) * ly - ly
    c, s = np.cos(yaw), np.sin(yaw)
    ways = np.stack([c * end_x + s * end_y, c * end_y - s * end_x, turn], axis=1)
    np.testing.assert_allclose(closed_form(turned, ways), [*radii, base, lx, ly, yaw], atol=1e-12)


def test_increments_agree_with_the_closed_form_and_are_no_worse(drive_of_kind, world_of, problem_of, waves):
    """Over eight drives: both are off by chance only, the increments, which also have the IMU, by less."""
    ours, theirs = [], []
    for seed in range(8):
        world = slow_world(world_of, drive_of_kind, waves, seed, seed)
        angles, slip, R, p = noisy(world, np.random.default_rng(seed + 100), NOISE, POSE_SIGMA)
        true = truth_of(world)
        theirs.append(by_closed_form(world, angles, R, p) - true)
        ours.append(by_increments(world, problem_of, angles, slip, R, p) - true)
    ours, theirs = np.array(ours), np.array(theirs)
    assert np.all(np.sqrt((ours**2).mean(axis=0)) < np.sqrt((theirs**2).mean(axis=0)))
    spread = theirs.std(axis=0, ddof=1) / np.sqrt(len(theirs))
    assert np.all(np.abs((theirs - ours).mean(axis=0)) < 4.0 * spread)
