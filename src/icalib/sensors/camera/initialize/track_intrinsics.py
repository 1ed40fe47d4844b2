"""Intrinsics and distortion of a camera from its feature tracks and a gyroscope, without an initial guess.

If the assumed focal length is s times too long, rates from tracks are s times too small about the axes of the image
plane, and right about the optical axis:

    w_imu = R_imu_cam diag(s, s, 1) w_cam + b.

with the gyroscope bias b.

1. The time offset is the one at which a linear regression of the gyroscope's rates on the camera's fits best, with an
   arbitrary matrix (`rate_regression`). Then s gives the focal length.
2. Gauss-Newton refines rotation, time offset, gyroscope bias, focal length, principal point and distortion together,
   from the epipolar geometry of pairs of images, given the gyroscope's rotation in between (`joint_alignment`). The
   camera model is `FREE_MODEL`, unless the rig file has a distortion.
3. The camera model of the rig file is fitted to the result.
"""

from __future__ import annotations

from contextlib import suppress
from dataclasses import dataclass, replace

import numpy as np

from icalib.data.measurements import TrackStream
from icalib.errors import EstimationError
from icalib.geometry import so3
from icalib.geometry.cameras import camera_model
from icalib.geometry.cameras.base import CameraModel
from icalib.geometry.cameras.convert import fit_rays
from icalib.initialize.rate_alignment import RateAlignment, covered, kabsch, no_overlap
from icalib.initialize.rate_correlation import GyroRotation, SensorRates
from icalib.initialize.rate_regression import MeanRates, best_regressions
from icalib.motion.imu_data import ImuData
from icalib.rig import Camera
from icalib.sensors.camera.initialize.epipolar import ImagePairs, ray_derivatives, rotation_information_of_pairs
from icalib.sensors.camera.initialize.joint_alignment import gyro_rotations, matching_track_rates, track_rates

FREE_MODEL = "pinhole-equidistant"  # r = f theta plus a polynomial; zero distortion is close to narrow and wide lenses
START_FOCAL_WIDTHS = (1.0, 0.35)  # start focal lengths in image widths: of a usual lens, and of a fisheye lens
FOCAL_SCALES = np.geomspace(0.1, 10.0, 100)  # trial scales of the rates by a wrong start focal length, 5 % apart
MAX_SCALE_ROUNDS, SCALE_TOLERANCE = 4, 0.05  # rounds; |log(scale)|. Rates depend on the focal length, hence rounds
RATE_CAUCHY_MEDIANS = 3.0  # scale of Cauchy's weights, in medians of the rate error
N_FREE_DISTORTION = 2  # coefficients of `FREE_MODEL` that are estimated; higher ones matter at the image border only
# Standard deviations of the priors, in steps of `ImagePairs.lens_directions` (0.03 rad RMS over the rays): the focal
# length is nearly free, pixels are square to 1 %, the principal point is near the middle; then each coefficient.
LENS_PRIOR_SIGMAS, DISTORTION_PRIOR_SIGMA = np.array([10.0, 0.1, 1.0, 1.0]), 3.0
CORRELATED_TRACK_RAYS = 300.0  # rays that count as one: a point is in many pairs, and wrong intrinsics affect many
MAX_REFINEMENT_STEPS = 15
MAX_ROTATION_STEP, MAX_OFFSET_STEP_S, MAX_LENS_STEP = 0.3, 0.05, 3.0  # rad, s, steps of `lens_directions`
REFINEMENT_TOLERANCE = 0.1  # standard deviations of the unknowns; a smaller step means convergence
MAX_LOG_FOCAL_SIGMA = 0.1  # of log(focal length); the estimator may not converge from a start further off
MAX_UNEXPLAINED_TRACK_RATE = 0.35  # share of the angular rate; with more, the motions of camera and IMU do not match
MIN_RAYS_PER_PARAMETER = 4  # of a model that is fitted to rays
MAX_FITTED_RAYS = 400  # rays to which a model is fitted, spread over the tracks
EQUAL_FIT_PX = 0.5  # px RMS by which a fit may be worse than the best, and still be compared with it by the tracks
INVISIBLE_RAY_COST = 5.0  # of a pixel that the model cannot unproject; else models of narrow lenses would fit best


@dataclass(frozen=True)
class _Fit:
    """Intrinsics and alignment of a camera.

    lens: (P,) intrinsics and distortion; aligned: rotation, time offset and gyroscope bias; sigma: standard deviation
    of the logarithm of the focal length; cost: negative log-likelihood. The last two are infinite before refinement.
    """

    lens: np.ndarray
    aligned: RateAlignment
    sigma: float = np.inf
    cost: float = np.inf


def find_intrinsics(camera: Camera, stream: TrackStream, imu: ImuData, offset: float | None) -> np.ndarray:
    """(P,) intrinsics and distortion of `camera`; a distortion in the rig file is kept.

    offset: t_imu - t_camera [s], each clock counted from its first stamp, if it is known.
    Raises EstimationError if the tracks and the motion do not determine the intrinsics.
    """
    stated = camera.distortion.value
    model = camera_model(FREE_MODEL if stated is None else camera.model)
    distortion = model.start_distortions[0] if stated is None else stated
    rough = _rough(stream, imu, model, _starts(camera, distortion, model), offset)
    fit = _refined(stream, imu, model, rough, offset is not None, N_FREE_DISTORTION if stated is None else 0)
    if not fit.sigma < MAX_LOG_FOCAL_SIGMA:
        raise EstimationError(
            f"{camera.name}: the rotation in the recording does not determine the focal length; turn the rig "
            "about axes perpendicular to the optical axis, or give intrinsics: {guess: [fx, fy, cx, cy]} in the rig "
            "file."
        )
    return fit.lens if stated is not None else _in_model(camera, stream, imu, model, fit, offset is not None)


def _starts(camera: Camera, distortion: np.ndarray | tuple[float, ...], model: CameraModel) -> list[np.ndarray]:
    """Start values (P,) with each of `START_FOCAL_WIDTHS`, and the principal point in the image centre."""
    width, height = camera.resolution
    lens = np.array([1.0, 1.0, 0.5 * (width - 1), 0.5 * (height - 1), *distortion])
    focal = [share * width / model.central_scale(lens) for share in START_FOCAL_WIDTHS]
    return [np.array([f, f, *lens[2:]]) for f in focal]


def _rough(
    stream: TrackStream, imu: ImuData, model: CameraModel, starts: list[np.ndarray], offset: float | None
) -> _Fit:
    """Focal length, rotation, time offset and gyroscope bias by regression of angular rates.

    starts: (P,) start values; offset: known time offset [s], or None. Raises EstimationError if none fit."""
    rates, best = [matching_track_rates(imu, stream, model, starts[0])], 0
    step = float(np.median(rates[0].end - rates[0].start))
    rates += [track_rates(stream, model, lens, step, thinned=True) for lens in starts[1:]]
    if offset is None:
        shifts = [(x, k) for k, r in enumerate(rates) for x in best_regressions(imu, r)[:1]]
        if not shifts:
            raise no_overlap(imu, stream.name)
        shift, best = max(shifts, key=lambda candidate: candidate[0].score)
        offset = shift.offset
    lens, camera_rates = starts[best], rates[best]
    aligned, scale, unexplained = _scaled(imu, camera_rates, offset, stream.name)
    for _ in range(MAX_SCALE_ROUNDS):
        lens = np.concatenate([lens[:2] / scale, lens[2:]])
        if abs(np.log(scale)) < SCALE_TOLERANCE:
            break
        camera_rates = track_rates(stream, model, lens, step, thinned=True)
        aligned, scale, unexplained = _scaled(imu, camera_rates, offset, stream.name)
    if unexplained > MAX_UNEXPLAINED_TRACK_RATE:
        raise EstimationError(
            f"the motion of {stream.name} does not match that of {imu.name} at any time offset and focal "
            f"length ({unexplained:.0%} of the angular rate is unexplained). Check that both come from the "
            "same recording and overlap in time, or give intrinsics in the rig file."
        )
    return _Fit(lens, aligned)


def _scaled(imu: ImuData, rates: SensorRates, offset: float, name: str) -> tuple[RateAlignment, float, float]:
    """Alignment of the rates, scale s of the camera's rates about image-plane axes, and the unexplained share.

    offset: [s], clocks counted from their first stamps. The share is the median rate error over the median deviation of
    the gyroscope's rates from their median. Raises EstimationError if the recordings do not overlap.
    """
    inside = covered(imu, rates, offset)
    if not inside.any():
        raise no_overlap(imu, name)
    gyro = MeanRates.of(imu).over(rates.start[inside] + offset, rates.end[inside] + offset)
    candidates = [
        (*_robust_rotation(gyro, rates.rate[inside] * [scale, scale, 1.0]), float(scale)) for scale in FOCAL_SCALES
    ]
    error, R, bias, scale = min(candidates, key=lambda x: x[0])
    spread = float(np.median(np.linalg.norm(gyro - np.median(gyro, axis=0), axis=1)))
    return RateAlignment(offset, R, bias), scale, error / max(spread, 1e-9)


def _robust_rotation(gyro: np.ndarray, rates: np.ndarray) -> tuple[float, np.ndarray, np.ndarray]:
    """Median error [rad/s], R (3, 3) and b (3,) [rad/s] of gyro = R rates + b, by iteratively reweighted least squares.

    gyro, rates: (n, 3) [rad/s]."""
    R, bias = kabsch(gyro, rates, np.ones(len(gyro)))
    for _ in range(2):
        error = np.linalg.norm(gyro - rates @ R.T - bias, axis=1)
        weight = 1.0 / (1.0 + (error / (RATE_CAUCHY_MEDIANS * np.median(error) + 1e-12)) ** 2)
        R, bias = kabsch(gyro, rates, weight)
    return float(np.median(np.linalg.norm(gyro - rates @ R.T - bias, axis=1))), R, bias


def _refined(
    stream: TrackStream, imu: ImuData, model: CameraModel, rough: _Fit, keep_offset: bool, n_distortion: int
) -> _Fit:
    """Refines `rough` by Gauss-Newton over all unknowns, with the first `n_distortion` coefficients of the distortion.

    keep_offset: whether the time offset is known."""
    aligned, n = rough.aligned, 4 + n_distortion
    pairs = ImagePairs.of(stream, model, rough.lens, _free_directions(rough.lens, n_distortion))
    lens_step, sigma, cost = np.zeros(n), np.ones(7 + n), np.inf
    prior = np.concatenate([np.zeros(7), LENS_PRIOR_SIGMAS, np.full(n_distortion, DISTORTION_PRIOR_SIGMA)])
    prior[7:] **= -2.0
    prior[3] = 1e12 if keep_offset else 0.0
    for _ in range(MAX_REFINEMENT_STEPS):
        N, r, cost = _normal_equations(pairs, imu, lens_step, aligned)
        N += np.diag(prior + 1e-9 * N.diagonal())
        x = np.linalg.solve(N, r - prior * np.append(np.zeros(7), lens_step))
        sigma = np.sqrt(np.diag(np.linalg.inv(N)))
        x /= max(1.0, _step_length(x))
        R, bias = aligned.rotation @ so3.exp(x[:3].copy()), aligned.gyro_bias + x[4:7]
        aligned = replace(aligned, offset=aligned.offset + x[3], rotation=R, gyro_bias=bias)
        lens_step = lens_step + x[7:]
        if np.abs(x / sigma).max() < REFINEMENT_TOLERANCE:
            break
    log_focal = float(pairs.lens_directions[0, 0] / rough.lens[0])  # change of log(focal length) per first step
    return _Fit(rough.lens + lens_step @ pairs.lens_directions, aligned, log_focal * float(sigma[7]), cost)


def _step_length(x: np.ndarray) -> float:
    """The largest ratio of rotation, time offset or intrinsics in the step x (7 + L,) to its limit."""
    rotation, offset, lens = np.linalg.norm(x[:3]), abs(x[3]), np.abs(x[7:]).max()
    return max(rotation / MAX_ROTATION_STEP, offset / MAX_OFFSET_STEP_S, lens / MAX_LENS_STEP)


def _free_directions(lens: np.ndarray, n_distortion: int) -> np.ndarray:
    """(4 + n_distortion, P) directions in which `lens` (P,) is adjusted.

    They are the common scale of fx and fy, fy alone, the principal point (2), and the first distortion coefficients.
    """
    out = np.zeros((4 + n_distortion, len(lens)))
    out[0, :2], out[1, 1], out[2, 2], out[3, 3] = lens[:2], lens[1], lens[0], lens[1]
    out[range(4, 4 + n_distortion), range(4, 4 + n_distortion)] = 1.0
    return out


def _normal_equations(
    pairs: ImagePairs, imu: ImuData, lens_step: np.ndarray, aligned: RateAlignment
) -> tuple[np.ndarray, np.ndarray, float]:
    """Normal matrix (7 + L, 7 + L), right-hand side (7 + L,), and the negative log-likelihood.

    Unknowns: rotation (3), time offset, gyroscope bias (3), steps of the intrinsics (L). The noise of each image pair
    is unknown. So the log-likelihood sums -n / 2 log(mean squared error) over pairs with n rays each.
    """
    rotations = gyro_rotations(GyroRotation.integrate(imu, aligned.gyro_bias), *(pairs.times + aligned.offset).T)
    pairs = pairs.select(np.isin(np.arange(len(pairs.times)), rotations.covered))
    lens = pairs.lens + lens_step @ pairs.lens_directions
    rays, valid = pairs.model.unproject(lens, pairs.uv)
    rays = np.where(valid[:, None], rays, 0.0)
    J_rays = ray_derivatives(pairs.model, lens, pairs.lens_directions, rays)
    J_rays = np.where(valid[:, None], J_rays, 0.0).transpose(1, 0, 2)
    p, q = pairs.shared.T
    m, n, R_ci = len(rotations.covered), len(lens_step), aligned.rotation.T
    R = np.ascontiguousarray(R_ci @ rotations.R @ aligned.rotation)
    H, g, squares = np.empty((m, 3 + n, 3 + n)), np.empty((m, 3 + n)), np.empty(m)
    rotation_information_of_pairs(rays[p], rays[q], J_rays[p], J_rays[q], pairs.begin, R, H, g, squares)
    J = np.zeros((m, 3 + n, 7 + n))
    J[:, :3, :3], J[:, :3, 3] = R - np.eye(3), rotations.J_offset @ aligned.rotation
    J[:, :3, 4:7], J[:, 3:, 7:] = R_ci @ rotations.J_bias, np.eye(n)
    count = np.diff(pairs.begin)
    weight = 1.0 / (CORRELATED_TRACK_RAYS * np.median(squares / count) + 1e-18)
    flat = J.reshape(-1, 7 + n)
    cost = 0.5 * (count * np.log(squares / count + 1e-18)).sum() + INVISIBLE_RAY_COST * (~valid[p] | ~valid[q]).sum()
    return weight * flat.T @ (H @ J).reshape(-1, 7 + n), weight * flat.T @ g.ravel(), float(cost)


def _in_model(
    camera: Camera, stream: TrackStream, imu: ImuData, model: CameraModel, fit: _Fit, keep_offset: bool
) -> np.ndarray:
    """(P,) intrinsics and distortion of the rig file's camera model, fitted to the rays of `fit` at observed pixels.

    model: the camera model of `fit`. Models with two shape parameters may have several fits with about the same error.
    The one that explains the tracks best after a refinement is returned. Raises EstimationError if no fit is found.
    """
    wanted = camera_model(camera.model)
    uv = stream.uv[:: max(1, len(stream.uv) // MAX_FITTED_RAYS)]
    rays, valid = model.unproject(fit.lens, uv)
    rays, uv, fitted = rays[valid], uv[valid], []
    for distortion in wanted.start_distortions:
        start = np.array([*fit.lens[:4], *distortion])
        start[:2] *= model.central_scale(fit.lens) / wanted.central_scale(start)
        visible = wanted.project(start, rays)[1]
        if visible.sum() > MIN_RAYS_PER_PARAMETER * len(start):
            with suppress(np.linalg.LinAlgError):
                params = fit_rays(wanted, start, rays[visible], uv[visible], 1e-3)
                if not any(np.allclose(params, other, rtol=2e-2, atol=1e-2) for other in fitted):
                    fitted.append(params)
    if not fitted:
        raise EstimationError(
            f"{camera.name}: its lens is too wide for {camera.model}; choose a fisheye model, or give intrinsics in "
            "the rig file."
        )
    errors = [_fit_error(wanted, params, rays, uv) for params in fitted]
    good = [params for params, error in zip(fitted, errors, strict=True) if error < EQUAL_FIT_PX + min(errors)]
    if len(good) == 1:
        return good[0]
    n_distortion = len(good[0]) - 4
    fits = [_refined(stream, imu, wanted, replace(fit, lens=params), keep_offset, n_distortion) for params in good]
    return min(fits, key=lambda one: one.cost).lens


def _fit_error(model: CameraModel, params: np.ndarray, rays: np.ndarray, uv: np.ndarray) -> float:
    """RMS distance [px] of projected rays from uv (n, 2); a ray that cannot be projected counts as one image size."""
    projected, valid = model.project(params, rays)
    return float(np.sqrt(np.mean(np.where(valid, ((projected - uv) ** 2).sum(axis=1), np.ptp(uv) ** 2))))
