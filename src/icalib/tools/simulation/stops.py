"""Simulated recordings of sensors that stand still at several places.

A camera and a LiDAR, while a board is in several places: at each stop there is an image of the corners, and a cloud of
the board and of the walls of a room. Several LiDARs at several places of a room, a street or a corridor, made of boxes.
Formulas are the obvious ones, by rays and planes; none is the estimator's.
"""

from __future__ import annotations

import heapq
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import yaml
from scipy.spatial.transform import Rotation, Slerp

from icalib.base.files import below, write_text
from icalib.base.yaml_nodes import YamlValue, read_yaml
from icalib.data.measurements import CornerStream, LidarStream, Measurements
from icalib.errors import RigError
from icalib.geometry.targets import Checkerboard, Target
from icalib.kinds import simulated_kinds
from icalib.rig import Camera, Lidar, Parameter, Rig, Settings, by_name
from icalib.rig.file import rig_to_dict, target_of
from icalib.tools.simulation.motion import rotation_from_vector
from icalib.tools.simulation.output import IMAGE, BagWriter
from icalib.tools.simulation.projection import project, visible
from icalib.tools.simulation.rendering import Imaging, Renderer, Sheet
from icalib.tools.simulation.scenario import SimCamera, interval
from icalib.tools.simulation.scenario_file import read_camera
from icalib.tools.simulation.writing import atomic_output, write_corners

_STOP_NS = 1_000_000_000  # between stops
_SWAY_HZ = np.array([0.31, 0.47, 0.72, 0.39, 0.58, 0.87])  # of a hand that holds a board; about and along three axes
_SWAY_ARM_M = 0.3
_IMAGES = "/cam0/image_raw"
# From LiDAR axes (x ahead, y left) to those of a camera that looks ahead (x right, y down), a little askew.
_AXES = np.array([[0.0, -1.0, 0.0], [0.0, 0.0, -1.0], [1.0, 0.0, 0.0]])


def _t_cam_lidar() -> np.ndarray:
    T = np.eye(4)
    T[:3, :3] = rotation_from_vector(np.deg2rad([3.0, -4.0, 2.0])) @ _AXES
    T[:3, 3] = 0.03, -0.16, -0.09
    return T


def _camera() -> SimCamera:
    fisheye = (-0.05, -0.08, 0.1, -0.05)
    return SimCamera("cam0", "pinhole-equidistant", (1920, 1208), (1177.0, 1178.0, 962.0, 613.0), fisheye, np.eye(4))


@dataclass(frozen=True)
class Pauses:
    """When what is recorded at places, in turn. hold_s: at rest at each place; carry_s: from a place to the next,
    smoothly. camera_hz, lidar_hz: rates; scan_s: from the first to the last column of a cloud; late_s: the LiDAR's
    stamps are late, or those of each LiDAR against the one before. sway_m: of a hand, all the time; it turns by as much
    at 0.3 m."""

    hold_s: float = 2.0
    carry_s: float = 1.5
    camera_hz: float = 20.0
    lidar_hz: float = 10.0
    scan_s: float = 0.1
    late_s: float = 0.03
    sway_m: float = 0.0

    def instants(self, places: int, rate_hz: float) -> np.ndarray:
        """Instants [s] of a sensor of `rate_hz` in a recording of so many places."""
        return np.arange(0.5 / rate_hz, places * self.hold_s + (places - 1) * self.carry_s, 1.0 / rate_hz)

    def poses(self, places: np.ndarray, seconds: np.ndarray) -> np.ndarray:
        """(n, 4, 4) poses at `seconds` (n,) of what is carried to one of `places` (p, 4, 4) after the other."""
        place, since = np.divmod(seconds, self.hold_s + self.carry_s)
        u = np.clip((since - self.hold_s) / self.carry_s, 0.0, 1.0)
        along = place + u**3 * (10.0 - 15.0 * u + 6.0 * u**2)
        places = np.concatenate([places, places[-1:]])  # the last one lasts
        out, k = np.tile(np.eye(4), (len(seconds), 1, 1)), np.arange(len(places))
        turns = Slerp(k, Rotation.from_matrix(places[:, :3, :3]))(along)
        sway = self.sway_m * np.sin(2.0 * np.pi * _SWAY_HZ * seconds[:, None] + np.arange(6.0))
        out[:, :3, :3] = (turns * Rotation.from_rotvec(sway[:, :3] / _SWAY_ARM_M)).as_matrix()
        out[:, :3, 3] = np.stack([np.interp(along, k, places[:, i, 3]) for i in range(3)], axis=1) + sway[:, 3:]
        return out


ONCE = Pauses(1.0, 1e-9, camera_hz=1.0, lidar_hz=1.0, scan_s=0.0, late_s=0.0)  # an image and a cloud at each place


@dataclass(frozen=True)
class Stops:
    """A rig at rest: camera, LiDAR and board. board_angles_deg: largest tilt of the board from facing the camera about
    each of its axes; distance_m: between camera and board. azimuth_deg: beams outside return nothing. range_noise_m,
    range_offset_m: along the beam. bleed_m: beams that miss the sheet by less return its range, too, as from reflective
    edges. room_m: from the camera to the walls. panels: T_cam_panel (n, 4, 4) of flat objects as large as the sheet;
    carried: T_board_panel (n, 4, 4) of such objects that move with the board."""

    n_stops: int = 10
    seed: int = 0
    camera: SimCamera = field(default_factory=_camera)
    T_cam_lidar: np.ndarray = field(default_factory=_t_cam_lidar)
    target: Target = field(default_factory=lambda: Checkerboard(7, 6, 0.095, sheet=(0.7, 0.85)))
    board_angles_deg: tuple[float, float, float] = (40.0, 40.0, 30.0)
    distance_m: tuple[float, float] = (1.5, 3.5)
    rings: int = 16
    azimuth_steps: int = 1800
    elevation_deg: tuple[float, float] = (-15.0, 15.0)
    azimuth_deg: tuple[float, float] = (-180.0, 180.0)
    range_noise_m: float = 0.02
    range_offset_m: float = 0.0
    bleed_m: float = 0.0
    room_m: float = 5.0
    panels: np.ndarray = field(default_factory=lambda: np.zeros((0, 4, 4)))
    carried: np.ndarray = field(default_factory=lambda: np.zeros((0, 4, 4)))
    pauses: Pauses = ONCE

    def rig(self, knows_lens: bool = True, topics: bool = False) -> Rig:
        """The rig that a user would write, without any true value but, if `knows_lens`, those of the lens. topics: of a
        bag in place of files."""
        c, sheet = self.camera, replace(self.target, size_sigma=0.0)
        lens = [Parameter("fixed", np.array(x)) if knows_lens else Parameter() for x in (c.intrinsics, c.distortion)]
        camera = Camera(c.name, f"{c.name}/corners.csv", c.model, c.resolution, c.corner_noise_px, lens[0], lens[1])
        lidar = Lidar("lidar0", "lidar0/scans.npz", self.range_noise_m)
        if topics:
            camera, lidar = replace(camera, path="", topic=_IMAGES), replace(lidar, path="", topic="/lidar0/points")
        settings = Settings(loss="none", outlier_std=0.0, bloom=False, board_shape=False, blur_noise=False, segments=0)
        return Rig(by_name(camera, lidar), sheet, settings=settings)


def simulate_stops(stops: Stops, seed: int) -> tuple[Measurements, np.ndarray]:
    """Corners and clouds of all stops, and the poses T_cam_board (n_stops, 4, 4) of the board."""
    rng = np.random.default_rng(seed)
    boards = np.array([_board_pose(stops, rng) for _ in range(stops.n_stops)])
    pauses, n = stops.pauses, stops.n_stops
    at_images, at_clouds = pauses.instants(n, pauses.camera_hz), pauses.instants(n, pauses.lidar_hz)
    corners, points = zip(*(_corners(stops, T, rng) for T in pauses.poses(boards, at_images)), strict=True)
    clouds = [_cloud(stops, T, rng) for T in pauses.poses(boards, at_clouds)]
    start = np.cumsum([0, *(len(x) for x in corners)]).astype(np.int64)
    images = nanoseconds(at_images), start, np.concatenate(points), np.concatenate(corners)
    column_s = np.arange(len(clouds[0])) // stops.rings * (pauses.scan_s / stops.azimuth_steps)
    lidar = scans("lidar0", nanoseconds(at_clouds + pauses.late_s), clouds, np.tile(column_s, len(clouds)))
    return Measurements.of_streams(CornerStream(stops.camera.name, *images), lidar), boards


def nanoseconds(seconds: np.ndarray) -> np.ndarray:
    """Stamps [ns] of instants (n,) of a recording."""
    return _STOP_NS + np.round(1e9 * seconds).astype(np.int64)


def scans(name: str, stamps_ns: np.ndarray, clouds: Sequence[np.ndarray], offset_s: np.ndarray) -> LidarStream:
    """The stream of clouds (N, 3). offset_s: of all points from the stamps of their clouds."""
    xyz = np.concatenate(clouds).astype(np.float32)
    start = np.cumsum([0, *map(len, clouds)]).astype(np.int64)
    return LidarStream(name, stamps_ns, start, offset_s.astype(np.float32), xyz, np.full(len(xyz), -1, np.int32))


def _board_pose(stops: Stops, rng: np.random.Generator) -> np.ndarray:
    """A pose of the board all of whose corners the camera sees, and at which the LiDAR looks."""
    middle = np.append(stops.target.outlines[0].mean(axis=0), 0.0)
    turned = np.diag([1.0, -1.0, -1.0])  # z of the board towards the camera, its y up
    while True:
        T = np.eye(4)
        T[:3, :3] = turned @ rotation_from_vector(np.deg2rad(stops.board_angles_deg) * rng.uniform(-1.0, 1.0, 3))
        distance = rng.uniform(*stops.distance_m)
        direction = np.array([*rng.uniform(-0.5, 0.5, 2), 1.0])
        T[:3, 3] = distance * direction / np.linalg.norm(direction) - T[:3, :3] @ middle
        in_camera = stops.target.points @ T[:3, :3].T + T[:3, 3]
        x, y, z = stops.T_cam_lidar[:3, :3].T @ (T[:3, :3] @ middle + T[:3, 3] - stops.T_cam_lidar[:3, 3])
        looked_at = _between(np.arctan2(z, np.hypot(x, y)), stops.elevation_deg)
        looked_at &= _between(np.arctan2(y, x), stops.azimuth_deg)
        if looked_at and visible(stops.camera, in_camera, project(stops.camera, in_camera)).all():
            return T


def _between(angle: np.ndarray, limits_deg: tuple[float, float]) -> np.ndarray:
    low, high = np.deg2rad(limits_deg)
    return (angle > low) & (angle < high)


def _corners(stops: Stops, T_cam_board: np.ndarray, rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
    """Noisy image points (n, 2) of all corners in the picture, and their numbers (n,)."""
    in_camera = stops.target.points @ T_cam_board[:3, :3].T + T_cam_board[:3, 3]
    uv = project(stops.camera, in_camera)
    seen = np.flatnonzero(visible(stops.camera, in_camera, uv))
    uv = uv + stops.camera.corner_noise_px * rng.standard_normal(uv.shape)
    return uv[seen], seen


def _cloud(stops: Stops, T_cam_board: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """(N, 3) measured points in the frame of the LiDAR: each beam ends at the board, a panel or a wall."""
    azimuth = np.pi * (2.0 * np.arange(stops.azimuth_steps)[:, None] / stops.azimuth_steps - 1.0)
    azimuth = azimuth[_between(azimuth[:, 0], stops.azimuth_deg)]
    beams = directions(azimuth, np.deg2rad(np.linspace(*stops.elevation_deg, stops.rings)))
    R, origin = stops.T_cam_lidar[:3, :3], stops.T_cam_lidar[:3, 3]
    rays = beams @ R.T
    ahead = np.where(rays > 0.0, 1.0, -1.0) * stops.room_m - origin
    distance = (ahead / np.where(rays == 0.0, -1e-12, rays)).min(axis=1)
    outline = stops.target.outlines[0] + stops.bleed_m * np.array([[-1.0], [1.0]])
    for T in (T_cam_board, *stops.panels, *(T_cam_board @ stops.carried)):
        distance = np.minimum(distance, _to_sheet(T, outline, origin, rays))
    measured = distance + stops.range_offset_m + stops.range_noise_m * rng.standard_normal(len(distance))
    return beams * measured[:, None]


def directions(azimuth: np.ndarray, elevation: np.ndarray) -> np.ndarray:
    """(n rings, 3) unit vectors of a spinning LiDAR's beams at each azimuth (n, 1) and elevation (rings,) [rad]."""
    axes = np.cos(azimuth) * np.cos(elevation), np.sin(azimuth) * np.cos(elevation), np.sin(elevation) + 0.0 * azimuth
    return np.stack(axes, axis=2).reshape(-1, 3)


def _to_sheet(T: np.ndarray, outline: np.ndarray, origin: np.ndarray, rays: np.ndarray) -> np.ndarray:
    """(n,) distances from `origin` (3,) along `rays` (n, 3) to a sheet at T (4, 4); infinite where they miss it."""
    normal = T[:3, 2]
    distance = (normal @ (T[:3, 3] - origin)) / (rays @ normal)
    xy = ((origin + distance[:, None] * rays - T[:3, 3]) @ T[:3, :3])[:, :2]
    hit = (distance > 0.0) & (xy > outline[0]).all(axis=1) & (xy < outline[1]).all(axis=1)
    return np.where(hit, distance, np.inf)


# Scenario files of rigs at rest; their format is described in docs/simulation.md.


def load_stops(path: Path) -> Stops | None:
    """The scenario of a file with a section `stops`; None for other files. Raises RigError, one sentence naming file,
    line, field, what is wrong and what to do."""
    root = read_yaml(path, "scenario file")
    if "stops" not in root.entries():
        return None
    fields = root.record(("stops", "sensors", "target"), ("seed",))
    sensors = fields["sensors"].record(("cam0", "lidar0"))
    camera = read_camera("cam0", sensors["cam0"], 0)
    lidar: Any = simulated_kinds()["lidar"].parse("lidar0", sensors["lidar0"], 0)
    target = target_of(fields["target"])
    if len(target.outlines) != 1:
        fields["target"].fail("a rig at rest is simulated before one board; give one.")
    return Stops(
        camera=camera,
        T_cam_lidar=np.linalg.inv(camera.T_imu_sensor) @ lidar.T_imu_sensor,
        target=target,
        rings=lidar.rings,
        azimuth_steps=lidar.azimuth_steps,
        elevation_deg=lidar.elevation_deg,
        range_noise_m=lidar.range_noise_m,
        seed=fields["seed"].whole(0) if "seed" in fields else 0,
        **_places(fields["stops"]),
        pauses=_pauses(fields["stops"], camera, lidar),
    )


def _pauses(value: YamlValue, camera: SimCamera, lidar: Any) -> Pauses:
    """What the section `stops` says of the time at and between places."""
    keys = {"hold": "hold_s", "carry": "carry_s", "sway": "sway_m"}
    chosen = {keys[key]: field.positive() for key, field in value.entries().items() if key in keys}
    late_s = camera.time_offset_s - lidar.time_offset_s
    rates = camera.rate_hz, lidar.rate_hz
    return (
        Pauses(camera_hz=rates[0], lidar_hz=rates[1], scan_s=1.0 / rates[1], late_s=late_s, **chosen)
        if chosen
        else ONCE
    )


def _places(value: YamlValue) -> dict[str, Any]:
    """The fields of `Stops` that the section `stops` sets."""
    fields = value.record(("count",), ("distance", "board_angles_deg", "range_offset", "room", "hold", "carry", "sway"))
    chosen: dict[str, Any] = {"n_stops": fields["count"].whole(1)}
    if "distance" in fields:
        chosen["distance_m"] = interval(fields["distance"])
    if "board_angles_deg" in fields:
        chosen["board_angles_deg"] = tuple(fields["board_angles_deg"].vector(3).tolist())
    if "range_offset" in fields:
        chosen["range_offset_m"] = fields["range_offset"].number()
    if "room" in fields:
        chosen["room_m"] = fields["room"].positive()
    return chosen


def write_stops(stops: Stops, seed: int, path: Path, as_bag: bool = False) -> None:
    """Writes corners and clouds, or images and clouds as a bag of ROS 2, their truth and their rig file to the new
    folder `path`, atomically. Raises RecordingError if `path` exists or cannot be written, RigError for a bag of a rig
    that does not record between the places."""
    if as_bag and stops.pauses is ONCE:
        raise RigError("a bag of stops needs `hold` in the section stops; give it, or leave --level out.")
    measured, boards = simulate_stops(stops, seed)
    rig = replace(stops.rig(knows_lens=False, topics=as_bag), settings=Settings())
    with atomic_output(path) as folder:
        if as_bag:
            _write_bag(stops, seed, boards, measured.lidars[0], folder)
        else:
            write_corners(below(folder, stops.camera.name), measured.cameras[0], stops.target)
            _record(measured.lidars[0], 0).write_table(below(folder, "lidar0"))
        for name, plain in (("rig.yaml", rig_to_dict(rig)), ("truth.yaml", _truth(stops, seed, boards))):
            write_text(folder / name, yaml.safe_dump(plain, sort_keys=False, default_flow_style=None, width=1000))


def _truth(stops: Stops, seed: int, boards: np.ndarray) -> dict[str, Any]:
    camera = stops.camera
    lens = {"intrinsics": list(map(float, camera.intrinsics)), "distortion": list(map(float, camera.distortion))}
    lidar = {"type": "lidar", "T_cam0_lidar0": stops.T_cam_lidar.tolist(), "range_offset": stops.range_offset_m}
    sensors = {"cam0": {"type": "camera", "model": camera.model} | lens, "lidar0": lidar}
    return {"seed": seed, "sensors": sensors, "T_cam0_board": boards.tolist()}


def _record(lidar: LidarStream, offset_ns: int) -> Any:
    """Table and messages of the clouds, as the simulator of a LiDAR writes them."""
    kind: Any = simulated_kinds()["lidar"]
    return kind(lidar.name, np.eye(4)).record(lidar, offset_ns)


def _write_bag(stops: Stops, seed: int, boards: np.ndarray, lidar: LidarStream, path: Path) -> None:
    """Writes rendered images of the board, and `lidar`, in order of their true instants."""
    topic = _record(lidar, -round(1e9 * stops.pauses.late_s)).topic
    renderer, rng = Renderer(stops.camera, Imaging(blur_px=0.8, noise=2.0)), np.random.default_rng([seed, 1])
    seconds = stops.pauses.instants(stops.n_stops, stops.pauses.camera_hz)
    moments = zip(nanoseconds(seconds).tolist(), stops.pauses.poses(boards, seconds), strict=True)

    def take(bag: BagWriter, stamp_ns: int, T: np.ndarray) -> Any:
        picture = renderer.picture([Sheet(stops.target, T)], np.eye(4)[None], rng)
        return bag.image(stamp_ns, stops.camera.name, picture.pixels)

    images = ((ns, _IMAGES, partial(take, stamp_ns=ns, T=T)) for ns, T in moments)
    clouds = ((ns, topic.name, make) for ns, make in topic.events)
    with BagWriter("mcap", path, {_IMAGES: IMAGE, topic.name: topic.message}) as bag:
        for at_ns, name, make in heapq.merge(images, clouds, key=lambda event: event[0]):
            bag.write(name, make(bag), at_ns)


# Several LiDARs that stand still at several places. Surroundings are boxes.

Box = tuple[tuple[float, float, float], tuple[float, float, float], float]  # centre, size [m], yaw [deg]


def pose(rotation_deg: tuple[float, float, float], translation: tuple[float, float, float]) -> np.ndarray:
    """(4, 4) pose from a rotation vector [deg] and a translation [m]."""
    T = np.eye(4)
    T[:3, :3], T[:3, 3] = rotation_from_vector(np.deg2rad(rotation_deg)), translation
    return T


ROOM: tuple[Box, ...] = (
    ((0.0, 0.0, 1.5), (9.0, 6.5, 3.0), 0.0),  # its walls, seen from inside
    ((3.2, 2.4, 1.0), (1.2, 0.6, 2.0), 10.0),
    ((-2.5, -2.4, 0.4), (1.8, 0.9, 0.8), -5.0),
    ((-3.6, 1.8, 0.9), (0.8, 1.1, 1.8), 25.0),
    ((1.0, -2.7, 0.5), (0.7, 0.7, 1.0), 40.0),
)
STREET: tuple[Box, ...] = (
    ((0.0, 0.0, -5.0), (400.0, 400.0, 10.0), 0.0),  # the ground
    ((-18.0, 14.0, 5.0), (22.0, 10.0, 10.0), 0.0),
    ((9.0, 15.5, 4.0), (24.0, 10.0, 8.0), 0.0),
    ((-8.0, -16.0, 6.0), (30.0, 12.0, 12.0), 2.0),
    ((22.0, -14.0, 4.0), (14.0, 9.0, 8.0), -8.0),
    ((6.0, 6.5, 0.75), (4.4, 1.8, 1.5), 3.0),
    ((-7.0, -6.8, 0.8), (4.6, 1.9, 1.6), -2.0),
)
CORRIDOR: tuple[Box, ...] = (((0.0, 0.0, 1.2), (400.0, 2.4, 2.4), 0.0),)


@dataclass(frozen=True)
class Surroundings:
    """LiDARs at rest. T_lidar0: of each LiDAR, by name, in the frame of the first. boxes: of the scene; places: largest
    distance [m] of stops from the origin along x and y. height_m: of the first LiDAR. rings, azimuth_steps,
    elevation_deg: of all LiDARs. range_noise_m: along the beam."""

    T_lidar0: Mapping[str, np.ndarray] = field(
        default_factory=lambda: {"lidar0": np.eye(4), "lidar1": pose((0.0, 40.0, 75.0), (-0.1, 0.55, -0.3))}
    )
    n_stops: int = 3
    boxes: tuple[Box, ...] = ROOM
    places: tuple[float, float] = (1.5, 1.0)
    height_m: float = 1.3
    rings: int = 16
    azimuth_steps: int = 900
    elevation_deg: tuple[float, float] = (-25.0, 15.0)
    range_noise_m: float = 0.02
    pauses: Pauses = ONCE

    def rig(self) -> Rig:
        """The rig that a user would write, without any true value."""
        return Rig(by_name(*(Lidar(name, "") for name in self.T_lidar0)))


def simulate_surroundings(scene: Surroundings, seed: int) -> Measurements:
    """The clouds of all stops."""
    rng = np.random.default_rng(seed)
    bodies = []
    for _ in range(scene.n_stops):
        x, y = np.array(scene.places) * rng.uniform(-1.0, 1.0, 2)
        bodies.append(pose((0.0, 0.0, rng.uniform(-180.0, 180.0)), (x, y, scene.height_m)))
    return Measurements.of_streams(
        *(_lidar_stream(scene, k, np.array(bodies), rng) for k in range(len(scene.T_lidar0)))
    )


def _lidar_stream(scene: Surroundings, number: int, bodies: np.ndarray, rng: np.random.Generator) -> LidarStream:
    """The clouds of a LiDAR at `bodies` (n_stops, 4, 4) and on the way between them, each column at its instant."""
    name, T = list(scene.T_lidar0.items())[number]
    begins = scene.pauses.instants(scene.n_stops, scene.pauses.lidar_hz)
    column_s = np.arange(scene.azimuth_steps) * (scene.pauses.scan_s / scene.azimuth_steps)
    drawn = [_cloud_of_boxes(scene, scene.pauses.poses(bodies, t + column_s) @ T, rng) for t in begins]
    offset_s = column_s[np.concatenate([column for _, column in drawn])]
    stamps_ns = nanoseconds(begins + number * scene.pauses.late_s)
    return scans(name, stamps_ns, [cloud for cloud, _ in drawn], offset_s)


def _cloud_of_boxes(
    scene: Surroundings, T_world_lidar: np.ndarray, rng: np.random.Generator
) -> tuple[np.ndarray, np.ndarray]:
    """(N, 3) measured points in the frame of the LiDAR, of the beams that hit something within 100 m, and their columns
    (N,). T_world_lidar (azimuth_steps, 4, 4): at the instant of each column of beams."""
    azimuth = 2.0 * np.pi * np.arange(scene.azimuth_steps)[:, None] / scene.azimuth_steps
    beams = directions(azimuth, np.deg2rad(np.linspace(*scene.elevation_deg, scene.rings)))
    column = np.repeat(np.arange(scene.azimuth_steps), scene.rings)
    T = T_world_lidar[column]
    rays, origin = (T[:, :3, :3] @ beams[:, :, None])[:, :, 0], T[:, :3, 3]
    distance = np.min([_to_box(box, origin, rays) for box in scene.boxes], axis=0)
    hit = distance < 100.0
    measured = distance[hit] + scene.range_noise_m * rng.standard_normal(int(hit.sum()))
    return beams[hit] * measured[:, None], column[hit]


def _to_box(box: Box, origin: np.ndarray, rays: np.ndarray) -> np.ndarray:
    """(n,) distances from `origin` (n, 3) along `rays` (n, 3) to the next side of a box, from outside or inside;
    infinite where they miss it."""
    centre, size, yaw = box
    R = pose((0.0, 0.0, yaw), (0.0, 0.0, 0.0))[:3, :3]
    o, d = (origin - centre) @ R, rays @ R
    d = np.where(np.abs(d) < 1e-12, 1e-12, d)
    both = np.stack([(-0.5 * np.array(size) - o) / d, (0.5 * np.array(size) - o) / d])
    enter, leave = both.min(axis=0).max(axis=1), both.max(axis=0).min(axis=1)
    hit = (enter < leave) & (leave > 0.0)
    return np.where(hit, np.where(enter > 0.0, enter, leave), np.inf)
