"""Extrinsics, time offset and intrinsics of a camera with feature tracks, on a known trajectory of the IMU.

If two images share a point, its two rays and the translation of the camera in between lie in one epipolar plane. As the
trajectory is known, epipolar errors of thousands of points determine a few unknowns: rotation, lever arm, time offset
and up to two directions of the intrinsics. Points are not estimated. Angular rates give start values. Start rotations
about the main axis of the motion are tried on a grid, because a robot on a floor rotates about this axis only.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from scipy.optimize import OptimizeResult, least_squares

from icalib.base.compiled import njit
from icalib.data.measurements import TrackStream
from icalib.errors import EstimationError
from icalib.geometry import so3
from icalib.geometry.cameras.base import CameraModel
from icalib.motion.known_motion import imu_poses, is_known
from icalib.motion.poses import Poses
from icalib.motion.sweep import EstimatedMotion
from icalib.sensors.camera.initialize.tracks.epipolar_rotation import pairs_with_shared_points

PAIR_STEPS_S = (0.5, 1.0)  # s between the images of a pair; over shorter times the motion is small against ray errors
MAX_EPIPOLAR_PAIRS = 300  # pairs of images for each of `PAIR_STEPS_S`
MIN_EPIPOLAR_PAIRS = 20  # pairs of images; fewer contain too little motion to determine seven unknowns
EPIPOLAR_RAY_SIGMA = 3e-3  # rad, standard deviation of a ray, dominated by the initial guess of the intrinsics
CORRELATED_RAYS = 30.0  # rays of a pair with about the same error by wrong intrinsics; they count as one observation
TRACK_ARM_SIGMA_M = 0.3  # m, standard deviation of the zero-mean prior of the lever arm; typical size of rigs
LENS_SIGMA = 0.03  # rad, RMS change of the rays by one standard deviation of each direction of the intrinsics (prior)
MAX_LENS_SIGMAS = 3.0  # largest step along one direction, in standard deviations of its prior
MIN_COVERED_PAIR_SHARE = 0.5  # of the pairs that could overlap the motion; a short overlap fits any extrinsics
MIN_POINT_RANGE_M = 0.2  # m; nearer points are implausible
CAUCHY_SIGMAS = 2.0  # scale of Cauchy's loss, in standard deviations of a ray
AXIS_ANGLES = 24  # start rotations about the main axis, 15 deg apart
MAX_REFINED_STARTS = 4  # starts with the least cost, which are refined
START_SUBSAMPLING = 6  # every 6th pair is used to compare starts
REFINEMENT_SUBSAMPLING = (3, 3, 1)  # every n-th pair is used in each round; a round relinearises motion and rays
EPIPOLAR_COST_TOLERANCE = 1e-4  # relative decrease of the cost at which a round has converged
RAY_ERROR_QUANTILE = 0.75  # quantile of the ray errors that `MAX_RAY_ERROR` limits; fewer than a quarter are outliers
MAX_RAY_ERROR = 0.01  # rad, three times `EPIPOLAR_RAY_SIGMA`
MAX_ROTATION_SIGMA = np.deg2rad(5.0)  # rad; with a larger uncertainty the rotation counts as unobservable
N_EXTRINSICS = 7  # rotation (3), lever arm (3), time offset
EXTRINSICS_SCALE = np.repeat([0.1, 0.1, 0.01], [3, 3, 1])  # rad, m, s; the solver's unknowns are scaled by these


@dataclass(frozen=True)
class CameraExtrinsics:
    """Extrinsics, time offset and intrinsics of a camera.

    rotation (3, 3), position (3,) [m]: T_imu_cam. offset: t_imu - t_camera [s], each clock counted from its first
    stamp. lens_step: (L,) step from the initial guess of the intrinsics, along `ImagePairs.lens_directions`.
    """

    rotation: np.ndarray
    position: np.ndarray
    offset: float
    lens_step: np.ndarray

    def moved(self, x: np.ndarray) -> CameraExtrinsics:
        """These after a step x (7 + L,): rotation in the camera frame [rad], lever arm [m], offset [s], `lens_step`."""
        R, p = self.rotation @ so3.exp(x[:3].copy()), self.position + x[3:6]
        return CameraExtrinsics(R, p, self.offset + float(x[6]), self.lens_step + x[N_EXTRINSICS:])


@dataclass(frozen=True)
class ImagePairs:
    """m pairs of images of one camera, and the points that the two images of each pair share.

    uv: (o, 2) [px] observations. times: (m, 2) [s] on the camera's clock since its first stamp. shared: (n, 2) indices
    of the observations of one point in both images; pair k has the rows begin[k]:begin[k + 1]. lens: (P,) initial guess
    of intrinsics and distortion. lens_directions: (L, P) directions in which `lens` is adjusted; the length of each is
    the standard deviation of its prior.
    """

    name: str
    model: CameraModel
    uv: np.ndarray
    times: np.ndarray
    shared: np.ndarray
    begin: np.ndarray
    lens: np.ndarray
    lens_directions: np.ndarray

    @classmethod
    def of(cls, stream: TrackStream, model: CameraModel, lens: np.ndarray, directions: np.ndarray) -> ImagePairs:
        """The pairs of `stream`; directions: (L, P) free directions of the intrinsics, of any length.

        Raises EstimationError if fewer than `MIN_EPIPOLAR_PAIRS` pairs share enough points.
        """
        rays, valid = model.unproject(lens, stream.uv)
        pairs = list(pairs_with_shared_points(stream, valid, PAIR_STEPS_S, MAX_EPIPOLAR_PAIRS))
        if len(pairs) < MIN_EPIPOLAR_PAIRS:
            raise EstimationError(
                f"{stream.name}: only {len(pairs)} pairs of images {PAIR_STEPS_S[0]} s or more apart share enough "
                "tracked points; record for longer, or with longer feature tracks."
            )
        times = stream.seconds[np.array([(i, j) for i, j, _, _ in pairs])]
        shared = [np.stack([p, q], axis=1) for _, _, p, q in pairs]
        begin = np.cumsum([0, *(len(x) for x in shared)])
        J_rays = ray_derivatives(model, lens, directions, rays[valid])
        effect = np.sqrt((J_rays**2).sum(axis=2).mean(axis=1))  # rad, RMS over the rays
        uv, used = _used(stream.uv, np.concatenate(shared))
        return cls(stream.name, model, uv, times, used, begin, lens, LENS_SIGMA * directions / effect[:, None])

    def lens_of(self, extrinsics: CameraExtrinsics) -> np.ndarray:
        """(P,) intrinsics and distortion after `extrinsics.lens_step`."""
        return self.lens + extrinsics.lens_step @ self.lens_directions

    def every(self, n: int) -> ImagePairs:
        """Every n-th pair."""
        return self.select(np.arange(len(self.times)) % n == 0)

    def select(self, kept: np.ndarray) -> ImagePairs:
        """The pairs that `kept` (m,) bool selects."""
        count = np.diff(self.begin)
        begin = np.cumsum([0, *count[kept]])
        uv, shared = _used(self.uv, self.shared[np.repeat(kept, count)])
        return replace(self, uv=uv, times=self.times[kept], shared=shared, begin=begin)


def _used(uv: np.ndarray, shared: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The observations of `uv` (o, 2) that the indices `shared` (n, 2) refer to, and the indices into these."""
    used, renumbered = np.unique(shared, return_inverse=True)
    return uv[used], renumbered.reshape(shared.shape)


def ray_derivatives(model: CameraModel, lens: np.ndarray, directions: np.ndarray, rays: np.ndarray) -> np.ndarray:
    """(L, n, 3) derivatives of the unit rays (n, 3) of fixed pixels by steps of `lens` (P,) along `directions` (L, P).

    For the projection K(f, lens) = uv with Jacobians K_f, K_lens, a step d gives df = -K_f^+ K_lens d, perpendicular to
    f. Zero for rays that the model does not project.
    """
    _, valid, J_ray, J_lens = model.project_with_jacobians(lens, rays)
    pixels = np.einsum("nrp,lp->lnr", J_lens, directions)
    a, b, c = (np.einsum("nk,nk->n", J_ray[:, i], J_ray[:, j]) for i, j in ((0, 0), (0, 1), (1, 1)))
    determinant = np.where(valid, a * c - b * b, 1.0)
    u = (c * pixels[..., 0] - b * pixels[..., 1]) / determinant
    v = (a * pixels[..., 1] - b * pixels[..., 0]) / determinant
    derivatives = -(u[..., None] * J_ray[:, 0] + v[..., None] * J_ray[:, 1])
    return np.where(valid[:, None], derivatives, 0.0)


@njit(cache=True, nogil=True, error_model="numpy")
def _ray_errors(f, h, J_f, J_h, lens_step, begin, R, b, e):
    """Writes the epipolar errors e (n,) [rad] of the rays f and h (n, 3) of m pairs of images.

    R (m, 3, 3), b (m, 3) [m]: pose of the camera of f in the frame of the camera of h. lens_step (L,) moves the rays
    along their derivatives J_f, J_h (L, n, 3). Pair k has the rays begin[k]:begin[k + 1]. If rays intersect nearer than
    MIN_POINT_RANGE_M or behind a camera, the excess of their parallax is added to the error. Without this term, a
    camera without motion would fit best.
    """
    for k in range(len(begin) - 1):
        size = np.sqrt(b[k, 0] * b[k, 0] + b[k, 1] * b[k, 1] + b[k, 2] * b[k, 2]) + 1e-9
        t0, t1, t2 = b[k, 0] / size, b[k, 1] / size, b[k, 2] / size
        for i in range(begin[k], begin[k + 1]):
            f0, f1, f2, h0, h1, h2 = f[i, 0], f[i, 1], f[i, 2], h[i, 0], h[i, 1], h[i, 2]
            for j in range(len(lens_step)):
                s = lens_step[j]
                f0, f1, f2 = f0 + s * J_f[j, i, 0], f1 + s * J_f[j, i, 1], f2 + s * J_f[j, i, 2]
                h0, h1, h2 = h0 + s * J_h[j, i, 0], h1 + s * J_h[j, i, 1], h2 + s * J_h[j, i, 2]
            g0 = R[k, 0, 0] * f0 + R[k, 0, 1] * f1 + R[k, 0, 2] * f2
            g1 = R[k, 1, 0] * f0 + R[k, 1, 1] * f1 + R[k, 1, 2] * f2
            g2 = R[k, 2, 0] * f0 + R[k, 2, 1] * f1 + R[k, 2, 2] * f2
            c0, c1, c2 = g1 * h2 - g2 * h1, g2 * h0 - g0 * h2, g0 * h1 - g1 * h0
            tg, th = t0 * g0 + t1 * g1 + t2 * g2, t0 * h0 + t1 * h1 + t2 * h2
            off = (t0 * c0 + t1 * c1 + t2 * c2) / np.sqrt(max(2.0 - tg * tg - th * th, 1e-4))
            # Signs of the depths d1, d2 in t + d1 g = d2 h (least squares).
            gh = g0 * h0 + g1 * h1 + g2 * h2
            behind = tg - th * gh > 0.0 or tg * gh - th > 0.0
            near = np.sqrt(c0 * c0 + c1 * c1 + c2 * c2) - (0.0 if behind else size / MIN_POINT_RANGE_M)
            e[i] = np.sqrt(off * off + 0.5 * near * near) if near > 0.0 else off


@dataclass(frozen=True)
class _PairResiduals:
    """Epipolar residuals of `pairs` of images, as a function of a step from the extrinsics `at`.

    first, second: poses of the IMU at the instants of the first and second image of each pair. f, h: (n, 3) rays in
    both images; J_f, J_h: (L, n, 3) their derivatives by the steps of the intrinsics.
    """

    pairs: ImagePairs
    at: CameraExtrinsics
    first: Poses
    second: Poses
    f: np.ndarray
    h: np.ndarray
    J_f: np.ndarray
    J_h: np.ndarray

    @classmethod
    def of(cls, pairs: ImagePairs, motion: EstimatedMotion, at: CameraExtrinsics) -> _PairResiduals:
        """The residuals of the pairs with both images within the known `motion`, linearised at the extrinsics `at`."""
        t = pairs.times + at.offset
        pairs = pairs.select(is_known(motion.state.seconds, t[:, 0]) & is_known(motion.state.seconds, t[:, 1]))
        t1, t2 = (pairs.times + at.offset).T
        p, q = pairs.shared.T
        lens = pairs.lens_of(at)
        rays, valid = pairs.model.unproject(lens, pairs.uv)
        rays = np.where(valid[:, None], rays, 0.0)  # zero rays have no error
        J = np.where(valid[:, None], ray_derivatives(pairs.model, lens, pairs.lens_directions, rays), 0.0)
        return cls(pairs, at, imu_poses(motion, t1), imu_poses(motion, t2), rays[p], rays[q], J[:, p], J[:, q])

    def errors(self, x: np.ndarray) -> np.ndarray:
        """(n,) [rad] epipolar errors of all points, after a step x (7 + L,) as in `CameraExtrinsics.moved`."""
        camera = self.at.moved(x)
        R_ic, p_ic = camera.rotation, camera.position
        (R1, p1), (R2, p2) = _after(self.first, x[6]), _after(self.second, x[6])
        R_c2_world = R_ic.T @ R2.transpose(0, 2, 1)
        b = np.einsum("nij,nj->ni", R_c2_world, p1 - p2 + R1 @ p_ic) - R_ic.T @ p_ic
        R = np.ascontiguousarray(R_c2_world @ R1 @ R_ic)
        e = np.empty(len(self.f))
        _ray_errors(self.f, self.h, self.J_f, self.J_h, x[N_EXTRINSICS:], self.pairs.begin, R, b, e)
        return e

    @property
    def errors_at(self) -> np.ndarray:
        """(n,) [rad] epipolar errors of all points at the extrinsics `at`."""
        return self.errors(np.zeros(N_EXTRINSICS + len(self.pairs.lens_directions)))

    def minimise(self, fixed: np.ndarray) -> tuple[CameraExtrinsics, OptimizeResult]:
        """The extrinsics at the nearest minimum of the robust cost, and the solver's result.

        fixed: (7,) bool, unknowns that do not change. The loss is Cauchy's for epipolar errors, quadratic for priors.
        """
        n, sigma = len(self.pairs.lens_directions), EPIPOLAR_RAY_SIGMA * np.sqrt(CORRELATED_RAYS)
        scale, free = (
            np.append(EXTRINSICS_SCALE, np.ones(n)),
            np.flatnonzero(~np.append(fixed, np.zeros(n, dtype=bool))),
        )

        def step(y: np.ndarray) -> np.ndarray:
            x = np.zeros(len(scale))
            x[free] = scale[free] * y
            return x

        def residuals(y: np.ndarray) -> np.ndarray:
            x = step(y)
            camera = self.at.moved(x)
            return np.concatenate([self.errors(x) / sigma, camera.position / TRACK_ARM_SIGMA_M, camera.lens_step])

        # Bounds, because an infinite focal length, with parallel rays, fits best if the motion contradicts the tracks.
        limit, inside = np.append(np.full(len(free) - n, np.inf), np.full(n, MAX_LENS_SIGMAS)), 0.99 * MAX_LENS_SIGMAS
        present = np.append(np.zeros(len(free) - n), np.clip(self.at.lens_step, -inside, inside))
        result = least_squares(
            residuals,
            np.zeros(len(free)),
            bounds=(-limit - present, limit - present),
            loss=_cauchy_of_first(len(self.f)),
            f_scale=CAUCHY_SIGMAS / np.sqrt(CORRELATED_RAYS),
            max_nfev=20,
            ftol=EPIPOLAR_COST_TOLERANCE,
        )
        return self.at.moved(step(result.x)), result


def _cauchy_of_first(n: int) -> Any:
    """The callable `loss` of scipy's `least_squares`: Cauchy's for the first n residuals, quadratic for the priors.

    Its type is Any, because the type stubs of scipy lack callable losses.
    """

    def loss(z: np.ndarray) -> np.ndarray:
        s = z[:n]
        rho = np.stack([z, np.ones_like(z), np.zeros_like(z)])
        rho[:, : len(s)] = np.log1p(s), 1.0 / (1.0 + s), -1.0 / (1.0 + s) ** 2
        return rho

    return loss


def _after(poses: Poses, dt: float) -> tuple[np.ndarray, np.ndarray]:
    """R_world_imu (m, 3, 3) and p_world_imu (m, 3) a time dt [s] later, at constant velocity and angular rate."""
    return poses.rotation @ so3.exp_many(dt * poses.rate), poses.position + dt * poses.velocity


def extrinsics_on_motion(
    pairs: ImagePairs,
    motion: EstimatedMotion,
    starts: Sequence[CameraExtrinsics],
    axis: np.ndarray | None,
    fixed: np.ndarray,
) -> CameraExtrinsics:
    """The extrinsics of the camera that fit its `pairs` of images best, given the `motion` of the IMU.

    The search begins at each of the `starts`, rotated by a grid of angles about `axis` (3,) in the IMU's frame if that
    is not None. fixed: (7,) bool, unknowns that stay as in the starts, in the order of `CameraExtrinsics.moved`.

    Raises EstimationError if too few images overlap the motion in time, the tracks contradict the motion, or the motion
    does not determine the rotation.
    """
    angles = np.linspace(0.0, 2.0 * np.pi, AXIS_ANGLES, endpoint=False)
    rotations = [np.eye(3)] if axis is None else [so3.exp(a * axis) for a in angles]
    sample = pairs.every(START_SUBSAMPLING)
    least = MIN_COVERED_PAIR_SHARE * _share_in_common(sample, motion) * len(sample.times)
    at_starts = [_PairResiduals.of(sample, motion, start) for start in starts]
    covered = [s for s in at_starts if len(s.pairs.times) > least]
    tried = [replace(s, at=replace(s.at, rotation=R @ s.at.rotation)) for s in covered for R in rotations]
    if not tried:
        raise EstimationError(
            f"{pairs.name}: too few of its images fall within the trajectory of the other sensors; check its clock."
        )
    best = sorted(tried, key=_mean_cost)[:MAX_REFINED_STARTS]
    refined = [(*s.minimise(fixed), len(s.f)) for s in best]
    camera, result, _ = min(refined, key=lambda x: x[1].cost / x[2])  # cost per ray, because the numbers of rays differ
    for n in REFINEMENT_SUBSAMPLING:
        camera, result = _PairResiduals.of(pairs.every(n), motion, camera).minimise(fixed)
    _check(_PairResiduals.of(pairs, motion, camera), result, fixed)
    return camera


def _share_in_common(pairs: ImagePairs, motion: EstimatedMotion) -> float:
    """The largest share of the pairs of images that can lie within the known motion, at any time offset."""
    span, known = np.ptp(pairs.times), np.ptp(motion.state.seconds)
    return min(1.0, float(known / span)) if span > 0.0 else 1.0


def _mean_cost(residuals: _PairResiduals) -> float:
    """Cauchy's loss, the mean over all rays."""
    return float(np.log1p((residuals.errors_at / (CAUCHY_SIGMAS * EPIPOLAR_RAY_SIGMA)) ** 2).mean())


def _check(residuals: _PairResiduals, result: OptimizeResult, fixed: np.ndarray) -> None:
    """Raises EstimationError if the residuals are too large, or a free rotation is too uncertain.

    result: of the last `minimise`; fixed: (7,) bool."""
    name = residuals.pairs.name
    error = float(np.quantile(np.abs(residuals.errors_at), RAY_ERROR_QUANTILE))
    if error > MAX_RAY_ERROR:
        raise EstimationError(
            f"{name}: its feature tracks contradict the motion of the other sensors (rays miss each other by "
            f"{np.rad2deg(error):.1f} deg); check that all come from the same recording, and its intrinsics."
        )
    if fixed[0]:
        return
    sigma = EXTRINSICS_SCALE[:3] * np.sqrt(np.diag(np.linalg.pinv(result.jac.T @ result.jac)))[:3]
    if np.linalg.norm(sigma) > MAX_ROTATION_SIGMA:
        raise EstimationError(
            f"{name}: the motion does not determine its rotation; turn the robot about two axes or more and move "
            "along each, or give rotation in the rig file."
        )
