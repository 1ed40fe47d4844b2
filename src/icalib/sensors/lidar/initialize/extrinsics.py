"""A LiDAR's extrinsics and time offset from nothing, with the motion of the IMU where nothing else shows it.

Its scans, registered one after the other, say how it turned; the gyroscope says the same of the IMU, which gives time
offset and rotation. Turned by the gyroscope, the scans are registered again, and better. Their positions then give the
lever arm: against a motion that cameras or another LiDAR showed, or against the IMU's own readings, with gravity.
"""

from __future__ import annotations

import numpy as np

from icalib.data.measurements import LidarStream
from icalib.errors import EstimationError
from icalib.geometry import so3
from icalib.initialize.steps.gyro_rotation import GyroRotation
from icalib.initialize.steps.rate_alignment import RateAlignment, only_axis
from icalib.initialize.steps.rate_correlation import SensorRates
from icalib.initialize.steps.single_recording import NOTHING_KNOWN, KnownExtrinsics
from icalib.initialize.trajectories.imu_trajectory import MAX_PROPAGATION_S, ImuTrajectory
from icalib.initialize.trajectories.known_trajectory import imu_poses_at
from icalib.initialize.trajectories.lever_arm_rows import (
    DISPLACEMENT_SIGMA_M,
    MIN_MIRRORED_SHARE,
    SINGLE_AXIS_RATE_RATIO,
    is_mirrored,
    lever_arm_prior,
    solve_lever_arm,
    system_from_trajectory,
)
from icalib.initialize.trajectories.rotation_alignment import align_trajectory
from icalib.initialize.trajectories.sensor_trajectory import ExtrinsicsGuess, SensorTrajectory
from icalib.initialize.trajectories.trajectory_fit import TRAJECTORY_GRAVITY_TOLERANCE, fit_imu_trajectory
from icalib.motion.imu_data import ImuData
from icalib.optim.state import State
from icalib.sensors.lidar.initialize.odometry import Scan, lidar_path, scans_of

LEAST_CORRELATION = 0.6  # of turning rates with the IMU's
ARM_ROUNDS = 2  # each brings the path nearer to the known motion
SAME_RAD, SAME_S = 5e-3, 1e-3  # alignments this near turn a scan's points alike, to what the registration allows for


def lidar_and_motion(
    imu: ImuData, stream: LidarStream, gravity: float, held: KnownExtrinsics = NOTHING_KNOWN
) -> tuple[ExtrinsicsGuess, ImuTrajectory]:
    """From one LiDAR and the IMU alone; gravity [m/s^2]. Raises EstimationError, one sentence, where the recording does
    not show it."""
    aligned, path, rates = _aligned(imu, stream.name, scans_of(stream), held)
    found = fit_imu_trajectory(imu, path, rates, aligned, gravity, held)
    if found is None:
        raise _too_short(stream)
    _check_axes(stream.name, imu.name, found.unexplained > MIN_MIRRORED_SHARE)
    _check_gravity(found.gravity, gravity, imu.name, stream.name)
    return found.guess, found.motion


def lidar_on_motion(
    imu: ImuData, stream: LidarStream, known: State, held: KnownExtrinsics = NOTHING_KNOWN
) -> ExtrinsicsGuess:
    """From the motion of the IMU in `known`: keyframes no further apart than 50 ms or so. Raises EstimationError, one
    sentence, where the recording does not show it."""
    scans = scans_of(stream)
    aligned, alone, rates = _aligned(imu, stream.name, scans, held)
    guess = ExtrinsicsGuess(aligned.rotation, np.zeros(3) if held.position is None else held.position, aligned.offset)
    prior = lever_arm_prior(np.zeros(0), rates.rate, DISPLACEMENT_SIGMA_M, held.rotation is not None, held.position)
    gyro = GyroRotation.integrate(imu, known.bias[:, :3].mean(axis=0))

    def against(path: SensorTrajectory, now: ExtrinsicsGuess) -> ExtrinsicsGuess:
        t = path.seconds + now.offset
        path = path.only(path.ok & (t >= known.seconds[0]) & (t <= known.seconds[-1]))
        R, p = imu_poses_at(known, gyro, path.seconds + now.offset)
        system = system_from_trajectory(R, p, path.seconds, path.rotation, path.position)
        found = solve_lever_arm(system, prior, now.rotation, rates.rate)
        if found is None:
            raise _too_short(stream)
        _check_axes(stream.name, imu.name, is_mirrored(system, *found))
        return ExtrinsicsGuess(found[0], found[1][3:6], aligned.offset)

    if held.rotation is None and only_axis(rates.rate, SINGLE_AXIS_RATE_RATIO) is not None:
        # Which way the known motion is for the LiDAR, that motion itself has to show first.
        guess = against(alone, guess)
    for _ in range(ARM_ROUNDS):
        guess = against(_path_on(stream.name, scans, known, gyro, guess), guess)
    return guess


def _path_on(
    name: str, scans: list[Scan], known: State, gyro: GyroRotation, guess: ExtrinsicsGuess
) -> SensorTrajectory:
    """The path while the motion is known, near what motion and guess say: scans that show nothing of one direction do
    not drift."""

    def moving(t: np.ndarray) -> np.ndarray:
        R, p = imu_poses_at(known, gyro, np.clip(t + guess.offset, known.seconds[0], known.seconds[-1]))
        return p + R @ guess.position

    def turned(t: np.ndarray) -> np.ndarray:
        return gyro.carry(known.seconds, known.rotation, t + guess.offset) @ guess.rotation

    return lidar_path(name, scans, turned, moving)


def _aligned(
    imu: ImuData, name: str, scans: list[Scan], held: KnownExtrinsics
) -> tuple[RateAlignment, SensorTrajectory, SensorRates]:
    """Time offset, rotation and gyroscope bias; the LiDAR's path by the gyroscope's turns, as far as the IMU was
    running, and its rates."""
    first = align_trajectory(imu, name, _rates(name, lidar_path(name, scans, whole=False)), held)
    path = _turned_path(imu, name, scans, first)
    rates = _rates(name, path)
    aligned = align_trajectory(imu, name, rates, held)
    if not _alike(first, aligned):
        path = _turned_path(imu, name, scans, aligned)
    t = path.seconds + aligned.offset
    inside = path.ok & (t > imu.seconds[0]) & (t < imu.seconds[-1])
    return aligned, path.only(inside), rates


def _alike(a: RateAlignment, b: RateAlignment) -> bool:
    apart = so3.log(np.ascontiguousarray(a.rotation.T @ b.rotation))
    return float(np.linalg.norm(apart)) < SAME_RAD and abs(a.offset - b.offset) < SAME_S


def _turned_path(imu: ImuData, name: str, scans: list[Scan], aligned: RateAlignment) -> SensorTrajectory:
    gyro = GyroRotation.integrate(imu, aligned.gyro_bias)
    return lidar_path(name, scans, lambda t: gyro.at(t + aligned.offset) @ aligned.rotation)


def _rates(name: str, path: SensorTrajectory) -> SensorRates:
    t, R = path.seconds[path.ok], path.rotation[path.ok]
    near = np.diff(t) < MAX_PROPAGATION_S
    turn = so3.log_many(np.ascontiguousarray(R[:-1].transpose(0, 2, 1) @ R[1:])) / np.diff(t)[:, None]
    if near.sum() < 2:
        raise EstimationError(f"{name}: its scans are more than {MAX_PROPAGATION_S} s apart; record at a higher rate.")
    return SensorRates(t[:-1][near], t[1:][near], turn[near], LEAST_CORRELATION)


def _too_short(stream: LidarStream) -> EstimationError:
    return EstimationError(
        f"{stream.name}: too few of its scans fall within the recording of the IMU to estimate its lever arm; "
        "check that both clocks overlap, or record for longer."
    )


def _check_axes(lidar: str, imu: str, mirrored: bool) -> None:
    if mirrored:
        raise EstimationError(
            f"{lidar} turns as {imu} does, but moves the other way: its points are mirrored, for one of its "
            "axes or the direction of its azimuth is reversed. Make its axes right-handed. Or the "
            f"accelerometer is inverted: set accel_axes: [-x, -y, -z] of {imu} in the rig file."
        )


def _check_gravity(measured: float, expected: float, imu: str, lidar: str) -> None:
    if abs(measured / expected - 1.0) > TRAJECTORY_GRAVITY_TOLERANCE:
        raise EstimationError(
            f"{imu} and {lidar} together give a gravity of {measured:.3g} m/s^2 instead of {expected:.3g}; "
            "check that the accelerometer is in m/s^2, not in g (accel_unit), and that the LiDAR sees walls "
            "in all directions."
        )
