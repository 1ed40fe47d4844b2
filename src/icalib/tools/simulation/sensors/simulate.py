"""Simulates the measurements of a scenario, and their truth."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from icalib.data.measurements import CornerStream, ImuStream, Measurements
from icalib.geometry.targets.base import BOARD
from icalib.sensors.sensor import mounted
from icalib.tools.simulation.scenario.scenario import GRAVITY_WORLD, HandheldMotion, Scenario, SimCamera
from icalib.tools.simulation.scenario.sensor import Report, SimScene, SimSensor
from icalib.tools.simulation.scenario.trajectory import TrueTrajectory
from icalib.tools.simulation.sensors.corners import CornerTruth, see_corners
from icalib.tools.simulation.sensors.drives import drive_motion
from icalib.tools.simulation.sensors.imu import ideal_readings, imu_stamps, inside, read_imu
from icalib.tools.simulation.sensors.motion import reference_motion
from icalib.tools.simulation.sensors.tracks import SimulatedTracks, TrackTruth, follow

Progress = Callable[[str, float], None]  # called with the current step, and the progress of the whole, 0 to 1
_CAMERA_STREAM = 2  # number of the first camera's random stream; further cameras have the following ones


@dataclass(frozen=True, eq=False)
class Truth:
    """True values behind the measurements.

    All instants are seconds on the IMU's clock since `imu_clock_origin_ns`. Arrays with N rows have one for each
    reading in the measurements; lost readings have none. Dictionaries are by name of the sensor.
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
    gravity: np.ndarray  # (3,) m/s^2, world
    T_world_bodies: np.ndarray  # (bodies, 4, 4), in the order of the target's bodies
    bow: np.ndarray  # (3,) m
    values: dict[str, dict[str, np.ndarray]]  # of each parameter, by its name in results, of each sensor and the board
    T_imu_sensor: dict[str, np.ndarray]
    time_offset: dict[str, float]  # s, between raw stamps: t_imu = t_sensor + time_offset
    corners: dict[str, CornerTruth]
    trajectory: TrueTrajectory
    tracks: dict[str, TrackTruth] = field(default_factory=dict)
    reported: dict[str, Any] = field(default_factory=dict)  # without noise, in the form of the sensor's kind
    points: np.ndarray = field(default_factory=lambda: np.empty((0, 3)))  # (F, 3) m, world, by number of the feature
    planes: np.ndarray = field(default_factory=lambda: np.empty((0, 4)))  # (P, 4) n, d: n . p = d, world

    @property
    def T_world_board(self) -> np.ndarray:
        """(4, 4) pose of the first body of the target."""
        return self.T_world_bodies[0]

    def pose_at(self, seconds: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Exact R_world_imu (N, 3, 3), position (N, 3) m and velocity (N, 3) m/s in the world at seconds (N,)."""
        return self.trajectory.pose_at(np.asarray(seconds, dtype=np.float64))


@dataclass(frozen=True, eq=False)
class Simulation:
    """One simulated recording with its truth."""

    scenario: Scenario
    measurements: Measurements
    truth: Truth


def raw_time_offset(scenario: Scenario, sensor: SimCamera | SimSensor) -> float:
    """Seconds to add to the sensor's raw stamps to get the IMU's clock: its time offset, plus the difference of the
    clock origins."""
    return sensor.time_offset_s + (scenario.imu_clock_origin_ns - sensor.clock_origin_ns) * 1e-9


def simulate(scenario: Scenario, seed: int, progress: Progress = lambda stage, done: None) -> Simulation:
    """Simulates one recording; the same scenario and seed give the same numbers.

    Motion, IMU noise and each sensor have separate random streams, so that a change of one does not affect the others.
    Raises RigError if a sensor of a robot has fewer than two measurements, RecordingError if a recorded motion cannot
    be used.
    """
    progress("motion", 0.0)
    imu_rng = np.random.default_rng([seed, 1])
    stamps = imu_stamps(scenario, imu_rng)
    seconds = stamps.astype(np.float64) * 1e-9
    trajectory = _motion(scenario, seed)
    readings = read_imu(scenario, seconds, ideal_readings(scenario, trajectory, seconds), imu_rng)
    kept = ~inside(scenario.imu_gaps, seconds)
    stamps_ns = stamps[kept] + np.int64(scenario.imu_clock_origin_ns)
    imu = ImuStream("imu0", stamps_ns, readings.gyro[kept], readings.accel[kept])
    progress("images", 0.1)
    corners, corner_truth = _corners(scenario, trajectory, seed)
    followed = _tracks(scenario, trajectory, seed)
    scene = SimScene(trajectory, seconds, scenario.duration_s, scenario.room, scenario.robot_noise_enabled)
    reports = _reports(scenario, scene, seed, progress)
    truth = Truth(
        **_motion_truth(scenario, trajectory, seconds[kept]),
        **_rig_truth(scenario),
        gyro_bias=readings.gyro_bias[kept],
        accel_bias=readings.accel_bias[kept],
        corners=corner_truth,
        tracks={s.name: t for s, t in zip(followed.streams, followed.truths, strict=True)},
        reported={name: report.truth for name, report in reports.items()},
        points=followed.points,
    )
    streams = (report.stream for report in reports.values())
    measured = Measurements.of_streams(imu, *corners, *followed.streams, *streams)
    return Simulation(scenario, measured, truth)


def true_values(scenario: Scenario, sensor: SimCamera | SimSensor) -> dict[str, np.ndarray]:
    """True parameters of a sensor by their names in the rig, extrinsics and time offset included."""
    T, offset = sensor.T_imu_sensor, np.array([raw_time_offset(scenario, sensor)])
    return mounted(T[:3, :3], T[:3, 3], offset) | sensor.values()


def _motion(scenario: Scenario, seed: int) -> TrueTrajectory:
    """The true trajectory."""
    motion = scenario.motion
    rng = np.random.default_rng([seed if motion.seed is None else motion.seed, 0])
    if isinstance(motion, HandheldMotion):
        return reference_motion(scenario, rng)
    assert scenario.room is not None  # `Scenario` sees to it
    T_imu_rolling = next((s.T_imu_sensor for s in scenario.sensors if s.rolls), None)
    return drive_motion(motion, scenario.room, T_imu_rolling, scenario.duration_s, rng)


def _corners(
    scenario: Scenario, trajectory: TrueTrajectory, seed: int
) -> tuple[tuple[CornerStream, ...], dict[str, CornerTruth]]:
    if not scenario.board:
        return (), {}
    corners = [
        see_corners(scenario, camera, trajectory, np.random.default_rng([seed, _CAMERA_STREAM + i]))
        for i, camera in enumerate(scenario.cameras)
    ]
    return tuple(stream for stream, _ in corners), {stream.name: truth for stream, truth in corners}


def _tracks(scenario: Scenario, trajectory: TrueTrajectory, seed: int) -> SimulatedTracks:
    if scenario.room is None or scenario.features is None or not scenario.cameras:
        return SimulatedTracks((), (), np.empty((0, 3)))
    return follow(scenario, scenario.room, scenario.features, trajectory, seed)


def _reports(scenario: Scenario, scene: SimScene, seed: int, progress: Progress) -> dict[str, Report]:
    """Measurements of the sensors other than IMU and cameras, by name."""
    reports, of_kind, share = {}, Counter[int](), 0.7 / max(len(scenario.sensors), 1)
    for i, sensor in enumerate(scenario.sensors):
        number = sensor.random_stream + of_kind[sensor.random_stream]
        of_kind[sensor.random_stream] += 1
        progress(sensor.name, 0.3 + share * i)
        done = _shared(progress, sensor.name, 0.3 + share * i, share)
        reports[sensor.name] = sensor.report(scene, [seed, number], done)
    return reports


def _shared(progress: Progress, stage: str, before: float, share: float) -> Callable[[float], None]:
    return lambda done: progress(stage, before + share * done)


def _motion_truth(scenario: Scenario, trajectory: TrueTrajectory, seconds: np.ndarray) -> dict[str, Any]:
    """The fields of `Truth` on the motion of the IMU; seconds (N,): of its readings."""
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
    """The fields of `Truth` that are copied from the scenario."""
    sensors = scenario.mounted
    return {
        "imu_intrinsics": scenario.imu_intrinsics,
        "target_size": scenario.target_size,
        "gravity": GRAVITY_WORLD,
        "T_world_bodies": scenario.body_poses,
        "bow": np.array(scenario.bow),
        "planes": np.empty((0, 4)) if scenario.room is None else scenario.room.planes,
        "values": {
            "imu0": {"intrinsics": scenario.imu_intrinsics},
            BOARD: {"size": np.array([scenario.target_size])},
            **{sensor.name: true_values(scenario, sensor) for sensor in sensors},
        },
        "T_imu_sensor": {sensor.name: sensor.T_imu_sensor for sensor in sensors},
        "time_offset": {sensor.name: raw_time_offset(scenario, sensor) for sensor in sensors},
    }
