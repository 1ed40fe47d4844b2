"""How the IMU moved, from points that cameras followed: linear in everything once rotations are known.

Rotations come from the gyroscope. Within a window of a few seconds the position is, from its beginning on,

    p(t) = v0 t + g t^2 / 2 + D_f(t) - D_R(t) b_a        D_f'' = R f,  D_R'' = R

and a camera at p(t) + R p_imu_cam sees its points along known rays: the distance of each point from its rays is linear
in the points, v0, g, b_a and the lever arms. Points are eliminated, then the windows' own v0 and g. A distance counts
by the inverse of the point's range, found in rounds. A window's gravity may differ a little from that of all, because
the gyroscope drifts; how long gravity is is known.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from itertools import pairwise

import numpy as np

from icalib.initialize.steps.gyro_rotation import GyroRotation

WINDOW_S = 4.0
ROUNDS = 5
BIAS_SIGMA = 0.3  # m/s^2
ARM_SIGMA = 0.5  # m
RAY_SIGMA = 5e-3  # rad, of a ray: what rough intrinsics leave
ALIKE = 100  # rays of a window: more tell no more, because rough intrinsics bend them alike
OWN = 6  # unknowns of a window: v0, what its g differs by
SHARED = 6  # of all: g, b_a, then the lever arms
DRIFT_SIGMA = 0.3  # m/s^2, of a window's gravity about that of all
GRAVITY_SIGMA = 0.05  # m/s^2, of its length


@dataclass(frozen=True)
class Rays:
    """What all cameras saw: times (n,) on the imu clock; camera (n,); feature (n,); direction (n, 3) in the camera."""

    times: np.ndarray
    camera: np.ndarray
    feature: np.ndarray
    direction: np.ndarray


@dataclass(frozen=True)
class WindowMotion:
    """begins (W,) s: windows, each until the next begins; in the frame of the gyroscope's start velocity (W, 3) there,
    gravity (W, 3); accel_bias (3,); arms (C, 3) p_imu_cam."""

    gyro: GyroRotation
    begins: np.ndarray
    velocity: np.ndarray
    gravity: np.ndarray
    accel_bias: np.ndarray
    arms: np.ndarray

    @cached_property
    def _integrals(self) -> _Integrals:
        return _Integrals.of(self.gyro)

    def within(self, window: int, t: np.ndarray) -> np.ndarray:
        """(n, 3) positions of the IMU from the window's beginning on."""
        s = (t - self.begins[window])[:, None]
        D_f, D_R = self._integrals.since(self.begins[window], t)
        return self.velocity[window] * s + 0.5 * self.gravity[window] * s**2 + D_f - D_R @ self.accel_bias

    def poses(self, t: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """R_world_imu (n, 3, 3) and position (n, 3) at times t, world z up: windows follow one another."""
        window = np.clip(np.searchsorted(self.begins, t, side="right") - 1, 0, None)
        rotation, position = np.empty((len(t), 3, 3)), np.empty((len(t), 3))
        at, R = np.zeros(3), self.gyro.at(t)
        for k, begin in enumerate(self.begins):
            del begin
            level, own = _level(self.gravity[k]), window == k
            rotation[own] = level @ R[own]
            position[own] = at + self.within(k, t[own]) @ level.T
            if k + 1 < len(self.begins):
                at = at + level @ self.within(k, self.begins[k + 1 : k + 2])[0]
        return rotation, position


@dataclass(frozen=True)
class _Integrals:
    """First and second integrals of R f (N, 3) and R (N, 3, 3) at the IMU's stamps, as one array (N, 12)."""

    seconds: np.ndarray
    once: np.ndarray
    twice: np.ndarray

    @classmethod
    def of(cls, gyro: GyroRotation) -> _Integrals:
        imu, R = gyro.imu, gyro.rotation
        x = np.concatenate([np.einsum("nij,nj->ni", R, imu.accel), R.reshape(-1, 9)], axis=1)
        h = np.diff(imu.seconds)[:, None]
        once, twice = np.zeros_like(x), np.zeros_like(x)
        once[1:] = np.cumsum(0.5 * h * (x[1:] + x[:-1]), axis=0)
        twice[1:] = np.cumsum(h * once[:-1] + h**2 * (x[:-1] / 3.0 + x[1:] / 6.0), axis=0)
        return cls(imu.seconds, once, twice)

    def since(self, begin: float, t: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """D_f (n, 3) and D_R (n, 3, 3) at times t, both and their slopes zero at `begin`."""

        def at(x: np.ndarray, s: np.ndarray) -> np.ndarray:
            return np.stack([np.interp(s, self.seconds, x[:, k]) for k in range(x.shape[1])], axis=1)

        start = np.array([begin])
        D = at(self.twice, t) - at(self.twice, start) - at(self.once, start) * (t - begin)[:, None]
        return D[:, :3], D[:, 3:].reshape(-1, 3, 3)


def solve_linear_motion(
    gyro: GyroRotation, rays: Rays, R_imu_cam: list[np.ndarray], arms: list[np.ndarray | None], gravity: float
) -> WindowMotion:
    """The IMU's motion while `rays` were seen, by cameras of known rotation; `arms` where they are known; `gravity`
    m/s^2."""
    low, high = float(rays.times.min()), float(rays.times.max())
    edges = np.linspace(low, high, max(int(round((high - low) / WINDOW_S)), 1) + 1)
    edges[-1] += 1e-6
    integrals, shared = _Integrals.of(gyro), SHARED + 3 * len(R_imu_cam)
    systems = [_Window.of(gyro, integrals, rays, R_imu_cam, a, b) for a, b in pairwise(edges)]
    prior = np.concatenate([np.zeros(3), np.full(3, BIAS_SIGMA**-2), np.full(shared - 6, ARM_SIGMA**-2)])
    mean = np.zeros(shared)
    for k, arm in enumerate(arms):
        if arm is not None:
            at = slice(SHARED + 3 * k, SHARED + 3 * k + 3)
            prior[at], mean[at] = 1e12, arm
    own, common = np.zeros((len(systems), OWN)), mean
    for _ in range(ROUNDS):
        reduced = [w.normal(np.concatenate([x, common])) for w, x in zip(systems, own, strict=True)]
        N, r = np.diag(prior), prior * mean
        if (length := float(np.linalg.norm(common[:3]))) > 0.0:
            down = common[:3] / length
            N[:3, :3] += np.outer(down, down) / GRAVITY_SIGMA**2
            r[:3] += gravity * down / GRAVITY_SIGMA**2
        for A, b in reduced:
            A[range(3, OWN), range(3, OWN)] += DRIFT_SIGMA**-2
            K = np.linalg.solve(A[:OWN, :OWN], np.column_stack([A[:OWN, OWN:], b[:OWN]]))
            N = N + A[OWN:, OWN:] - A[OWN:, :OWN] @ K[:, :-1]
            r = r + b[OWN:] - A[OWN:, :OWN] @ K[:, -1]
        common = np.linalg.solve(N, r)
        own = np.array([np.linalg.solve(A[:OWN, :OWN], b[:OWN] - A[:OWN, OWN:] @ common) for A, b in reduced])
    arms_found = common[SHARED:].reshape(-1, 3)
    return WindowMotion(gyro, edges[:-1], own[:, :3], own[:, 3:] + common[:3], common[3:6], arms_found)


@dataclass
class _Window:
    """One window's observations, those of a track together: camera centre = full (x, 1) with full (n, 3, m + 1);
    direction (n, 3) of the ray; track (n,), and where each begins (t,); weight (n,), of the round."""

    full: np.ndarray
    direction: np.ndarray
    track: np.ndarray
    begins: np.ndarray
    weight: np.ndarray | None = None

    @classmethod
    def of(
        cls, gyro: GyroRotation, integrals: _Integrals, rays: Rays, R_ic: list[np.ndarray], begin: float, end: float
    ) -> _Window:
        own = np.flatnonzero((rays.times >= begin) & (rays.times < end))
        number, track, count = np.unique(rays.feature[own], return_inverse=True, return_counts=True)
        own, feature = own[count[track] >= 3], rays.feature[own[count[track] >= 3]]
        own = own[np.argsort(feature, kind="stable")]
        _, begins, track = np.unique(rays.feature[own], return_index=True, return_inverse=True)
        del number
        t, camera = rays.times[own], rays.camera[own]
        s, R = (t - begin)[:, None, None], gyro.at(t)
        D_f, D_R = integrals.since(begin, t)
        A = np.zeros((len(t), 3, OWN + SHARED + 3 * len(R_ic) + 1))
        A[:, :, 0:3], A[:, :, 3:6] = s * np.eye(3), 0.5 * s**2 * np.eye(3)
        A[:, :, 6:9], A[:, :, 9:12], A[:, :, -1] = A[:, :, 3:6], -D_R, D_f
        for k in range(len(R_ic)):
            A[camera == k, :, 12 + 3 * k : 15 + 3 * k] = R[camera == k]
        direction = np.einsum("nij,njk,nk->ni", R, np.stack(R_ic)[camera], rays.direction[own])
        return cls(A, direction, track, begins)

    def _by_track(self, x: np.ndarray) -> np.ndarray:
        """(t, ...) sums of x (n, ...) over the observations of each track."""
        return np.add.reduceat(x, self.begins, axis=0) if len(x) else x

    def normal(self, x: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Normal matrix and right-hand side of the unknowns x, points eliminated; weights by those found with x."""
        Q = np.eye(3) - self.direction[:, :, None] * self.direction[:, None, :]
        if self.weight is not None:
            self.weight = self._reweighted(Q, self.weight, x)
        else:
            self.weight = np.ones(len(self.track))
        full, m = self.full, self.full.shape[2]
        along = np.einsum("ni,nia->na", self.direction, full)
        QA = self.weight[:, None, None] * (full - self.direction[:, :, None] * along[:, None, :])
        M, side = self._by_track(self.weight[:, None, None] * Q), self._by_track(QA)
        M += 1e-9 * np.trace(M, axis1=1, axis2=2)[:, None, None] * np.eye(3)
        G = full.reshape(-1, m).T @ QA.reshape(-1, m) - side.reshape(-1, m).T @ np.linalg.solve(M, side).reshape(-1, m)
        G[range(len(x)), range(len(x))] += 1e-9 * np.trace(G) / len(x)
        return G[:-1, :-1], -G[:-1, -1]

    def _reweighted(self, Q: np.ndarray, weight: np.ndarray, x: np.ndarray) -> np.ndarray:
        """By the inverse square of each point's range, less where a ray misses its point."""
        centre, wQ = self.full @ np.append(x, 1.0), weight[:, None, None] * Q
        M, b = self._by_track(wQ), self._by_track(np.einsum("nij,nj->ni", wQ, centre))
        M += 1e-9 * np.trace(M, axis1=1, axis2=2)[:, None, None] * np.eye(3)
        away = np.linalg.solve(M, b[:, :, None])[self.track, :, 0] - centre
        reach = np.maximum(np.linalg.norm(away, axis=1), 0.1)
        miss = np.linalg.norm(np.einsum("nij,nj->ni", Q, away), axis=1) / reach
        typical = float(np.median(miss))
        alike = max(1.0, len(reach) / ALIKE)
        sigma, scale = np.sqrt(alike) * max(RAY_SIGMA, typical), 3.0 * typical + 1e-12
        return 1.0 / ((sigma * reach) ** 2 * (1.0 + (miss / scale) ** 2))


def _level(gravity: np.ndarray) -> np.ndarray:
    """R_world_start: the smallest turn that brings gravity down."""
    d = -gravity / np.linalg.norm(gravity)
    axis = np.cross(d, [0.0, 0.0, 1.0])
    K = np.array([[0.0, -axis[2], axis[1]], [axis[2], 0.0, -axis[0]], [-axis[1], axis[0], 0.0]])
    return np.eye(3) + K + K @ K / (1.0 + d[2])
