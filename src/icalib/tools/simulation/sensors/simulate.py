"""From a scenario to measurements and the truth behind them."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from icalib.data.measurements import (
    CornerStream,
    ImuStream,
    LidarStream,
    Measurements,
    PoseStream,
    WheelPoses,
    WheelStream,
)
from icalib.rig import LENS
from icalib.sensors.camera.spec import BLOOM
from icalib.tools.simulation.scenario.robot import SimLidar, SimPoses, SimWheels
from icalib.tools.simulation.scenario.scenario import GRAVITY_WORLD, HandheldMotion, Scenario, SimCamera
from icalib.tools.simulation.sensors.corners import CornerTruth, see_corners
from icalib.tools.simulation.sensors.drives import drive_motion
from icalib.tools.simulation.sensors.imu import imu_stamps, inside, read_imu
from icalib.tools.simulation.sensors.lidar import scan_room
from icalib.tools.simulation.sensors.motion import AnalyticTrajectory, TrueTrajectory, exact_motion, reference_motion
from icalib.tools.simulation.sensors.poses import PoseTruth, report_poses
from icalib.tools.simulation.sensors.tracks import SimulatedTracks, TrackTruth, follow
from icalib.tools.simulation.sensors.wheels import WheelTruth, read_wheels

Progress = Callable[[str, float], None]  # what is being done, and the share of all that is done
_LIDAR_STREAM, _WHEEL_STREAM, _POSE_STREAM = 1000, 2000, 4000  # of random numbers; those of cameras count from 2


@dataclass(frozen=True, eq=False)
class Truth:
    """What the measurements were made from.

    All instants are seconds on the IMU's clock since `imu_clock_origin_ns`. Arrays over the readings have one row per
    reading in the measurements (readings lost in gaps have none). Dictionaries are by the sensor's name.
    """

    imu_clock_origin_ns: int
    seconds: np.ndarray  # (N,)
    R_world_imu: np.ndarray  # (N, 3, 3)
    position: np.ndarray  # (N, 3) m, world
    velocity: np.ndarray  # (N, 3) m/s, world
    gyro_bias: np.ndarray  # (N, 3) rad/s
    accel_bias: np.ndarray  # (N, 3) m/s^2
    imu_intrinsics: np.ndarray  # (24,)
    target_size: float
    scale: dict[str, float]  # of pose sensors
    gravity: np.ndarray  # (3,) m/s^2, world
    T_world_bodies: np.ndarray  # (bodies, 4, 4), in the order of the target's bodies
    bow: np.ndarray  # (3,) m
    T_imu_cam: dict[str, np.ndarray]
    time_offset: dict[str, float]  # s, between raw stamps: t_imu = t_sensor + time_offset
    intrinsics: dict[str, np.ndarray]
    distortion: dict[str, np.ndarray]
    bloom: dict[str, float]  # px
    corners: dict[str, CornerTruth]
    trajectory: TrueTrajectory
    tracks: dict[str, TrackTruth] = field(default_factory=dict)
    wheels: dict[str, WheelTruth] = field(default_factory=dict)
    points: np.ndarray = field(default_factory=lambda: np.empty((0, 3)))  # (F, 3) m, world, by number of the feature
    planes: np.ndarray = field(default_factory=lambda: np.empty((0, 4)))  # (P, 4) n, d: n . p = d, world
    T_imu_lidar: dict[str, np.ndarray] = field(default_factory=dict)
    T_imu_wheel: dict[str, np.ndarray] = field(default_factory=dict)
    drive: dict[str, dict[str, np.ndarray]] = field(default_factory=dict)  # of wheels, see `SimWheels.drive`
    T_imu_pose: dict[str, np.ndarray] = field(default_factory=dict)  # of pose sensors
    T_world_frame: dict[str, np.ndarray] = field(default_factory=dict)  # of theirs
    poses: dict[str, PoseTruth] = field(default_factory=dict)

    @property
    def T_world_board(self) -> np.ndarray:
        """(4, 4): of the first body."""
        return self.T_world_bodies[0]

    def pose_at(self, seconds: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Exact R_world_imu (N, 3, 3), position and velocity (N, 3) in world at seconds (N,)."""
        return self.trajectory.pose_at(np.asarray(seconds, dtype=np.float64))


@dataclass(frozen=True, eq=False)
class Simulation:
    """One simulated recording."""

    scenario: Scenario
    measurements: Measurements
    truth: Truth


def raw_time_offset(scenario: Scenario, sensor: SimCamera | SimLidar | SimWheels | SimPoses) -> float:
    """Seconds to add to the sensor's raw stamps to get the IMU's: the offset and the distance of the clock origins."""
    return sensor.time_offset_s + (scenario.imu_clock_origin_ns - sensor.clock_origin_ns) * 1e-9


def simulate(scenario: Scenario, seed: int, progress: Progress = lambda stage, done: None) -> Simulation:
    """Simulate one recording; the same scenario and seed give the same numbers.

    Motion, IMU noise and each sensor draw from streams of their own: changing one leaves the others as they are.
    Raises RigError where a robot's sensor measures less than twice, RecordingError where a recorded motion cannot be
    used.
    """
    progress("motion", 0.0)
    imu_rng = np.random.default_rng([seed, 1])
    stamps = imu_stamps(scenario, imu_rng)
    seconds = stamps.astype(np.float64) * 1e-9
    trajectory, ideal = _motion(scenario, seed, seconds)
    readings = read_imu(scenario, seconds, ideal, imu_rng)
    kept = ~inside(scenario.imu_gaps, seconds)
    stamps_ns = stamps[kept] + np.int64(scenario.imu_clock_origin_ns)
    imu = ImuStream("imu0", stamps_ns, readings.gyro[kept], readings.accel[kept])
    progress("images", 0.1)
    corners, corner_truth = _corners(scenario, trajectory, seed)
    followed = _tracks(scenario, trajectory, seed)
    lidars = _scans(scenario, trajectory, seed, progress)
    progress("wheels", 0.95)
    wheels, wheel_truth = _wheels(scenario, trajectory, seconds, seed)
    poses, pose_truth = _poses(scenario, trajectory, seconds, seed)
    truth = Truth(
        **_motion_truth(scenario, trajectory, seconds[kept]),
        **_rig_truth(scenario),
        gyro_bias=readings.gyro_bias[kept],
        accel_bias=readings.accel_bias[kept],
        corners=corner_truth,
        tracks={s.name: t for s, t in zip(followed.streams, followed.truths, strict=True)},
        wheels=wheel_truth,
        poses=pose_truth,
        points=followed.points,
    )
    measured = Measurements.of_streams(imu, *corners, *followed.streams, *lidars, *wheels, *poses)
    return Simulation(scenario, measured, truth)


def _motion(scenario: Scenario, seed: int, seconds: np.ndarray) -> tuple[TrueTrajectory, np.ndarray]:
    """The trajectory, and the rates and forces (N, 6) that an IMU without errors reads on it."""
    motion = scenario.motion
    rng = np.random.default_rng([seed if motion.seed is None else motion.seed, 0])
    reference: AnalyticTrajectory
    if isinstance(motion, HandheldMotion):
        reference = reference_motion(scenario, rng)
    else:
        assert scenario.room is not None  # `Scenario` sees to it
        T_imu_wheel = scenario.wheels[0].T_imu_wheel if scenario.wheels else None
        reference = drive_motion(motion, scenario.room, T_imu_wheel, scenario.duration_s, rng)
    if motion.exact:
        trajectory = exact_motion(reference, seconds)
        return trajectory, trajectory.readings
    return reference, reference.readings_at(seconds)


def _corners(
    scenario: Scenario, trajectory: TrueTrajectory, seed: int
) -> tuple[tuple[CornerStream, ...], dict[str, CornerTruth]]:
    if not scenario.board:
        return (), {}
    seen = [
        see_corners(scenario, camera, trajectory, np.random.default_rng([seed, 2 + i]))
        for i, camera in enumerate(scenario.cameras)
    ]
    return tuple(stream for stream, _ in seen), {stream.name: truth for stream, truth in seen}


def _tracks(scenario: Scenario, trajectory: TrueTrajectory, seed: int) -> SimulatedTracks:
    if scenario.room is None or scenario.features is None or not scenario.cameras:
        return SimulatedTracks((), (), np.empty((0, 3)))
    return follow(scenario, scenario.room, scenario.features, trajectory, seed)


def _scans(scenario: Scenario, trajectory: TrueTrajectory, seed: int, progress: Progress) -> tuple[LidarStream, ...]:
    scans = []
    for i, lidar in enumerate(scenario.lidars):
        assert scenario.room is not None  # `Scenario` sees to it
        share = (0.3 + 0.65 * i / len(scenario.lidars), 0.65 / len(scenario.lidars))
        done = _shared(progress, lidar.name, *share)
        scans.append(scan_room(scenario.room, lidar, trajectory, scenario, [seed, _LIDAR_STREAM + i], done))
    return tuple(scans)


def _shared(progress: Progress, stage: str, before: float, share: float) -> Callable[[float], None]:
    return lambda done: progress(stage, before + share * done)


def _wheels(
    scenario: Scenario, trajectory: TrueTrajectory, seconds: np.ndarray, seed: int
) -> tuple[tuple[WheelStream | WheelPoses, ...], dict[str, WheelTruth]]:
    read = []
    for i, wheels in enumerate(scenario.wheels):
        rng = np.random.default_rng([seed, _WHEEL_STREAM + i])
        read.append(read_wheels(wheels, trajectory, seconds, scenario.robot_noise_enabled, rng))
    return tuple(stream for stream, _ in read), {stream.name: truth for stream, truth in read}


def _poses(
    scenario: Scenario, trajectory: TrueTrajectory, seconds: np.ndarray, seed: int
) -> tuple[tuple[PoseStream, ...], dict[str, PoseTruth]]:
    read = []
    for i, sensor in enumerate(scenario.poses):
        rng = np.random.default_rng([seed, _POSE_STREAM + i])
        read.append(report_poses(sensor, trajectory, seconds, scenario.robot_noise_enabled, rng))
    return tuple(stream for stream, _ in read), {stream.name: truth for stream, truth in read}


def _motion_truth(scenario: Scenario, trajectory: TrueTrajectory, seconds: np.ndarray) -> dict[str, Any]:
    """The fields of `Truth` on where the IMU was at its readings."""
    rotation, position, velocity = trajectory.pose_at(seconds)
    return {
        "imu_clock_origin_ns": scenario.imu_clock_origin_ns,
        "seconds": seconds,
        "R_world_imu": rotation,
        "position": position,
        "velocity": velocity,
        "trajectory": trajectory,
    }


def _rig_truth(scenario: Scenario) -> dict[str, Any]:
    """The fields of `Truth` that the scenario states."""
    cameras, lidars, wheels, poses = scenario.cameras, scenario.lidars, scenario.wheels, scenario.poses
    lenses = {name: {c.name: np.array(getattr(c, name)) for c in cameras} for name in LENS}
    blooms = {BLOOM.name: {c.name: c.bloom_px for c in cameras}}
    return (
        lenses
        | blooms
        | {
            "T_imu_cam": {c.name: c.T_imu_cam for c in cameras},
            "imu_intrinsics": scenario.imu_intrinsics,
            "target_size": scenario.target_size,
            "scale": {s.name: s.scale for s in poses},
            "gravity": GRAVITY_WORLD,
            "T_world_bodies": scenario.body_poses,
            "bow": np.array(scenario.bow),
            "planes": np.empty((0, 4)) if scenario.room is None else scenario.room.planes,
            "time_offset": {s.name: raw_time_offset(scenario, s) for s in (*cameras, *lidars, *wheels, *poses)},
            "T_imu_lidar": {s.name: s.T_imu_lidar for s in lidars},
            "T_imu_wheel": {s.name: s.T_imu_wheel for s in wheels},
            "drive": {s.name: s.drive for s in wheels},
            "T_imu_pose": {s.name: s.T_imu_sensor for s in poses},
            "T_world_frame": {s.name: s.T_world_frame for s in poses},
        }
    )
