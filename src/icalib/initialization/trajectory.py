"""Where the IMU was at any instant: camera poses moved to the IMU, carried to that instant by the IMU's own readings."""

from __future__ import annotations

import numpy as np
from numba import njit

from icalib.errors import EstimationError
from icalib.estimation.imu_data import ImuData
from icalib.geometry import so3
from icalib.initialization.dead_reckoning import DeadReckoning
from icalib.initialization.guess import Guess
from icalib.measurements import Measurements
from icalib.rig import Rig

_WINDOW_S = 0.15  # camera poses this close to an instant are averaged
_SOFTENING_S = 0.03  # the weight of a pose falls with its distance in time beyond this


def initial_trajectory(
    guess: Guess, rig: Rig, measurements: Measurements, nodes_seconds: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """R_world_imu (K, 3, 3), position (K, 3) m and velocity (K, 3) m/s at nodes_seconds (K,) since the first reading.

    At each node the shape of the motion nearby comes from the readings; attitude, position and velocity are fitted to
    the camera poses within 0.15 s, and where there are none to the last before and the first after. Raises
    EstimationError where no image was taken while the IMU was running.
    """
    imu = ImuData.build(measurements.imu, rig.imu.noise)
    reckoning = DeadReckoning.integrate(imu, guess.gyro_bias)
    t, R, p = _imu_poses(guess, measurements, imu.seconds[-1])
    nodes = np.ascontiguousarray(nodes_seconds, dtype=np.float64)
    if len(t) == 0:
        raise EstimationError(f"no camera saw the target while {imu.name} was running; check the stamps.")
    bias = np.concatenate([[1.0], -guess.accel_bias])
    Q_t, _, second_t = reckoning.at(t)
    Q, first, second = reckoning.at(nodes)
    start_world = np.ascontiguousarray(R @ Q_t.transpose(0, 2, 1))
    rotation, position, velocity = np.empty((len(nodes), 3, 3)), np.empty((len(nodes), 3)), np.empty((len(nodes), 3))
    gravity = np.array([0.0, 0.0, -rig.gravity])
    _fit_nodes(
        nodes, Q, first @ bias, second @ bias, t, start_world, p, second_t @ bias, gravity, rotation, position, velocity
    )
    return rotation, position, velocity


def _imu_poses(guess: Guess, measurements: Measurements, end: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Instants (n,) on the imu clock in order, R_world_imu (n, 3, 3) and p_world_imu (n, 3) of all good images."""
    instants, rotations, positions = [], [], []
    for stream in measurements.cameras:
        camera = guess.cameras[stream.name]
        t = stream.seconds + camera.relative_offset
        use = camera.poses.ok & (t >= 0.0) & (t <= end)
        R = guess.R_world_board @ camera.poses.R_board_cam[use] @ camera.R_imu_cam.T
        instants.append(t[use])
        rotations.append(R)
        positions.append(camera.poses.p_board_cam[use] @ guess.R_world_board.T - R @ camera.p_imu_cam)
    t = np.concatenate(instants)
    order = np.argsort(t, kind="stable")
    return t[order], np.concatenate(rotations)[order], np.concatenate(positions)[order]


@njit(cache=True, nogil=True)
def _window(t, node):
    """First and last + 1 of the poses to use: those near, and always one on each side (near the end, if outside)."""
    centre = min(max(node, t[0]), t[-1])
    low = np.searchsorted(t, centre - _WINDOW_S)
    high = np.searchsorted(t, centre + _WINDOW_S, side="right")
    right = np.searchsorted(t, node)
    return max(min(low, right - 1), 0), min(max(high, right + 1), len(t))


@njit(cache=True, nogil=True)
def _attitude(start_world, weight, low, high):
    """Weighted mean of start_world[low:high], rotations close to each other, about that of the largest weight."""
    base = low
    for k in range(low, high):
        if weight[k - low] > weight[base - low]:
            base = k
    mean, turn = np.zeros(3), np.empty((3, 3))
    for k in range(low, high):
        for i in range(3):
            for j in range(3):
                turn[i, j] = 0.0
                for m in range(3):
                    turn[i, j] += start_world[base, m, i] * start_world[k, m, j]
        phi = so3.log(turn)
        for i in range(3):
            mean[i] += weight[k - low] * phi[i]
    total = weight[: high - low].sum()
    E = so3.exp(mean / total)
    A = np.zeros((3, 3))
    for i in range(3):
        for j in range(3):
            for m in range(3):
                A[i, j] += start_world[base, i, m] * E[m, j]
    return A


@njit(cache=True, nogil=True)
def _fit_nodes(nodes, Q, first, second, t, start_world, p, second_t, gravity, rotation, position, velocity):
    """Fill the node states. first, second: IMU integrals at the nodes (K, 3); second_t (n, 3) at the poses.

    p(t_k) = position + velocity tau + gravity tau^2 / 2 + A (second_t - second - first tau), tau = t_k - node.
    """
    for n in range(len(nodes)):
        low, high = _window(t, nodes[n])
        weight = np.empty(high - low)
        for k in range(low, high):
            weight[k - low] = 1.0 / (abs(t[k] - nodes[n]) + _SOFTENING_S)
        A = _attitude(start_world, weight, low, high)
        s0, s1, s2 = 0.0, 0.0, 1e-12  # the tiny term leaves the velocity at 0 where there is a single instant
        y, ty, x = np.zeros(3), np.zeros(3), np.empty(3)
        for k in range(low, high):
            tau, w = t[k] - nodes[n], weight[k - low]
            for i in range(3):
                x[i] = second_t[k, i] - second[n, i] - first[n, i] * tau
            s0, s1, s2 = s0 + w, s1 + w * tau, s2 + w * tau * tau
            for i in range(3):
                bend = A[i, 0] * x[0] + A[i, 1] * x[1] + A[i, 2] * x[2] + 0.5 * gravity[i] * tau * tau
                y[i] += w * (p[k, i] - bend)
                ty[i] += w * tau * (p[k, i] - bend)
        determinant = s0 * s2 - s1 * s1
        for i in range(3):
            position[n, i] = (s2 * y[i] - s1 * ty[i]) / determinant
            velocity[n, i] = (s0 * ty[i] - s1 * y[i]) / determinant
            for j in range(3):
                rotation[n, i, j] = A[i, 0] * Q[n, 0, j] + A[i, 1] * Q[n, 1, j] + A[i, 2] * Q[n, 2, j]
