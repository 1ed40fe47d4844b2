"""Simulated recordings of a camera and a LiDAR that stand still while a board is in several places.

Each place is a stop: an image of the corners, and a cloud of the board and of the walls of a room. Formulas are the
obvious ones, by rays and planes in the frame of the camera; none is the estimator's.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
import yaml

from icalib.base.files import below, write_text
from icalib.base.yaml_nodes import YamlValue, read_yaml
from icalib.data.measurements import CornerStream, LidarStream, Measurements
from icalib.geometry.targets import Checkerboard, Target
from icalib.kinds import simulated_kinds
from icalib.rig import Camera, Lidar, Parameter, Rig, Settings, by_name
from icalib.rig.file import rig_to_dict, target_of
from icalib.tools.simulation.motion import rotation_from_vector
from icalib.tools.simulation.projection import project, visible
from icalib.tools.simulation.scenario import SimCamera, interval
from icalib.tools.simulation.scenario_file import read_camera
from icalib.tools.simulation.writing import atomic_output, write_corners

_STOP_NS = 1_000_000_000  # between stops
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

    def rig(self, knows_lens: bool = True) -> Rig:
        """The rig that a user would write, without any true value but, if `knows_lens`, those of the lens."""
        c, sheet = self.camera, replace(self.target, size_sigma=0.0)
        lens = [Parameter("fixed", np.array(x)) if knows_lens else Parameter() for x in (c.intrinsics, c.distortion)]
        camera = Camera(c.name, f"{c.name}/corners.csv", c.model, c.resolution, c.corner_noise_px, lens[0], lens[1])
        settings = Settings(loss="none", outlier_std=0.0, bloom=False, board_shape=False, blur_noise=False, segments=0)
        return Rig(by_name(camera, Lidar("lidar0", "lidar0/scans.npz", self.range_noise_m)), sheet, settings=settings)


def simulate_stops(stops: Stops, seed: int) -> tuple[Measurements, np.ndarray]:
    """Corners and clouds of all stops, and the poses T_cam_board (n_stops, 4, 4) of the board."""
    rng = np.random.default_rng(seed)
    boards = np.array([_board_pose(stops, rng) for _ in range(stops.n_stops)])
    stamps_ns = _STOP_NS * np.arange(1, stops.n_stops + 1)
    corners, points = zip(*(_corners(stops, T, rng) for T in boards), strict=True)
    clouds = [_cloud(stops, T, rng) for T in boards]
    starts = [np.cumsum([0, *(len(x) for x in each)]).astype(np.int64) for each in (corners, clouds)]
    camera = CornerStream(stops.camera.name, stamps_ns, starts[0], np.concatenate(points), np.concatenate(corners))
    xyz = np.concatenate(clouds).astype(np.float32)
    zeros, none = np.zeros(len(xyz), np.float32), np.full(len(xyz), -1, np.int32)
    lidar = LidarStream("lidar0", stamps_ns, starts[1], zeros, xyz, none)
    return Measurements.of_streams(camera, lidar), boards


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
    """Noisy image points (n, 2) of all corners, and their numbers (n,)."""
    uv = project(stops.camera, stops.target.points @ T_cam_board[:3, :3].T + T_cam_board[:3, 3])
    return uv + stops.camera.corner_noise_px * rng.standard_normal(uv.shape), np.arange(len(uv))


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
    )


def _places(value: YamlValue) -> dict[str, Any]:
    """The fields of `Stops` that the section `stops` sets."""
    fields = value.record(("count",), ("distance", "board_angles_deg", "range_offset", "room"))
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


def write_stops(stops: Stops, seed: int, path: Path) -> None:
    """Writes corners, clouds, their truth and their rig file to the new folder `path`, atomically. Raises
    RecordingError if `path` exists or cannot be written."""
    measured, boards = simulate_stops(stops, seed)
    camera, lidar = stops.camera, measured.lidars[0]
    rig = replace(stops.rig(knows_lens=False), settings=Settings())
    lens = {"intrinsics": list(map(float, camera.intrinsics)), "distortion": list(map(float, camera.distortion))}
    truth = {
        "seed": seed,
        "sensors": {
            "cam0": {"type": "camera", "model": camera.model} | lens,
            "lidar0": {
                "type": "lidar", "T_cam0_lidar0": stops.T_cam_lidar.tolist(), "range_offset": stops.range_offset_m
            },
        },
        "T_cam0_board": boards.tolist(),
    }  # fmt: skip
    with atomic_output(path) as folder:
        write_corners(below(folder, camera.name), measured.cameras[0], stops.target)
        scans = {name: getattr(lidar, name) for name in ("stamps_ns", "start", "offset_s", "xyz", "plane")}
        below(folder, lidar.name).mkdir(parents=True)
        np.savez(below(folder, lidar.name) / "scans.npz", **scans)
        for name, plain in (("rig.yaml", rig_to_dict(rig)), ("truth.yaml", truth)):
            write_text(folder / name, yaml.safe_dump(plain, sort_keys=False, default_flow_style=None, width=1000))
