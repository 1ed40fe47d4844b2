"""Gravity, lever arm and accelerometer bias, linear in a camera's positions and the accelerometer's readings.

With the operator A[x] = (x_2 - x_1) / h_2 - (x_1 - x_0) / h_1 over three images at intervals h_1, h_2,

    A[p_board_cam] = A[R_board_imu] p_imu_cam + A[D_f] - A[D_R] b_a + g (h_1 + h_2) / 2

D_f and D_R are the double integrals over time of R_board_imu f and of R_board_imu, with specific force f,
accelerometer bias b_a, and gravity g in board axes. A is a difference of mean velocities, so velocities cancel."""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from icalib.errors import EstimationError
from icalib.geometry.small import once_integrated, twice_integrated
from icalib.initialize.rate_correlation import (
    MAX_USUAL_STEPS,
    GyroRotation,
)
from icalib.motion.imu_data import ImuData, clear_of

TRIPLE_STEP_S = 0.12  # s between images of a triple: long against pose noise, short against the loss of the target
READINGS_PER_BLOCK = 8192  # IMU readings whose rotations are computed at once: bounds the memory
ACCEL_BIAS_PRIOR_M_S2 = 0.3  # m/s^2: prior standard deviation
# Factor on the standard deviation of a row: rows share images, so their errors are correlated
SHARED_IMAGE_FACTOR = 2.0
MIN_ROW_SIGMA_M_S = 0.05  # m/s: floor of the standard deviation of a row
TARGET_GRAVITY_TOLERANCE = 0.1  # relative error of gravity: more means wrong units or a wrong target size
# The same for gravity and size, if the camera's rotation is a guess that may be degrees off
GUESSED_ROTATION_TOLERANCE = 0.5
MAX_UNEXPLAINED_ACCELERATION = 1.2  # median residual over median acceleration
TARGET_SIZE_TOLERANCE = 0.15  # relative error of the target's size


class Triples(NamedTuple):
    """Indices (n,) of the instants i < j < k of each triple, and the intervals h1, h2 (n,) s between them."""

    i: np.ndarray
    j: np.ndarray
    k: np.ndarray
    h1: np.ndarray
    h2: np.ndarray

    @classmethod
    def at(cls, t: np.ndarray, i: np.ndarray, j: np.ndarray, k: np.ndarray) -> Triples:
        """Triples of the instants i, j, k (n,) among increasing times t (N,) s."""
        return cls(i, j, k, t[j] - t[i], t[k] - t[j])

    def some(self, chosen: np.ndarray) -> Triples:
        """The triples selected by `chosen`, a mask or indices (n,)."""
        return Triples(*(x[chosen] for x in self))

    def second(self, x: np.ndarray) -> np.ndarray:
        """A[x] (n, ...) of x (N, ...) at the instants: difference of its mean slopes, see the module's equation."""
        flat, h1, h2 = x.reshape(len(x), -1), self.h1[:, None], self.h2[:, None]
        differences = (flat[self.k] - flat[self.j]) / h2 - (flat[self.j] - flat[self.i]) / h1
        return differences.reshape(-1, *x.shape[1:])

    @property
    def half(self) -> np.ndarray:
        """(n,) (h_1 + h_2) / 2 [s], which is A[t^2 / 2]."""
        return 0.5 * (self.h1 + self.h2)


@dataclass(frozen=True)
class LeverArm:
    """position: p_imu_cam (3,) m, with covariance (3, 3); gravity (3,) m/s^2 in board axes; accel_bias (3,) m/s^2;
    size: true size of the target over the stated one, with standard deviation size_std; unexplained: median residual
    over the median acceleration that the camera shows."""

    position: np.ndarray
    covariance: np.ndarray
    gravity: np.ndarray
    accel_bias: np.ndarray
    size: float
    size_std: float
    unexplained: float

    @property
    def contradicts_camera(self) -> bool:
        """Whether the accelerometer measured another motion than the camera. Noise alone leaves an unexplained share of
        1."""
        return self.unexplained > MAX_UNEXPLAINED_ACCELERATION


def solve_camera_lever_arm(
    imu: ImuData,
    times: np.ndarray,
    R_board_imu: np.ndarray,
    p_board_cam: np.ndarray,
    gyro: GyroRotation,
    known: np.ndarray | None,
) -> LeverArm:
    """Solves for one camera, from rotations R_board_imu (M, 3, 3) and positions p_board_cam (M, 3) m at `times` (M,) s
    on the IMU's clock. known: p_imu_cam (3,) m if it is known. Raises EstimationError if too few images can be used."""
    used = (times >= imu.seconds[1]) & (times <= imu.seconds[-2])
    t, p = times[used], p_board_cam[used]
    # Errors of rotation and position of one image are correlated. Without smoothing, these errors bias the lever arm
    # towards the target.
    R_bi = gyro.smoothed(t, R_board_imu[used])
    D_f, D_R = _double_integrals(imu, t, R_bi, gyro)
    triples = _image_triples(t, imu.gaps)
    n, second = len(triples.i), triples.second
    if n < 10:
        raise EstimationError("too few images are close enough in time to estimate gravity; record for longer.")
    rows = np.zeros((n, 3, 9))
    rows[:, :, 0:3] = second(R_bi)
    rows[:, :, 3:6] = triples.half[:, None, None] * np.eye(3)
    rows[:, :, 6:9] = -second(D_R)
    rhs = second(p) - second(D_f)
    if known is not None:
        rhs = rhs - rows[:, :, 0:3] @ known
        rows[:, :, 0:3] = 0.0
    x, covariance = _solve(rows, rhs)
    arm, unexplained = x[0:3] if known is None else known, _median_ratio(rhs - rows @ x, second(p))
    return LeverArm(arm, covariance, x[3:6], x[6:9], *scale_by_accelerometer(rows, rhs, second(D_f)), unexplained)


def _median_ratio(a: np.ndarray, b: np.ndarray) -> float:
    """Median length of vectors `a` (n, 3) over that of `b` (m, 3)."""
    size = [float(np.median(np.linalg.norm(x, axis=1))) for x in (a, b)]
    return size[0] / max(size[1], 1e-12)


def _solve(rows: np.ndarray, rhs: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Least squares for x (9,): lever arm, gravity, bias, with a weak prior on lever arm and bias. Repeated without
    outliers. Returns x and the covariance (3, 3) of the lever arm."""
    prior = np.diag(1.0 / np.array([1.0] * 3 + [1e3] * 3 + [ACCEL_BIAS_PRIOR_M_S2] * 3))
    weight, sigma, x, A = np.ones(len(rows)), MIN_ROW_SIGMA_M_S, np.zeros(9), np.zeros((0, 9))
    for _ in range(4):
        A = np.concatenate([(rows * weight[:, None, None]).reshape(-1, 9), sigma * prior])
        b = np.concatenate([(rhs * weight[:, None]).ravel(), np.zeros(9)])
        x = np.linalg.lstsq(A, b, rcond=None)[0]
        size = np.linalg.norm(rhs - rows @ x, axis=1)
        weight = (size < 4.0 * np.median(size) + 1e-9).astype(float)
        sigma = max(MIN_ROW_SIGMA_M_S, SHARED_IMAGE_FACTOR * float(np.median(size)))
    return x, sigma**2 * np.linalg.inv(A.T @ A)[:3, :3]


def scale_by_accelerometer(rows: np.ndarray, rhs: np.ndarray, force_rows: np.ndarray) -> tuple[float, float]:
    """True size of the target, or of a trajectory, over the stated one, and its standard deviation.

    It is the inverse of an estimated factor on the accelerometer's part of the equations. A factor on the noisy
    positions would be biased towards zero. rows (n, 3, m), rhs (n, 3): of the linear system; force_rows (n, 3): the
    accelerometer's part of rhs.
    """
    A = np.concatenate([rows, force_rows[:, :, None]], axis=2).reshape(force_rows.size, -1)
    b = rhs.ravel()
    information = A.T @ A + 1e-9 * np.eye(A.shape[1])
    x = np.linalg.solve(information, A.T @ b)
    variance = np.mean((b - A @ x) ** 2)
    factor = max(1.0 + float(x[-1]), 1e-3)
    return 1.0 / factor, float(np.sqrt(variance * np.linalg.inv(information)[-1, -1])) / factor**2


def _image_triples(t: np.ndarray, gaps: tuple[tuple[float, float], ...]) -> Triples:
    """Triples of images about TRIPLE_STEP_S apart, within a factor of two, or of neighbours if most are further apart.
    None spans a gap of the IMU."""
    i = np.arange(len(t))
    j = np.searchsorted(t, t + TRIPLE_STEP_S - 1e-3)
    k = np.searchsorted(t, t + 2 * TRIPLE_STEP_S - 1e-3)
    longest, usual = 2 * TRIPLE_STEP_S, float(np.median(np.diff(t))) if len(t) > 1 else 0.0
    if usual > TRIPLE_STEP_S:
        k, longest = np.maximum(k, j + 1), max(longest, MAX_USUAL_STEPS * usual)
    good = (k < len(t)) & (j < k) & (i < j)
    i, j, k = i[good], j[good], k[good]
    close = (t[j] - t[i] < longest) & (t[k] - t[j] < longest)
    close &= clear_of(gaps, t[i], t[k])
    return Triples.at(t, i[close], j[close], k[close])


def _double_integrals(
    imu: ImuData, t: np.ndarray, R_bi: np.ndarray, gyro: GyroRotation
) -> tuple[np.ndarray, np.ndarray]:
    """Double integrals of R_board_imu f (n, 3) and of R_board_imu (n, 3, 3) at image times t (n,) s, from the first
    stamp of the IMU."""
    s, x = imu.seconds, np.empty((12, len(imu.seconds)))
    for a in range(0, len(s), READINGS_PER_BLOCK):
        block = slice(a, min(a + READINGS_PER_BLOCK, len(s)))
        R = gyro.carry(t, R_bi, s[block])
        x[:3, block] = (R @ imu.accel[block, :, None])[:, :, 0].T
        x[3:, block] = R.reshape(-1, 9).T
    j = imu.interval(t)
    out = np.stack([_double_integral(s, row, t, j) for row in x], axis=1)
    return out[:, :3], out[:, 3:].reshape(-1, 3, 3)


def _double_integral(s: np.ndarray, x: np.ndarray, t: np.ndarray, j: np.ndarray) -> np.ndarray:
    """(n,) at times t, in intervals j, of x (N,), linear between times s (N,)."""
    dt = np.diff(s)
    once = once_integrated(x, dt)
    twice = twice_integrated(x, once, dt)
    tau = t - s[j]
    return twice[j] + once[j] * tau + 0.5 * x[j] * tau**2


def check_target_size(arm: LeverArm, camera: str, guessed: bool) -> None:
    """Raises EstimationError if the accelerometer contradicts the stated size of the target. guessed: whether the
    camera's rotation is a guess, whose error also changes the size."""
    if abs(arm.size - 1.0) > max(GUESSED_ROTATION_TOLERANCE if guessed else TARGET_SIZE_TOLERANCE, 5.0 * arm.size_std):
        raise EstimationError(
            f"{camera}: the accelerometer shows the target to be {arm.size:.2f} +- {arm.size_std:.2f} times as "
            "large as in the rig file; check tag_size or square_size (in metres) and tag_spacing (gap over "
            "tag_size)."
        )


def check_gravity(measured: float, expected: float, imu: str, guessed: bool) -> None:
    """Raises EstimationError if the `measured` gravity is not `expected` [m/s^2]. guessed: see `check_target_size`."""
    if abs(measured / expected - 1.0) <= (GUESSED_ROTATION_TOLERANCE if guessed else TARGET_GRAVITY_TOLERANCE):
        return
    raise EstimationError(
        f"{imu} and the target together give a gravity of {measured:.3g} m/s^2 instead of {expected:.3g}; "
        "check that the accelerometer is in m/s^2 (not in g: accel_unit), and tag_size or square_size in the "
        "rig file."
    )
