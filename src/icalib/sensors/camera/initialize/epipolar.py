"""Rotation and extrinsics of cameras from feature tracks, by the epipolar constraint."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from scipy.optimize import OptimizeResult, least_squares

from icalib.base.compiled import njit
from icalib.errors import EstimationError
from icalib.geometry import so3
from icalib.geometry.cameras.base import CameraModel
from icalib.geometry.small import solve_definite
from icalib.motion.poses import EstimatedMotion, Poses, imu_poses, is_known
from icalib.sensors.camera.stream import TrackStream, shared_rows

# Extrinsics, time offset and intrinsics of a camera with feature tracks, on a known trajectory of the IMU.
#
# If two images share a point, its two rays and the translation of the camera in between lie in one epipolar plane. As
# the trajectory is known, epipolar errors of thousands of points determine a few unknowns: rotation, lever arm, time
# offset and up to two directions of the intrinsics. Points are not estimated. Angular rates give start values. Start
# rotations about the main axis of the motion are tried on a grid, because a robot on a floor rotates about this axis
# only.

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


# Rotation of a camera between two images, from tracked points: epipolar geometry, without an initial guess.
#
# Unit rays f and h of one point satisfy t . (R f x h) = 0, where R rotates from the first camera to the second and t
# is the unit direction of motion. R and t minimise the errors over their standard deviation (Sampson's weighting) with
# Cauchy's loss.

MIN_SHARED_POINTS = 12  # points that two images share: a relative pose has five unknowns, the rest gives redundancy
SAMPLED_PAIRS = 30  # pairs of images that show how long tracks are
EPIPOLAR_ITERATIONS = 10  # of rotation and direction, from a start without translation
DIRECTION_ITERATIONS = 4  # of the direction alone, at a fixed rotation
EPIPOLAR_DAMPING = 1e-9  # of the mean diagonal: without translation the direction is unobservable


@njit(cache=True, nogil=True)
def _tangent_basis(t, a, b):
    """Fills a, b (3,): unit vectors orthogonal to the unit vector t (3,) and to each other."""
    k = 0
    for i in range(3):
        if abs(t[i]) < abs(t[k]):
            k = i
    a[:] = 0.0
    a[k] = 1.0
    along = t[k]
    for i in range(3):
        a[i] -= along * t[i]
    n = np.sqrt(a[0] * a[0] + a[1] * a[1] + a[2] * a[2])
    for i in range(3):
        a[i] /= n
    b[0], b[1], b[2] = t[1] * a[2] - t[2] * a[1], t[2] * a[0] - t[0] * a[2], t[0] * a[1] - t[1] * a[0]


@njit(cache=True, nogil=True)
def _epipolar_errors(f, h, R, t, g, c, e, sigma):
    """Fills g (n, 3) = R f, c (n, 3) = R f x h, the errors e (n,) = t . c / sigma, and sigma (n,): the standard
    deviation of t . c by unit noise of both rays."""
    for i in range(len(f)):
        for r in range(3):
            g[i, r] = R[r, 0] * f[i, 0] + R[r, 1] * f[i, 1] + R[r, 2] * f[i, 2]
        c[i, 0] = g[i, 1] * h[i, 2] - g[i, 2] * h[i, 1]
        c[i, 1] = g[i, 2] * h[i, 0] - g[i, 0] * h[i, 2]
        c[i, 2] = g[i, 0] * h[i, 1] - g[i, 1] * h[i, 0]
        tg = t[0] * g[i, 0] + t[1] * g[i, 1] + t[2] * g[i, 2]
        th = t[0] * h[i, 0] + t[1] * h[i, 1] + t[2] * h[i, 2]
        sigma[i] = np.sqrt(max(2.0 - tg * tg - th * th, 1e-4))
        e[i] = (t[0] * c[i, 0] + t[1] * c[i, 1] + t[2] * c[i, 2]) / sigma[i]


@njit(cache=True, nogil=True)
def _epipolar_row(g, h, c, J_f_lens, J_h_lens, R, t, a, b, J):
    """Fills J (5 + L,): derivative of t . (R f x h) for one point by a left rotation of R, by t along a and b, and by
    the lens. g = R f, c = g x h; J_f_lens, J_h_lens (L, 3): derivatives of the rays f and h by the lens."""
    m0, m1 = h[1] * t[2] - h[2] * t[1], h[2] * t[0] - h[0] * t[2]
    m2 = h[0] * t[1] - h[1] * t[0]
    J[0], J[1] = g[1] * m2 - g[2] * m1, g[2] * m0 - g[0] * m2
    J[2] = g[0] * m1 - g[1] * m0
    J[3] = a[0] * c[0] + a[1] * c[1] + a[2] * c[2]
    J[4] = b[0] * c[0] + b[1] * c[1] + b[2] * c[2]
    for j in range(len(J_f_lens)):
        # t . (R J_f x h + R f x J_h), with m = h x t and t x R f.
        J[5 + j] = 0.0
        for r in range(3):
            R_J_f = R[r, 0] * J_f_lens[j, 0] + R[r, 1] * J_f_lens[j, 1] + R[r, 2] * J_f_lens[j, 2]
            J[5 + j] += R_J_f * (m0 if r == 0 else m1 if r == 1 else m2)
            p, q = (r + 1) % 3, (r + 2) % 3
            J[5 + j] += J_h_lens[j, r] * (t[p] * g[q] - t[q] * g[p])


@njit(cache=True, nogil=True)
def _epipolar_sums(f, h, J_f_lens, J_h_lens, R, t, a, b, A, x):
    """Normal equations A (5 + L, 5 + L), x (5 + L,) of the errors e = t . (R f x h) over their standard deviation, with
    Cauchy's weights. Unknowns: a left rotation of R, t along a and b (which are filled), and L lens parameters.
    J_f_lens, J_h_lens (n, L, 3): derivatives of the rays f, h (n, 3). Returns the weighted sum of squares [rad^2]."""
    n, m = len(f), J_f_lens.shape[1]
    g, c, e, sigma, J = np.empty((n, 3)), np.empty((n, 3)), np.empty(n), np.empty(n), np.empty(5 + m)
    _epipolar_errors(f, h, R, t, g, c, e, sigma)
    scale, cost = 3.0 * np.median(np.abs(e)) + 1e-12, 0.0
    _tangent_basis(t, a, b)
    A[:] = 0.0
    x[:] = 0.0
    for i in range(n):
        _epipolar_row(g[i], h[i], c[i], J_f_lens[i], J_h_lens[i], R, t, a, b, J)
        w = 1.0 / (1.0 + (e[i] / scale) ** 2)
        cost += w * e[i] ** 2
        for r in range(5 + m):
            J[r] /= sigma[i]
            x[r] -= w * J[r] * e[i]
            for k in range(r + 1):
                A[r, k] += w * J[r] * J[k]
    for r in range(5 + m):
        for k in range(r):
            A[k, r] = A[r, k]
    return cost


@njit(cache=True, nogil=True)
def _move_direction(t, a, b, da, db):
    """Moves the unit vector t by da along a and db along b, at most by 0.5 rad."""
    size = np.sqrt(da * da + db * db)
    shorter = 0.5 / size if size > 0.5 else 1.0
    for r in range(3):
        t[r] += shorter * (da * a[r] + db * b[r])
    norm = np.sqrt(t[0] * t[0] + t[1] * t[1] + t[2] * t[2])
    for r in range(3):
        t[r] /= norm


@njit(cache=True, nogil=True)
def refine_relative_pose(f, h, R, t):
    """Refines R (3, 3) and the unit direction t (3,) of the relative pose with h ~ R f + s t, for rays f, h (n, 3).
    Returns the weighted sum of squares [rad^2] before the last step; infinite if singular."""
    a, b, A, x, J_no_lens = np.empty(3), np.empty(3), np.empty((5, 5)), np.empty(5), np.empty((len(f), 0, 3))
    cost = np.inf
    for _ in range(EPIPOLAR_ITERATIONS):
        cost = _epipolar_sums(f, h, J_no_lens, J_no_lens, R, t, a, b, A, x)
        mean = EPIPOLAR_DAMPING * (A[0, 0] + A[1, 1] + A[2, 2])
        for r in range(5):
            A[r, r] += mean
        if not solve_definite(A, x):
            return np.inf
        R[:] = so3.exp(x[:3].copy()) @ R
        _move_direction(t, a, b, x[3], x[4])
    return cost


@njit(cache=True, nogil=True)
def _direction_step(A, x, y):
    """Solves the 2 x 2 block of A (5, 5) that belongs to the direction, for the right side (x, y)."""
    mean = EPIPOLAR_DAMPING * (A[0, 0] + A[1, 1] + A[2, 2])
    p, q, r = A[3, 3] + mean, A[3, 4], A[4, 4] + mean
    inverse = 1.0 / (p * r - q * q)
    return inverse * (r * x - q * y), inverse * (p * y - q * x)


@njit(cache=True, nogil=True)
def rotation_information(f, h, J_f_lens, J_h_lens, R, t, H, g):
    """Fills H (3 + L, 3 + L) and g (3 + L,), the normal equations H step = g of a left rotation of R and of L lens
    parameters, after elimination of the direction of motion t, which is refined. Arguments as for `_epipolar_sums`.
    Returns the weighted sum of squares [rad^2]."""
    a, b, A, x, J_no_lens = np.empty(3), np.empty(3), np.empty((5, 5)), np.empty(5), np.empty((len(f), 0, 3))
    for _ in range(DIRECTION_ITERATIONS):
        _epipolar_sums(f, h, J_no_lens, J_no_lens, R, t, a, b, A, x)
        u, v = _direction_step(A, x[3], x[4])
        _move_direction(t, a, b, u, v)
    n = 5 + J_f_lens.shape[1]
    A, x = np.empty((n, n)), np.empty(n)
    cost = _epipolar_sums(f, h, J_f_lens, J_h_lens, R, t, a, b, A, x)
    for i in range(n - 2):
        r = i if i < 3 else i + 2
        u, v = _direction_step(A, A[3, r], A[4, r])
        g[i] = x[r] - u * x[3] - v * x[4]
        for k in range(n - 2):
            c = k if k < 3 else k + 2
            H[i, k] = A[r, c] - u * A[3, c] - v * A[4, c]
    return cost


@njit(cache=True, nogil=True)
def direction_for_rotation(f, h, R):
    """The direction of motion (3,) that fits rays f, h (n, 3) best for the rotation R: eigenvector of the smallest
    eigenvalue of sum (R f x h)(R f x h)^T."""
    N, g, c = np.zeros((3, 3)), np.empty(3), np.empty(3)
    for i in range(len(f)):
        for r in range(3):
            g[r] = R[r, 0] * f[i, 0] + R[r, 1] * f[i, 1] + R[r, 2] * f[i, 2]
        c[0] = g[1] * h[i, 2] - g[2] * h[i, 1]
        c[1] = g[2] * h[i, 0] - g[0] * h[i, 2]
        c[2] = g[0] * h[i, 1] - g[1] * h[i, 0]
        for r in range(3):
            for k in range(3):
                N[r, k] += c[r] * c[k]
    return np.linalg.eigh(N)[1][:, 0].copy()


@njit(cache=True, nogil=True)
def rotation_information_of_pairs(f, h, J_f_lens, J_h_lens, begin, R, H, g, cost):
    """Fills H (M, 3 + L, 3 + L), g (M, 3 + L) and cost (M,) of `rotation_information`, for pairs of images with
    rotations R (M, 3, 3). Pair i has the rows begin[i]..begin[i + 1] of the rays f, h (n, 3) and of their derivatives
    (n, L, 3)."""
    for i in range(len(R)):
        rows = slice(begin[i], begin[i + 1])
        t = direction_for_rotation(f[rows], h[rows], R[i])
        cost[i] = rotation_information(f[rows], h[rows], J_f_lens[rows], J_h_lens[rows], R[i], t, H[i], g[i])


def rotation_without_translation(f: np.ndarray, h: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """R (3, 3) that best rotates rays f to h (n, 3), and the best direction of motion (3,) for it."""
    U, _, Vt = np.linalg.svd(h.T @ f)
    R = U @ np.diag([1.0, 1.0, np.sign(np.linalg.det(U @ Vt))]) @ Vt
    return np.ascontiguousarray(R), direction_for_rotation(f, h, R)


def rotation_error(f: np.ndarray, h: np.ndarray, R: np.ndarray, t: np.ndarray) -> tuple[float, float]:
    """Standard deviation [rad] of a rotation about each axis (RMS over axes), and of a ray across its epipolar plane
    [rad]."""
    H, g, J_no_lens = np.empty((3, 3)), np.empty(3), np.empty((len(f), 0, 3))
    cost = rotation_information(f, h, J_no_lens, J_no_lens, R, t.copy(), H, g)
    H[range(3), range(3)] += EPIPOLAR_DAMPING * np.trace(H)
    return float(np.sqrt(cost / len(f) * np.trace(np.linalg.inv(H)) / 3.0)), float(np.sqrt(cost / len(f)))


def image_pairs(stream: TrackStream, step: float) -> list[tuple[int, int]]:
    """Indices of each image and of the one about `step` s later."""
    t = stream.seconds
    after = np.searchsorted(t, t + step - 0.5 * float(np.median(np.diff(t))))
    return [(i, int(j)) for i, j in enumerate(after) if i < j < len(t)]


def pairs_with_shared_points(
    stream: TrackStream, valid: np.ndarray, steps: Sequence[float], most: int
) -> Iterator[tuple[int, int, np.ndarray, np.ndarray]]:
    """About `most` pairs of images for each of the `steps` [s] between them, with MIN_SHARED_POINTS shared points or
    more: indices of both images, and rows as `shared_points` returns them. If tracks are shorter than the first step,
    all steps are halved until half of the pairs share enough points."""
    for step in _shortened_steps(stream, valid, steps):
        every = image_pairs(stream, step)
        for i, j in every[:: max(1, len(every) // most)]:
            p, q = shared_points(stream, valid, i, j)
            if len(p) >= MIN_SHARED_POINTS:
                yield i, j, p, q


def _shortened_steps(stream: TrackStream, valid: np.ndarray, steps: Sequence[float]) -> Sequence[float]:
    """The steps times 1, 1/2, 1/4 or 1/8: the largest at which more than half of the pairs share enough points."""
    for shorter in (1.0, 0.5, 0.25, 0.125):
        every = image_pairs(stream, shorter * steps[0])
        some = every[:: max(1, len(every) // SAMPLED_PAIRS)]
        enough = sum(len(shared_points(stream, valid, i, j)[0]) >= MIN_SHARED_POINTS for i, j in some)
        if 2 * enough > len(some):
            return [shorter * step for step in steps]
    return steps


def shared_points(stream: TrackStream, valid: np.ndarray, i: int, j: int) -> tuple[np.ndarray, np.ndarray]:
    """Rows of the points that images i and j share, in i and in j; only those with a valid ray."""
    p, q = shared_rows(stream.start, stream.feature, i, j)
    valid_rows = valid[p] & valid[q]
    return p[valid_rows], q[valid_rows]
