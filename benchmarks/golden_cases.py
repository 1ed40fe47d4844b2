"""The calibrations of the golden record. Each case runs in an empty folder with the links `data` (real recordings) and
`examples`, writes what it needs there, and names files by relative paths: these are in messages and results."""

from __future__ import annotations

import contextlib
import tempfile
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from math import inf
from pathlib import Path
from typing import Any

import numpy as np

from icalib.data.measurements import Measurements
from icalib.geometry.targets import AprilGrid, Charuco, Checkerboard, Circles, NoTarget, Target
from icalib.rig import Ground, Rig, Settings
from icalib.sensors.imu.simulate import SimImu
from icalib.sensors.lidar.simulate import SimLidar
from icalib.sensors.pose.simulate import SimPoses
from icalib.sensors.position.simulate import SimPositions
from icalib.sensors.wheels.simulate import SimWheels
from icalib.tools.simulation import (
    Drive,
    Features,
    Room,
    Scenario,
    handheld,
    load_scenario,
    rig_for,
    simulate,
    tag_map,
    with_drawn_guess,
    write_sensors,
)

ROOT = Path(__file__).resolve().parent.parent
SEED = 1
EPOCH_NS = 1_600_000_000_000_000_000


@dataclass(frozen=True)
class Inputs:
    """What is calibrated: a rig or its file, and measurements, or paths of recordings, used up to end_s [s]."""

    rig: Rig | Path
    recordings: Sequence[Measurements] | Sequence[Path]
    end_s: float = inf


Case = Callable[[], Inputs]

STILLS = """
sensors:
  cam0: {type: camera, topic: images/*_0.jpg, model: pinhole-radtan5, resolution: [752, 480]}
  cam1: {type: camera, topic: images/*_1.jpg, model: pinhole-radtan5, resolution: [752, 480]}
target: {type: aprilgrid, rows: 6, cols: 6, tag_size: 0.088, tag_spacing: 0.3}
"""
WHEEL_MOCAP = """
sensors:
  mocap0: {type: pose, path: mocap0/poses.tum}
  wheel0: {type: wheels, measures: ticks, counts_per_turn: 2796.8, wheel_noise: 0.02}
"""
GNSS_WALK = """
gravity: 9.7985
sensors:
  imu0:
    {type: imu, path: imu.csv, columns: ["1", "5", "6", "7", "2", "3", "4"], accel_unit: g, time_unit: s}
  gnss0: {type: position, path: gnss.pos}
"""
MISSPELT = """
sensors:
  imu0: {type: imu}
  cam0: {type: camera, model: pinhole-radtan, resolution: [752, 480], intrinsic: {fixed: [458, 457, 367, 248]}}
target: {type: aprilgrid, rows: 6, cols: 6, tag_size: 0.088, tag_spacing: 0.3}
"""


@contextlib.contextmanager
def case_folder(data: Path) -> Iterator[None]:
    """Makes a folder as the cases need it the current one. data: folder of the real recordings."""
    with tempfile.TemporaryDirectory() as folder:
        Path(folder, "data").symlink_to(data.resolve(), target_is_directory=True)
        Path(folder, "examples").symlink_to(ROOT / "examples", target_is_directory=True)
        with contextlib.chdir(folder):
            yield


# Real recordings.


def _euroc(rig_file: str, seconds: float = inf) -> Case:
    return lambda: Inputs(Path("examples/euroc", rig_file), [Path("data/euroc_imu_april")], seconds)


def _from_text(rig: str, recording: str) -> Case:
    return lambda: Inputs(_written(Path("rig.yaml"), rig), [Path(recording)])


def _wheel_mocap() -> Inputs:
    """Encoder ticks and planar poses of a square, as tables."""
    (path,) = Path("data/wheel_mocap").glob("diff/square/*/*_run-01.csv")
    write_wheel_tables(Path("run"), np.loadtxt(path, delimiter=","))
    return Inputs(_written(Path("rig.yaml"), WHEEL_MOCAP), [Path("run")])


def write_wheel_tables(folder: Path, rows: np.ndarray) -> None:
    """Tables of `wheel0` and `mocap0` from rows (n, 6): t [s], x, y [m], heading [rad], right and left ticks since the
    row before."""
    stamps = EPOCH_NS + np.round(rows[:, 0] * 1e9).astype(np.int64)
    ticks = np.cumsum(rows[:, 4:], axis=0).astype(np.int64)
    lines = [f"{t},{left},{right}" for t, (right, left) in zip(stamps, ticks, strict=True)]
    poses = [
        f"{t // 10**9}.{t % 10**9:09d} {x} {y} 0 0 0 {np.sin(0.5 * h)} {np.cos(0.5 * h)}"
        for t, (x, y, h) in zip(stamps, rows[:, 1:4], strict=True)
    ]
    _written(folder / "wheel0" / "ticks.csv", "\n".join(["#timestamp [ns],left,right", *lines]) + "\n")
    _written(folder / "mocap0" / "poses.tum", "\n".join(poses) + "\n")


# Simulated recordings, and rigs without a guess and with the default settings.


def _rig(scenario: Scenario, **named: Any) -> Rig:
    """named: as in `rig_for`."""
    return rig_for(scenario, settings=Settings(), **named)


def _simulated(scenario: Scenario, rig: Rig) -> Inputs:
    return Inputs(rig, [simulate(scenario, SEED).measurements])


def _without_imu(scenario: Scenario, rig: Rig) -> Inputs:
    return Inputs(rig.with_(imu=None), [simulate(scenario, SEED).measurements.without("imu0")])


# The paper's robot, with the sensors `parts`: c cameras that track points, b a camera before a wall of tags, l a LiDAR,
# w wheels.

NO_TARGET: dict[str, Any] = {"target": NoTarget(), "T_world_bodies": np.zeros((0, 4, 4))}
WALL_OF_TAGS: dict[str, Any] = {
    "board": True,
    "target": AprilGrid(4, 10, 0.6, 0.3),
    "T_world_board": np.array([[0.0, 0.0, -1.0, 5.9], [-1.0, 0.0, 0.0, 3.9], [0.0, 1.0, 0.0, 0.1], [0.0, 0, 0, 1.0]]),
}


def _robot_scenario(motion: str, seconds: float, parts: str = "clw", points: int = 600) -> Scenario:
    """points: of a turn of a LiDAR's laser, and 20 times those that a camera tracks."""
    scenario = load_scenario(Path("examples/paper", f"{motion}.yaml"))
    cameras = scenario.cameras if "c" in parts else ()
    if "b" in parts:
        scenario = replace(scenario, **WALL_OF_TAGS)
        cameras = (replace(scenario.cameras[0], corner_noise_px=0.15),)
    lidars = tuple(replace(x, azimuth_steps=points) for x in scenario.of(SimLidar) if "l" in parts)
    wheels = tuple(x for x in scenario.of(SimWheels) if "w" in parts)
    features = Features(per_image=points // 20, count=450, persistent=60) if "c" in parts else None
    return replace(scenario, duration_s=seconds, cameras=cameras, sensors=(*lidars, *wheels), features=features)


def _robot(motion: str, seconds: float, parts: str = "clw", points: int = 600) -> Case:
    """With a guess, and settings that model just what is simulated; intrinsics of cameras are free."""

    def case() -> Inputs:
        scenario = _robot_scenario(motion, seconds, parts, points)
        rig = rig_for(scenario, intrinsics="free", distortion="free")
        return _simulated(scenario, with_drawn_guess(rig, scenario, SEED))

    return case


def _robot_from_nothing(motion: str, seconds: float, parts: str) -> Case:
    """Planes are found in the points of the LiDAR."""

    def case() -> Inputs:
        scenario = _robot_scenario(motion, seconds, parts, 300)
        return Inputs(_rig(scenario), [simulate(scenario, SEED).measurements.unassociated()])

    return case


def _restarted_clock() -> Inputs:
    """Two recordings of a camera and the IMU; between them the camera's clock was set back."""
    scenario = _robot_scenario("table2-3d", 12.0, "b")
    (camera,) = scenario.cameras
    later = replace(scenario, cameras=(replace(camera, clock_origin_ns=camera.clock_origin_ns - 37_123_000_000),))
    rig = _rig(scenario).with_("cam0", clock_restarts=True)
    return Inputs(rig, [simulate(s, seed).measurements for seed, s in ((SEED, scenario), (SEED + 1, later))])


# Images, from a bag or a folder as drivers write them. Nothing is known of the lens.


def _images_of(target: Target, folder: str) -> Case:
    """A small camera that is moved by hand in front of a target."""

    def case() -> Inputs:
        base = handheld(5.0)
        motion = replace(base.motion, distance_m=0.9, rotation_scale=0.7, translation_scale=0.8)
        return _driver_messages(replace(base, target=target, motion=motion), folder, 6.0)

    return case


def _images_of_a_room() -> Inputs:
    scenario = replace(_robot_scenario("table2-3d", 8.0, "c"), features=None, **NO_TARGET)
    return _driver_messages(scenario, "run.bag", 10.0)


def _driver_messages(scenario: Scenario, name: str, rate_hz: float) -> Inputs:
    """With the first camera alone, at half its resolution, and the rig file that the simulator writes."""
    fx, fy, cx, cy = 0.5 * np.array(scenario.cameras[0].intrinsics)
    small = (fx, fy, cx - 0.25, cy - 0.25)  # the centre of the top left pixel stays (0, 0)
    camera = replace(scenario.cameras[0], rate_hz=rate_hz, resolution=(376, 240), intrinsics=small)
    write_sensors(simulate(replace(scenario, cameras=(camera,)), SEED), SEED, Path(name))
    is_file = Path(name).suffix == ".bag"
    return Inputs(Path(name).with_suffix(".rig.yaml") if is_file else Path(name, "rig.yaml"), [Path(name)])


def _tags() -> Inputs:
    """Tags anywhere on walls and floor, whose poses nobody measured."""
    scenario = tag_map(8.0)
    rig = _rig(scenario, intrinsics="free", distortion="free")
    return _simulated(scenario, rig)


# Poses and positions.


def _pose(turn: float, x: float, y: float, z: float) -> np.ndarray:
    """(4, 4) of a rotation by `turn` about (2, 1, 2) [rad], and a position [m]."""
    a, c, s = np.array([2.0, 1.0, 2.0]) / 3.0, np.cos(turn), np.sin(turn)
    T = np.eye(4)
    T[:3, :3] = c * np.eye(3) + (1.0 - c) * np.outer(a, a) + s * np.cross(np.eye(3), a)
    T[:3, 3] = x, y, z
    return T


def _poses(name: str = "mocap0", mount: np.ndarray | None = None, **fields: Any) -> SimPoses:
    """In a frame that is tilted against gravity."""
    frame, mount = _pose(2.0, 3.0, -1.0, 0.5), _pose(1.1, 0.1, -0.2, 0.15) if mount is None else mount
    given = {"time_offset_s": 0.0123, "clock_origin_ns": 777, "phase_s": 0.003} | fields
    return SimPoses(name, mount, T_world_frame=frame, **given)


def _antenna(**fields: Any) -> SimPositions:
    given = {"rate_hz": 5.0, "phase_s": 0.3, "clock_origin_ns": 5_000_000_000} | fields
    return SimPositions("gnss0", _pose(0.0, 0.4, -0.25, 0.6), 0.037, **given)


def _in_a_room(drive: Drive, seconds: float, *sensors: Any) -> Scenario:
    room = Room((30.0, 20.0, 6.0))
    return Scenario((), duration_s=seconds, motion=drive, board=False, room=room, sensors=sensors)


def _odometry_imu() -> Inputs:
    """An odometry that drifts, and an IMU."""
    odometry = _poses(kind="relative", rotation_noise=5e-3, position_noise=1e-2)
    scenario = _in_a_room(Drive("free"), 12.0, odometry)
    return _simulated(scenario, _rig(scenario))


def _poses_without_imu() -> Inputs:
    other = _poses("slam0", _pose(-2.0, -0.2, 0.3, 0.1), clock_origin_ns=0, position_noise=5e-3, rate_hz=30.0)
    scenario = _in_a_room(Drive("free"), 15.0, _poses(rate_hz=50.0), other)
    return _without_imu(scenario, _rig(scenario))


def _position_on_wheels() -> Inputs:
    """On a flat floor, without an IMU and without the sizes of the wheels."""
    wheels = SimWheels("wheels0", _pose(0.0, 0.1, 0.05, -0.3), 0.013)
    scenario = _in_a_room(Drive("planar"), 30.0, wheels, _antenna(T_world_frame=_pose(0.0, 3.0, -1.0, 0.5)))
    rig = _rig(scenario).with_("wheels0", ground=Ground("level", tilt_noise=5e-3))
    return _without_imu(scenario, rig)


def _position_in_the_target_frame() -> Inputs:
    scenario = handheld(10.0)
    camera = replace(scenario.cameras[0], rate_hz=10.0)
    frame = scenario.T_world_board
    prism = _antenna(rate_hz=10.0, position_noise=2e-3, T_world_frame=frame, shared_frame="target")
    scenario = replace(scenario, cameras=(camera,), sensors=(prism,))
    return _simulated(scenario, _rig(scenario))


def _hand_eye(inverted: bool = False) -> Case:
    """A camera on a robot's flange, which stops once a second. inverted: poses of the base in the flange's frame."""

    def case() -> Inputs:
        clock = {"rate_hz": 1.0, "phase_s": 0.5, "time_offset_s": 0.0, "clock_origin_ns": 0}
        base = handheld(19.8)
        flange = _poses("flange", rotation_noise=2e-3, position_noise=1e-3, **clock)
        cameras = (replace(base.cameras[0], **clock),)
        scenario = replace(base, cameras=cameras, sensors=(flange,), imu_clock_origin_ns=0)
        inputs = _without_imu(scenario, _rig(scenario, intrinsics="free", distortion="free"))
        (measured,) = inputs.recordings
        assert isinstance(measured, Measurements)
        (poses,) = measured.poses
        if inverted:
            back = np.ascontiguousarray(poses.rotation.transpose(0, 2, 1))
            poses = replace(poses, rotation=back, position=-np.einsum("nij,nj->ni", back, poses.position))
        return replace(inputs, recordings=[measured.with_streams(poses)])

    return case


# Wrong rigs and recordings.


def _several_imus() -> Inputs:
    """A second IMU, with a clock of its own that starts late, as the body of a rig with a camera and a target."""
    base = handheld(12.0)
    second = SimImu("imu1", _pose(0.4, 0.12, -0.08, 0.05), 0.0123, 333.0, 1.5, base.imu_clock_origin_ns)
    scenario = replace(base, cameras=base.cameras[:1]).with_sensors(second)
    return _simulated(scenario, replace(_rig(scenario), body="imu1"))


def _wrong_lens() -> Inputs:
    """The rig file fixes the focal lengths of cam0 at wrong values."""
    scenario = handheld(10.0)
    (cam0, cam1) = scenario.cameras
    wrong = replace(scenario, cameras=(replace(cam0, intrinsics=(472.6, 471.3, 367.2, 248.4)), cam1))
    return _simulated(scenario, _rig(wrong))


def _written(path: Path, text: str) -> Path:
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(text, encoding="utf-8")
    return path


CASES: dict[str, Case] = {
    "euroc": _euroc("rig.yaml"),
    "euroc-equidistant": _euroc("rig-equidistant.yaml", 30.0),
    "euroc-from-nothing": _euroc("rig-from-nothing.yaml", 30.0),
    "table2-3d": _robot("table2-3d", 10.0),
    "table2-planar": _robot("table2-planar", 10.0),
    "table2-ramp": _robot("table2-ramp", 10.0),
    "straight-line": _robot("straight-line", 6.0, points=300),
    "standing": _robot("standing", 6.0, points=300),
    "lidar": _robot("table2-3d", 12.0, "l", 1800),
    "lidar-wheels": _robot_from_nothing("table2-ramp", 10.0, "lw"),
    "camera-wheels": _robot_from_nothing("table2-ramp", 10.0, "bw"),
    "restarted-clock": _restarted_clock,
    "wheel-mocap": _wheel_mocap,
    "stills": _from_text(STILLS, "data/aprilgrid_images"),
    "images-aprilgrid": _images_of(AprilGrid(6, 6, 0.088, 0.3), "run.bag"),
    "images-checkerboard": _images_of(Checkerboard(6, 9, 0.06), "run"),
    "images-charuco": _images_of(Charuco(8, 6, 0.08, 0.06, "4x4_50"), "run"),
    "images-circles": _images_of(Circles(7, 8, 0.08, 0.048), "run.bag"),
    "images-room": _images_of_a_room,
    "tags": _tags,
    "hand-eye": _hand_eye(),
    "odometry-imu": _odometry_imu,
    "poses-without-imu": _poses_without_imu,
    "gnss-walk": _from_text(GNSS_WALK, "data/gnss_imu/walk"),
    "position-on-wheels": _position_on_wheels,
    "position-in-target-frame": _position_in_the_target_frame,
    "wrong-lens": _wrong_lens,
    "wrong-rig-file": _from_text(MISSPELT, "data/euroc_imu_april"),
    "refused-recording": _from_text(WHEEL_MOCAP, "data/euroc_imu_april"),
    "refused-poses": _hand_eye(inverted=True),
    "several-imus": _several_imus,
}
