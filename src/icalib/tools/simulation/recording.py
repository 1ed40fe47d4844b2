"""Simulates all sensors of a scenario."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from icalib.data.measurements import CornerStream, ImuStream, Measurements
from icalib.errors import RecordingError
from icalib.geometry.targets.base import BOARD
from icalib.sensors.imu.spec import ACCEL_DELAY, INTRINSICS, LOW_PASS
from icalib.sensors.sensor import CLOCK_RATE, mounted
from icalib.tools.simulation.corners import CornerTruth, SimulatedTracks, TrackTruth, follow, see_corners
from icalib.tools.simulation.ground import ground_motion
from icalib.tools.simulation.motion import (
    Reference,
    Waves,
    basis_with_z,
    ideal_readings,
    imu_stamps,
    inside,
    read_imu,
    recorded_motion,
    reference_motion,
)
from icalib.tools.simulation.room import Room
from icalib.tools.simulation.scenario import (
    GRAVITY_WORLD,
    HandheldMotion,
    Report,
    Scenario,
    SimCamera,
    SimScene,
    SimSensor,
)
from icalib.tools.simulation.trajectory import Drive, TrueTrajectory

# Simulates the measurements of a scenario, and their truth.

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
    noisy = scenario.robot_noise_enabled
    scene = SimScene(trajectory, seconds, scenario.duration_s, scenario.room, noisy, scenario.sheets)
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
    rate = {CLOCK_RATE.name: np.array([sensor.clock_rate_ppm])}
    return {**mounted(T[:3, :3], T[:3, 3], offset), **rate, **sensor.true_parameters().values}


def _imu_values(scenario: Scenario) -> dict[str, np.ndarray]:
    """True parameters of the first IMU; of a low-pass half the variance of its response."""
    values = {INTRINSICS.name: scenario.imu_intrinsics, ACCEL_DELAY.name: np.array([scenario.imu_accel_delay_s])}
    if scenario.imu_cutoff_hz is not None:
        values[LOW_PASS.name] = np.array([0.5 * np.log(2.0) / (2.0 * np.pi * scenario.imu_cutoff_hz) ** 2])
    return values


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
        "target_size": scenario.target_size,
        "gravity": GRAVITY_WORLD,
        "T_world_bodies": scenario.body_poses,
        "bow": np.array(scenario.bow),
        "planes": np.empty((0, 4)) if scenario.room is None else scenario.room.planes,
        "values": {
            "imu0": _imu_values(scenario),
            BOARD: {"size": np.array([scenario.target_size])},
            **{sensor.name: true_values(scenario, sensor) for sensor in sensors},
        },
        "T_imu_sensor": {sensor.name: sensor.T_imu_sensor for sensor in sensors},
        "time_offset": {sensor.name: raw_time_offset(scenario, sensor) for sensor in sensors},
    }


# Trajectories of a robot through its room, in closed form, for the kinds of motion in `Drive`.

_HEIGHT = 0.45  # height of the middle of a free motion, relative to the room's
_SHIFT = np.array([[0.20, 0.20, 0.12], [0.02, 0.02, 0.035]])  # amplitudes, slow and fast, relative to the room's sides
_SHIFT_HZ = np.array([[0.05, 0.08], [0.30, 0.45]])
_ANGLES_RAD = np.array([[1.2, 0.22, 0.22], [0.30, 0.14, 0.14]])  # yaw, pitch, roll
_ANGLES_HZ = np.array([[0.06, 0.10], [0.30, 0.50]])
_AXIS_RAD = np.array([[1.2, 0.0, 0.0], [0.30, 0.0, 0.0]])
_CHECK_S = 0.05
_GROUND_BELOW_IMU = np.array([0.0, 0.0, -0.3])  # m, origin of the wheel frame in the IMU frame, if there are no wheels


def drive_motion(
    drive: Drive, room: Room, T_imu_wheel: np.ndarray | None, duration_s: float, rng: np.random.Generator
) -> TrueTrajectory:
    """The trajectory of `drive`, with phases drawn from `rng`. T_imu_wheel (4, 4): pose of the wheel frame, None for a
    frame 0.3 m below the IMU.

    Raises RecordingError if a recorded motion cannot be read, is too short, or leaves the room.
    """
    if drive.on_ground:
        if T_imu_wheel is None:
            T_imu_wheel = np.eye(4)
            T_imu_wheel[:3, 3] = _GROUND_BELOW_IMU
        return ground_motion(drive, room, T_imu_wheel, duration_s, rng)
    center = np.array([0.0, 0.0, _HEIGHT * room.size[2]])
    if drive.path is not None:
        return _within(room, recorded_motion(drive.path, duration_s, center), drive.path, duration_s)
    basis, angles = np.eye(3), _ANGLES_RAD
    if drive.kind == "single-axis":
        basis, angles = basis_with_z(np.array(drive.axis_imu)), _AXIS_RAD
    turns, shifts = _waves(angles, _ANGLES_HZ, rng), _waves(_SHIFT * room.size, _SHIFT_HZ, rng)
    return Reference(basis, basis.T, center, np.eye(3), turns, shifts)


def _within(room: Room, motion: TrueTrajectory, path: Path, duration_s: float) -> TrueTrajectory:
    _, position, _ = motion.pose_at(np.arange(0.0, duration_s, _CHECK_S))
    x, y, z = room.size
    if (position < [-0.5 * x, -0.5 * y, 0.0]).any() or (position > [0.5 * x, 0.5 * y, z]).any():
        sides = " x ".join(f"{side:.1f}" for side in np.ptp(position, axis=0))
        raise RecordingError(f"{path} reaches over {sides} m and leaves the room; give the room a larger size.")
    return motion


def _waves(amplitude: np.ndarray, band_hz: np.ndarray, rng: np.random.Generator) -> Waves:
    frequency = rng.uniform(band_hz[:, :1], band_hz[:, 1:], amplitude.shape)
    return Waves(amplitude, frequency, rng.uniform(0.0, 2.0 * np.pi, amplitude.shape))
