"""A differential drive in closed form that neither slips, unless told to, nor leaves the ground; the estimator's view.

The wheels' frame turns by three angles that are sums of waves, and its origin moves along its own x: the obvious path.
The IMU rides along on a lever arm. None of it uses the estimator's formulas.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from icalib.data.measurements import ImuStream
from icalib.geometry import so3
from icalib.motion.imu_data import ImuData
from icalib.motion.poses import EstimatedMotion
from icalib.optim.arrowhead import NO_DIRECTIONS, Piece, Prior, in_parallel, make_pieces, solve
from icalib.optim.state import Entry, Layout, State, make_layout
from icalib.rig import ImuNoise
from icalib.sensors.imu.residual import ImuFactor

GRAVITY = np.array([0.0, 0.0, -9.81])
GRID_S = 2e-3
GAUSS = np.polynomial.legendre.leggauss(4)
TOLERANCES = {"rotation": 2e-3, "translation": 5e-3, "time_offset": 1e-3, "radii": 1e-4, "baseline": 1e-3}


@dataclass(frozen=True)
class Waves:
    """offset + sum of amplitude sin(2 pi frequency t + phase); amplitude, frequency, phase (n,)."""

    offset: float
    amplitude: tuple[float, ...]
    frequency: tuple[float, ...]
    phase: tuple[float, ...]

    def __call__(self, t, order=0):
        out = np.full(np.shape(t), self.offset if order == 0 else 0.0, dtype=np.result_type(t, float))
        for a, f, p in zip(self.amplitude, self.frequency, self.phase, strict=True):
            w = 2.0 * np.pi * f
            out = out + a * w**order * np.sin(w * t + p + 0.5 * np.pi * order)
        return out


@dataclass(frozen=True)
class Drive:
    """yaw, pitch, roll [rad] and speed [m/s] of the wheels' frame; where it is in the IMU; the wheels themselves; how
    fast it slips to its left [m/s]."""

    yaw: Waves
    pitch: Waves
    roll: Waves
    speed: Waves
    duration: float = 4.0
    R_imu_wheel: np.ndarray = field(default_factory=lambda: Rotation.from_euler("zyx", [0.4, -0.06, 0.05]).as_matrix())
    p_imu_wheel: np.ndarray = field(default_factory=lambda: np.array([-0.25, 0.1, -0.15]))
    radii: np.ndarray = field(default_factory=lambda: np.array([0.1, 0.11]))
    baseline: float = 0.5
    slip: Waves = Waves(0.0, (), (), ())

    def rotation(self, t):
        """R_world_wheel (n, 3, 3)."""
        angles = np.stack([self.yaw(t), self.pitch(t), self.roll(t)], axis=-1)
        return Rotation.from_euler("ZYX", angles).as_matrix()

    def rate(self, t):
        """(n, 3) rad/s in the wheels' axes, from the rates of the angles."""
        r, p = self.roll(t), self.pitch(t)
        dy, dp, dr = self.yaw(t, 1), self.pitch(t, 1), self.roll(t, 1)
        return np.stack(
            [
                dr - dy * np.sin(p),
                dp * np.cos(r) + dy * np.sin(r) * np.cos(p),
                -dp * np.sin(r) + dy * np.cos(r) * np.cos(p),
            ],
            axis=-1,
        )

    def rate_slope(self, t):
        """(n, 3) rad/s^2, by a complex step."""
        return np.imag(self.rate(t + 1e-30j)) / 1e-30

    def integral(self, f, t):
        """Integral of f(t) (n, m) from 0 to each t: Gauss's four points on every stretch of GRID_S, and on the rest."""
        x, w = 0.5 * (GAUSS[0] + 1.0), 0.5 * GAUSS[1]
        edges = GRID_S * np.arange(np.ceil(t.max() / GRID_S) + 1)
        parts = f((edges[:-1, None] + GRID_S * x).ravel()).reshape(len(edges) - 1, 4, -1)
        whole = np.concatenate([np.zeros((1, parts.shape[2])), np.cumsum(GRID_S * (w[:, None] * parts).sum(1), 0)])
        j = np.minimum((t / GRID_S).astype(int), len(edges) - 2)
        rest = t - edges[j]
        last = f((edges[j][:, None] + rest[:, None] * x).ravel()).reshape(len(t), 4, -1)
        return whole[j] + rest[:, None] * (w[:, None] * last).sum(1)

    def along(self, t, order=0):
        """(n, 3) velocity of the wheels' origin in the wheels' axes, or its derivative in these."""
        return np.stack([self.speed(t, order), self.slip(t, order), np.zeros(len(t))], axis=1)

    def travel(self, t):
        """(n, 3) the same in the world."""
        return np.einsum("nij,nj->ni", self.rotation(t), self.along(t))

    @property
    def lever(self):
        """p_wheel_imu: the IMU in the wheels' frame."""
        return -self.R_imu_wheel.T @ self.p_imu_wheel

    def pose(self, t):
        """R_world_imu, p_world_imu, velocity at t (n,)."""
        R = self.rotation(t)
        p = self.integral(self.travel, t) + R @ self.lever
        v = self.travel(t) + np.einsum("nij,nj->ni", R, np.cross(self.rate(t), self.lever))
        return R @ self.R_imu_wheel.T, p, v

    def readings(self, t):
        """Angular rate and specific force (n, 3) in the IMU's axes."""
        w, dw = self.rate(t), self.rate_slope(t)
        a = self.along(t, 1) + np.cross(w, self.along(t)) + np.cross(dw, self.lever)
        a = a + np.cross(w, np.cross(w, self.lever))
        f = a - np.einsum("nji,j->ni", self.rotation(t), GRAVITY)
        return w @ self.R_imu_wheel.T, f @ self.R_imu_wheel.T

    def angles(self, t):
        """(n, 2) rad that the wheels have turned since 0."""

        def rates(s):
            turn = 0.5 * self.baseline * self.rate(s)[:, 2]
            return np.stack([(self.speed(s) - turn) / self.radii[0], (self.speed(s) + turn) / self.radii[1]], axis=1)

        return self.integral(rates, t)


def some_waves(rng, offset, size, slow, fast):
    n = 4
    return Waves(
        offset,
        tuple(size * rng.uniform(0.5, 1.0, n) / np.sqrt(n)),
        tuple(rng.uniform(slow, fast, n)),
        tuple(rng.uniform(0.0, 2.0 * np.pi, n)),
    )


def make_drive(kind: str, seed: int = 0, **changes) -> Drive:
    """ "planar", or "hills" with 6 degrees of pitch and roll; about 1 m/s and 40 deg/s."""
    rng = np.random.default_rng(seed)
    hill = 0.15 if kind == "hills" else 0.0
    yaw, pitch, roll, speed = (
        some_waves(rng, *x)
        for x in [(0.3, 1.2, 0.05, 0.2), (0.0, hill, 0.1, 0.5), (0.0, hill, 0.1, 0.5), (1.0, 0.8, 0.05, 0.5)]
    )
    return Drive(yaw, pitch, roll, speed, **changes)


NOISE = ImuNoise(gyro=2e-4, accel=2e-3, gyro_walk=1e-5, accel_walk=1e-4)


@dataclass(frozen=True)
class World:
    """A drive as the estimator sees it: IMU readings with a bias, keyframes, wheel stamps on a clock of their own.
    state: the truth."""

    drive: Drive
    imu: ImuData
    seconds: np.ndarray
    angles: np.ndarray
    layout: Layout
    state: State

    def moved(self, **values) -> State:
        """The truth with other values of blocks of wheel0; rotations are turned by what is given."""
        changed = dict(self.state.values)
        for name, d in values.items():
            old = changed["wheel0", name]
            changed["wheel0", name] = old @ so3.exp(np.array(d)) if name == "rotation" else old + d
        return replace(self.state, values=changed)

    def motion(self, state: State | None = None) -> EstimatedMotion:
        """At `state`, by default the truth."""
        return EstimatedMotion(state or self.state, self.imu, 9.81, 0.5)


BIAS = np.array([0.01, -0.02, 0.005, 0.1, -0.05, 0.08])


def make_world(
    drive: Drive,
    imu_hz: float = 200.0,
    wheel_hz: float = 70.0,
    keyframe_s: float = 0.05,
    offset: float = 0.0123,
    noise_seed: int | None = None,
) -> World:
    """Noiseless unless there is a seed for the IMU's white noise."""
    t = np.arange(0.0, drive.duration, 1.0 / imu_hz)
    gyro, accel = drive.readings(t)
    if noise_seed is not None:
        white = np.random.default_rng([noise_seed, 1]).standard_normal((2, len(t), 3)) * np.sqrt(imu_hz)
        gyro, accel = gyro + white[0] * NOISE.gyro, accel + white[1] * NOISE.accel
    stream = ImuStream("imu0", np.round(t * 1e9).astype(np.int64), gyro + BIAS[:3], accel + BIAS[3:])
    seconds = np.arange(0.0, drive.duration - 0.05, 1.0 / wheel_hz)
    keyframes = np.arange(0.0317, t[-1], keyframe_s)
    R, p, v = drive.pose(keyframes)
    values = {
        ("imu0", "intrinsics"): np.zeros(24),
        ("wheel0", "rotation"): drive.R_imu_wheel,
        ("wheel0", "translation"): drive.p_imu_wheel,
        ("wheel0", "time_offset"): np.array([offset]),
        ("wheel0", "radii"): drive.radii,
        ("wheel0", "baseline"): np.array([drive.baseline]),
    }
    entries: list[Entry] = [
        (s, n, "rotation" if n == "rotation" else "vector", v.size if n != "rotation" else 3, s != "imu0")
        for (s, n), v in values.items()
    ]
    layout = make_layout([*entries, ("wheel0", "clock_rate", "vector", 1, False)])
    state = State(keyframes, R, p, v, np.tile(BIAS, (len(keyframes), 1)), values)
    return World(drive, ImuData.build(stream, NOISE), seconds, drive.angles(seconds + offset), layout, state)


@dataclass(frozen=True)
class PoseFactor:
    """In place of cameras: poses of the keyframes, measured with noise of rotation [rad] and position [m]."""

    rotation: np.ndarray
    position: np.ndarray
    sigma: tuple[float, float]

    def accumulate(self, state: State, piece: Piece, sums: bool) -> float:
        last = piece.last == len(state.seconds) - 1
        own = slice(piece.first, piece.last + last)
        turn = so3.log_many(np.ascontiguousarray(self.rotation[own].transpose(0, 2, 1) @ state.rotation[own]))
        r = np.concatenate([turn / self.sigma[0], (state.position[own] - self.position[own]) / self.sigma[1]], axis=1)
        if sums:
            J = np.tile(np.diag(np.repeat([0.0, 1.0 / self.sigma[1]], 3)), (len(r), 1, 1))
            J[:, :3, :3] = [so3.right_jacobian_inverse(x) / self.sigma[0] for x in turn]
            piece.diagonal[: len(r), :6, :6] += np.einsum("nij,nik->njk", J, J)
            piece.side[: len(r), :6, -1] += np.einsum("nij,ni->nj", J, r)
        return 0.5 * float((r**2).sum())


@dataclass(frozen=True)
class DriveProblem:
    """What `solver.minimise` asks of a problem: IMU, known poses, one wheel factor, priors."""

    layout: Layout
    imu: ImuFactor
    poses: PoseFactor
    wheels: Any
    priors: tuple[Prior, ...] = ()
    fixed_directions: np.ndarray = field(default_factory=lambda: NO_DIRECTIONS)

    @property
    def n_keyframes(self):
        return self.imu.n_keyframes

    @property
    def tolerance(self):
        out = np.zeros(self.layout.size)
        for b in self.layout.free:
            out[b.columns] = TOLERANCES[b.name]
        return out

    def pieces(self):
        return make_pieces(self.n_keyframes, self.layout.size)

    def solve(self, pieces, damping=0.0):
        return solve(pieces, self.n_keyframes, self.tolerance, damping, self.fixed_directions, self.layout.essential)

    def residuals(self):
        return self.imu.output(), self.wheels.output()

    def warm_started(self, _at):
        return self  # no points of the scene

    def linearise(self, state, pieces, out, sums=True, curved=False):
        def add(piece):
            if sums:
                piece.clear()
            cost = self.imu.accumulate(state, piece, out[0], sums) + self.poses.accumulate(state, piece, sums)
            cost += self.wheels.accumulate(state, piece, out[1], sums, curved)
            cost += self.imu.accumulate_bias_prior(state, piece, sums)
            return cost + (sum(p.accumulate(state, piece, sums) for p in self.priors) if piece.first == 0 else 0.0)

        return sum(in_parallel(add, pieces))


@pytest.fixture(scope="session")
def drive_of_kind() -> Callable[..., Drive]:
    return make_drive


@pytest.fixture(scope="session")
def world_of() -> Callable[..., World]:
    return make_world


@pytest.fixture(scope="session")
def waves() -> type[Waves]:
    return Waves


@pytest.fixture(scope="session")
def problem_of() -> Callable[..., DriveProblem]:
    def make(world, wheels, rotation, position, sigma, start, priors=()):
        imu = ImuFactor.build(world.imu, start, 9.81, world.layout)
        return DriveProblem(world.layout, imu, PoseFactor(rotation, position, sigma), wheels, priors)

    return make
