"""The lens of a camera that follows points, from nothing: by the turns that a gyroscope felt.

Where the focal length is taken to be s times too long, rates from tracks are s times too small about the axes of the
image plane, and right about the optical axis:

    w_imu = R_imu_cam diag(s, s, 1) w_cam + b

The shift of the clocks is where the gyroscope's rates regress best on the camera's, whatever the matrix between them
(see `rate_shifts`); s then gives the focal length. From there Gauss-Newton finds all together: rotation, time offset,
bias of the gyroscope, focal length, principal point and distortion, from the epipolar geometry of the points that two
images share, given the gyroscope's turn between both (see `track_alignment`). The lens is sought as one whose radius
is a polynomial of the angle, which is near every lens, and then written in the model of the rig file.
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
from icalib.initialize.steps.epipolar_rotation import rotation_information_of_pairs, track_rates
from icalib.initialize.steps.gyro_rates import MeanRates
from icalib.initialize.steps.gyro_rotation import GyroRotation
from icalib.initialize.steps.rate_alignment import RateAlignment, covered, kabsch, no_overlap
from icalib.initialize.steps.rate_correlation import SensorRates
from icalib.initialize.steps.rate_regression import best_regressions, matching_track_rates
from icalib.motion.imu_data import ImuData
from icalib.rig import Camera
from icalib.sensors.camera.initialize.tracks.epipolar_extrinsics import ImagePairs, lens_slopes
from icalib.sensors.camera.initialize.tracks.joint_alignment import gyro_turns

ANY_LENS = "pinhole-equidistant"  # its start, r = f theta, is near every lens, wide and narrow
STARTS = (1.0, 0.35)  # of the image width: near a usual lens, and a fisheye one
SCALES = np.geomspace(0.1, 10.0, 100)  # 5 % apart
SCALED_ROUNDS, SCALED_ENOUGH = 4, 0.05
BENDS_FROM = 3.0  # medians, of what rates differ by, from where on they count less
ANY_BENDS = 2  # of its coefficients
# Of what is known beforehand, one standard deviation in units of `Followed.bends`, 0.03 rad RMS over the rays: hardly
# anything of focal length and distortion; pixels are square to 1 %, the principal point is near the middle.
PRIOR, BENT = np.array([10.0, 0.1, 1.0, 1.0]), 3.0
ALIKE = 300.0  # of how many rays the errors are alike: those of one point in many pairs, and what the lens leaves
ROUNDS = 15
MOST_TURN, MOST_SHIFT_S, MOST_BENT = 0.3, 0.05, 3.0  # of a round
ENOUGH = 0.1  # standard deviations, of a round
LARGEST_SIGMA = 0.1  # of the logarithm of the focal length: from further off the solver may not find back
LARGEST_UNEXPLAINED = 0.35  # of the angular rate
FEWEST_SEEN = 4  # times the parameters of a model, of rays that show them
MOST_FITTED = 400  # rays
ALSO_NEAR_PX = 0.5  # RMS, by which a lens of two coefficients may miss another
UNSEEN = 5.0  # of the cost: a ray outside the range of the model, or lenses would learn to look away


@dataclass(frozen=True)
class _Fit:
    """lens (P,), how the camera is aligned with the IMU, the standard deviation of the logarithm of the focal length,
    and the cost."""

    lens: np.ndarray
    aligned: RateAlignment
    sigma: float = np.inf
    cost: float = np.inf


def find_intrinsics(camera: Camera, stream: TrackStream, imu: ImuData, offset: float | None) -> np.ndarray:
    """(P,) intrinsics and distortion; the distortion of the rig file, where it has one. offset: t_imu - t_camera, both
    since their clock's first stamp [s], where it is known.

    Raises EstimationError, one sentence, where the tracks or the motion do not show the lens.
    """
    given = camera.distortion.value
    model = camera_model(ANY_LENS if given is None else camera.model)
    distortion = model.start_distortions[0] if given is None else given
    rough = _rough(stream, imu, model, _starts(camera, distortion, model), offset)
    found = _refined(stream, imu, model, rough, offset is not None, ANY_BENDS if given is None else 0)
    if not found.sigma < LARGEST_SIGMA:
        raise EstimationError(
            f"{camera.name}: the rotation in the recording does not determine the focal length; turn the rig "
            "about axes perpendicular to the optical axis, or give intrinsics: [fx, fy, cx, cy] in the rig "
            "file."
        )
    return found.lens if given is not None else _in_model(camera, stream, imu, model, found, offset is not None)


def _starts(camera: Camera, distortion: np.ndarray | tuple[float, ...], model: CameraModel) -> list[np.ndarray]:
    width, height = camera.resolution
    lens = np.array([1.0, 1.0, 0.5 * (width - 1), 0.5 * (height - 1), *distortion])
    long = [share * width / model.central_scale(lens) for share in STARTS]
    return [np.array([f, f, *lens[2:]]) for f in long]


def _rough(
    stream: TrackStream, imu: ImuData, model: CameraModel, starts: list[np.ndarray], offset: float | None
) -> _Fit:
    """The focal length by the regression of rates. Raises EstimationError where they do not match."""
    rates, best = [matching_track_rates(imu, stream, model, starts[0])], 0
    step = float(np.median(rates[0].end - rates[0].start))
    rates += [track_rates(stream, model, lens, step, thinned=True) for lens in starts[1:]]
    if offset is None:
        shifts = [(x, k) for k, r in enumerate(rates) for x in best_regressions(imu, r)[:1]]
        if not shifts:
            raise no_overlap(imu, stream.name)
        shift, best = max(shifts, key=lambda found: found[0].score)
        offset = shift.offset
    lens, own = starts[best], rates[best]
    aligned, scale, unexplained = _scaled(imu, own, offset, stream.name)
    for _ in range(SCALED_ROUNDS):
        lens = np.concatenate([lens[:2] / scale, lens[2:]])
        if abs(np.log(scale)) < SCALED_ENOUGH:
            break
        own = track_rates(stream, model, lens, step, thinned=True)
        aligned, scale, unexplained = _scaled(imu, own, offset, stream.name)
    if unexplained > LARGEST_UNEXPLAINED:
        raise EstimationError(
            f"the motion of {stream.name} does not match that of {imu.name} at any time offset and focal "
            f"length ({unexplained:.0%} of the angular rate is unexplained). Check that both come from the "
            "same recording, overlap in time, and are in rad/s, or give intrinsics in the rig file."
        )
    return _Fit(lens, aligned)


def _scaled(imu: ImuData, rates: SensorRates, offset: float, name: str) -> tuple[RateAlignment, float, float]:
    """How camera and IMU go together, how many times as fast the camera turns about the axes of its image plane as it
    says, and what share of the rate is unexplained then."""
    inside = covered(imu, rates, offset)
    if not inside.any():
        raise no_overlap(imu, name)
    gyro = MeanRates.of(imu).over(rates.start[inside] + offset, rates.end[inside] + offset)
    found = [(*_turned(gyro, rates.rate[inside] * [scale, scale, 1.0]), float(scale)) for scale in SCALES]
    left, R, bias, scale = min(found, key=lambda x: x[0])
    spread = float(np.median(np.linalg.norm(gyro - np.median(gyro, axis=0), axis=1)))
    return RateAlignment(offset, R, bias), scale, left / max(spread, 1e-9)


def _turned(gyro: np.ndarray, seen: np.ndarray) -> tuple[float, np.ndarray, np.ndarray]:
    """How far rates gyro = R seen + b (n, 3) are apart, by the median [rad/s], and R and b, robustly."""
    R, bias = kabsch(gyro, seen, np.ones(len(gyro)))
    for _ in range(2):
        left = np.linalg.norm(gyro - seen @ R.T - bias, axis=1)
        R, bias = kabsch(gyro, seen, 1.0 / (1.0 + (left / (BENDS_FROM * np.median(left) + 1e-12)) ** 2))
    return float(np.median(np.linalg.norm(gyro - seen @ R.T - bias, axis=1))), R, bias


def _refined(stream: TrackStream, imu: ImuData, model: CameraModel, rough: _Fit, keep_offset: bool, bends: int) -> _Fit:
    """All together by Gauss-Newton, with the first `bends` coefficients of the distortion."""
    aligned, n = rough.aligned, 4 + bends
    followed = ImagePairs.of(stream, model, rough.lens, _directions(rough.lens, bends))
    bent, sigma, cost = np.zeros(n), np.ones(7 + n), np.inf
    known = np.concatenate([np.zeros(7), PRIOR, np.full(bends, BENT)])
    known[7:] **= -2.0
    known[3] = 1e12 if keep_offset else 0.0
    for _ in range(ROUNDS):
        N, r, cost = _normal(followed, imu, bent, aligned)
        N += np.diag(known + 1e-9 * N.diagonal())
        x = np.linalg.solve(N, r - known * np.append(np.zeros(7), bent))
        sigma = np.sqrt(np.diag(np.linalg.inv(N)))
        most = (np.linalg.norm(x[:3]) / MOST_TURN, abs(x[3]) / MOST_SHIFT_S, np.abs(x[7:]).max() / MOST_BENT)
        x /= max(1.0, *most)
        R, bias = aligned.rotation @ so3.exp(x[:3].copy()), aligned.gyro_bias + x[4:7]
        aligned, bent = replace(aligned, offset=aligned.offset + x[3], rotation=R, gyro_bias=bias), bent + x[7:]
        if np.abs(x / sigma).max() < ENOUGH:
            break
    longer = float(followed.bends[0, 0] / rough.lens[0])
    return _Fit(rough.lens + bent @ followed.bends, aligned, longer * float(sigma[7]), cost)


def _directions(lens: np.ndarray, bends: int) -> np.ndarray:
    """(4 + bends, P) in which a lens is sought: longer, longer down than across, principal point, distortion."""
    out = np.zeros((4 + bends, len(lens)))
    out[0, :2], out[1, 1], out[2, 2], out[3, 3] = lens[:2], lens[1], lens[0], lens[1]
    out[range(4, 4 + bends), range(4, 4 + bends)] = 1.0
    return out


def _normal(
    followed: ImagePairs, imu: ImuData, bent: np.ndarray, aligned: RateAlignment
) -> tuple[np.ndarray, np.ndarray, float]:
    """Normal matrix and right-hand side of rotation, time offset, bias of the gyroscope, and the lens (7 + L,); and
    minus the logarithm of the likelihood, where the noise of each pair of images is not known."""
    own, D, swept, turned = gyro_turns(
        GyroRotation.integrate(imu, aligned.gyro_bias), *(followed.times + aligned.offset).T
    )
    seen = followed.some(np.isin(np.arange(len(followed.times)), own))
    lens = seen.lens + bent @ seen.bends
    rays, valid = seen.model.unproject(lens, seen.uv)
    rays = np.where(valid[:, None], rays, 0.0)
    by = np.where(valid[:, None], lens_slopes(seen.model, lens, seen.bends, rays), 0.0).transpose(1, 0, 2)
    p, q = seen.shared.T
    m, n, R_ci = len(own), len(bent), aligned.rotation.T
    R = np.ascontiguousarray(R_ci @ D @ aligned.rotation)
    H, g, left = np.empty((m, 3 + n, 3 + n)), np.empty((m, 3 + n)), np.empty(m)
    rotation_information_of_pairs(rays[p], rays[q], by[p], by[q], seen.begin, R, H, g, left)
    J = np.zeros((m, 3 + n, 7 + n))
    J[:, :3, :3], J[:, :3, 3], J[:, :3, 4:7] = R - np.eye(3), swept @ aligned.rotation, R_ci @ turned
    J[:, 3:, 7:] = np.eye(n)
    count = np.diff(seen.begin)
    weight = 1.0 / (ALIKE * np.median(left / count) + 1e-18)
    flat = J.reshape(-1, 7 + n)
    cost = float(0.5 * (count * np.log(left / count + 1e-18)).sum() + UNSEEN * (~valid[p] | ~valid[q]).sum())
    return weight * flat.T @ (H @ J).reshape(-1, 7 + n), weight * flat.T @ g.ravel(), cost


def _in_model(
    camera: Camera, stream: TrackStream, imu: ImuData, model: CameraModel, fit: _Fit, keep_offset: bool
) -> np.ndarray:
    """(P,) of the camera's model: nearest to the lens where points were seen. Where several are as near, as in models
    of two shape parameters, that which the tracks fit best from there."""
    wanted = camera_model(camera.model)
    uv = stream.uv[:: max(1, len(stream.uv) // MOST_FITTED)]
    rays, valid = model.unproject(fit.lens, uv)
    rays, uv, found = rays[valid], uv[valid], []
    for distortion in wanted.start_distortions:
        start = np.array([*fit.lens[:4], *distortion])
        start[:2] *= model.central_scale(fit.lens) / wanted.central_scale(start)
        seen = wanted.project(start, rays)[1]
        if seen.sum() > FEWEST_SEEN * len(start):
            with suppress(np.linalg.LinAlgError):
                params = fit_rays(wanted, start, rays[seen], uv[seen], 1e-3)
                if not any(np.allclose(params, other, rtol=2e-2, atol=1e-2) for other in found):
                    found.append(params)
    if not found:
        raise EstimationError(
            f"{camera.name}: its lens is too wide for {camera.model}; choose a fisheye model, or give intrinsics in "
            "the rig file."
        )
    missed = [_missed(wanted, params, rays, uv) for params in found]
    near = [params for params, px in zip(found, missed, strict=True) if px < ALSO_NEAR_PX + min(missed)]
    if len(near) == 1:
        return near[0]
    bends = len(near[0]) - 4
    fits = [_refined(stream, imu, wanted, replace(fit, lens=params), keep_offset, bends) for params in near]
    return min(fits, key=lambda one: one.cost).lens


def _missed(model: CameraModel, params: np.ndarray, rays: np.ndarray, uv: np.ndarray) -> float:
    """RMS [px]; a ray that the model cannot see misses by as much as the image's size."""
    found, valid = model.project(params, rays)
    return float(np.sqrt(np.mean(np.where(valid, ((found - uv) ** 2).sum(axis=1), np.ptp(uv) ** 2))))
