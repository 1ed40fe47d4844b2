"""What wheels report: turning rates from encoders, speed and yaw rate, a steering angle, or relative poses of their
frame as the paper's (27) has them."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np

from icalib.data.measurements import WheelPoses, WheelStream
from icalib.errors import RigError
from icalib.tools.simulation.scenario.instants import LEAD_S, check_enough, stamped
from icalib.tools.simulation.scenario.robot import SimWheels
from icalib.tools.simulation.sensors.motion import TrueTrajectory

_GAUSS = np.polynomial.legendre.leggauss(3)
_STEEPEST_RAD = 1.3
_KINDS: dict[str, Literal["pair", "steered", "twist"]] = {"rates": "pair", "steering": "steered", "twist": "twist"}
_SUBSTEPS = 12  # of an interval of (27), for its noise
_AT_A_TIME = 100_000  # instants: motion and its derivatives take 2 kB each


@dataclass(frozen=True, eq=False)
class WheelTruth:
    """seconds (N,) on the IMU's clock of each stamp; value: (N, 2) as in `WheelStream`, or (N - 1, 3) relative poses,
    both without noise."""

    seconds: np.ndarray
    value: np.ndarray


def read_wheels(
    wheels: SimWheels, trajectory: TrueTrajectory, imu_seconds: np.ndarray, noisy: bool, rng: np.random.Generator
) -> tuple[WheelStream | WheelPoses, WheelTruth]:
    """One wheel sensor's readings within those of the IMU, at imu_seconds (N,)."""
    stamps, seconds = stamped(wheels, imu_seconds[-1] - LEAD_S)
    if wheels.reports == "poses":
        stamps, seconds = stamps[:: wheels.poses_every], seconds[:: wheels.poses_every]
        check_enough(wheels.name, stamps)
        true, covariance = relative_poses(wheels, trajectory, seconds)
        measured = true + _drawn(covariance, rng) * float(noisy)
        return WheelPoses(wheels.name, stamps, measured, covariance), WheelTruth(seconds, true)
    if wheels.sampling == "instantaneous":
        stamps, seconds = stamps[1:], seconds[1:]
        true = reported(wheels, trajectory, seconds)
    else:
        true = _means(wheels, trajectory, seconds, imu_seconds)
        stamps, seconds = stamps[1:], seconds[1:]
        if wheels.reports == "steering":
            true[:, 1] = reported(wheels, trajectory, seconds)[:, 1]
    densities = {"twist": [wheels.speed_noise, wheels.yaw_noise], "steering": [wheels.noise, wheels.steering_noise]}
    density = np.array(densities.get(wheels.reports, [wheels.noise, wheels.noise]))
    noise = density * np.sqrt(wheels.rate_hz) * rng.standard_normal(true.shape)
    measured = true + noise * float(noisy)
    stream = WheelStream(wheels.name, stamps, measured, wheels.sampling, _KINDS[wheels.reports])
    return stream, WheelTruth(seconds, true)


def reported(wheels: SimWheels, trajectory: TrueTrajectory, seconds: np.ndarray) -> np.ndarray:
    """(N, 2) at each instant, without noise, as in `WheelStream`. Of rates (v_x -+ baseline/2 w_z) / radius."""
    some = np.split(seconds, range(_AT_A_TIME, len(seconds), _AT_A_TIME))
    return np.concatenate([_reported(wheels, trajectory, s) for s in some])


def _reported(wheels: SimWheels, trajectory: TrueTrajectory, seconds: np.ndarray) -> np.ndarray:
    velocity, rate = wheel_velocity(wheels.T_imu_wheel, trajectory, seconds)
    ahead, turning = velocity[:, 0], rate[:, 2]
    if wheels.reports == "twist":
        return np.stack([ahead / wheels.scales[0], turning / wheels.scales[1]], axis=1)
    if wheels.reports == "steering":
        return np.stack([ahead / wheels.radius, _steering(wheels, ahead, turning)], axis=1)
    half = 0.5 * wheels.baseline
    left = (ahead - half * turning) / wheels.radii[0]
    right = (ahead + half * turning) / wheels.radii[1]
    return np.stack([left, right], axis=1)


def _steering(wheels: SimWheels, ahead: np.ndarray, turning: np.ndarray) -> np.ndarray:
    """(N,) rad: a point a wheelbase ahead moves at v_x forwards, or backwards, and at wheelbase w_z to the left. Raises
    RigError where no front wheels can be steered so."""
    angle = np.arctan2(np.copysign(wheels.wheelbase, ahead) * turning, np.abs(ahead))
    if np.abs(angle).max() > _STEEPEST_RAD:
        raise RigError(
            f"{wheels.name} would have to steer by {np.rad2deg(np.abs(angle).max()):.0f} deg; choose a motion with "
            "wider curves that never drives backwards, or a shorter wheelbase."
        )
    return angle - wheels.steering_offset


def wheel_velocity(
    T_imu_wheel: np.ndarray, trajectory: TrueTrajectory, seconds: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """(N, 3) velocity [m/s] and angular rate [rad/s] of the wheel frame in its own axes."""
    rotation, _, velocity = trajectory.pose_at(seconds)
    rate = trajectory.rate_at(seconds)
    in_imu = np.einsum("nji,nj->ni", rotation, velocity) + np.cross(rate, T_imu_wheel[:3, 3])
    return in_imu @ T_imu_wheel[:3, :3], rate @ T_imu_wheel[:3, :3]


def _means(wheels: SimWheels, trajectory: TrueTrajectory, seconds: np.ndarray, imu_seconds: np.ndarray) -> np.ndarray:
    """(N - 1, 2) means between the instants, by Gauss's rule between all these and the IMU's, where rates may jump."""
    within = imu_seconds[(imu_seconds > seconds[0]) & (imu_seconds < seconds[-1])]
    cuts = np.union1d(seconds, within)
    width = np.diff(cuts)
    at = 0.5 * (cuts[:-1] + cuts[1:])[:, None] + 0.5 * width[:, None] * _GAUSS[0]
    rates = reported(wheels, trajectory, at.ravel()).reshape(*at.shape, 2)
    angle = 0.5 * width[:, None] * np.einsum("g,ngw->nw", _GAUSS[1], rates)
    turned = np.concatenate([np.zeros((1, 2)), np.cumsum(angle, axis=0)])[np.searchsorted(cuts, seconds)]
    return np.diff(turned, axis=0) / np.diff(seconds)[:, None]


def relative_poses(wheels: SimWheels, trajectory: TrueTrajectory, seconds: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """(K, 3) yaw, x, y between consecutive instants (K + 1,) by the paper's (27), without noise, and (K, 3, 3) the
    covariance that integrating noisy readings would give them: yaw = e3 . Log(R_W(k)_W(k+1)), x and y of p_W(k)_W(k+1).
    """
    each = _AT_A_TIME // (2 * _SUBSTEPS + 1)
    some = [seconds[k : k + each + 1] for k in range(0, len(seconds) - 1, each)]
    poses, covariances = zip(*(_relative_poses(wheels, trajectory, s) for s in some), strict=True)
    return np.concatenate(poses), np.concatenate(covariances)


def _relative_poses(
    wheels: SimWheels, trajectory: TrueTrajectory, seconds: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    parts = np.linspace(seconds[:-1], seconds[1:], 2 * _SUBSTEPS + 1, axis=1)
    rotation, position = _frames(wheels, trajectory, parts.ravel())
    rotation, position = rotation.reshape(*parts.shape, 3, 3), position.reshape(*parts.shape, 3)
    xy = np.einsum("kji,kmj->kmi", rotation[:, 0], position - position[:, :1])[..., :2]
    yaw = _rotation_vectors(np.einsum("kji,kmjl->kmil", rotation[:, 0], rotation))[..., 2]
    return np.column_stack([yaw[:, -1], xy[:, -1]]), _covariance(wheels, yaw, xy, np.diff(seconds))


def _drawn(covariance: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """(K, 3) normal vectors of the covariances (K, 3, 3), which may be singular."""
    size, axes = np.linalg.eigh(covariance)
    return (axes @ (np.sqrt(np.maximum(size, 0.0)) * rng.standard_normal(size.shape))[..., None])[..., 0]


def _frames(wheels: SimWheels, trajectory: TrueTrajectory, seconds: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """R_world_wheel (N, 3, 3) and p_world_wheel (N, 3)."""
    rotation, position, _ = trajectory.pose_at(seconds)
    return rotation @ wheels.T_imu_wheel[:3, :3], position + rotation @ wheels.T_imu_wheel[:3, 3]


def _rotation_vectors(rotation: np.ndarray) -> np.ndarray:
    """(..., 3) Log of rotations (..., 3, 3) of less than half a turn: the axis from R - R^T, the angle from atan2."""
    twice = np.stack([rotation[..., i, j] - rotation[..., j, i] for i, j in ((2, 1), (0, 2), (1, 0))], axis=-1)
    sine = 0.5 * np.linalg.norm(twice, axis=-1)
    angle = np.arctan2(sine, 0.5 * (np.trace(rotation, axis1=-2, axis2=-1) - 1.0))
    return 0.5 * twice * np.where(sine > 0.0, angle / np.where(sine > 0.0, sine, 1.0), 1.0)[..., None]


def _covariance(wheels: SimWheels, yaw: np.ndarray, xy: np.ndarray, duration: np.ndarray) -> np.ndarray:
    """(K, 3, 3) of yaw, x, y: the noise of rates at each part, carried to the end of its interval.

    yaw (K, M), xy (K, M, 2) along each interval, M odd: Simpson's rule. An error of the turning rate at one instant
    turns the rest of the way about where the frame then was; one of the speed is along where it then points.
    """
    r_l, r_r = wheels.radii
    speeds = np.array([[-r_l, r_r], [0.5 * r_l * wheels.baseline, 0.5 * r_r * wheels.baseline]]) / wheels.baseline
    to_end = xy[:, -1:] - xy
    c, s, none, one = np.cos(yaw), np.sin(yaw), np.zeros_like(yaw), np.ones_like(yaw)
    by_turn = np.stack([one, -to_end[..., 1], to_end[..., 0]], axis=-1)
    by_speed, by_slip = np.stack([none, c, s], axis=-1), np.stack([none, -s, c], axis=-1)
    by_wheels = np.stack([by_turn, by_speed], axis=-1) @ speeds * wheels.noise
    effect = np.concatenate([by_wheels, by_slip[..., None] * wheels.slip], axis=-1)
    weight = np.where(np.arange(yaw.shape[1]) % 2, 4.0, 2.0)
    weight[[0, -1]] = 1.0
    weight = weight / weight.sum() * duration[:, None]
    return np.einsum("km,kmin,kmjn->kij", weight, effect, effect)
