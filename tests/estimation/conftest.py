"""A short noiseless recording, the estimator's problem on it at the truth, and normal equations as dense matrices."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
import pytest

from icalib.estimation.arrowhead import Piece
from icalib.estimation.corner_factor import CornerFactor, CornerNoise
from icalib.estimation.imu_data import ImuData
from icalib.estimation.imu_factor import ImuFactor
from icalib.estimation.nodes import place_nodes
from icalib.estimation.poses import assign_nodes
from icalib.estimation.problem import Problem
from icalib.estimation.state import NODE, Layout, State, make_layout
from icalib.geometry.cameras import camera_model
from icalib.simulation import Scenario, Simulation, handheld, simulate

TOLERANCE = {
    "rotation": 2e-3,
    "translation": 5e-3,
    "time_offset": 1e-3,
    "intrinsics": 1.0,
    "distortion": 1e-2,
    "tilt": 2e-3,
    "shape": 1e-3,
    "bloom": 0.1,
    "radii": 1e-3,
    "baseline": 5e-3,
}


@dataclass(frozen=True)
class Setup:
    """A simulated recording seen by the estimator: the board's origin is the origin of the world. state: the truth."""

    sim: Simulation
    imu: ImuData
    layout: Layout
    state: State

    def truth_at(self, seconds: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Rotation, position, velocity of the IMU at seconds since its first stamp."""
        R, p, v = self.sim.truth.pose_at(seconds + self.sim.truth.seconds[0])
        return R, p - self.sim.truth.T_world_board[:3, 3], v

    def columns_scale(self) -> np.ndarray:
        """(B,) a reasonable step of each border column."""
        scale = np.zeros(self.layout.size)
        for b in self.layout.free:
            scale[b.columns] = 1e-3 if b.key == ("imu0", "intrinsics") else TOLERANCE[b.name]
        return scale

    def perturbed(self, rng: np.random.Generator, size: float = 1.0) -> State:
        chain = rng.normal(size=(len(self.state.seconds), NODE)) * np.repeat([2e-3, 2e-3, 5e-3, 5e-4, 5e-3], 3)
        return self.state.retract(
            self.layout, size * chain, size * rng.normal(size=self.layout.size) * self.columns_scale()
        )


def make_setup(
    sim: Simulation, *, imu_free: bool = False, shape: int = 0, bloom: bool = False, spacing: float = 0.05
) -> Setup:
    truth, measurements = sim.truth, sim.measurements
    imu = ImuData.build(measurements.imu, sim.scenario.imu_noise)
    entries = [("imu0", "intrinsics", "vector", 24, imu_free), ("board0", "tilt", "tilt", 2, True)]
    entries.append(("board0", "shape", "vector", shape, shape > 0))
    values = {("imu0", "intrinsics"): truth.imu_intrinsics.copy(), ("board0", "shape"): np.zeros(shape)}
    values["board0", "tilt"] = truth.T_world_board[:3, :3].copy()
    times = []
    for c in measurements.cameras:
        T = truth.T_imu_cam[c.name]
        offset = truth.time_offset[c.name] + (c.origin_ns - measurements.imu.origin_ns) * 1e-9
        parameters = {
            "rotation": T[:3, :3].copy(),
            "translation": T[:3, 3].copy(),
            "time_offset": np.array([offset]),
            "intrinsics": truth.intrinsics[c.name].copy(),
            "distortion": truth.distortion[c.name].copy(),
            "bloom": np.zeros(1),
        }
        for name, value in parameters.items():
            kind, size = ("rotation", 3) if name == "rotation" else ("vector", len(value))
            entries.append((c.name, name, kind, size, bloom or name != "bloom"))
            values[c.name, name] = value
        times.append(c.seconds + offset)
    seconds = place_nodes(imu, times, spacing, 0.5)
    bias = np.concatenate([truth.gyro_bias[0], truth.accel_bias[0]])
    pending = Setup(sim, imu, make_layout(entries), State(seconds, *(np.empty(0),) * 4, values))
    R, p, v = pending.truth_at(seconds)
    return replace(pending, state=State(seconds, R, p, v, np.tile(bias, (len(seconds), 1)), values))


def make_factor(setup: Setup, camera: int, scheme: str = "inertial", **changes) -> CornerFactor:
    """The factor of one camera, everything kept, sigma 0.2 px, no loss and no common error unless `changes` say so."""
    stream = setup.sim.measurements.cameras[camera]
    n, state = len(stream.uv), setup.state
    node = assign_nodes(scheme, state.seconds, stream.seconds + state.values[stream.name, "time_offset"][0])
    target = setup.sim.scenario.target
    factor = CornerFactor(
        stream=stream,
        model=camera_model(setup.sim.scenario.cameras[camera].model),
        imu=setup.imu,
        gravity=9.81,
        scheme=scheme,
        times=stream.seconds,
        node=node,
        keep=np.ones(n, dtype=bool),
        noise=CornerNoise(np.full(len(node), 0.2), np.zeros(0), np.zeros((n, 0))),
        direction=np.zeros((0, 2)),
        target="board0",
        points=target.points,
        basis=np.zeros((len(target.points), setup.layout.block("board0", "shape").size, 3)),
        layout=setup.layout,
        n_nodes=len(state.seconds),
    )
    return replace(factor, **changes)


def make_problem(setup: Setup, start: State | None = None, scheme: str = "inertial") -> Problem:
    columns = setup.layout.columns("imu0", "intrinsics")
    imu = ImuFactor.build(setup.imu, start or setup.state, 9.81, columns[columns >= 0])
    cameras = tuple(make_factor(setup, i, scheme) for i in range(len(setup.sim.measurements.cameras)))
    return Problem(setup.layout, imu, cameras, (), setup.columns_scale())


def make_dense(pieces: tuple[Piece, ...], n_nodes: int) -> tuple[np.ndarray, np.ndarray]:
    """The normal matrix (chain, then border) and its gradient."""
    n_border = pieces[0].border.shape[0] - 1
    o = NODE * n_nodes
    H, g = np.zeros((o + n_border, o + n_border)), np.zeros(o + n_border)
    for piece in pieces:
        for k in range(piece.first, piece.last + 1):
            i, a = k - piece.first, slice(NODE * k, NODE * k + NODE)
            H[a, a] += piece.diagonal[i]
            H[a, o:] += piece.side[i, :, :-1]
            g[a] += piece.side[i, :, -1]
            if k < piece.last:
                H[a, NODE * k + NODE : NODE * k + 2 * NODE] += piece.upper[i]
        H[o:, o:] += piece.border[:-1, :-1]
        g[o:] += piece.border[:-1, -1]
    return np.triu(H) + np.triu(H, 1).T, g


def unlike_cameras(duration_s: float, asynchronous: bool = True) -> Scenario:
    """Two cameras of different models, an IMU with scale, misalignment and g-sensitivity."""
    scenario = handheld(duration_s, asynchronous=asynchronous, noiseless=True)
    cam0, cam1 = scenario.cameras
    cam1 = replace(cam1, model="pinhole-equidistant", distortion=(-0.02, 0.01, -0.004, 0.001))
    intrinsics = np.random.default_rng(7).normal(size=24) * np.repeat([5e-3, 5e-3, 1e-2, 1e-3], [6, 6, 3, 9])
    return replace(scenario, cameras=(cam0, cam1), imu_intrinsics=intrinsics)


@pytest.fixture(scope="session")
def unlike() -> Simulation:
    return simulate(unlike_cameras(0.5), seed=0)


@pytest.fixture(scope="session")
def setup_of() -> Callable[..., Setup]:
    return make_setup


@pytest.fixture(scope="session")
def factor_of() -> Callable[..., CornerFactor]:
    return make_factor


@pytest.fixture(scope="session")
def problem_of() -> Callable[..., Problem]:
    return make_problem


@pytest.fixture(scope="session")
def dense() -> Callable[..., tuple[np.ndarray, np.ndarray]]:
    return make_dense
