"""Simulated measurements of IMU and cameras, by direct formulas without approximations for speed."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from icalib.base.files import regular
from icalib.errors import RecordingError
from icalib.rig import ImuNoise
from icalib.tools.simulation.scenario import GRAVITY_WORLD, HandheldMotion, Interval, Scenario
from icalib.tools.simulation.trajectory import Jet, Rows, TrueTrajectory, Vector, matrices, values

# True trajectories of the IMU in closed form.
#
# Frames: world (z up), imu. Angular rates w and specific forces f are in the imu frame: R' = R [w]x, v' = R f + g, p'
# = v.

_ANGLES_RAD = np.array([[0.45, 0.22, 0.18], [0.12, 0.09, 0.08]])  # slow, fast sinusoid; about camera z, y, x
_YAW_RAD = np.array([[0.25, 0.0, 0.0], [0.10, 0.0, 0.0]])
_SHIFT_M = np.array([[0.15, 0.10, 0.15], [0.05, 0.04, 0.05]])
_FREQUENCY_HZ = np.array([[0.30, 0.55], [0.80, 1.20]])  # range of the slow, of the fast sinusoid
_AXIS_X, _AXIS_Y, _AXIS_Z = np.eye(3)


def skew(w: np.ndarray) -> np.ndarray:
    """(..., 3, 3) cross-product matrices of w (..., 3): skew(w) v = w x v."""
    W = np.zeros((*w.shape[:-1], 3, 3))
    W[..., 2, 1], W[..., 0, 2], W[..., 1, 0] = w[..., 0], w[..., 1], w[..., 2]
    return W - np.swapaxes(W, -1, -2)


def readings_of(rotation: np.ndarray, rotation_rate: np.ndarray, acceleration: np.ndarray) -> np.ndarray:
    """(N, 6) angular rate [rad/s] and specific force [m/s^2] in the imu frame, from R_world_imu and its time derivative
    (N, 3, 3), and the acceleration (N, 3) m/s^2 in the world."""
    spin = np.swapaxes(rotation, 1, 2) @ rotation_rate
    rate = 0.5 * np.stack([spin[:, i, j] - spin[:, j, i] for i, j in ((2, 1), (0, 2), (1, 0))], axis=1)
    return np.concatenate([rate, np.einsum("nji,nj->ni", rotation, acceleration - GRAVITY_WORLD)], axis=1)


@dataclass(frozen=True, eq=False)
class Waves:
    """Several channels, each a sum of sinusoids. amplitude, frequency [Hz], phase [rad]: all (sinusoids, channels)."""

    amplitude: np.ndarray
    frequency: np.ndarray
    phase: np.ndarray

    def derivative(self, order: int, seconds: np.ndarray) -> np.ndarray:
        """(N, channels) time derivative of the given order at seconds (N,)."""
        omega = 2.0 * np.pi * self.frequency
        angle = omega * seconds[:, None, None] + self.phase + 0.5 * np.pi * order
        return np.sum(self.amplitude * omega**order * np.sin(angle), axis=1)


@dataclass(frozen=True, eq=False)
class Reference:
    """Trajectory in closed form: R_world_imu = left Rz(a0) Ry(a1) Rx(a2) right, p_world_imu = center + axes s. Angles a
    [rad] and shifts s [m] are `Waves`."""

    left: np.ndarray
    right: np.ndarray
    center: np.ndarray
    axes: np.ndarray  # (3, 3) columns: the directions of the shifts in world
    angles: Waves
    shifts: Waves

    def pose_at(self, seconds: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """See `Trajectory.pose_at`."""
        Rz, Ry, Rx = self._factors(seconds)
        rotation = self.left @ Rz @ Ry @ Rx @ self.right
        position = self.center + self.shifts.derivative(0, seconds) @ self.axes.T
        return rotation, position, self.shifts.derivative(1, seconds) @ self.axes.T

    def readings_at(self, seconds: np.ndarray) -> np.ndarray:
        """(N, 6) true angular rate [rad/s] and specific force [m/s^2] in the IMU frame."""
        _, Ry, Rx = self._factors(seconds)
        da = self.angles.derivative(1, seconds)[:, :, None]
        # The axis of each angle, transformed by the rotations to its right.
        rate = da[:, 2] * _AXIS_X + da[:, 1] * (_AXIS_Y @ Rx) + da[:, 0] * (_AXIS_Z @ (Ry @ Rx))
        rotation, _, _ = self.pose_at(seconds)
        acceleration = self.shifts.derivative(2, seconds) @ self.axes.T
        force = np.einsum("nji,nj->ni", rotation, acceleration - GRAVITY_WORLD)
        return np.concatenate([rate @ self.right, force], axis=1)

    def rate_at(self, seconds: np.ndarray) -> np.ndarray:
        """See `Trajectory.rate_at`."""
        return self.readings_at(seconds)[:, :3]

    def _factors(self, seconds: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        angles = self.angles.derivative(0, seconds)
        return _turn(2, angles[:, 0]), _turn(1, angles[:, 1]), _turn(0, angles[:, 2])


def _turn(axis: int, angle: np.ndarray) -> np.ndarray:
    """(N, 3, 3) rotations by angle (N,) rad about the coordinate axis number `axis`."""
    i, j = (axis + 1) % 3, (axis + 2) % 3
    R = np.zeros((len(angle), 3, 3))
    R[:, axis, axis] = 1.0
    R[:, i, i] = R[:, j, j] = np.cos(angle)
    R[:, j, i] = np.sin(angle)
    R[:, i, j] = -R[:, j, i]
    return R


def _waves(amplitude: np.ndarray, rng: np.random.Generator) -> Waves:
    frequency = rng.uniform(_FREQUENCY_HZ[:, :1], _FREQUENCY_HZ[:, 1:], (2, 3))
    return Waves(amplitude, frequency, rng.uniform(0.0, 2.0 * np.pi, (2, 3)))


def basis_with_z(axis: np.ndarray) -> np.ndarray:
    """(3, 3) rotation with the unit vector along `axis` (3,) as its third column."""
    z = axis / np.linalg.norm(axis)
    x = np.cross(np.eye(3)[np.argmin(np.abs(z))], z)
    x /= np.linalg.norm(x)
    return np.stack([x, np.cross(z, x), z], axis=1)


def reference_motion(scenario: Scenario, rng: np.random.Generator) -> Reference:
    """The scenario's handheld motion in closed form. Its middle is the pose at which the first camera looks at the
    board's centre, or at the origin of T_world_board if the target has several bodies."""
    motion = scenario.motion
    assert isinstance(motion, HandheldMotion)
    # A rig without cameras faces the board along its z axis.
    T_imu_cam = scenario.cameras[0].T_imu_sensor if scenario.cameras else np.eye(4)
    R_world_board, origin = scenario.T_world_board[:3, :3], scenario.T_world_board[:3, 3]
    corners = scenario.target.points if scenario.T_world_bodies is None else np.zeros((1, 3))
    middle = 0.5 * (corners.min(axis=0) + corners.max(axis=0)) + [0.0, 0.0, motion.distance_m]
    # The board's tags face its +z, so the camera looks along -z, with its y down where the board's is up.
    R_world_cam = R_world_board @ np.diag([1.0, -1.0, -1.0])
    R_world_imu = R_world_cam @ T_imu_cam[:3, :3].T
    center = origin + R_world_board @ middle - R_world_imu @ T_imu_cam[:3, 3]

    left, right, axes = R_world_cam, T_imu_cam[:3, :3].T, R_world_board
    angles, shifts = _ANGLES_RAD, _SHIFT_M
    if motion.kind == "planar":
        left, right, axes = np.eye(3), R_world_imu, np.eye(3)
        angles, shifts = _YAW_RAD, _SHIFT_M * [1.0, 1.0, 0.0]
    elif motion.kind == "single_axis":
        basis = basis_with_z(np.array(motion.axis_imu))
        left, right, angles = R_world_imu @ basis, basis.T, _YAW_RAD
    elif motion.kind == "motionless":
        angles, shifts = 0.0 * angles, 0.0 * shifts
    return Reference(
        left,
        right,
        center,
        axes,
        _waves(motion.rotation_scale * angles, rng),
        _waves(motion.translation_scale * shifts, rng),
    )


# A motion from a recorded trajectory: a smoothing spline through the poses of a TUM or EuRoC file.

_KNOT_S = 0.1  # interval of the knots: motion faster than a few Hz is smoothed away as noise
_ORDER = 6  # quintic: the fourth derivative of position is continuous
_STIFFNESS = 1e-6  # weight of the roughness, relative to 1 for each pose: determines control points in gaps of the file
_LARGEST_GAP_S = 0.5
# Coefficients of the uniform quintic B-spline: the value is (1, u, ... u^5) _BASIS (6 control points) / 120.
_BASIS = (
    np.array(
        [
            [1.0, 26.0, 66.0, 26.0, 1.0, 0.0],
            [-5.0, -50.0, 0.0, 50.0, 5.0, 0.0],
            [10.0, 20.0, -60.0, 20.0, 10.0, 0.0],
            [-10.0, 20.0, 0.0, -20.0, 10.0, 0.0],
            [5.0, -20.0, 30.0, -20.0, 5.0, 0.0],
            [-1.0, 5.0, -10.0, 10.0, -5.0, 1.0],
        ]
    )
    / 120.0
)


@dataclass(frozen=True, eq=False)
class RecordedMotion:
    """Quintic B-splines of p_world_imu and of a quaternion for R_world_imu. control (C, 7): x, y, z [m]; qx, qy, qz,
    qw.

    The spline of the quaternion does not have unit length; the rotation is that of the normalised quaternion.
    """

    control: np.ndarray

    def pose_at(self, seconds: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """See `Trajectory.pose_at`."""
        rows, position = self._jets(seconds, 1)
        return matrices(rows, 0), values(position, 0), values(position, 1)

    def readings_at(self, seconds: np.ndarray) -> np.ndarray:
        """(N, 6) true angular rate [rad/s] and specific force [m/s^2] in the IMU frame."""
        rows, position = self._jets(seconds, 2)
        return readings_of(matrices(rows, 0), matrices(rows, 1), values(position, 2))

    def rate_at(self, seconds: np.ndarray) -> np.ndarray:
        """See `Trajectory.rate_at`."""
        return self.readings_at(seconds)[:, :3]

    def _jets(self, seconds: np.ndarray, order: int) -> tuple[Rows, Vector]:
        first, power = _segment(seconds, len(self.control), order)
        points = self.control[first[:, None] + np.arange(_ORDER)]  # (N, 6, 7)
        series = np.einsum("knb,nbc->ckn", power, points)
        x, y, z, qx, qy, qz, qw = (Jet(c) for c in series)
        return _rotation(qx, qy, qz, qw), (x, y, z)


def _segment(seconds: np.ndarray, controls: int, order: int) -> tuple[np.ndarray, np.ndarray]:
    """Number (N,) of the first of the six control points at each instant, and Taylor coefficients (order + 1, N, 6) of
    the basis functions. controls: number of control points."""
    first = np.clip((seconds / _KNOT_S).astype(np.int64), 0, controls - _ORDER)
    u = seconds / _KNOT_S - first
    coefficients, power = _BASIS, []
    for k in range(order + 1):
        powers = u[:, None] ** np.arange(len(coefficients))
        power.append(powers @ coefficients)
        coefficients = np.arange(1, len(coefficients))[:, None] * coefficients[1:] / ((k + 1) * _KNOT_S)
    return first, np.array(power)


def _rotation(x: Jet, y: Jet, z: Jet, w: Jet) -> Rows:
    """Rotation matrix of a quaternion of any length."""
    xx, yy, zz, ww = x * x, y * y, z * z, w * w
    rows = (
        (ww + xx - yy - zz, 2.0 * (x * y - w * z), 2.0 * (x * z + w * y)),
        (2.0 * (x * y + w * z), ww - xx + yy - zz, 2.0 * (y * z - w * x)),
        (2.0 * (x * z - w * y), 2.0 * (y * z + w * x), ww - xx - yy + zz),
    )
    square = xx + yy + zz + ww
    a, b, c = ((p / square, q / square, r / square) for p, q, r in rows)
    return a, b, c


def recorded_motion(path: Path, duration_s: float, middle: np.ndarray) -> RecordedMotion:
    """The motion in the file `path` from its first pose on, shifted so that the middle of its extent is at middle (3,)
    m.

    Raises RecordingError naming the file if it cannot be read, is too short, or has a gap.
    """
    seconds, poses = _read(path)
    if seconds[-1] < duration_s:
        raise RecordingError(f"{path} is {seconds[-1]:.3g} s long; lower the duration of {duration_s:g} s.")
    if (gap := float(np.diff(seconds).max())) > _LARGEST_GAP_S:
        raise RecordingError(
            f"{path} has a gap of {gap:.3g} s; give a trajectory without gaps above {_LARGEST_GAP_S} s."
        )
    used = seconds <= duration_s + _KNOT_S
    seconds, poses = seconds[used], poses[used]
    poses[:, :3] += middle - 0.5 * (poses[:, :3].min(axis=0) + poses[:, :3].max(axis=0))
    # q and -q are the same rotation: each quaternion gets the sign that is closer to its predecessor.
    turned = np.sum(poses[1:, 3:] * poses[:-1, 3:], axis=1) < 0.0
    poses[1:, 3:] *= np.where(np.cumsum(turned) % 2, -1.0, 1.0)[:, None]
    return RecordedMotion(_fitted(seconds, poses))


def _fitted(seconds: np.ndarray, values: np.ndarray) -> np.ndarray:
    """Control points (C, 7) of the smoothing spline of values (N, 7) at seconds (N,): least squares of residuals and of
    the roughness."""
    controls = int(seconds[-1] / _KNOT_S) + _ORDER
    first, power = _segment(seconds, controls, 0)
    normal, right = np.zeros((controls, controls)), np.zeros((controls, values.shape[1]))
    columns = first[:, None] + np.arange(_ORDER)
    np.add.at(normal, (columns[:, :, None], columns[:, None, :]), power[0][:, :, None] * power[0][:, None, :])
    np.add.at(right, columns, power[0][:, :, None] * values[:, None, :])
    rough = np.diff(np.eye(controls), n=3, axis=0)
    return np.linalg.solve(normal + _STIFFNESS * rough.T @ rough, right)


def _read(path: Path) -> tuple[np.ndarray, np.ndarray]:
    """Seconds (N,) since the first pose, and poses (N, 7): x, y, z, qx, qy, qz, qw."""
    stamps, rows = [], []
    for number, line in enumerate(_lines(path), 1):
        euroc = "," in line
        if not line.strip() or line.startswith("#"):
            continue
        fields = [field.strip() for field in line.split(",")] if euroc else line.split()
        try:
            # Seconds since 1970 with nine decimals exceed float64, so that they are read as integer nanoseconds.
            stamps.append(int(fields[0]) if euroc else _nanoseconds(fields[0]))
            x, y, z, a, b, c, d = (float(field) for field in fields[1:8])
        except ValueError:
            form = "t [ns], x, y, z, qw, qx, qy, qz" if euroc else "t x y z qx qy qz qw"
            raise RecordingError(f"{path}:{number}: the line is not {form}; correct or remove it.") from None
        rows.append((x, y, z, b, c, d, a) if euroc else (x, y, z, a, b, c, d))
    poses = np.array(rows, dtype=np.float64).reshape(-1, 7)
    lengths = np.linalg.norm(poses[:, 3:], axis=1)
    if len(rows) < _ORDER or not np.isfinite(poses).all() or (np.abs(lengths - 1.0) > 1e-2).any():
        raise RecordingError(f"{path} does not hold at least {_ORDER} poses of unit quaternions; give another file.")
    seconds = (np.array(stamps, dtype=np.int64) - stamps[0]).astype(np.float64) * 1e-9
    if (np.diff(seconds) <= 0.0).any():
        late = int(np.argmax(np.diff(seconds) <= 0.0)) + 1
        raise RecordingError(f"{path}: pose {late} is not later than the one before; sort the file by time.")
    poses[:, 3:] /= lengths[:, None]
    return seconds, poses


def _nanoseconds(text: str) -> int:
    integer, _, fraction = text.partition(".")
    if "e" in text.lower():
        return round(float(text) * 1e9)
    sign = -1 if integer.startswith("-") else 1
    return int(integer) * 1_000_000_000 + sign * int((fraction + "0" * 9)[:9])


def _lines(path: Path) -> list[str]:
    try:
        return regular(path).read_text(encoding="utf-8-sig").splitlines()
    except (OSError, UnicodeDecodeError) as error:
        reason = getattr(error, "strerror", None) or error
        raise RecordingError(f"{path} cannot be read ({reason}); give the path of a trajectory.") from None


# Simulated IMU readings: sensor model, bias random walk, white noise.

_QUADRATURE_NODES = 6  # a motion below the Nyquist frequency is averaged to rounding
_CUTOFF_NODES = 32  # one below seven times the cutoff, to 2e-8
_LOWER = ((0, 1, 1, 2, 2, 2), (0, 0, 1, 0, 1, 2))  # row and column indices of xx, yx, yy, zx, zy, zz


@dataclass(frozen=True, eq=False)
class ImuReadings:
    """Measured gyro [rad/s] and accel [m/s^2], and the true biases that they contain, all (N, 3)."""

    gyro: np.ndarray
    accel: np.ndarray
    gyro_bias: np.ndarray
    accel_bias: np.ndarray


def inside(intervals: tuple[Interval, ...], seconds: np.ndarray) -> np.ndarray:
    """(N,) bool: whether each instant in seconds (N,) is in one of the intervals, ends included."""
    hit = np.zeros(len(seconds), dtype=bool)
    for start, end in intervals:
        hit |= (seconds >= start) & (seconds <= end)
    return hit


def imu_stamps(scenario: Scenario, rng: np.random.Generator) -> np.ndarray:
    """Stamps (N,) int64 [ns] of the readings since the IMU clock's origin; the first is 0."""
    count = round(scenario.duration_s * scenario.imu_rate_hz) + 1
    seconds = np.arange(count) / scenario.imu_rate_hz
    seconds[1:] += rng.uniform(-scenario.imu_jitter_s, scenario.imu_jitter_s, count - 1)
    return np.round(seconds * 1e9).astype(np.int64)


def ideal_readings(scenario: Scenario, trajectory: TrueTrajectory, seconds: np.ndarray) -> np.ndarray:
    """(N, 6) readings without errors at seconds (N,): angular rates [rad/s] and specific forces [m/s^2], sampled as
    `Scenario.imu_sampling` says; the accelerometer's late by its delay.

    Means are those over the time since the reading before; the first one's over a period. The low-pass filter is
    Gaussian and has no delay. Its amplitude is 1/sqrt(2) at the cutoff, by default half the rate.
    """
    if delay := scenario.imu_accel_delay_s:
        prompt = replace(scenario, imu_accel_delay_s=0.0)
        rates, forces = (ideal_readings(prompt, trajectory, t) for t in (seconds, seconds - delay))
        return np.concatenate([rates[:, :3], forces[:, 3:]], axis=1)
    period, cutoff_hz = 1.0 / scenario.imu_rate_hz, scenario.imu_cutoff_hz
    if scenario.imu_sampling == "instantaneous" and cutoff_hz is None:
        return trajectory.readings_at(seconds)
    if scenario.imu_sampling == "interval-mean" and cutoff_hz is None:
        steps = np.diff(seconds, prepend=seconds[0] - period)
        nodes, weights = np.polynomial.legendre.leggauss(_QUADRATURE_NODES)
        shifts = [0.5 * steps * (node - 1.0) for node in nodes]
    else:
        sigma_s = np.sqrt(np.log(2.0)) / (2.0 * np.pi * (cutoff_hz or 0.5 / period))
        nodes, weights = np.polynomial.hermite_e.hermegauss(_CUTOFF_NODES if cutoff_hz else _QUADRATURE_NODES)
        shifts = [np.full(len(seconds), sigma_s * node) for node in nodes]
    shares = weights / weights.sum()
    return np.sum([w * trajectory.readings_at(seconds + s) for w, s in zip(shares, shifts, strict=True)], axis=0)


def distort(intrinsics: np.ndarray, true: np.ndarray) -> np.ndarray:
    """(N, 6) readings without bias and noise of true angular rates [rad/s] and specific forces [m/s^2] (N, 6), by
    the scale-misalignment model. intrinsics (24,): see `Scenario`."""
    M_a, M_g = np.eye(3), np.eye(3)
    M_a[_LOWER] += intrinsics[:6]
    M_g[_LOWER] += intrinsics[6:12]
    C_a = rotation_from_vector(intrinsics[12:15])
    A_g = intrinsics[15:24].reshape(3, 3)
    rate, force = true[:, :3], true[:, 3:]
    return np.concatenate([rate @ M_g.T + force @ A_g.T, force @ (M_a @ C_a).T], axis=1)


def rotation_from_vector(vector: np.ndarray) -> np.ndarray:
    """Exp of a rotation vector (3,) [rad] by Rodrigues' formula."""
    angle = float(np.linalg.norm(vector))
    if angle == 0.0:
        return np.eye(3)
    K = skew(vector / angle)
    return np.eye(3) + np.sin(angle) * K + (1.0 - np.cos(angle)) * K @ K


@dataclass(frozen=True, eq=False)
class Errors:
    """Errors of an IMU: noise, and whether it is on; rate [Hz]; biases (6,) at the first reading [rad/s, m/s^2];
    intrinsics (24,), see `Scenario`."""

    noise: ImuNoise
    noisy: bool
    rate_hz: float
    bias: tuple[float, ...]
    intrinsics: np.ndarray


def read_imu(scenario: Scenario, seconds: np.ndarray, true: np.ndarray, rng: np.random.Generator) -> ImuReadings:
    """Readings of the first IMU, see `readings_with_errors`."""
    bias = (*scenario.gyro_bias, *scenario.accel_bias)
    noise, noisy = scenario.imu_noise, scenario.imu_noise_enabled
    errors = Errors(noise, noisy, scenario.imu_rate_hz, bias, scenario.imu_intrinsics)
    return readings_with_errors(errors, seconds, true, rng)


def readings_with_errors(
    errors: Errors, seconds: np.ndarray, true: np.ndarray, rng: np.random.Generator
) -> ImuReadings:
    """Readings with bias and noise of true angular rates [rad/s] and specific forces [m/s^2] (N, 6) at seconds (N,).

    A noise density d gives each reading the standard deviation d sqrt(rate). A walk density w adds w sqrt(dt) N(0, 1)
    to the bias from one reading to the next.
    """
    noise = errors.noise
    white, steps = rng.standard_normal((2, len(seconds), 6)) * float(errors.noisy)
    white *= np.sqrt(errors.rate_hz) * np.repeat([noise.gyro, noise.accel], 3)
    steps *= np.repeat([noise.gyro_walk, noise.accel_walk], 3)
    steps[0] = 0.0
    steps[1:] *= np.sqrt(np.diff(seconds))[:, None]
    bias = np.array(errors.bias) + np.cumsum(steps, axis=0)
    reading = distort(errors.intrinsics, true) + bias + white
    return ImuReadings(reading[:, :3], reading[:, 3:], bias[:, :3], bias[:, 3:])
