"""A short noiseless recording, the estimator's problem on it at the truth, and normal equations as dense matrices."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from tests.typed import instance, not_none

from icalib.data.measurements import CornerStream, LidarStream, TrackStream
from icalib.estimate.inputs import specs_of, tolerance_of
from icalib.estimate.problem import Problem
from icalib.geometry.cameras import camera_model
from icalib.geometry.planes import plane_of
from icalib.geometry.targets import AprilGrid
from icalib.geometry.targets.base import BOARD
from icalib.model.bodies import SIZE, Bodies
from icalib.motion.factor import keyed
from icalib.motion.imu_data import ImuData
from icalib.motion.poses import MIDDLE, EstimatedMotion, assign_keyframes, place_keyframes
from icalib.optim.arrowhead import Piece, Prior, make_pieces
from icalib.optim.state import KEYFRAME_DIM, Entry, Kind, Layout, State, make_layout
from icalib.rig import ImuSensor, Lidar, Scheme, Settings
from icalib.rig.scene import SHAPE_LABELS
from icalib.sensors.camera.corner_factor import CornerFactor, CornerNoise
from icalib.sensors.camera.model import NO_BLOOM, restrict
from icalib.sensors.camera.spec import Shutter
from icalib.sensors.camera.track_factor import FeatureFactor
from icalib.sensors.camera.track_surfaces import OnPlanes, Surfaces
from icalib.sensors.camera.tracks import TrackNoise
from icalib.sensors.imu.residual import ImuFactor
from icalib.sensors.imu.spec import class_noise
from icalib.sensors.lidar.binning import LidarNoise
from icalib.sensors.lidar.residual import LidarFactor
from icalib.sensors.lidar.simulate import SimLidar
from icalib.tools.simulation import Scenario, Simulation, handheld, load_scenario, simulate

RINGS = "ring_elevations", "ring_offsets", "ring_azimuths"
TOLERANCE = {
    "range_offset": 5e-3,
    "range_scale": 1e-2,
    "ring_elevations": 2e-3,
    "ring_offsets": 5e-3,
    "ring_azimuths": 2e-3,
    "gravity": 0.01,
    "rotation": 2e-3,
    "translation": 5e-3,
    "time_offset": 1e-3,
    "clock_rate": 1e3,
    "readout": 1e-3,
    "intrinsics": 1.0,
    "size_effect": 1e-3,
    "accel_delay": 1e-3,
    "low_pass": 1e-5,
    "distortion": 1e-2,
    "tilt": 2e-3,
    "sheet_middle": 1e-2,
    "shape": 1e-3,
    "bloom": 0.1,
    "radii": 1e-3,
    "baseline": 5e-3,
    "scales": 5e-3,
    "radius": 1e-3,
    "wheelbase": 5e-3,
    "steering_offset": 5e-3,
    "ground_height": 5e-3,
    "plane": (2e-3, 2e-3, 5e-3),
    "frame_rotation": 2e-3,
    "frame_yaw": 2e-3,
    "frame_translation": 5e-3,
    "frame_offset": 5e-3,
    "size": 1e-2,
    "scale": 1e-2,
    "position_rotation": 2e-3,
}
PAPER = Path(__file__).parents[1] / "examples" / "paper"
FEWEST_POINTS = 200  # of a plane in a setup


def fields_of(target: AprilGrid) -> dict:
    return {f.name: getattr(target, f.name) for f in dataclasses.fields(target)}


@dataclass(frozen=True)
class SplitGrid(AprilGrid):
    """An AprilGrid whose tags are in turn those of three bodies, each with a frame of its own, anywhere."""

    @cached_property
    def bodies(self) -> tuple[str, ...]:
        return ("left", "middle", "right")

    @cached_property
    def body(self) -> np.ndarray:
        return np.arange(len(self.points)) // 4 % 3

    @cached_property
    def points(self) -> np.ndarray:
        on_grid = AprilGrid(**fields_of(self)).points
        own = np.empty_like(on_grid)
        for k in range(3):
            R, p = self.frame(k)
            rows = np.arange(len(on_grid)) // 4 % 3 == k
            own[rows] = (on_grid[rows] - p) @ R
        return own

    @staticmethod
    def frame(k: int) -> tuple[np.ndarray, np.ndarray]:
        """R_grid_body, p_grid_body."""
        rng = np.random.default_rng(k)
        return Rotation.from_rotvec(rng.normal(size=3)).as_matrix(), rng.normal(size=3)

    def place(self, k: int, reference: int) -> tuple[np.ndarray, np.ndarray]:
        """R_reference_k, p_reference_k."""
        (Rk, pk), (R, p) = self.frame(k), self.frame(reference)
        return R.T @ Rk, R.T @ (pk - p)


@dataclass(frozen=True)
class Setup:
    """A simulated recording seen by the estimator: the scene's origin is the origin of the world, `origin` in the
    simulation's. state: the truth."""

    sim: Simulation
    imu: ImuData
    layout: Layout
    bodies: Bodies
    streams: tuple[CornerStream, ...]
    origin: np.ndarray
    state: State

    def truth_at(self, seconds: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Rotation, position, velocity of the IMU at seconds since its first stamp."""
        R, p, v = self.sim.truth.pose_at(seconds + self.sim.truth.seconds[0])
        return R, p - self.origin, v

    def columns_scale(self) -> np.ndarray:
        """(B,) a reasonable step of each calibration column."""
        scale = np.zeros(self.layout.size)
        for b in self.layout.free:
            scale[b.columns] = 1e-3 if b.name == "intrinsics" and b.size == 24 else TOLERANCE[b.name]
        return scale

    def perturbed(self, rng: np.random.Generator, size: float = 1.0) -> State:
        one = [2e-3, 2e-3, 5e-3, 5e-4, 5e-3] + [5e-3, 5e-4, 5e-3] * len(self.layout.further_imus)
        chain = rng.normal(size=(len(self.state.seconds), 3 * len(one))) * np.repeat(one, 3)
        return self.state.retract(
            self.layout, size * chain, size * rng.normal(size=self.layout.size) * self.columns_scale()
        )


def make_setup(
    sim: Simulation,
    *,
    imu_free: bool = False,
    shape: bool = False,
    bloom: bool = False,
    spacing: float = 0.05,
    split: bool = False,
    size: bool = False,
) -> Setup:
    """split: the target is taken as three bodies that stand where they would on the target. size: it is estimated."""
    truth, measurements = sim.truth, sim.measurements
    imu = ImuData.build(not_none(measurements.imu), sim.scenario.imu_noise)
    entries: list[Entry] = [("imu0", "intrinsics", "vector", 24, imu_free), ("board0", "tilt", "tilt", 2, True)]
    target = SplitGrid(**fields_of(instance(sim.scenario.target, AprilGrid))) if split else sim.scenario.target
    bodies = Bodies(target, (1, 0, 2) if split else (0,), (), shape, sized=size)
    entries += bodies.size_entries() + bodies.shape_entries() + bodies.pose_entries()
    values = {(name, "shape"): np.zeros(len(SHAPE_LABELS)) for name in bodies.bending}
    values["imu0", "intrinsics"] = truth.values["imu0"]["intrinsics"].copy()
    values[SIZE] = np.array([truth.target_size])
    R_world_grid, origin = truth.T_world_board[:3, :3], truth.T_world_board[:3, 3]
    R_grid_scene, p_grid_scene = target.frame(1) if isinstance(target, SplitGrid) else (np.eye(3), np.zeros(3))
    values["board0", "tilt"] = R_world_grid @ R_grid_scene
    if isinstance(target, SplitGrid):
        for k in bodies.used:
            body, (R_body, p_body) = target.bodies[k], target.place(k, bodies.used[0])
            values[body, "rotation"], values[body, "translation"] = R_body, p_body
    times = []
    for c in measurements.cameras:
        T = truth.T_imu_sensor[c.name]
        offset = truth.time_offset[c.name] + (c.origin_ns - not_none(measurements.imu).origin_ns) * 1e-9
        parameters = {
            "rotation": T[:3, :3].copy(),
            "translation": T[:3, 3].copy(),
            "time_offset": np.array([offset]),
            "intrinsics": truth.values[c.name]["intrinsics"].copy(),
            "distortion": truth.values[c.name]["distortion"].copy(),
            "bloom": np.zeros(1),
        }
        for name, value in parameters.items():
            kind: Kind = "rotation" if name == "rotation" else "vector"
            columns = 3 if name == "rotation" else len(value)
            entries.append((c.name, name, kind, columns, bloom or name != "bloom"))
            values[c.name, name] = value
        values |= {(c.name, "clock_rate"): np.zeros(1), (c.name, MIDDLE): c.seconds[-1:] / 2.0}
        times.append(c.seconds + offset)
    for c in measurements.cameras:
        entries.append((c.name, "clock_rate", "vector", 1, True))
    seconds = place_keyframes(imu, times, spacing, 0.5)
    bias = np.concatenate([truth.gyro_bias[0], truth.accel_bias[0]])
    streams = restrict(bodies, measurements).cameras
    empty = np.empty(0)
    pending = Setup(
        sim,
        imu,
        make_layout(entries),
        bodies,
        streams,
        origin + R_world_grid @ p_grid_scene,
        State(seconds, empty, empty, empty, empty, values),
    )
    R, p, v = pending.truth_at(seconds)
    return replace(pending, state=State(seconds, R, p, v, np.tile(bias, (len(seconds), 1)), values))


def make_factor(setup: Setup, camera: int, scheme: Scheme = "inertial", **changes) -> CornerFactor:
    """The factor of one camera, everything kept, sigma 0.2 px, no loss and no common error unless `changes` say so."""
    stream = setup.streams[camera]
    n, state = len(stream.uv), setup.state
    keyframe = assign_keyframes(scheme, state.seconds, stream.seconds + state.values[stream.name, "time_offset"][0])
    factor = CornerFactor(
        stream=stream,
        model=camera_model(setup.sim.scenario.cameras[camera].model),
        imu=setup.imu,
        gravity=9.81,
        scheme=scheme,
        times=stream.seconds,
        keyframe=keyframe,
        keep=np.ones(n, dtype=bool),
        noise=CornerNoise(np.full(n, 0.2), np.zeros(0), np.zeros((n, 2, 0))),
        direction=NO_BLOOM,
        bodies=setup.bodies,
        layout=setup.layout,
        n_keyframes=len(state.seconds),
    )
    return replace(factor, **changes)


def make_features(
    setup: Setup,
    scheme: Scheme = "inertial",
    loss: tuple[str, float] = ("none", 2.5),
    noise_px: float = 0.0,
    shutter: Shutter | None = None,
) -> FeatureFactor:
    """The corners of both cameras as features of unknown position, sigma 0.8 and 1.1 px, that of the second camera
    growing with the number of views; of every third image of the first camera some are not in use. shutter: of the
    first camera."""
    rng = np.random.default_rng(11)
    streams = tuple(
        TrackStream(s.name, s.stamps_ns, s.start, s.point, s.uv + noise_px * rng.normal(size=s.uv.shape))
        for s in setup.streams
    )
    views = rng.integers(0, 20, len(streams[1].uv))
    streams = (streams[0], replace(streams[1], views=views))
    cameras = tuple(make_factor(setup, i, scheme) for i in range(len(streams)))
    cameras = (replace(cameras[0], shutter=shutter), *cameras[1:])
    keep = [rng.random(len(s.uv)) < 0.9 for s in streams]
    cuts = tuple(p.first for p in make_pieces(len(setup.state.seconds), 0)[1:])
    noise = (TrackNoise(0.8), TrackNoise(1.1, 0.3))
    factor = FeatureFactor(cameras, streams, noise, tuple(keep), *loss, setup.layout)
    return factor.cut(setup.state, cuts)


def make_features_on_planes(setup: Setup, *arguments, **options) -> tuple[Setup, FeatureFactor]:
    """The setup with two planes, about where the features are and 2 deg from there, and its features, of which two of
    three are on one of them, known to lie there to 3 to 8 mm."""
    factor = make_features(setup, *arguments, **options)
    views, n = factor._views(setup.state, 0, factor.n_keyframes), factor.tracks.count
    points = factor._from_anchors(views, slice(0, n), factor.tracks.start)
    centre = points.mean(axis=0)
    across, _, normal = np.linalg.svd(points - centre, full_matrices=False)[2]
    both = [plane_of(normal, centre + 0.004 * normal), plane_of(normal + 0.03 * across, centre)]
    keys = tuple((f"plane {k}", "plane") for k in range(2))
    entries: list[Entry] = [(b.sensor, b.name, b.kind, b.size, b.start is not None) for b in setup.layout.blocks]
    layout = make_layout([*entries, *((*key, "plane", 3, True) for key in keys)])
    values = setup.state.values | dict(zip(keys, both, strict=True))
    setup = replace(setup, layout=layout, state=replace(setup.state, values=values))
    rng = np.random.default_rng(21)
    surfaces = Surfaces(keys, np.array(both), np.zeros(2, dtype=np.int64), np.zeros(0, dtype=np.int64), 0.005)
    on = OnPlanes(rng.integers(-1, 2, n), rng.uniform(0.003, 0.008, n), np.ones(n))
    cameras = tuple(replace(c, layout=layout) for c in factor.cameras)
    return setup, replace(factor, layout=layout, cameras=cameras, surfaces=surfaces, on=on)


def make_problem(setup: Setup, start: State | None = None, scheme: Scheme = "inertial") -> Problem:
    imu = ImuFactor.build(setup.imu, start or setup.state, 9.81, setup.layout)
    cameras = tuple(make_factor(setup, i, scheme) for i in range(len(setup.sim.measurements.cameras)))
    return Problem(setup.layout, keyed((imu, *cameras)), (), setup.columns_scale())


@dataclass(frozen=True)
class RoomSetup:
    """A robot with IMU and LiDAR in its room: state is the truth, planes those that enough points lie on; plane (N,)
    is the index into them of each point, -1: none."""

    sim: Simulation
    imu: ImuData
    layout: Layout
    planes: tuple[tuple[str, str], ...]
    plane: np.ndarray
    state: State

    @property
    def stream(self) -> LidarStream:
        return self.sim.measurements.lidars[0]

    def columns_scale(self) -> np.ndarray:
        """(B,) a reasonable step of each calibration column."""
        scale = np.zeros(self.layout.size)
        for b in self.layout.free:
            scale[b.columns] = 1e-3 if b.key == ("imu0", "intrinsics") else TOLERANCE[b.name]
        return scale

    def perturbed(self, rng: np.random.Generator, size: float = 1.0) -> State:
        chain = rng.normal(size=(len(self.state.seconds), KEYFRAME_DIM)) * np.repeat([2e-3, 2e-3, 5e-3, 5e-4, 5e-3], 3)
        calib = rng.normal(size=self.layout.size) * self.columns_scale()
        return self.state.retract(self.layout, size * chain, size * calib)

    def motion(self, state: State) -> EstimatedMotion:
        return EstimatedMotion(state, self.imu, 9.81, 0.5)

    def factor(self, start: State | None = None, noise: LidarNoise | None = None, **options) -> LidarFactor:
        """The LiDAR's, its moments taken at `start` or the truth."""
        motion = self.motion(start or self.state)
        noise = noise or LidarNoise(0.03)
        return LidarFactor.build(self.stream, self.plane, self.planes, motion, noise, self.layout, **options)

    def problem(self, start: State, noise: LidarNoise | None = None, **options) -> Problem:
        """IMU and LiDAR, the first keyframe held where it is."""
        imu = ImuFactor.build(self.imu, start, 9.81, self.layout)
        lidar = self.factor(start, noise, **options)
        sensors = ImuSensor("imu0", "", class_noise("consumer")), Lidar(self.stream.name, "")
        tolerance = tolerance_of(self.layout, specs_of(self.layout, sensors), Settings())
        # One ring has no offset of its own, and the mean azimuth is a rotation: nothing but priors holds these numbers.
        rings = (b for b in self.layout.free if b.name in ("ring_offsets", "ring_azimuths"))
        priors = tuple(Prior(b, np.zeros(b.size), np.full(b.size, 10.0)) for b in rings)
        return Problem(self.layout, keyed((imu, lidar)), priors, tolerance, framed=False)


def make_room(
    sim: Simulation,
    *,
    imu_free: bool = False,
    spacing: float = 0.025,
    sheet: bool = False,
    drifts: bool = False,
    rings: bool = False,
) -> RoomSetup:
    """Of the first LiDAR; the planes' points are the means of the faces that the points were seen on. sheet: the floor
    is the sheet of a target at the origin of the world; drifts: the rate of the clock is estimated; rings: the
    errors of its rings are."""
    truth, stream = sim.truth, sim.measurements.lidars[0]
    imu = ImuData.build(not_none(sim.measurements.imu), sim.scenario.imu_noise)
    count = np.bincount(stream.plane[stream.plane >= 0], minlength=len(truth.planes))
    used = np.flatnonzero(count >= FEWEST_POINTS)
    own = np.full(len(truth.planes) + 1, -1, dtype=np.int32)
    own[used] = np.arange(len(used))
    planes = tuple((f"plane{k}", "plane") for k in used)
    entries: list[Entry] = [
        ("imu0", "intrinsics", "vector", 24, imu_free),
        (stream.name, "rotation", "rotation", 3, True),
    ]
    entries.append((stream.name, "translation", "vector", 3, True))
    entries.append((stream.name, "time_offset", "vector", 1, True))
    entries.append((stream.name, "clock_rate", "vector", 1, drifts))
    entries.append((stream.name, "range_offset", "vector", 1, sheet))
    entries.append((stream.name, "range_scale", "vector", 1, sheet or drifts))
    entries.extend((stream.name, name, "vector", 16, rings) for name in RINGS)
    if sheet:
        assert used[0] == 0, "the first face of a room is its floor"
        planes = ((BOARD, "tilt"), *planes[1:])
        entries.append((*planes[0], "tilt", 2, True))
    entries.extend((*key, "plane", 3, True) for key in planes[sheet:])
    T, origin_s = truth.T_imu_sensor[stream.name], (stream.origin_ns - not_none(sim.measurements.imu).origin_ns) * 1e-9
    offset = truth.time_offset[stream.name] + origin_s
    values = {
        ("imu0", "intrinsics"): truth.values["imu0"]["intrinsics"].copy(),
        (stream.name, "time_offset"): np.array([offset]),
    }
    values |= {(stream.name, name): np.zeros(1) for name in ("range_offset", "range_scale", "clock_rate")}
    values[stream.name, MIDDLE] = stream.seconds[-1:] / 3.0
    values |= {(stream.name, name): np.zeros(16) for name in RINGS}
    values[stream.name, "rotation"], values[stream.name, "translation"] = T[:3, :3].copy(), T[:3, 3].copy()
    faces = not_none(sim.scenario.room).faces
    for key, k in zip(planes, used, strict=True):
        at = plane_of(truth.planes[k, :3], faces[k, 0] + 0.5 * (faces[k, 1] + faces[k, 2]))
        values[key] = np.eye(3) if key[1] == "tilt" else at
    ends = stream.seconds[[0, -1]] + offset + np.array([0.0, stream.offset_s.max()])
    seconds = place_keyframes(imu, [np.clip(ends, 0.0, imu.seconds[-1])], spacing, 0.5)
    R, p, v = truth.pose_at(seconds + truth.seconds[0])
    bias = np.tile(np.concatenate([truth.gyro_bias[0], truth.accel_bias[0]]), (len(seconds), 1))
    state = State(seconds, R, p, v, bias, values)
    return RoomSetup(sim, imu, make_layout(entries), planes, own[stream.plane], state)


def room_scenario(duration_s: float, *, example: str = "table2-3d", noiseless: bool = False, **lidar) -> Scenario:
    """The paper's robot with IMU and LiDAR alone, moving freely or as another example; `lidar`: changes of it."""
    scenario = load_scenario(PAPER / f"{example}.yaml")
    return replace(
        scenario,
        duration_s=duration_s,
        cameras=(),
        sensors=(replace(scenario.of(SimLidar)[0], **lidar),),
        features=None,
        board=False,
        imu_noise_enabled=not noiseless,
        robot_noise_enabled=not noiseless,
    )


def make_dense(pieces: tuple[Piece, ...], n_keyframes: int) -> tuple[np.ndarray, np.ndarray]:
    """The normal matrix (chain, then calib) and its gradient."""
    n_calib = pieces[0].calib.shape[0] - 1
    dim = pieces[0].dim
    o = dim * n_keyframes
    H, g = np.zeros((o + n_calib, o + n_calib)), np.zeros(o + n_calib)
    for piece in pieces:
        for k in range(piece.first, piece.last + 1):
            i, a = k - piece.first, slice(dim * k, dim * k + dim)
            H[a, a] += piece.diagonal[i]
            H[a, o:] += piece.side[i, :, :-1]
            g[a] += piece.side[i, :, -1]
            if k < piece.last:
                H[a, dim * k + dim : dim * k + 2 * dim] += piece.upper[i]
        H[o:, o:] += piece.calib[:-1, :-1]
        g[o:] += piece.calib[:-1, -1]
        for H_part, g_part in schur_of_features(piece, n_keyframes) if piece.features else ():
            H -= H_part
            g -= g_part
    return np.triu(H) + np.triu(H, 1).T, g


def schur_of_features(piece: Piece, n_keyframes: int) -> Iterator[tuple[np.ndarray, np.ndarray]]:
    """What eliminating each feature of a piece takes from the dense normal matrix and its gradient."""
    sums, o = not_none(piece.features).sums, KEYFRAME_DIM * n_keyframes
    for f in range(len(sums.diagonal)):
        K = np.zeros((3, o + sums.side.shape[2]))
        K[:, o:] = sums.side[f]
        for e in np.flatnonzero(sums.track == f):
            i = sums.image[e]
            a = KEYFRAME_DIM * (piece.first + sums.keyframe[i])
            K[:, a : a + KEYFRAME_DIM] += sums.block[e] @ sums.pose[i]
            if len(sums.next_pose):
                K[:, a + KEYFRAME_DIM : a + 2 * KEYFRAME_DIM] += sums.block[e] @ sums.next_pose[i]
        M = K[:, :-1].T @ np.linalg.solve(sums.diagonal[f], K)
        yield M[:, :-1], M[:, -1]


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
def features_of() -> Callable[..., FeatureFactor]:
    return make_features


@pytest.fixture(scope="session")
def problem_of() -> Callable[..., Problem]:
    return make_problem


@pytest.fixture(scope="session")
def features_on_planes() -> Callable[..., tuple[Setup, FeatureFactor]]:
    return make_features_on_planes


@pytest.fixture(scope="session")
def dense() -> Callable[..., tuple[np.ndarray, np.ndarray]]:
    return make_dense


@pytest.fixture(scope="session")
def room_of() -> Callable[..., RoomSetup]:
    return make_room


@pytest.fixture(scope="session")
def robot_scenario() -> Callable[..., Scenario]:
    return room_scenario


@pytest.fixture(scope="session")
def sparse_room() -> Simulation:
    """Half a second, few points, no noise of the IMU: where its readings jump, `Poses.velocity` is not quite the
    derivative of the position (a quarter of the jump times the time since the reading)."""
    scenario = room_scenario(0.6, rings=8, azimuth_steps=300, elevation_deg=(-40.0, 30.0))
    return simulate(replace(scenario, imu_noise_enabled=False), seed=3)
