"""From a scenario to measurements and the truth behind them."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from icalib.measurements import ImuStream, Measurements
from icalib.simulation.corners import CornerTruth, see_corners
from icalib.simulation.imu import imu_stamps, inside, read_imu
from icalib.simulation.motion import Trajectory, exact_motion, reference_motion
from icalib.simulation.scenario import GRAVITY_WORLD, Scenario, SimCamera


@dataclass(frozen=True, eq=False)
class Truth:
    """What the measurements were made from.

    All instants are seconds on the IMU's clock since `imu_clock_origin_ns`. Arrays over the readings have one row per
    reading in the measurements (readings lost in gaps have none). Dictionaries are by camera name.
    """

    imu_clock_origin_ns: int
    seconds: np.ndarray  # (N,)
    R_world_imu: np.ndarray  # (N, 3, 3)
    position: np.ndarray  # (N, 3) m, world
    velocity: np.ndarray  # (N, 3) m/s, world
    gyro_bias: np.ndarray  # (N, 3) rad/s
    accel_bias: np.ndarray  # (N, 3) m/s^2
    imu_intrinsics: np.ndarray  # (24,)
    gravity: np.ndarray  # (3,) m/s^2, world
    T_world_bodies: np.ndarray  # (bodies, 4, 4), in the order of the target's bodies
    bow: np.ndarray  # (3,) m
    T_imu_cam: dict[str, np.ndarray]
    time_offset: dict[str, float]  # s, between raw stamps: t_imu = t_cam + time_offset
    intrinsics: dict[str, np.ndarray]
    distortion: dict[str, np.ndarray]
    bloom_px: dict[str, float]
    corners: dict[str, CornerTruth]
    trajectory: Trajectory

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


def raw_time_offset(scenario: Scenario, camera: SimCamera) -> float:
    """Seconds to add to the camera's raw stamps to get the IMU's: the offset and the distance of the clock origins."""
    return camera.time_offset_s + (scenario.imu_clock_origin_ns - camera.clock_origin_ns) * 1e-9


def simulate(scenario: Scenario, seed: int) -> Simulation:
    """Simulate one recording; the same scenario and seed give the same numbers.

    Motion, IMU noise and each camera draw from streams of their own: changing one leaves the others as they are.
    """
    motion_seed = seed if scenario.motion.seed is None else scenario.motion.seed
    imu_rng = np.random.default_rng([seed, 1])
    stamps = imu_stamps(scenario, imu_rng)
    seconds = stamps.astype(np.float64) * 1e-9
    reference = reference_motion(scenario, np.random.default_rng([motion_seed, 0]))
    if scenario.motion.exact:
        trajectory = exact_motion(reference, seconds)
        ideal = trajectory.readings
    else:
        trajectory = reference
        ideal = reference.readings_at(seconds)
    readings = read_imu(scenario, seconds, ideal, imu_rng)
    kept = ~inside(scenario.imu_gaps, seconds)
    streams, corners = zip(
        *(
            see_corners(scenario, camera, trajectory, np.random.default_rng([seed, 2 + i]))
            for i, camera in enumerate(scenario.cameras)
        ),
        strict=True,
    )
    stamps_ns = stamps[kept] + np.int64(scenario.imu_clock_origin_ns)
    imu = ImuStream("imu0", stamps_ns, readings.gyro[kept], readings.accel[kept])
    rotation, position, velocity = trajectory.pose_at(seconds[kept])
    truth = Truth(
        scenario.imu_clock_origin_ns,
        seconds[kept],
        rotation,
        position,
        velocity,
        readings.gyro_bias[kept],
        readings.accel_bias[kept],
        scenario.imu_intrinsics,
        GRAVITY_WORLD,
        scenario.body_poses,
        np.array(scenario.bow),
        {c.name: c.T_imu_cam for c in scenario.cameras},
        {c.name: raw_time_offset(scenario, c) for c in scenario.cameras},
        {c.name: np.array(c.intrinsics) for c in scenario.cameras},
        {c.name: np.array(c.distortion) for c in scenario.cameras},
        {c.name: c.bloom_px for c in scenario.cameras},
        {c.name: t for c, t in zip(scenario.cameras, corners, strict=True)},
        trajectory,
    )
    return Simulation(scenario, Measurements(imu, tuple(streams)), truth)
