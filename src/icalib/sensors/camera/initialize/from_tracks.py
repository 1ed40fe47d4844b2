"""Initial guess from feature tracks and an IMU, without a target.

Epipolar geometry gives the rotations of each camera between images. Their alignment with the gyroscope gives time
offsets, extrinsic rotations and the gyroscope bias. With known rotations, velocities, gravity, accelerometer bias and
lever arms are the solution of a linear problem (`solve_linear_motion`).

Trajectory of the IMU from feature tracks and known rotations, as a linear problem (Dong-Si and Mourikis 2012).

Rotations come from the gyroscope. Within a window of a few seconds, the position relative to that at its beginning is

    p(t) = v0 t + g t^2 / 2 + D_f(t) - D_R(t) b_a        D_f'' = R f,  D_R'' = R

with the specific force f, the initial velocity v0, gravity g and the accelerometer bias b_a. A camera at
p(t) + R p_imu_cam observes points along known rays. The distances of points from their rays are linear in the points,
v0, g, b_a and the lever arms. Points are eliminated first, then v0 and g of each window. Distances are weighted by the
inverse range of their points, which is found iteratively. Each window has a gravity close to a common one, because the
gyroscope drifts. The length of gravity is known.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from itertools import pairwise

import numpy as np

from icalib.data.measurements import Measurements, TrackStream
from icalib.errors import EstimationError
from icalib.geometry.cameras import camera_model
from icalib.initialize.initializer import merged_value
from icalib.initialize.rate_alignment import RateAlignment
from icalib.initialize.rate_correlation import GyroRotation
from icalib.initialize.trajectories import levelling_rotation
from icalib.motion.imu_data import ImuData, imu_data
from icalib.rig import Camera, Rig
from icalib.sensors.camera.initialize.guess import (
    CameraGuess,
    Guess,
    align_camera,
    chosen_offset,
    known_value,
    relative_offset,
)
from icalib.sensors.camera.initialize.joint_alignment import align_jointly, matching_track_rates, shared_rays
from icalib.sensors.camera.initialize.target_poses import TargetPoses
from icalib.sensors.camera.initialize.track_intrinsics import find_intrinsics
from icalib.sensors.sensor import ROTATION

MAX_IMAGE_STEP_S = 0.15  # s between the images that the linear problem uses; others add little information
MIN_TRACK_IMAGES = 3  # selected images that a typical track spans; the linear problem uses no shorter tracks
MIN_GRAVITY_RATIO = 0.7  # median specific force over gravity; typical rigs accelerate by less than 3 m/s^2


def guess_from_tracks(rig: Rig, measurements: Measurements) -> Guess:
    """The initial guess of one recording; its camera poses are in the world frame.

    Raises EstimationError if the tracks do not determine the guess, or the intrinsics of a camera.
    """
    imu = imu_data(rig, measurements)
    assert imu is not None  # the rig file reader refuses tracks without an IMU
    params = [start_intrinsics(c, t, imu, measurements) for c, t in zip(rig.cameras, measurements.tracks, strict=True)]
    rates = [
        matching_track_rates(imu, t, camera_model(c.model), p)
        for c, t, p in zip(rig.cameras, measurements.tracks, params, strict=True)
    ]
    aligned = [
        align_camera(c, s, r, imu, measurements)
        for c, s, r in zip(rig.cameras, measurements.cameras, rates, strict=True)
    ]
    aligned = _aligned_together(rig, measurements, imu, params, aligned)
    gyro = GyroRotation.integrate(imu, aligned[0].gyro_bias)
    rays = _rays(rig, measurements, imu, params, [a.offset for a in aligned])
    arms = [known_value(c.translation) for c in rig.cameras]
    _check_units(imu, rig.gravity)
    motion = solve_linear_motion(gyro, rays, [a.rotation for a in aligned], arms, rig.gravity)
    cameras = {}
    for k, (camera, stream, alignment) in enumerate(zip(rig.cameras, measurements.cameras, aligned, strict=True)):
        raw = camera.time_offset.value
        given = None if raw is None else relative_offset(raw, stream, measurements)
        offset = chosen_offset(camera, rates[k], imu, given, alignment)
        R = merged_value(ROTATION, camera.rotation, camera.rotation.value, alignment.rotation)
        p = motion.arms[k] if camera.translation.value is None else camera.translation.value
        cameras[camera.name] = CameraGuess(params[k], offset, R, p, _poses(motion, stream.seconds + offset, R, p))
    return Guess(cameras, gyro_bias=aligned[0].gyro_bias, accel_bias=motion.accel_bias, R_world_board=np.eye(3))


def _aligned_together(
    rig: Rig, measurements: Measurements, imu: ImuData, params: list[np.ndarray], aligned: list[RateAlignment]
) -> list[RateAlignment]:
    """The alignments of all cameras, refined together with one gyroscope bias; see `joint_alignment`.

    params: (P,) intrinsics and distortion of each camera; aligned: alignments of single cameras."""
    pairs = []
    for k, (camera, stream) in enumerate(zip(rig.cameras, measurements.tracks, strict=True)):
        pairs += shared_rays(k, stream, camera_model(camera.model), params[k])
    fixed = [(known_value(c.rotation) is not None, known_value(c.time_offset) is not None) for c in rig.cameras]
    return align_jointly(GyroRotation.integrate(imu, aligned[0].gyro_bias), pairs, aligned, fixed)


def _check_units(imu: ImuData, gravity: float) -> None:
    """Raises EstimationError if the ratio of median specific force and `gravity` [m/s^2] is far from 1."""
    force = float(np.median(np.linalg.norm(imu.accel, axis=1)))
    if not MIN_GRAVITY_RATIO < force / gravity < 1.0 / MIN_GRAVITY_RATIO:
        raise EstimationError(
            f"{imu.name} measures {force:.3g} m/s^2 most of the time instead of about {gravity:.3g}; check that "
            "the accelerometer is in m/s^2, not in g."
        )


def start_intrinsics(camera: Camera, stream: TrackStream, imu: ImuData, measurements: Measurements) -> np.ndarray:
    """(P,) intrinsics and distortion: those of the rig file, else those estimated from the tracks.

    If the rig file has intrinsics but no distortion, the distortion is the first start value of the camera model.
    Raises EstimationError as `find_intrinsics` does.
    """
    if camera.intrinsics.value is None:
        fixed = known_value(camera.time_offset)
        offset = None if fixed is None else relative_offset(fixed, stream, measurements)
        return find_intrinsics(camera, stream, imu, offset)
    distortion = camera.distortion.value
    if distortion is None:
        distortion = np.array(camera_model(camera.model).start_distortions[0])
    return np.concatenate([camera.intrinsics.value, distortion])


def _rays(rig: Rig, measurements: Measurements, imu: ImuData, params: list[np.ndarray], offsets: list[float]) -> Rays:
    """Rays of all cameras in the selected images within the IMU's recording.

    params: (P,) by camera; offsets: time offsets [s] by camera, clocks counted from their first stamps."""
    parts = []
    for k, (camera, stream) in enumerate(zip(rig.cameras, measurements.tracks, strict=True)):
        direction, valid = camera_model(camera.model).unproject(params[k], stream.uv)
        t = (stream.seconds + offsets[k])[stream.image]
        used = valid & (t >= imu.seconds[0]) & (t <= imu.seconds[-1]) & _selected_images(stream)[stream.image]
        parts.append((t[used], np.full(int(used.sum()), k), stream.feature[used], direction[used]))
    return Rays(*(np.concatenate(column) for column in zip(*parts, strict=True)))


def _selected_images(stream: TrackStream) -> np.ndarray:
    """(M,) bool: selects the first image in each interval of `MAX_IMAGE_STEP_S`.

    The interval is shorter if the median track is too short for `MIN_TRACK_IMAGES` such images.
    """
    t = stream.seconds
    numbers, track = np.unique(stream.feature, return_inverse=True)
    first, last = np.full(len(numbers), np.inf), np.full(len(numbers), -np.inf)
    np.minimum.at(first, track, t[stream.image])
    np.maximum.at(last, track, t[stream.image])
    duration = float(np.median((last - first)[track]))  # weighted by observations, so that short tracks count little
    step = min(MAX_IMAGE_STEP_S, duration / MIN_TRACK_IMAGES)
    return np.diff(np.floor((t - t[0]) / max(step, 1e-3) + 1e-6), prepend=-1.0) > 0.0


def _poses(motion: WindowMotion, times: np.ndarray, R_imu_cam: np.ndarray, p_imu_cam: np.ndarray) -> TargetPoses:
    """Poses of a camera in the world at `times` (M,) [s] on the IMU's clock; `ok` within the IMU's recording."""
    imu = motion.gyro.imu
    R, p = motion.poses(times)
    inside = (times >= imu.seconds[0]) & (times <= imu.seconds[-1])
    return TargetPoses(R @ R_imu_cam, p + R @ p_imu_cam, inside, np.zeros(len(times)), np.zeros(len(times)))


MOTION_WINDOW_S = 4.0  # s; over longer windows gravity rotates in the drifting gyroscope frame
REWEIGHTING_ROUNDS = 5  # ranges and weights change little after the third
MIN_WINDOW_OBSERVATIONS = 3  # of a point in a window; of two, nearly all information determines the point itself
MIN_RANGE_M = 0.1  # m, lower limit of the range of a point in its weights
ACCEL_BIAS_SIGMA = 0.3  # m/s^2, standard deviation of the zero-mean prior; for consumer MEMS accelerometers
WINDOW_ARM_SIGMA_M = 0.5  # m, standard deviation of the zero-mean prior of lever arms
GRAVITY_DRIFT_SIGMA = 0.3  # m/s^2, of the gravity of one window about the common one: 2 deg of gyroscope drift
GRAVITY_NORM_SIGMA = 0.05  # m/s^2, of the length of gravity, which varies by as much over the earth
WINDOW_RAY_SIGMA = 5e-3  # rad, standard deviation of a ray with rough intrinsics
MAX_INDEPENDENT_RAYS = 100  # of a window; rough intrinsics make ray errors correlate, so more add no information
N_WINDOW, N_COMMON = 6, 6  # unknowns of a window: v0, g - g_common; common unknowns before lever arms: g_common, b_a
FIXED_INFORMATION = 1e12  # m^-2, prior information of a known lever arm: a standard deviation of a micrometre


@dataclass(frozen=True)
class Rays:
    """n observations by all cameras.

    times: (n,) [s] on the IMU's clock; camera, feature: (n,) numbers; direction: (n, 3) unit rays in the camera frame.
    """

    times: np.ndarray
    camera: np.ndarray
    feature: np.ndarray
    direction: np.ndarray


@dataclass(frozen=True)
class WindowMotion:
    """The solution for W windows, in the start frame of `gyro` (the IMU's attitude at its first reading).

    begins: (W,) [s] on the IMU's clock; a window ends where the next begins. velocity: (W, 3) [m/s] at the beginnings;
    gravity: (W, 3) [m/s^2]; accel_bias: (3,) [m/s^2]; arms: (C, 3) [m] p_imu_cam of each camera.
    """

    gyro: GyroRotation
    begins: np.ndarray
    velocity: np.ndarray
    gravity: np.ndarray
    accel_bias: np.ndarray
    arms: np.ndarray

    @cached_property
    def _integrals(self) -> _Integrals:
        return _Integrals.of(self.gyro)

    def within(self, window: int, t: np.ndarray) -> np.ndarray:
        """(n, 3) [m] positions of the IMU at times t (n,) [s], relative to that at the beginning of the window."""
        s = (t - self.begins[window])[:, None]
        D_f, D_R = self._integrals.since(self.begins[window], t)
        return self.velocity[window] * s + 0.5 * self.gravity[window] * s**2 + D_f - D_R @ self.accel_bias

    def poses(self, t: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """R_world_imu (n, 3, 3) and p_world_imu (n, 3) [m] at times t (n,) [s]; world z is up.

        Each window begins at the final position of the previous one, and is rotated so that its gravity points down.
        """
        window = np.clip(np.searchsorted(self.begins, t, side="right") - 1, 0, None)
        rotation, position = np.empty((len(t), 3, 3)), np.empty((len(t), 3))
        origin, R = np.zeros(3), self.gyro.at(t)
        for k in range(len(self.begins)):
            R_world_start, rows = levelling_rotation(self.gravity[k]), window == k
            rotation[rows] = R_world_start @ R[rows]
            position[rows] = origin + self.within(k, t[rows]) @ R_world_start.T
            if k + 1 < len(self.begins):
                origin = origin + R_world_start @ self.within(k, self.begins[k + 1 : k + 2])[0]
        return rotation, position


@dataclass(frozen=True)
class _Integrals:
    """First and second time integrals of R f (3 columns) and R (9 columns), once and twice (N, 12).

    seconds: (N,) stamps of the IMU; f: specific force; R = R_start_imu by the gyroscope.
    """

    seconds: np.ndarray
    once: np.ndarray
    twice: np.ndarray

    @classmethod
    def of(cls, gyro: GyroRotation) -> _Integrals:
        """Integrals of R f and R, both taken as linear between readings of the IMU."""
        imu, R = gyro.imu, gyro.rotation
        x = np.concatenate([np.einsum("nij,nj->ni", R, imu.accel), R.reshape(-1, 9)], axis=1)
        h = np.diff(imu.seconds)[:, None]
        once, twice = np.zeros_like(x), np.zeros_like(x)
        once[1:] = np.cumsum(0.5 * h * (x[1:] + x[:-1]), axis=0)
        twice[1:] = np.cumsum(h * once[:-1] + h**2 * (x[:-1] / 3.0 + x[1:] / 6.0), axis=0)
        return cls(imu.seconds, once, twice)

    def since(self, begin: float, t: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """D_f (n, 3) [m] and D_R (n, 3, 3) [s^2] at times t (n,) [s]; values and derivatives are zero at `begin`."""

        def at(x: np.ndarray, s: np.ndarray) -> np.ndarray:
            return np.stack([np.interp(s, self.seconds, x[:, k]) for k in range(x.shape[1])], axis=1)

        start = np.array([begin])
        D = at(self.twice, t) - at(self.twice, start) - at(self.once, start) * (t - begin)[:, None]
        return D[:, :3], D[:, 3:].reshape(-1, 3, 3)


def solve_linear_motion(
    gyro: GyroRotation, rays: Rays, R_imu_cam: list[np.ndarray], arms: list[np.ndarray | None], gravity: float
) -> WindowMotion:
    """The motion of the IMU over the time of `rays`, from cameras with known rotations R_imu_cam (3, 3).

    arms: known lever arm (3,) [m] of each camera, or None; gravity: its length [m/s^2].
    """
    low, high = float(rays.times.min()), float(rays.times.max())
    edges = np.linspace(low, high, max(int(round((high - low) / MOTION_WINDOW_S)), 1) + 1)
    edges[-1] += 1e-6
    integrals = _Integrals.of(gyro)
    windows = [_Window.of(gyro, integrals, rays, R_imu_cam, a, b) for a, b in pairwise(edges)]
    mean, information = _common_prior(arms)
    local, common = np.zeros((len(windows), N_WINDOW)), mean
    for _ in range(REWEIGHTING_ROUNDS):
        systems = [w.normal_equations(np.concatenate([x, common])) for w, x in zip(windows, local, strict=True)]
        N, r = np.diag(information), information * mean
        if (length := float(np.linalg.norm(common[:3]))) > 0.0:
            down = common[:3] / length
            N[:3, :3] += np.outer(down, down) / GRAVITY_NORM_SIGMA**2
            r[:3] += gravity * down / GRAVITY_NORM_SIGMA**2
        local, common = _solve_windows(systems, N, r)
    estimated_arms = common[N_COMMON:].reshape(-1, 3)
    return WindowMotion(gyro, edges[:-1], local[:, :3], local[:, 3:] + common[:3], common[3:6], estimated_arms)


def _common_prior(arms: list[np.ndarray | None]) -> tuple[np.ndarray, np.ndarray]:
    """Mean and information (inverse variance), (6 + 3 C,) each, of the prior of the common unknowns: g, b_a, arms."""
    information = np.concatenate(
        [np.zeros(3), np.full(3, ACCEL_BIAS_SIGMA**-2), np.full(3 * len(arms), WINDOW_ARM_SIGMA_M**-2)]
    )
    mean = np.zeros(len(information))
    for k, arm in enumerate(arms):
        if arm is not None:
            columns = slice(N_COMMON + 3 * k, N_COMMON + 3 * k + 3)
            information[columns], mean[columns] = FIXED_INFORMATION, arm
    return mean, information


def _solve_windows(
    systems: list[tuple[np.ndarray, np.ndarray]], N: np.ndarray, r: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Unknowns of the windows (W, 6) and common unknowns (6 + 3 C,), by the Schur complement of each window.

    systems: normal matrix and right-hand side of each window; N, r: those of the priors of the common unknowns.
    """
    n = N_WINDOW
    for A, b in systems:
        A[range(3, n), range(3, n)] += GRAVITY_DRIFT_SIGMA**-2
        K = np.linalg.solve(A[:n, :n], np.column_stack([A[:n, n:], b[:n]]))
        N = N + A[n:, n:] - A[n:, :n] @ K[:, :-1]
        r = r + b[n:] - A[n:, :n] @ K[:, -1]
    common = np.linalg.solve(N, r)
    return np.array([np.linalg.solve(A[:n, :n], b[:n] - A[:n, n:] @ common) for A, b in systems]), common


@dataclass
class _Window:
    """The n observations of one window, sorted by track, with camera centres linear in the m unknowns x.

    position: (n, 3, m + 1), so that the camera centre is position (x, 1) [m]. direction: (n, 3) unit rays; both are in
    the start frame of the gyroscope. track: (n,) indices; begins: (t,) first observation of each track. weight: (n,)
    [m^-2] of the last round, None before the first.
    """

    position: np.ndarray
    direction: np.ndarray
    track: np.ndarray
    begins: np.ndarray
    weight: np.ndarray | None = None

    @classmethod
    def of(
        cls, gyro: GyroRotation, integrals: _Integrals, rays: Rays, R_ic: list[np.ndarray], begin: float, end: float
    ) -> _Window:
        """The observations from `begin` to `end` [s] of tracks that have enough of them."""
        rows = np.flatnonzero((rays.times >= begin) & (rays.times < end))
        _, track, count = np.unique(rays.feature[rows], return_inverse=True, return_counts=True)
        rows = rows[count[track] >= MIN_WINDOW_OBSERVATIONS]
        rows = rows[np.argsort(rays.feature[rows], kind="stable")]
        _, begins, track = np.unique(rays.feature[rows], return_index=True, return_inverse=True)
        t, camera = rays.times[rows], rays.camera[rows]
        s, R = (t - begin)[:, None, None], gyro.at(t)
        D_f, D_R = integrals.since(begin, t)
        position = np.zeros((len(t), 3, N_WINDOW + N_COMMON + 3 * len(R_ic) + 1))
        position[:, :, 0:3], position[:, :, 3:6] = s * np.eye(3), 0.5 * s**2 * np.eye(3)
        position[:, :, 6:9], position[:, :, 9:12], position[:, :, -1] = position[:, :, 3:6], -D_R, D_f
        for k in range(len(R_ic)):
            position[camera == k, :, 12 + 3 * k : 15 + 3 * k] = R[camera == k]
        direction = np.einsum("nij,njk,nk->ni", R, np.stack(R_ic)[camera], rays.direction[rows])
        return cls(position, direction, track, begins)

    def _by_track(self, x: np.ndarray) -> np.ndarray:
        """(t, ...) sums of x (n, ...) over the observations of each track."""
        return np.add.reduceat(x, self.begins, axis=0) if len(x) else x

    def normal_equations(self, x: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Normal matrix (m, m) and right-hand side (m,), with points eliminated.

        Updates the weights by the previous solution `x` (m,); in the first round they are 1."""
        Q = np.eye(3) - self.direction[:, :, None] * self.direction[:, None, :]
        if self.weight is not None:
            self.weight = self._reweighted(Q, self.weight, x)
        else:
            self.weight = np.ones(len(self.track))
        position, m = self.position, self.position.shape[2]
        along = np.einsum("ni,nia->na", self.direction, position)
        QA = self.weight[:, None, None] * (position - self.direction[:, :, None] * along[:, None, :])
        M, C = self._by_track(self.weight[:, None, None] * Q), self._by_track(QA)
        M += 1e-9 * np.trace(M, axis1=1, axis2=2)[:, None, None] * np.eye(3)
        G = position.reshape(-1, m).T @ QA.reshape(-1, m) - C.reshape(-1, m).T @ np.linalg.solve(M, C).reshape(-1, m)
        G[range(len(x)), range(len(x))] += 1e-9 * np.trace(G) / len(x)
        return G[:-1, :-1], -G[:-1, -1]

    def _reweighted(self, Q: np.ndarray, weight: np.ndarray, x: np.ndarray) -> np.ndarray:
        """(n,) [m^-2] weights from ranges and ray errors of the points at the solution `x` (m,), with Cauchy's loss.

        Q: (n, 3, 3) projectors perpendicular to the rays. Points are triangulated with the present `weight` (n,).
        """
        centre, wQ = self.position @ np.append(x, 1.0), weight[:, None, None] * Q
        M, b = self._by_track(wQ), self._by_track(np.einsum("nij,nj->ni", wQ, centre))
        M += 1e-9 * np.trace(M, axis1=1, axis2=2)[:, None, None] * np.eye(3)
        to_point = np.linalg.solve(M, b[:, :, None])[self.track, :, 0] - centre
        range_m = np.maximum(np.linalg.norm(to_point, axis=1), MIN_RANGE_M)
        error = np.linalg.norm(np.einsum("nij,nj->ni", Q, to_point), axis=1) / range_m
        typical = float(np.median(error))
        redundancy = max(1.0, len(range_m) / MAX_INDEPENDENT_RAYS)
        sigma, scale = np.sqrt(redundancy) * max(WINDOW_RAY_SIGMA, typical), 3.0 * typical + 1e-12
        return 1.0 / ((sigma * range_m) ** 2 * (1.0 + (error / scale) ** 2))
