"""The first guess, from nothing: intrinsics, poses, clocks, rotation, gravity, lever arms. What the rig gives is
used."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from icalib.errors import EstimationError
from icalib.estimation.imu_data import ImuData
from icalib.first_guess.clocks import Alignment, align, camera_rates, check_axes
from icalib.first_guess.gyro import GyroRotation
from icalib.first_guess.intrinsics import guess_intrinsics
from icalib.first_guess.lever_arm import LeverArm, check_gravity, check_size, lever_arm
from icalib.first_guess.target_poses import TargetPoses, target_poses
from icalib.geometry.cameras import camera_model
from icalib.measurements import CornerStream, Measurements
from icalib.rig import Camera, Parameter, Rig

VELOCITY_STEP_S = 0.04


@dataclass(frozen=True)
class CameraGuess:
    """params (P,); offset: t_imu - t_cam, each since its clock's first stamp [s]; T_imu_cam; poses in the board
    frame."""

    params: np.ndarray
    offset: float
    rotation: np.ndarray
    position: np.ndarray
    poses: TargetPoses


@dataclass(frozen=True)
class Guess:
    """Where the solver starts. R_world_board: world z is up, its origin the board's; its x axis horizontal in the
    board."""

    cameras: dict[str, CameraGuess]
    gyro_bias: np.ndarray
    accel_bias: np.ndarray
    R_world_board: np.ndarray

    def values(self) -> dict[tuple[str, str], np.ndarray]:
        """The lasting parameters by sensor and name."""
        out: dict[tuple[str, str], np.ndarray] = {("board0", "tilt"): self.R_world_board}
        for name, c in self.cameras.items():
            out[name, "rotation"], out[name, "translation"] = c.rotation, c.position
            out[name, "time_offset"] = np.array([c.offset])
            out[name, "intrinsics"], out[name, "distortion"] = c.params[:4], c.params[4:]
        return out

    def biases(self, n: int) -> np.ndarray:
        """(n, 6) the biases, the same at all nodes."""
        return np.tile(np.concatenate([self.gyro_bias, self.accel_bias]), (n, 1))


def initial_guess(rig: Rig, measurements: Measurements) -> Guess:
    """Raises EstimationError, one sentence, where the recording does not carry a guess."""
    imu = ImuData.build(measurements.imu, rig.imu.noise)
    params = [_params(c, s, rig) for c, s in zip(rig.cameras, measurements.cameras, strict=True)]
    poses = [
        target_poses(s, camera_model(c.model), p, rig.target.points)
        for c, s, p in zip(rig.cameras, measurements.cameras, params, strict=True)
    ]
    aligned = [
        _align(c, s, q, imu, measurements) for c, s, q in zip(rig.cameras, measurements.cameras, poses, strict=True)
    ]
    best = int(np.argmax([q.ok.sum() for q in poses]))
    gyro_bias = aligned[best].gyro_bias
    gyro = GyroRotation.integrate(imu, gyro_bias)
    arms = [
        lever_arm(imu, s.seconds + a.offset, q, a.rotation, gyro, _trusted(c.translation))
        for c, s, q, a in zip(rig.cameras, measurements.cameras, poses, aligned, strict=True)
    ]
    gravity = arms[best].gravity
    check_gravity(float(np.linalg.norm(gravity)), rig.gravity, rig.imu.name)
    for c, m in zip(rig.cameras, arms, strict=True):
        check_size(m, c.name)
    cameras = {
        c.name: _camera_guess(c, s, p, a, m, q, measurements)
        for c, s, p, a, m, q in zip(rig.cameras, measurements.cameras, params, aligned, arms, poses, strict=True)
    }
    return Guess(cameras, gyro_bias, _mean_bias(arms), _level(gravity))


def _params(camera: Camera, stream: CornerStream, rig: Rig) -> np.ndarray:
    """(P,) from the rig where it has them, else from the corners."""
    model = camera_model(camera.model)
    given = np.full(len(model.parameter_names), np.nan)
    for part, parameter in ((slice(0, 4), camera.intrinsics), (slice(4, None), camera.distortion)):
        if parameter.value is not None:
            given[part] = parameter.value
    if not np.isnan(given).any():
        return given
    return guess_intrinsics(stream, model, camera.resolution, rig.target.points, given)


def _trusted(parameter: Parameter) -> np.ndarray | None:
    """A value that what else is guessed may rest on; one that is only a place to start from may be far off."""
    return None if parameter.mode == "free" else parameter.value


def _relative_offset(value: np.ndarray, stream: CornerStream, measurements: Measurements) -> float:
    return float(value[0]) + (stream.origin_ns - measurements.imu.origin_ns) * 1e-9


def _align(
    camera: Camera, stream: CornerStream, poses: TargetPoses, imu: ImuData, measurements: Measurements
) -> Alignment:
    rates = camera_rates(stream, poses)
    given, trusted = camera.time_offset.value, _trusted(camera.time_offset)
    if trusted is not None:
        found = align(imu, camera.name, rates, _relative_offset(trusted, stream, measurements))
    else:
        try:
            found = align(imu, camera.name, rates, None)
        except EstimationError:
            if given is None:
                raise
            found = align(imu, camera.name, rates, _relative_offset(given, stream, measurements))
    rotation = _trusted(camera.rotation)
    if rotation is None:
        check_axes(rates, camera.name)
    return found if rotation is None else Alignment(found.offset, rotation, found.gyro_bias)


def _camera_guess(
    camera: Camera,
    stream: CornerStream,
    params: np.ndarray,
    aligned: Alignment,
    arm: LeverArm,
    poses: TargetPoses,
    measurements: Measurements,
) -> CameraGuess:
    """What was found, and in its place what the rig gives."""
    offset, R, p = camera.time_offset.value, camera.rotation.value, camera.translation.value
    return CameraGuess(
        params,
        aligned.offset if offset is None else _relative_offset(offset, stream, measurements),
        aligned.rotation if R is None else R,
        arm.position if p is None else p,
        poses,
    )


def _mean_bias(arms: list[LeverArm]) -> np.ndarray:
    return np.mean([a.accel_bias for a in arms], axis=0)


def _level(gravity_board: np.ndarray) -> np.ndarray:
    """R_world_board with z against gravity and x along the horizontal direction nearest to the board's x (or y)."""
    up = -gravity_board / np.linalg.norm(gravity_board)
    reference = np.eye(3)[0] if abs(up[0]) < 0.9 else np.eye(3)[1]
    x = reference - (reference @ up) * up
    x /= np.linalg.norm(x)
    return np.stack([x, np.cross(up, x), up])


def initial_trajectory(
    guess: Guess, rig: Rig, measurements: Measurements, nodes: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """R_world_imu (K, 3, 3), position and velocity (K, 3) at `nodes` [s on the imu clock since its first stamp].

    From the nearest camera pose, rotation carried by the gyroscope, position interpolated.
    """
    imu = ImuData.build(measurements.imu, rig.imu.noise)
    times, rotations, positions = [], [], []
    for stream in measurements.cameras:
        c = guess.cameras[stream.name]
        ok = c.poses.ok
        R_bi = c.poses.rotation[ok] @ c.rotation.T
        times.append(stream.seconds[ok] + c.offset)
        rotations.append(guess.R_world_board @ R_bi)
        positions.append((c.poses.position[ok] - R_bi @ c.position) @ guess.R_world_board.T)
    t = np.concatenate(times)
    order = np.argsort(t, kind="stable")
    order = order[np.diff(t[order], prepend=-np.inf) > 1e-4]
    t, R, p = t[order], np.concatenate(rotations)[order], np.concatenate(positions)[order]

    def position(s: np.ndarray) -> np.ndarray:
        return np.stack([np.interp(s, t, p[:, k]) for k in range(3)], axis=1)

    rotation = GyroRotation.integrate(imu, guess.gyro_bias).carry(t, R, nodes)
    velocity = (position(nodes + VELOCITY_STEP_S) - position(nodes - VELOCITY_STEP_S)) / (2.0 * VELOCITY_STEP_S)
    return np.ascontiguousarray(rotation), position(nodes), velocity
