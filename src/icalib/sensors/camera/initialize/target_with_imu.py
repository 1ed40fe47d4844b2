"""Initial guess of cameras that see a target, of the IMU's biases, and of the attitude of the target.

Steps: intrinsics; camera poses; time offset and rotation by angular rates; gravity, accelerometer bias and lever arm by
double-integrated accelerations. Each step uses the values of the rig file.

Initial guess of a rig without an IMU: relative poses of cameras from simultaneous images of the target.

Detects an IMU whose recorded axes are not the true ones: inverted, permuted or left-handed.

If the readings do not fit the motion that cameras measured, each convention is tried. An error names one that fits far
better.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace

import numpy as np

from icalib.data.measurements import Measurements
from icalib.errors import EstimationError
from icalib.geometry import so3
from icalib.geometry.cameras import camera_model
from icalib.initialize.initializer import merged_translation, merged_value
from icalib.initialize.lever_arm import LeverArm, check_gravity, check_target_size, solve_camera_lever_arm
from icalib.initialize.rate_alignment import RateAlignment
from icalib.initialize.rate_correlation import GyroRotation
from icalib.motion.imu_data import ImuData, imu_data
from icalib.optim.state import Key
from icalib.rig import Axes, Camera, ImuSensor, Rig
from icalib.sensors.camera.initialize.guess import (
    CameraGuess,
    Guess,
    align_camera,
    chosen_offset,
    known_value,
    relative_offset,
)
from icalib.sensors.camera.initialize.scene_intrinsics import find_scene, intrinsics_of
from icalib.sensors.camera.initialize.target_poses import TargetPoses, camera_rates
from icalib.sensors.camera.initialize.target_scene import TargetScene, scene_poses
from icalib.sensors.camera.model import choose_bodies, restrict, taken_at_once
from icalib.sensors.sensor import ROTATION

__all__ = ["CameraGuess", "Guess", "initial_guess", "initial_trajectory"]

# s, half the interval of the central difference for velocities; the interval is two image periods at 25 Hz. Over
# shorter intervals the noise of poses dominates, over longer ones the acceleration.
VELOCITY_HALF_STEP_S = 0.04


def initial_guess(rig: Rig, measurements: Measurements, scene: TargetScene | None = None) -> Guess:
    """The initial guess of one recording.

    scene: poses of the target's bodies, if known; streams must then have corners of these bodies only. If None, it is
    estimated from this recording. Raises EstimationError if the recording does not determine a guess.
    """
    if scene is None:
        bodies = choose_bodies(rig.target, [measurements], bent=False, rig=rig)
        measurements = restrict(bodies, measurements)
        scene = find_scene(rig, bodies, [measurements])
    params = [intrinsics_of(c, s, rig.target, scene) for c, s in zip(rig.cameras, measurements.cameras, strict=True)]
    poses = [
        scene_poses(s, camera_model(c.model), p, scene)
        for c, s, p in zip(rig.cameras, measurements.cameras, params, strict=True)
    ]
    imu = imu_data(rig, measurements)
    if imu is None:
        return guess_without_imu(rig, measurements, params, poses, scene.values)
    assert rig.imu is not None
    views = _TargetViews(rig, measurements, params, poses, scene.values)
    try:
        guess, is_contradicted = views.guess(imu)
    except EstimationError as error:
        refuse_other_axes(rig.imu, imu, views.unexplained_acceleration, error)
        raise
    if is_contradicted:
        refuse_other_axes(rig.imu, imu, views.unexplained_acceleration, None)
    return guess


@dataclass(frozen=True)
class _TargetViews:
    """Camera poses from images of the target, in one recording.

    params: (P,) intrinsics and distortion of each camera; poses: T_target_cam of the images of each camera. scene:
    poses T_target_body of the bodies as in a state, keyed by body and parameter.
    """

    rig: Rig
    measurements: Measurements
    params: list[np.ndarray]
    poses: list[TargetPoses]
    scene: dict[Key, np.ndarray]

    def guess(self, imu: ImuData) -> tuple[Guess, bool]:
        """The guess from camera poses and `imu`, and whether the accelerometer contradicts the camera poses.

        Raises EstimationError if the measurements do not determine the guess.
        """
        best = self._best_camera
        aligned = [self._aligned(imu, k) for k in range(len(self.poses))]
        gyro = GyroRotation.integrate(imu, aligned[best].gyro_bias)
        arms = [self._arm(imu, k, a, gyro) for k, a in enumerate(aligned)]
        self._check_gravity(imu, arms[best], aligned[best])
        for c, arm, a in zip(self.rig.cameras, arms, aligned, strict=True):
            check_target_size(arm, c.name, a.given)
        cameras = {
            c.name: _camera_guess(c, self._offset(imu, k, a), self.params[k], a, arm, self.poses[k])
            for k, (c, a, arm) in enumerate(zip(self.rig.cameras, aligned, arms, strict=True))
        }
        guess = Guess(
            cameras, aligned[best].gyro_bias, _mean_bias(arms), _attitude_of_board(arms[best].gravity), self.scene
        )
        return guess, arms[best].contradicts_camera

    def unexplained_acceleration(self, imu: ImuData) -> float:
        """Share of the acceleration of the camera with most poses that the accelerometer readings do not explain.

        Raises EstimationError if their alignment fails, or gravity is implausible.
        """
        a = self._aligned(imu, self._best_camera)
        arm = self._arm(imu, self._best_camera, a, GyroRotation.integrate(imu, a.gyro_bias))
        self._check_gravity(imu, arm, a)
        return arm.unexplained

    @property
    def _best_camera(self) -> int:
        """Index of the camera with most poses."""
        return int(np.argmax([q.ok.sum() for q in self.poses]))

    def _aligned(self, imu: ImuData, k: int) -> RateAlignment:
        """Time offset, rotation and gyroscope bias from the poses of camera `k`."""
        stream = self.measurements.cameras[k]
        return align_camera(self.rig.cameras[k], stream, camera_rates(stream, self.poses[k]), imu, self.measurements)

    def _offset(self, imu: ImuData, k: int, aligned: RateAlignment) -> float:
        """The time offset [s] of camera `k` from the rig file or `aligned`, with clocks counted from first stamps."""
        camera, stream = self.rig.cameras[k], self.measurements.cameras[k]
        raw = camera.time_offset.value
        given = None if raw is None else relative_offset(raw, stream, self.measurements)
        return chosen_offset(camera, camera_rates(stream, self.poses[k]), imu, given, aligned)

    def _arm(self, imu: ImuData, k: int, aligned: RateAlignment, gyro: GyroRotation) -> LeverArm:
        """Lever arm, gravity and accelerometer bias from the poses of camera `k`."""
        poses, known = self.poses[k], known_value(self.rig.cameras[k].translation)
        t = self.measurements.cameras[k].seconds[poses.ok] + aligned.offset
        R_board_imu = poses.rotation[poses.ok] @ aligned.rotation.T
        return solve_camera_lever_arm(imu, t, R_board_imu, poses.position[poses.ok], gyro, known)

    def _check_gravity(self, imu: ImuData, arm: LeverArm, aligned: RateAlignment) -> None:
        """Raises EstimationError if the length of gravity in `arm` is implausible."""
        check_gravity(float(np.linalg.norm(arm.gravity)), self.rig.gravity, imu.name, aligned.given)


def _camera_guess(
    camera: Camera, offset: float, params: np.ndarray, aligned: RateAlignment, arm: LeverArm, poses: TargetPoses
) -> CameraGuess:
    """The guess of one camera: values of the rig file, else the estimates `aligned` and `arm`.

    An estimate replaces an initial guess of the rig file if it contradicts it.
    """
    p = camera.translation.value
    if p is not None and camera.translation.mode == "free":
        p = merged_translation(p, arm.position, arm.covariance)
    return CameraGuess(
        params,
        offset,
        merged_value(ROTATION, camera.rotation, camera.rotation.value, aligned.rotation),
        arm.position if p is None else p,
        poses,
    )


def _mean_bias(arms: list[LeverArm]) -> np.ndarray:
    """(3,) [m/s^2] accelerometer bias: mean of the estimates from each camera."""
    return np.mean([a.accel_bias for a in arms], axis=0)


def _attitude_of_board(gravity_board: np.ndarray) -> np.ndarray:
    """R_world_board (3, 3) from gravity (3,) [m/s^2], which points down, in the board's frame; world z is up.

    World x is the projection of the board's x axis on the horizontal plane, or of its y axis if x is nearly vertical.
    """
    up = -gravity_board / np.linalg.norm(gravity_board)
    reference = np.eye(3)[0] if abs(up[0]) < 0.9 else np.eye(3)[1]
    x = reference - (reference @ up) * up
    x /= np.linalg.norm(x)
    return np.stack([x, np.cross(up, x), up])


def initial_trajectory(
    guess: Guess, rig: Rig, measurements: Measurements, keyframes: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """R_world_imu (K, 3, 3), position [m] and velocity [m/s] (K, 3) at `keyframes` (K,).

    keyframes: [s] on the IMU's clock since its first stamp. The gyroscope propagates the rotation from the nearest
    camera pose; positions are interpolated linearly; velocities are their central differences.
    """
    imu = imu_data(rig, measurements)
    if imu is None:
        return trajectory_without_imu(guess, measurements, keyframes)
    t, R, p, _ = guess.body_poses(measurements)

    def position(s: np.ndarray) -> np.ndarray:
        return np.stack([np.interp(s, t, p[:, k]) for k in range(3)], axis=1)

    rotation = GyroRotation.integrate(imu, guess.gyro_bias).carry(t, R, keyframes)
    step = VELOCITY_HALF_STEP_S
    velocity = (position(keyframes + step) - position(keyframes - step)) / (2.0 * step)
    return np.ascontiguousarray(rotation), position(keyframes), velocity


UNCHANGED_AXES: Axes = ("x", "y", "z")
MAX_GOOD_UNEXPLAINED = 0.4  # unexplained share of the acceleration below which a convention fits
# largest unexplained share of another convention, relative to that of the present one, at which it is named
MAX_UNEXPLAINED_RATIO = 0.5
_UNIQUE_BEST_RATIO = 0.8  # best over second best unexplained share, above which both conventions are named


@dataclass(frozen=True)
class AxisConvention:
    """gyro, accel: the recorded columns that are the true x, y, z axes, with sign; words: the convention as a
    clause."""

    gyro: Axes
    accel: Axes
    words: str

    def of(self, imu: ImuData) -> ImuData:
        """The readings of `imu` in the true axes, if this convention holds."""
        return replace(imu, gyro=_in_axes(imu.gyro, self.gyro), accel=_in_axes(imu.accel, self.accel))

    def fields(self, sensor: ImuSensor) -> str:
        """Text with the fields `gyro_axes` and `accel_axes` to set in the rig file, whose present axes are those of
        `sensor`."""
        fields = []
        for name, stated, axes in (
            ("gyro_axes", sensor.gyro_axes, self.gyro),
            ("accel_axes", sensor.accel_axes, self.accel),
        ):
            if axes != UNCHANGED_AXES:
                fields.append(f"{name}: [{', '.join(_composed(stated or UNCHANGED_AXES, axes))}]")
        return " and ".join(fields)


def axis_conventions() -> Iterator[AxisConvention]:
    """All conventions that are tried, the most common first. A rotation between both triads is assigned to the
    gyroscope."""
    yield AxisConvention(UNCHANGED_AXES, ("-x", "-y", "-z"), "has an inverted accelerometer, which reads -g at rest")
    for k, axis in enumerate("xyz"):
        yield AxisConvention(_flipped(k), UNCHANGED_AXES, f"has a left-handed gyroscope, axis {axis} reversed")
    yield AxisConvention(("-x", "-y", "-z"), UNCHANGED_AXES, "has a gyroscope with all axes reversed")
    for k, axis in enumerate("xyz"):
        yield AxisConvention(UNCHANGED_AXES, _flipped(k), f"has a left-handed accelerometer, axis {axis} reversed")
    for k in range(3):
        others = tuple(j for j in range(3) if j != k)
        names = " and ".join("xyz"[j] for j in others)
        yield AxisConvention(_flipped(*others), UNCHANGED_AXES, f"has a gyroscope whose axes {names} are reversed")
        yield AxisConvention(_swapped(*others), UNCHANGED_AXES, f"has a gyroscope whose axes {names} are swapped")
        yield AxisConvention(UNCHANGED_AXES, _swapped(*others), f"has an accelerometer whose axes {names} are swapped")
    for axes in (("y", "z", "x"), ("z", "x", "y")):
        yield AxisConvention(axes, UNCHANGED_AXES, "has a gyroscope whose axes differ from those of its accelerometer")


def refuse_other_axes(
    sensor: ImuSensor, imu: ImuData, unexplained: Callable[[ImuData], float], failed: EstimationError | None
) -> None:
    """Raises EstimationError if readings in another convention fit far better. unexplained(imu): share of the measured
    acceleration that the readings do not explain; it may raise EstimationError. failed: the error that the present
    readings raised, if any."""
    if sensor.assumed:
        return
    now = _unexplained_or_inf(unexplained, imu)
    ranked = sorted(
        (
            (_unexplained_or_inf(unexplained, convention.of(imu)), k, convention)
            for k, convention in enumerate(axis_conventions())
        ),
        key=lambda x: x[:2],
    )
    best, _, convention = ranked[0]
    if best < min(MAX_GOOD_UNEXPLAINED, MAX_UNEXPLAINED_RATIO * now):
        alternative = (
            f" (or {ranked[1][2].fields(sensor)}, which fits as well)"
            if best > _UNIQUE_BEST_RATIO * ranked[1][0]
            else ""
        )
        raise EstimationError(
            f"{sensor.name} {convention.words}: its readings fit the cameras only then; set "
            f"{convention.fields(sensor)}{alternative} of {sensor.name} in the rig file."
        ) from failed


def _unexplained_or_inf(unexplained: Callable[[ImuData], float], imu: ImuData) -> float:
    """The unexplained share, infinite if it raises EstimationError."""
    try:
        return unexplained(imu)
    except EstimationError:
        return np.inf


def _in_axes(values: np.ndarray, axes: Axes) -> np.ndarray:
    """Columns of `values` (N, 3), permuted and signed as in `axes`."""
    sign = [-1.0 if entry.startswith("-") else 1.0 for entry in axes]
    return np.ascontiguousarray(values[:, ["xyz".index(entry[-1]) for entry in axes]] * sign)


def _composed(stated: Axes, axes: Axes) -> list[str]:
    """The axes of the rig file after the axes `axes` are applied to those in `stated`."""
    columns = [(stated["xyz".index(entry[-1])], entry.startswith("-")) for entry in axes]
    return [f"{'-' if name.startswith('-') != is_negated else ''}{name[-1]}" for name, is_negated in columns]


def _flipped(*which: int) -> Axes:
    """Axes with the columns in `which` negated."""
    x, y, z = (f"-{axis}" if k in which else axis for k, axis in enumerate("xyz"))
    return x, y, z


def _swapped(i: int, j: int) -> Axes:
    """Axes with columns i and j exchanged."""
    axes = list("xyz")
    axes[i], axes[j] = axes[j], axes[i]
    return axes[0], axes[1], axes[2]


# Largest number of image pairs, spread over the recording, that determine the relative pose of two cameras. The cost
# grows with its square, and the initial guess needs no better mean.
MAX_IMAGE_PAIRS = 200
Scene = dict[Key, np.ndarray]
Pose = tuple[np.ndarray, np.ndarray]  # R (3, 3), p (3,) m


def guess_without_imu(
    rig: Rig, measurements: Measurements, params: list[np.ndarray], poses: list[TargetPoses], scene: Scene
) -> Guess:
    """The initial guess of one recording; the first camera is the body, and the world is the target's frame.

    params: (P,) intrinsics and distortion of each camera; poses: T_target_cam of the images of each camera; scene:
    poses of the target's bodies. Raises EstimationError naming a camera without any pose, or cameras that no
    simultaneous images connect to the first one.
    """
    for camera, camera_poses in zip(rig.cameras, poses, strict=True):
        if not camera_poses.ok.any():
            raise EstimationError(
                f"{camera.name}: its lens explains the corners in none of its {len(camera_poses.ok)} images; check its "
                "model and resolution in the rig file, and remove intrinsics and distortion so that they are "
                "estimated."
            )
    offsets = [
        relative_offset(np.zeros(1) if c.time_offset.value is None else c.time_offset.value, s, measurements)
        for c, s in zip(rig.cameras, measurements.cameras, strict=True)
    ]
    times = [s.seconds + o for s, o in zip(measurements.cameras, offsets, strict=True)]
    extrinsics = _extrinsics(rig, times, poses)
    cameras = {c.name: CameraGuess(params[i], offsets[i], *extrinsics[i], poses[i]) for i, c in enumerate(rig.cameras)}
    return Guess(cameras, np.zeros(3), np.zeros(3), np.eye(3), scene)


def trajectory_without_imu(
    guess: Guess, measurements: Measurements, keyframes: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """R_world_body (K, 3, 3), position [m] and velocity [m/s] (K, 3) at `keyframes` (K,) [s].

    Each pose is that of the nearest image; velocities are zero.
    """
    t, R, p, _ = guess.body_poses(measurements)
    nearest = np.searchsorted(0.5 * (t[1:] + t[:-1]), keyframes)
    return np.ascontiguousarray(R[nearest]), p[nearest], np.zeros((len(keyframes), 3))


def _extrinsics(rig: Rig, times: list[np.ndarray], poses: list[TargetPoses]) -> list[Pose]:
    """T_body_cam of each camera: that of the rig file, else by a tree of relative poses from the first camera.

    The tree grows by the pair of cameras with most simultaneous images. times: (M,) [s] instants of the images of each
    camera on the body's clock; poses: T_target_cam. Raises EstimationError if a camera is not connected.
    """
    extrinsics: dict[int, Pose] = {0: (np.eye(3), np.zeros(3))}
    for i, c in enumerate(rig.cameras[1:], 1):
        if c.rotation.value is not None and c.translation.value is not None:
            extrinsics[i] = c.rotation.value, c.translation.value
    while len(extrinsics) < len(rig.cameras):
        pairs = [(a, b) for a in extrinsics for b in range(len(rig.cameras)) if b not in extrinsics]
        relative_poses = {(a, b): _relative_poses(times[a], poses[a], times[b], poses[b]) for a, b in pairs}
        (a, b), relative = max(relative_poses.items(), key=lambda item: len(item[1]))
        if not relative:
            raise _not_connected(rig, extrinsics)
        R, p = _medoid(relative)
        extrinsics[b] = extrinsics[a][0] @ R, extrinsics[a][1] + extrinsics[a][0] @ p
    for i, c in enumerate(rig.cameras[1:], 1):
        R, p = c.rotation.value, c.translation.value
        extrinsics[i] = (extrinsics[i][0] if R is None else R, extrinsics[i][1] if p is None else p)
    return [extrinsics[i] for i in range(len(rig.cameras))]


def _relative_poses(ta: np.ndarray, a: TargetPoses, tb: np.ndarray, b: TargetPoses) -> list[Pose]:
    """T_a_b of two cameras, one for each of up to `MAX_IMAGE_PAIRS` pairs of simultaneous images, at `ta`, `tb` [s]."""
    pairs = np.column_stack(taken_at_once(ta, tb))
    pairs = pairs[a.ok[pairs[:, 0]] & b.ok[pairs[:, 1]]]
    if len(pairs) > MAX_IMAGE_PAIRS:
        pairs = pairs[np.linspace(0, len(pairs) - 1, MAX_IMAGE_PAIRS).astype(int)]
    return [(a.rotation[i].T @ b.rotation[j], a.rotation[i].T @ (b.position[j] - a.position[i])) for i, j in pairs]


def _medoid(poses: list[Pose]) -> Pose:
    """The medoid, a robust mean: the pose with the least median distance to all. One radian counts as one metre."""
    R, p = np.array([R for R, _ in poses]), np.array([p for _, p in poses])
    angles = np.linalg.norm(so3.log_many((R[:, None].swapaxes(-1, -2) @ R[None]).reshape(-1, 3, 3)), axis=1)
    distance = angles.reshape(len(R), -1) + np.linalg.norm(p[:, None] - p[None], axis=2)
    return poses[int(np.argmin(np.median(distance, axis=1)))]


def _not_connected(rig: Rig, connected: dict[int, Pose]) -> EstimationError:
    """The error, not raised, that no simultaneous images connect some cameras to those in `connected`."""
    lost = ", ".join(c.name for i, c in enumerate(rig.cameras) if i not in connected)
    known = ", ".join(c.name for i, c in enumerate(rig.cameras) if i in connected)
    return EstimationError(
        f"{lost} and {known} never saw the target at the same instant, and there is no IMU to connect them; "
        "show it to both at once with synchronised stamps, add the IMU, or give rotation and translation in "
        "the rig file."
    )
