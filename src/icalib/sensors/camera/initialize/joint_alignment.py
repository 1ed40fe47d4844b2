"""Joint refinement of time offsets, extrinsic rotations and gyroscope bias from rotations of cameras and gyroscope.

Between two images, half a second or more apart, the gyroscope predicts the rotation of camera c as

    R_c2_c1 = R_i_c^T R_i2_i1 R_i_c.

The epipolar geometry of the shared points gives the error d of this prediction and its information matrix
(`rotation_information_of_pairs`). To first order

    d = (R_c2_c1 - 1) theta_i_c + R_i_c^T (R_i2_i1 w_1 - w_2) dt + R_i_c^T (int R_i2_i dt) b_g

with the right perturbation theta_i_c of R_i_c, the angular rates w_1, w_2 of the IMU at both images, the change dt of
the time offset and the change b_g of the gyroscope bias.

Angular rates of a camera from its feature tracks, over the interval that suits its motion best.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np

from icalib.data.measurements import TrackStream
from icalib.errors import EstimationError
from icalib.geometry import so3
from icalib.geometry.cameras.base import CameraModel
from icalib.initialize.rate_alignment import MIN_SECOND_AXIS_RATIO, RateAlignment, only_axis
from icalib.initialize.rate_correlation import GyroRotation, SensorRates
from icalib.initialize.rate_regression import MIN_REGRESSION_SCORE, best_regressions
from icalib.motion.imu_data import ImuData
from icalib.optim.arrowhead import complement
from icalib.sensors.camera.initialize.epipolar import (
    MIN_SHARED_POINTS,
    image_pairs,
    pairs_with_shared_points,
    refine_relative_pose,
    rotation_error,
    rotation_information_of_pairs,
    rotation_without_translation,
    shared_points,
)

ALIGNMENT_STEPS_S = (0.5, 1.0)  # s between two images; over shorter times rotations are small against ray errors
MAX_ALIGNMENT_PAIRS = 400  # image pairs for each camera and step; more change the result by less than its noise
ALIGNMENT_ITERATIONS = 6  # of Gauss-Newton; starts are within a few degrees and milliseconds
ALIGNMENT_RIDGE = 1e-12  # relative to the diagonal; keeps the normal matrix regular


@dataclass(frozen=True)
class SharedRays:
    """Unit rays f and h (n, 3) to the points that two images share, in the frame of the camera number `camera`.

    t1, t2: instants of the images [s] on the camera's clock since its first stamp."""

    camera: int
    t1: float
    t2: float
    f: np.ndarray
    h: np.ndarray


class GyroRotations(NamedTuple):
    """Rotations by the gyroscope over the m of n intervals t1 to t2 that its recording covers.

    covered: (m,) indices of these intervals. R: (m, 3, 3) R_i2_i1. J_offset: (m, 3) derivative by the time offset,
    R_i2_i1 w_1 - w_2 [rad/s]. J_bias: (m, 3, 3) derivative by the bias, the integral of R_i2_i over the interval [s].
    """

    covered: np.ndarray
    R: np.ndarray
    J_offset: np.ndarray
    J_bias: np.ndarray


def shared_rays(camera: int, stream: TrackStream, model: CameraModel, params: np.ndarray) -> list[SharedRays]:
    """The rays of image pairs that share enough points. camera: its number; params: (P,) intrinsics, distortion."""
    rays, valid = model.unproject(params, stream.uv)
    t = stream.seconds
    return [
        SharedRays(camera, float(t[i]), float(t[j]), rays[p], rays[q])
        for i, j, p, q in pairs_with_shared_points(stream, valid, ALIGNMENT_STEPS_S, MAX_ALIGNMENT_PAIRS)
    ]


def align_jointly(
    gyro: GyroRotation, pairs: list[SharedRays], start: list[RateAlignment], fixed: list[tuple[bool, bool]]
) -> list[RateAlignment]:
    """The alignments of all C cameras after Gauss-Newton, with one gyroscope bias.

    start: alignments to begin at; fixed: for each camera, whether its rotation and its time offset do not change. If
    the motion has one axis only, extrinsic rotations about this axis do not change. Returns `start` if the gyroscope
    covers no pair of images.
    """
    imu, n, bias = gyro.imu, 4 * len(start), np.mean([a.gyro_bias for a in start], axis=0)
    is_fixed = np.array([x for r, t in fixed for x in (r, r, r, t)] + [False] * 3)
    for _ in range(ALIGNMENT_ITERATIONS):
        gyro = GyroRotation.integrate(imu, bias)
        offset = np.array([start[p.camera].offset for p in pairs])
        t1, t2 = np.array([p.t1 for p in pairs]) + offset, np.array([p.t2 for p in pairs]) + offset
        rotations = gyro_rotations(gyro, t1, t2)
        if not len(rotations.covered):
            return start
        N, r = _normal_equations([pairs[i] for i in rotations.covered], start, rotations)
        x = _solve(N, r, is_fixed, _null_space(start, so3.log_many(rotations.R)))
        bias = bias + x[n:]
        start = [
            replace(a, offset=a.offset + x[4 * k + 3], rotation=a.rotation @ so3.exp(x[4 * k : 4 * k + 3].copy()))
            for k, a in enumerate(start)
        ]
    return [replace(a, gyro_bias=bias) for a in start]


def _null_space(start: list[RateAlignment], turns: np.ndarray) -> np.ndarray:
    """(4 C + 3, C) unobservable directions: rotation of each camera about the only axis of the motion.

    turns: (m, 3) [rad] rotation vectors of the motion. The result has no columns if these have more than one axis.
    """
    axis = only_axis(turns, MIN_SECOND_AXIS_RATIO)
    if axis is None:
        return np.zeros((4 * len(start) + 3, 0))
    out = np.zeros((4 * len(start) + 3, len(start)))
    for k, a in enumerate(start):
        out[4 * k : 4 * k + 3, k] = a.rotation.T @ axis
    return out


def _solve(N: np.ndarray, r: np.ndarray, fixed: np.ndarray, null_space: np.ndarray) -> np.ndarray:
    """The solution x (n,) of N x = r that is zero where `fixed` (n,) bool, and orthogonal to `null_space` (n, m)."""
    constrained = np.concatenate([np.eye(len(r))[:, fixed], null_space], axis=1)
    free = complement(np.linalg.qr(constrained)[0], len(r))
    M = free.T @ N @ free
    return free @ np.linalg.solve(M + ALIGNMENT_RIDGE * np.diag(M.diagonal()), free.T @ r)


def _normal_equations(
    pairs: list[SharedRays], start: list[RateAlignment], rotations: GyroRotations
) -> tuple[np.ndarray, np.ndarray]:
    """Normal matrix (4 C + 3, 4 C + 3) and right-hand side; rotations: those of the gyroscope for the m `pairs`.

    Unknowns: rotation (3) and time offset of each camera, then the gyroscope bias.
    """
    n, m, camera = 4 * len(start), len(pairs), np.array([p.camera for p in pairs], dtype=np.int64)
    R_ci = np.array([a.rotation.T for a in start])[camera]
    R = np.ascontiguousarray(R_ci @ rotations.R @ R_ci.transpose(0, 2, 1))
    H, g, J = np.empty((m, 3, 3)), np.empty((m, 3)), np.zeros((m, 3, n + 3))
    begin, empty = np.cumsum([0] + [len(p.f) for p in pairs]), [np.zeros((0, 3))]
    f, h = (np.concatenate([getattr(p, side) for p in pairs] or empty) for side in ("f", "h"))
    no_directions = np.zeros((len(f), 0, 3))  # intrinsics are fixed
    rotation_information_of_pairs(f, h, no_directions, no_directions, begin, R, H, g, np.empty(m))
    for c in range(len(start)):
        rows = camera == c
        J[rows, :, 4 * c : 4 * c + 3] = R[rows] - np.eye(3)
        J[rows, :, 4 * c + 3] = np.einsum("nij,nj->ni", R_ci[rows], rotations.J_offset[rows])
    J[:, :, n:] = R_ci @ rotations.J_bias
    flat = J.reshape(3 * m, n + 3)
    return flat.T @ (H @ J).reshape(3 * m, n + 3), flat.T @ g.ravel()


def gyro_rotations(gyro: GyroRotation, t1: np.ndarray, t2: np.ndarray) -> GyroRotations:
    """Rotations of the IMU over the intervals t1 to t2 (n,), s on its clock since its first stamp, and derivatives."""
    imu = gyro.imu
    h = np.diff(imu.seconds)[:, None]
    flat = gyro.rotation.reshape(-1, 9)
    integral = np.concatenate([np.zeros((1, 9)), np.cumsum(0.5 * h * (flat[1:] + flat[:-1]), axis=0)])

    def at(x: np.ndarray, t: np.ndarray) -> np.ndarray:
        return np.stack([np.interp(t, imu.seconds, x[:, k]) for k in range(x.shape[1])], axis=1)

    R1, R2 = gyro.at(t1), gyro.at(t2)
    w1, w2 = at(imu.gyro, t1), at(imu.gyro, t2)
    J_bias = R2.transpose(0, 2, 1) @ (at(integral, t2) - at(integral, t1)).reshape(-1, 3, 3)
    R = R2.transpose(0, 2, 1) @ R1
    inside = (t1 > imu.seconds[0]) & (t2 < imu.seconds[-1])
    bias = gyro_bias_of(gyro)
    J_offset = np.einsum("nij,nj->ni", R, w1 - bias) - (w2 - bias)
    return GyroRotations(np.flatnonzero(inside), R[inside], J_offset[inside], J_bias[inside])


def gyro_bias_of(gyro: GyroRotation) -> np.ndarray:
    """(3,) [rad/s] the bias that was subtracted before `gyro` was integrated."""
    return 0.5 * (gyro.imu.gyro[0] + gyro.imu.gyro[1]) - gyro.rate[0]


MIN_TRACK_RATES = 20  # rates: fewer do not show a time offset
MIN_TRACK_RATE_CORRELATION = 0.5  # with the IMU's rates; smaller than for poses, as rates from tracks are noisy
TRACK_RATE_STEP_S = 0.4  # s between two images: over less, rotation and lateral translation look alike
THINNED_STEP_SHARE = 0.3  # start of the next interval, as a share of `step`: those between add little information
NOISE_EVERY = 5  # the noise of every fifth rate is computed
RATE_STEPS_S = (TRACK_RATE_STEP_S, 0.2, 0.1, 0.05)  # s between the two images of a rate
MIN_STEP_PERIODS = 0.75  # shortest step, in periods of the images
# Ratio of scores above which rates from the second choice of starts replace those from the first
MIN_SCORE_RATIO = 1.3


def track_rates(
    stream: TrackStream,
    model: CameraModel,
    params: np.ndarray,
    step: float = TRACK_RATE_STEP_S,
    thinned: bool = False,
    chained: bool = False,
) -> SensorRates:
    """Mean angular rates between each image and the one about `step` s later, with their noise by the epipolar errors.

    thinned: skips images whose intervals overlap much. chained: also starts from the relative pose of the previous
    interval. Raises EstimationError if fewer than MIN_TRACK_RATES pairs share enough points.
    """
    rays, valid = model.unproject(params, stream.uv)
    t, rows, noise, previous = stream.seconds, [], [], None
    every = max(1, int(THINNED_STEP_SHARE * step / float(np.median(np.diff(t))))) if thinned else 1
    for i, j in image_pairs(stream, step)[::every]:
        p, q = shared_points(stream, valid, i, j)
        if len(p) < MIN_SHARED_POINTS:
            continue
        f, h = rays[p], rays[q]
        cost, R, direction = _best_relative_pose(f, h, previous)
        if np.isfinite(cost):
            previous = (R, direction) if chained else None
            rows.append((t[i], t[j], *(-so3.log(R) / (t[j] - t[i]))))
            if len(rows) % NOISE_EVERY == 0:
                noise.append(rotation_error(f, h, R, direction)[0] / (t[j] - t[i]))
    if len(rows) < MIN_TRACK_RATES:
        raise EstimationError(
            f"{stream.name}: only {len(rows)} pairs of images {step:.2g} s apart share {MIN_SHARED_POINTS} "
            "tracked points or more; record for longer, or with longer feature tracks."
        )
    columns = np.array(rows)
    start, end, rate = columns[:, 0].copy(), columns[:, 1].copy(), columns[:, 2:].copy()
    return SensorRates(start, end, rate, MIN_TRACK_RATE_CORRELATION, noise=float(np.median(noise)))


def _best_relative_pose(
    f: np.ndarray, h: np.ndarray, previous: tuple[np.ndarray, np.ndarray] | None
) -> tuple[float, np.ndarray, np.ndarray]:
    """Cost, rotation and direction of the better of two refinements: from a pure rotation, and from the relative pose
    `previous` if there is one."""
    refined = []
    for start in (rotation_without_translation(f, h), previous):
        if start is not None:
            R, t = start[0].copy(), start[1].copy()
            refined.append((refine_relative_pose(f, h, R, t), R, t))
    return min(refined, key=lambda x: x[0])


def matching_track_rates(imu: ImuData, stream: TrackStream, model: CameraModel, lens: np.ndarray) -> SensorRates:
    """Rates over the longest of RATE_STEPS_S whose match with the gyroscope is significant, with the matching offsets.
    Over short steps rotation and translation look alike; over long steps vibration averages out. If none is
    significant, the best rates, without offsets.

    Raises EstimationError as `track_rates` does for the first step.
    """
    period = float(np.median(np.diff(stream.seconds)))
    steps = [s for s in RATE_STEPS_S if s > MIN_STEP_PERIODS * period] or [period]
    failed: EstimationError | None = None
    candidates: list[tuple[float, SensorRates]] = []
    for step in steps:
        try:
            candidates += _rates_and_score(imu, stream, model, lens, step)
        except EstimationError as error:
            failed = failed or error
            continue
        if candidates[-1][1].offsets:
            break
    if not candidates:
        assert failed is not None
        raise failed
    return max(candidates, key=lambda x: x[0])[1]


def _rates_and_score(
    imu: ImuData, stream: TrackStream, model: CameraModel, lens: np.ndarray, step: float
) -> list[tuple[float, SensorRates]]:
    """Tries two choices of starts for each relative pose: no translation, or this and the pose of the previous
    interval. Returns score and rates of the second choice if these match the gyroscope clearly better, else of the
    first.

    If a camera moves far to the side, a start without translation often ends in a local minimum, unlike the previous
    pose. With a guessed lens, the previous pose may be the worse start.
    """
    candidates = []
    for chained in (False, True):
        rates = track_rates(stream, model, lens, step, chained=chained)
        shifts = best_regressions(imu, rates)
        likely = tuple(s.offset for s in shifts if s.score > MIN_REGRESSION_SCORE)
        candidates.append((max((s.score for s in shifts), default=-np.inf), replace(rates, offsets=likely)))
    (plain, _), (score, _) = candidates
    return candidates[1:] if score > MIN_SCORE_RATIO * plain else candidates[:1]
