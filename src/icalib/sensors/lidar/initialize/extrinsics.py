"""Initial extrinsics and time offset of a LiDAR, and the IMU trajectory if no other sensor gives it.

LiDAR odometry gives angular rates of the LiDAR. Their alignment with the gyroscope gives time offset and rotation.
Odometry is then repeated with rotations from the gyroscope, and is more accurate. The lever arm follows from the
positions of odometry, compared with a known trajectory, or with the readings of the IMU together with gravity."""

from __future__ import annotations

import numpy as np

from icalib.data.measurements import LidarStream
from icalib.errors import EstimationError
from icalib.geometry import so3
from icalib.initialize.initializer import (
    NOTHING_KNOWN,
    KnownExtrinsics,
)
from icalib.initialize.rate_alignment import RateAlignment, only_axis
from icalib.initialize.rate_correlation import GyroRotation, SensorRates
from icalib.initialize.smooth_trajectory import BodyPoses
from icalib.initialize.trajectories import (
    DISPLACEMENT_SIGMA_M,
    MAX_PROPAGATION_S,
    SINGLE_AXIS_RATE_RATIO,
    TRAJECTORY_GRAVITY_TOLERANCE,
    ExtrinsicsGuess,
    ImuTrajectory,
    SensorTrajectory,
    align_trajectory,
    fit_imu_trajectory,
    imu_poses_at,
    is_mirrored,
    lever_arm_prior,
    solve_lever_arm,
    system_from_trajectory,
)
from icalib.motion.imu_data import ImuData
from icalib.optim.state import State
from icalib.sensors.lidar.initialize.odometry import Scan, lidar_trajectory, sampled_scans

MIN_LIDAR_RATE_CORRELATION = 0.6  # of angular rates with those of the gyroscope
LEVER_ARM_ROUNDS = 2  # alternations of odometry near the known trajectory, and lever arm
# Alignments that differ by less give the same points of a scan, within the noise of the registration.
SAME_ALIGNMENT_RAD, SAME_ALIGNMENT_S = 5e-3, 1e-3


def lidar_and_motion(
    imu: ImuData, stream: LidarStream, gravity: float, extrinsics: KnownExtrinsics = NOTHING_KNOWN
) -> tuple[ExtrinsicsGuess, ImuTrajectory]:
    """Extrinsics and IMU trajectory from one LiDAR and the IMU. gravity [m/s^2]; extrinsics: those known. Raises
    EstimationError if the recording does not determine them."""
    aligned, trajectory, rates = _aligned(imu, stream.name, sampled_scans(stream), extrinsics)
    fit = fit_imu_trajectory(imu, trajectory, rates, aligned, gravity, extrinsics)
    if fit is None:
        raise _too_short(stream)
    _check_axes(stream.name, imu.name, fit.mirrored)
    _check_gravity(fit.gravity, gravity, imu.name, stream.name)
    return fit.guess, fit.motion


def scan_poses(stream: LidarStream) -> BodyPoses:
    """Poses of a LiDAR, three in each scan, by odometry alone. Raises EstimationError if it fails."""
    path = lidar_trajectory(stream.name, sampled_scans(stream), shares=(-1.0 / 3.0, 0.0, 1.0 / 3.0))
    path = path.only(path.ok)
    return BodyPoses(path.seconds, path.rotation, path.position)


def lidar_on_motion(
    imu: ImuData, stream: LidarStream, known: State, extrinsics: KnownExtrinsics = NOTHING_KNOWN
) -> ExtrinsicsGuess:
    """Extrinsics and time offset given the IMU trajectory `known`, with keyframes at most about 50 ms apart.
    extrinsics: those known. Raises EstimationError if the recording does not determine them."""
    scans = sampled_scans(stream)
    aligned, free, rates = _aligned(imu, stream.name, scans, extrinsics)
    guess = ExtrinsicsGuess(
        aligned.rotation, np.zeros(3) if extrinsics.position is None else extrinsics.position, aligned.offset
    )
    prior = lever_arm_prior(
        np.zeros(0), rates.rate, DISPLACEMENT_SIGMA_M, extrinsics.rotation is not None, extrinsics.position
    )
    gyro = GyroRotation.integrate(imu, known.bias[:, :3].mean(axis=0))

    def fitted(trajectory: SensorTrajectory, now: ExtrinsicsGuess) -> ExtrinsicsGuess:
        t = trajectory.seconds + now.offset
        trajectory = trajectory.only(trajectory.ok & (t >= known.seconds[0]) & (t <= known.seconds[-1]))
        R, p = imu_poses_at(known, gyro, trajectory.seconds + now.offset)
        system = system_from_trajectory(R, p, trajectory.seconds, trajectory.rotation, trajectory.position)
        solution = solve_lever_arm(system, prior, now.rotation, rates.rate)
        if solution is None:
            raise _too_short(stream)
        _check_axes(stream.name, imu.name, is_mirrored(system, *solution))
        return ExtrinsicsGuess(solution[0], solution[1][3:6], aligned.offset)

    if extrinsics.rotation is None and only_axis(rates.rate, SINGLE_AXIS_RATE_RATIO) is not None:
        # Rates about one axis do not determine the rotation about it: it comes from the known trajectory first.
        guess = fitted(free, guess)
    for _ in range(LEVER_ARM_ROUNDS):
        guess = fitted(_trajectory_near(stream.name, scans, known, gyro, guess), guess)
    return guess


def _trajectory_near(
    name: str, scans: list[Scan], known: State, gyro: GyroRotation, guess: ExtrinsicsGuess
) -> SensorTrajectory:
    """Odometry near the trajectory that `known` and `guess` predict, so that it does not drift in degenerate scenes."""

    def position_at(t: np.ndarray) -> np.ndarray:
        R, p = imu_poses_at(known, gyro, np.clip(t + guess.offset, known.seconds[0], known.seconds[-1]))
        return p + R @ guess.position

    def rotation_at(t: np.ndarray) -> np.ndarray:
        return gyro.carry(known.seconds, known.rotation, t + guess.offset) @ guess.rotation

    return lidar_trajectory(name, scans, rotation_at, position_at)


def _aligned(
    imu: ImuData, name: str, scans: list[Scan], extrinsics: KnownExtrinsics
) -> tuple[RateAlignment, SensorTrajectory, SensorRates]:
    """Alignment with the gyroscope: time offset, rotation and gyroscope bias. Also the LiDAR trajectory with rotations
    from the gyroscope, while the IMU was running; and the angular rates of this trajectory."""
    first = align_trajectory(imu, name, _rates(name, lidar_trajectory(name, scans, single_map=False)), extrinsics)
    trajectory = _trajectory_with_gyro(imu, name, scans, first)
    rates = _rates(name, trajectory)
    aligned = align_trajectory(imu, name, rates, extrinsics)
    if not _is_same(first, aligned):
        trajectory = _trajectory_with_gyro(imu, name, scans, aligned)
    t = trajectory.seconds + aligned.offset
    inside = trajectory.ok & (t > imu.seconds[0]) & (t < imu.seconds[-1])
    return aligned, trajectory.only(inside), rates


def _is_same(a: RateAlignment, b: RateAlignment) -> bool:
    """True if two alignments are equal within SAME_ALIGNMENT_RAD and SAME_ALIGNMENT_S."""
    apart = so3.log(np.ascontiguousarray(a.rotation.T @ b.rotation))
    return float(np.linalg.norm(apart)) < SAME_ALIGNMENT_RAD and abs(a.offset - b.offset) < SAME_ALIGNMENT_S


def _trajectory_with_gyro(imu: ImuData, name: str, scans: list[Scan], aligned: RateAlignment) -> SensorTrajectory:
    """LiDAR trajectory from odometry with rotations from the gyroscope."""
    gyro = GyroRotation.integrate(imu, aligned.gyro_bias)
    return lidar_trajectory(name, scans, lambda t: gyro.at(t + aligned.offset) @ aligned.rotation)


def _rates(name: str, trajectory: SensorTrajectory) -> SensorRates:
    """Mean angular rates from scan to scan, in axes of the LiDAR."""
    t, R = trajectory.seconds[trajectory.ok], trajectory.rotation[trajectory.ok]
    near = np.diff(t) < MAX_PROPAGATION_S
    turn = so3.log_many(np.ascontiguousarray(R[:-1].transpose(0, 2, 1) @ R[1:])) / np.diff(t)[:, None]
    if near.sum() < 2:
        raise EstimationError(f"{name}: its scans are more than {MAX_PROPAGATION_S} s apart; record at a higher rate.")
    return SensorRates(t[:-1][near], t[1:][near], turn[near], MIN_LIDAR_RATE_CORRELATION)


def _too_short(stream: LidarStream) -> EstimationError:
    """The error for too few scans to estimate the lever arm."""
    return EstimationError(
        f"{stream.name}: too few of its scans fall within the recording of the IMU to estimate its lever arm; "
        "check that both clocks overlap, or record for longer."
    )


def _check_axes(lidar: str, imu: str, mirrored: bool) -> None:
    """Raises EstimationError if the positions of the LiDAR are mirrored."""
    if mirrored:
        raise EstimationError(
            f"{lidar} turns as {imu} does, but moves the other way: its points are mirrored, as one of its axes, or "
            "the direction of its azimuth, is reversed. Make its axes right-handed. Or the "
            f"accelerometer is inverted: set accel_axes: [-x, -y, -z] of {imu} in the rig file."
        )


def _check_gravity(measured: float, expected: float, imu: str, lidar: str) -> None:
    """Raises EstimationError if the estimated gravity [m/s^2] is far from the expected one."""
    if abs(measured / expected - 1.0) > TRAJECTORY_GRAVITY_TOLERANCE:
        raise EstimationError(
            f"{imu} and {lidar} together give a gravity of {measured:.3g} m/s^2 instead of {expected:.3g}; "
            "check that the accelerometer is in m/s^2, not in g (accel_unit), and that the LiDAR sees walls "
            "in all directions."
        )
