"""A LiDAR's extrinsics and time offset from nothing, with the motion of the IMU where nothing else shows it.

Its scans, registered one after the other, say how it turned; the gyroscope says the same of the IMU, which gives time
offset and rotation. Turned by the gyroscope, the scans are registered again, and better. Their positions then give the
lever arm: against a motion that cameras or another LiDAR showed, or against the IMU's own readings, with gravity.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from icalib.data.measurements import LidarStream
from icalib.errors import EstimationError
from icalib.geometry import so3
from icalib.geometry.cubic import hermite
from icalib.initialize.lidar.lidar_arm import (
    ANY_SIGMA,
    BIAS_SIGMA,
    MIRRORED,
    ONE_AXIS,
    SPEED_SIGMA,
    WAY_SIGMA,
    against_motion,
    against_readings,
    arm_prior,
    is_mirrored,
    left_over,
    solve,
)
from icalib.initialize.lidar.lidar_motion import LONGEST_STEP_S, ImuMotion
from icalib.initialize.lidar.lidar_odometry import LidarPath, Scan, lidar_path, scans_of
from icalib.initialize.steps.by_recording import UNKNOWN, Held
from icalib.initialize.steps.clock_shifts import CameraRates
from icalib.initialize.steps.clocks import Alignment, align, as_given, contradicts, is_still, only_axis, turning
from icalib.initialize.steps.gyro import GyroRotation
from icalib.motion.imu_data import ImuData
from icalib.optim.state import Key, State

LEAST_CORRELATION = 0.6  # of turning rates with the IMU's
G_TOLERANCE = 0.1
ARM_ROUNDS = 2  # each brings the path nearer to the known motion
SAME_RAD, SAME_S = 5e-3, 1e-3  # alignments this near turn a scan's points alike, to what the registration allows for


@dataclass(frozen=True)
class LidarGuess:
    """Of a LiDAR, or whatever else has a path: R_imu_lidar, p_imu_lidar (3,) m; offset: as in `Held`; turned: whether
    it turned about more than one axis, which shows all of its rotation."""

    rotation: np.ndarray
    position: np.ndarray
    offset: float
    turned: bool = False

    def values(self, name: str) -> dict[Key, np.ndarray]:
        """As lasting parameters of a state."""
        return {
            (name, "rotation"): self.rotation,
            (name, "translation"): self.position,
            (name, "time_offset"): np.array([self.offset]),
        }


def lidar_and_motion(
    imu: ImuData, stream: LidarStream, gravity: float, held: Held = UNKNOWN
) -> tuple[LidarGuess, ImuMotion]:
    """From one LiDAR and the IMU alone; gravity [m/s^2]. Raises EstimationError, one sentence, where the recording does
    not show it."""
    aligned, path, rates = _aligned(imu, stream.name, scans_of(stream), held)
    found = motion_of_path(imu, path, rates, aligned, gravity, held)
    if found is None:
        raise _too_short(stream)
    _check_axes(stream.name, imu.name, found.left > MIRRORED)
    _check_gravity(found.gravity, gravity, imu.name, stream.name)
    return found.guess, found.motion


@dataclass(frozen=True)
class FromPath:
    """What a path shows: the sensor's guess, the motion of the IMU, how long gravity is [m/s^2], and R_world_map, which
    brings it down; the origin of the world is the map's. left: see `left_over`."""

    guess: LidarGuess
    motion: ImuMotion
    gravity: float
    level: np.ndarray
    left: float


def motion_of_path(
    imu: ImuData, path: LidarPath, rates: CameraRates, aligned: Alignment, gravity: float, held: Held
) -> FromPath | None:
    """From the path of one sensor, all of it while the IMU was running, and the IMU alone; None where it is too
    short."""
    gyro, t = GyroRotation.integrate(imu, aligned.gyro_bias), path.seconds + aligned.offset

    def carry(at_scans: np.ndarray) -> np.ndarray:
        return gyro.carry(t, at_scans, imu.seconds)

    prior = arm_prior(
        np.array([ANY_SIGMA] * 3 + [BIAS_SIGMA] * 3), rates.rate, SPEED_SIGMA, held.rotation is not None, held.position
    )
    system = against_readings(imu, carry, t, path.rotation, path.position)
    found = solve(system, prior, aligned.rotation, rates.rate)
    if found is None:
        return None
    R_il, x = found
    level, R_imu = _level(x[6:9]), path.rotation @ R_il.T
    position = (path.position - R_imu @ x[3:6]) @ level.T
    start = ImuMotion(gyro, t, level @ R_imu, position, np.zeros_like(position), aligned.gyro_bias, x[9:12], gravity)
    turned = only_axis(rates.rate, ONE_AXIS) is None
    guess, left = LidarGuess(R_il, x[3:6], aligned.offset, turned), left_over(system, R_il, x)
    return FromPath(guess, start.smoothed(), float(np.linalg.norm(x[6:9])), level, left)


def lidar_on_motion(imu: ImuData, stream: LidarStream, known: State, held: Held = UNKNOWN) -> LidarGuess:
    """From the motion of the IMU in `known`: nodes no further apart than 50 ms or so. Raises EstimationError, one
    sentence, where the recording does not show it."""
    scans = scans_of(stream)
    aligned, alone, rates = _aligned(imu, stream.name, scans, held)
    guess = LidarGuess(aligned.rotation, np.zeros(3) if held.position is None else held.position, aligned.offset)
    prior = arm_prior(np.zeros(0), rates.rate, WAY_SIGMA, held.rotation is not None, held.position)
    gyro = GyroRotation.integrate(imu, known.bias[:, :3].mean(axis=0))

    def against(path: LidarPath, now: LidarGuess) -> LidarGuess:
        t = path.seconds + now.offset
        path = where(path, path.ok & (t >= known.seconds[0]) & (t <= known.seconds[-1]))
        R, p = poses_in(known, gyro, path.seconds + now.offset)
        system = against_motion(R, p, path.seconds, path.rotation, path.position)
        found = solve(system, prior, now.rotation, rates.rate)
        if found is None:
            raise _too_short(stream)
        _check_axes(stream.name, imu.name, is_mirrored(system, *found))
        return LidarGuess(found[0], found[1][3:6], aligned.offset)

    if held.rotation is None and only_axis(rates.rate, ONE_AXIS) is not None:
        # Which way the known motion is for the LiDAR, that motion itself has to show first.
        guess = against(alone, guess)
    for _ in range(ARM_ROUNDS):
        guess = against(_path_on(stream.name, scans, known, gyro, guess), guess)
    return guess


def _path_on(name: str, scans: list[Scan], known: State, gyro: GyroRotation, guess: LidarGuess) -> LidarPath:
    """The path while the motion is known, near what motion and guess say: scans that show nothing of one direction do
    not drift."""

    def moving(t: np.ndarray) -> np.ndarray:
        R, p = poses_in(known, gyro, np.clip(t + guess.offset, known.seconds[0], known.seconds[-1]))
        return p + R @ guess.position

    def turned(t: np.ndarray) -> np.ndarray:
        return gyro.carry(known.seconds, known.rotation, t + guess.offset) @ guess.rotation

    return lidar_path(name, scans, turned, moving)


def where(path: LidarPath, own: np.ndarray) -> LidarPath:
    """The part `own` (n,) of a path."""
    return LidarPath(path.seconds[own], path.rotation[own], path.position[own], path.ok[own])


def poses_in(known: State, gyro: GyroRotation, t: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """R_world_imu (n, 3, 3), p (n, 3) at times t: cubic between nodes, by their velocities."""
    k = np.clip(np.searchsorted(known.seconds, t, side="right") - 1, 0, len(known.seconds) - 2)
    h = np.diff(known.seconds)[k][:, None]
    s = (t - known.seconds[k])[:, None] / h
    way = hermite(s, known.position[k + 1] - known.position[k], known.velocity[k] * h, known.velocity[k + 1] * h)
    return gyro.carry(known.seconds, known.rotation, t), known.position[k] + way


def _aligned(imu: ImuData, name: str, scans: list[Scan], held: Held) -> tuple[Alignment, LidarPath, CameraRates]:
    """Time offset, rotation and gyroscope bias; the LiDAR's path by the gyroscope's turns, as far as the IMU was
    running, and its rates."""
    first = align_path(imu, name, _rates(name, lidar_path(name, scans, whole=False)), held)
    path = _turned_path(imu, name, scans, first)
    rates = _rates(name, path)
    aligned = align_path(imu, name, rates, held)
    if not _alike(first, aligned):
        path = _turned_path(imu, name, scans, aligned)
    t = path.seconds + aligned.offset
    inside = path.ok & (t > imu.seconds[0]) & (t < imu.seconds[-1])
    return aligned, where(path, inside), rates


def _alike(a: Alignment, b: Alignment) -> bool:
    apart = so3.log(np.ascontiguousarray(a.rotation.T @ b.rotation))
    return float(np.linalg.norm(apart)) < SAME_RAD and abs(a.offset - b.offset) < SAME_S


def align_path(imu: ImuData, name: str, rates: CameraRates, held: Held) -> Alignment:
    """Time offset, rotation and gyroscope bias from rates. Raises EstimationError where they do not show them."""
    if held.rotation is not None and held.offset is not None:
        found = as_given(imu, name, rates, held.offset, held.rotation)
        if contradicts(imu, rates, found):
            raise EstimationError(
                f"{name} does not turn as {imu.name} does with the rotation and time_offset in the rig file; "
                "correct them, or remove them so that they are estimated."
            )
        return found
    _check_turning(imu, name, rates)
    found = align(imu, name, rates, held.offset)
    return found if held.rotation is None else as_given(imu, name, rates, found.offset, held.rotation)


def _turned_path(imu: ImuData, name: str, scans: list[Scan], aligned: Alignment) -> LidarPath:
    gyro = GyroRotation.integrate(imu, aligned.gyro_bias)
    return lidar_path(name, scans, lambda t: gyro.at(t + aligned.offset) @ aligned.rotation)


def _rates(name: str, path: LidarPath) -> CameraRates:
    t, R = path.seconds[path.ok], path.rotation[path.ok]
    near = np.diff(t) < LONGEST_STEP_S
    turn = so3.log_many(np.ascontiguousarray(R[:-1].transpose(0, 2, 1) @ R[1:])) / np.diff(t)[:, None]
    if near.sum() < 2:
        raise EstimationError(f"{name}: its scans are more than {LONGEST_STEP_S} s apart; record at a higher rate.")
    return CameraRates(t[:-1][near], t[1:][near], turn[near], LEAST_CORRELATION)


def _check_turning(imu: ImuData, name: str, rates: CameraRates) -> None:
    """Raises EstimationError where neither turns."""
    turned, seen = turning(imu, rates)
    if is_still(turned, seen):
        raise EstimationError(
            f"{name} and {imu.name} hardly turn ({turned:.4f} rad/s RMS), so time offset and rotation are "
            "unobservable; record again with rotation about two axes or more, or give rotation and "
            f"time_offset of {name} in the rig file."
        )


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
    if abs(measured / expected - 1.0) > G_TOLERANCE:
        raise EstimationError(
            f"{imu} and {lidar} together give a gravity of {measured:.3g} m/s^2 instead of {expected:.3g}; "
            "check that the accelerometer is in m/s^2, not in g (accel_unit), and that the LiDAR sees walls "
            "in all directions."
        )


def _level(gravity: np.ndarray) -> np.ndarray:
    """R_world_map: the smallest turn that brings gravity (3,) down."""
    d = -gravity / np.linalg.norm(gravity)
    axis = np.array([d[1], -d[0], 0.0])  # d x z
    sine = np.linalg.norm(axis)
    if sine < 1e-12:
        return np.diag([1.0, np.sign(d[2]), np.sign(d[2])])
    return so3.exp(axis * (np.arctan2(sine, d[2]) / sine))
