"""Where a camera stands that follows points, once other sensors have shown how the robot moves.

Of a point that two images share, both rays and the way of the camera in between lie in one plane. How the robot moves
is known, so that only the camera itself is open: rotation, lever arm and time offset, and how it bends rays, a few
unknowns of thousands of points. Angular rates say where to start, but not where the robot turns about one axis, as on a
floor: how the camera stands about it is tried all round. No place of a point is sought.
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
from icalib.initialize.steps.epipolar_rotation import pairs_with_shared_points
from icalib.motion.known_motion import imu_poses, is_known
from icalib.motion.poses import Poses
from icalib.motion.sweep import EstimatedMotion

STEPS_S = (0.5, 1.0)  # between two images
MOST_PAIRS = 300  # of images a step
FEWEST_PAIRS = 20
RAY_SIGMA = 3e-3  # rad, of a ray: what a rough lens leaves
ALIKE = 30.0  # of how many rays of two images a rough lens bends all alike: they count as one
ARM_SIGMA = 0.3  # m
LENS_SIGMA = 0.03  # rad, RMS over the rays, of what one coefficient may be off by
MOST_BENT = 3.0  # times that
LEAST_SEEN = 0.5  # of the pairs of images that can be: a short stretch in which little happens fits anywhere
NEAREST_M = 0.2  # of a point
BENDS = 2.0  # standard deviations, from where on a ray counts less
ANGLES = 24  # about the axis that the robot turns about most
FOLLOWED = 4  # starts
EVERY = 6  # every so many of the pairs say which start is best
ENOUGH = 1e-4  # of the cost, by which a step still lowers it
ROUNDS = (3, 3, 1)  # every so many do in rounds of taking motion and lens anew, where they have come to
MOST_RAYS = 0.75  # of which LARGEST_MISS is asked: points that were followed wrongly are fewer
LARGEST_MISS = 0.01  # rad
LARGEST_SIGMA = np.deg2rad(5.0)  # of the rotation, beyond which it is not shown
MOUNTED = 7  # unknowns of a mount
UNITS = np.repeat([0.1, 0.1, 0.01], [3, 3, 1])  # rad, m, s: of what a mount is sought by


@dataclass(frozen=True)
class CameraExtrinsics:
    """T_imu_cam; offset: t_imu - t_camera, both since their clock's first stamp [s]; bent (L,): by how much of each of
    the directions in which the lens is open it differs from the guess."""

    rotation: np.ndarray
    position: np.ndarray
    offset: float
    bent: np.ndarray

    def moved(self, x: np.ndarray) -> CameraExtrinsics:
        """By (7 + L,): a turn in the camera's axes, metres, seconds, and how the lens is bent."""
        R, p = self.rotation @ so3.exp(x[:3].copy()), self.position + x[3:6]
        return CameraExtrinsics(R, p, self.offset + float(x[6]), self.bent + x[7:])


@dataclass(frozen=True)
class ImagePairs:
    """What one camera followed: pairs of images at times (m, 2) on its clock, and which of the observations uv (o, 2)
    are of points that they share, (n, 2), those of pair k at begin[k]..begin[k + 1]. lens (P,): a guess of its
    intrinsics and distortion; bends (L, P): directions in which it is open, each as long as it may be off."""

    name: str
    model: CameraModel
    uv: np.ndarray
    times: np.ndarray
    shared: np.ndarray
    begin: np.ndarray
    lens: np.ndarray
    bends: np.ndarray

    @classmethod
    def of(cls, stream: TrackStream, model: CameraModel, lens: np.ndarray, directions: np.ndarray) -> ImagePairs:
        """`directions` (L, P): in which the lens is open. Raises EstimationError where hardly any images share enough
        points."""
        rays, valid = model.unproject(lens, stream.uv)
        pairs = list(pairs_with_shared_points(stream, valid, STEPS_S, MOST_PAIRS))
        if len(pairs) < FEWEST_PAIRS:
            raise EstimationError(
                f"{stream.name}: only {len(pairs)} pairs of images {STEPS_S[0]} s or more apart share enough "
                "tracked points; record for longer, or with longer feature tracks."
            )
        times = stream.seconds[np.array([(i, j) for i, j, _, _ in pairs])]
        shared = [np.stack([p, q], axis=1) for _, _, p, q in pairs]
        begin = np.cumsum([0, *(len(x) for x in shared)])
        slopes = lens_slopes(model, lens, directions, rays[valid])
        effect = np.sqrt((slopes**2).sum(axis=2).mean(axis=1))  # rad, RMS over the rays
        uv, used = _used(stream.uv, np.concatenate(shared))
        return cls(stream.name, model, uv, times, used, begin, lens, LENS_SIGMA * directions / effect[:, None])

    def lens_of(self, mount: CameraExtrinsics) -> np.ndarray:
        """(P,)"""
        return self.lens + mount.bent @ self.bends

    def every(self, n: int) -> ImagePairs:
        """One of `n` pairs."""
        return self.some(np.arange(len(self.times)) % n == 0)

    def some(self, kept: np.ndarray) -> ImagePairs:
        """The pairs `kept` (m,) bool."""
        count = np.diff(self.begin)
        begin = np.cumsum([0, *count[kept]])
        uv, shared = _used(self.uv, self.shared[np.repeat(kept, count)])
        return replace(self, uv=uv, times=self.times[kept], shared=shared, begin=begin)


def _used(uv: np.ndarray, shared: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Those of uv that `shared` names, and what it calls them then: rays of others need not be found."""
    used, renamed = np.unique(shared, return_inverse=True)
    return uv[used], renamed.reshape(shared.shape)


def lens_slopes(model: CameraModel, lens: np.ndarray, directions: np.ndarray, rays: np.ndarray) -> np.ndarray:
    """(L, n, 3) derivatives of rays (n, 3) of fixed pixels by steps of the lens along `directions` (L, P), nothing
    where the model cannot see: of K(f, lens) = uv follows df = -K_f^+ K_lens d, at right angles to f."""
    _, valid, by_ray, by_lens = model.project_with_jacobians(lens, rays)
    pixels = np.einsum("nrp,lp->lnr", by_lens, directions)
    a, b, c = (np.einsum("nk,nk->n", by_ray[:, i], by_ray[:, j]) for i, j in ((0, 0), (0, 1), (1, 1)))
    determinant = np.where(valid, a * c - b * b, 1.0)
    u = (c * pixels[..., 0] - b * pixels[..., 1]) / determinant
    v = (a * pixels[..., 1] - b * pixels[..., 0]) / determinant
    slopes = -(u[..., None] * by_ray[:, 0] + v[..., None] * by_ray[:, 1])
    return np.where(valid[:, None], slopes, 0.0)


@njit(cache=True, nogil=True, error_model="numpy")
def _misses(f, h, f_by, h_by, bent, begin, R, b, e):
    """e (n,): by how far rays f, turned by R (m, 3, 3), and h of each pair miss each other, rad, where the camera of f
    stands at b (m, 3), seen from that of h, and the lens is bent by (L,) of the slopes f_by, h_by (L, n, 3). Rays that
    would meet nearer than NEAREST_M, or behind a camera, miss by as much of the angle between them, too: else a camera
    that does not move at all would fit best."""
    for k in range(len(begin) - 1):
        size = np.sqrt(b[k, 0] * b[k, 0] + b[k, 1] * b[k, 1] + b[k, 2] * b[k, 2]) + 1e-9
        t0, t1, t2 = b[k, 0] / size, b[k, 1] / size, b[k, 2] / size
        for i in range(begin[k], begin[k + 1]):
            f0, f1, f2, h0, h1, h2 = f[i, 0], f[i, 1], f[i, 2], h[i, 0], h[i, 1], h[i, 2]
            for j in range(len(bent)):
                f0, f1, f2 = f0 + bent[j] * f_by[j, i, 0], f1 + bent[j] * f_by[j, i, 1], f2 + bent[j] * f_by[j, i, 2]
                h0, h1, h2 = h0 + bent[j] * h_by[j, i, 0], h1 + bent[j] * h_by[j, i, 1], h2 + bent[j] * h_by[j, i, 2]
            g0 = R[k, 0, 0] * f0 + R[k, 0, 1] * f1 + R[k, 0, 2] * f2
            g1 = R[k, 1, 0] * f0 + R[k, 1, 1] * f1 + R[k, 1, 2] * f2
            g2 = R[k, 2, 0] * f0 + R[k, 2, 1] * f1 + R[k, 2, 2] * f2
            c0, c1, c2 = g1 * h2 - g2 * h1, g2 * h0 - g0 * h2, g0 * h1 - g1 * h0
            tg, th = t0 * g0 + t1 * g1 + t2 * g2, t0 * h0 + t1 * h1 + t2 * h2
            off = (t0 * c0 + t1 * c1 + t2 * c2) / np.sqrt(max(2.0 - tg * tg - th * th, 1e-4))
            # Of t + d1 g = d2 h the signs of d1 and d2.
            gh = g0 * h0 + g1 * h1 + g2 * h2
            behind = tg - th * gh > 0.0 or tg * gh - th > 0.0
            near = np.sqrt(c0 * c0 + c1 * c1 + c2 * c2) - (0.0 if behind else size / NEAREST_M)
            e[i] = np.sqrt(off * off + 0.5 * near * near) if near > 0.0 else off


@dataclass(frozen=True)
class _PairResiduals:
    """Pairs of images as the camera `at` sees them: the motion at both (m,), f and h (n, 3) rays of the first and the
    second image, and their slopes (L, n, 3) by the lens."""

    followed: ImagePairs
    at: CameraExtrinsics
    first: Poses
    second: Poses
    f: np.ndarray
    h: np.ndarray
    f_by: np.ndarray
    h_by: np.ndarray

    @classmethod
    def of(cls, followed: ImagePairs, motion: EstimatedMotion, at: CameraExtrinsics) -> _PairResiduals:
        t = followed.times + at.offset
        followed = followed.some(is_known(motion.state.seconds, t[:, 0]) & is_known(motion.state.seconds, t[:, 1]))
        t1, t2 = (followed.times + at.offset).T
        p, q = followed.shared.T
        lens = followed.lens_of(at)
        rays, valid = followed.model.unproject(lens, followed.uv)
        rays = np.where(valid[:, None], rays, 0.0)  # these miss nothing
        by = np.where(valid[:, None], lens_slopes(followed.model, lens, followed.bends, rays), 0.0)
        return cls(followed, at, imu_poses(motion, t1), imu_poses(motion, t2), rays[p], rays[q], by[:, p], by[:, q])

    def misses(self, x: np.ndarray) -> np.ndarray:
        """(n,) of all rays, with the camera moved by x (7 + L,)."""
        mount = self.at.moved(x)
        p = mount.position
        (R1, at1), (R2, at2) = _after(self.first, x[6]), _after(self.second, x[6])
        back = mount.rotation.T @ R2.transpose(0, 2, 1)
        b = np.einsum("nij,nj->ni", back, at1 - at2 + R1 @ p) - mount.rotation.T @ p
        R = np.ascontiguousarray(back @ R1 @ mount.rotation)
        e = np.empty(len(self.f))
        _misses(self.f, self.h, self.f_by, self.h_by, x[MOUNTED:], self.followed.begin, R, b, e)
        return e

    @property
    def missed(self) -> np.ndarray:
        """(n,) of all rays, the camera where it is."""
        return self.misses(np.zeros(MOUNTED + len(self.followed.bends)))

    def sought(self, held: np.ndarray) -> tuple[CameraExtrinsics, OptimizeResult]:
        """The best mount near by."""
        n, sigma = len(self.followed.bends), RAY_SIGMA * np.sqrt(ALIKE)
        units, free = np.append(UNITS, np.ones(n)), np.flatnonzero(~np.append(held, np.zeros(n, dtype=bool)))

        def step(y: np.ndarray) -> np.ndarray:
            x = np.zeros(len(units))
            x[free] = units[free] * y
            return x

        def residuals(y: np.ndarray) -> np.ndarray:
            x = step(y)
            mount = self.at.moved(x)
            return np.concatenate([self.misses(x) / sigma, mount.position / ARM_SIGMA, mount.bent])

        def robust(z: np.ndarray) -> np.ndarray:
            """Cauchy's of the misses; what is said of lever arm and lens beforehand must hold however far they are."""
            s = z[: len(self.f)]
            rho = np.stack([z, np.ones_like(z), np.zeros_like(z)])
            rho[:, : len(s)] = np.log1p(s), 1.0 / (1.0 + s), -1.0 / (1.0 + s) ** 2
            return rho

        loss: Any = robust  # which scipy's types do not know of
        # Without bounds a lens of infinite length would fit best whatever moves as nothing else does.
        most = np.append(np.full(len(free) - n, np.inf), np.full(n, MOST_BENT))
        now = np.append(np.zeros(len(free) - n), np.clip(self.at.bent, -0.99 * MOST_BENT, 0.99 * MOST_BENT))
        bounds, scale = (-most - now, most - now), BENDS / np.sqrt(ALIKE)
        first = np.zeros(len(free))
        result = least_squares(residuals, first, bounds=bounds, loss=loss, f_scale=scale, max_nfev=20, ftol=ENOUGH)
        return self.at.moved(step(result.x)), result


def _after(poses: Poses, dt: float) -> tuple[np.ndarray, np.ndarray]:
    return poses.rotation @ so3.exp_many(dt * poses.rate), poses.position + dt * poses.velocity


def extrinsics_on_motion(
    followed: ImagePairs,
    motion: EstimatedMotion,
    starts: Sequence[CameraExtrinsics],
    axis: np.ndarray | None,
    held: np.ndarray,
) -> CameraExtrinsics:
    """The camera that fits best what it `followed`, sought from each of the `starts`, turned all round about `axis`
    (3,) of the IMU where there is one. held (7,): what is not sought, as in `CameraExtrinsics.moved`.

    Raises EstimationError where none fits, or the motion does not show how the camera is turned.
    """
    angles = np.linspace(0.0, 2.0 * np.pi, ANGLES, endpoint=False)
    turns = [np.eye(3)] if axis is None else [so3.exp(a * axis) for a in angles]
    some = followed.every(EVERY)
    least = LEAST_SEEN * _in_common(some, motion) * len(some.times)
    once = [s for s in (_PairResiduals.of(some, motion, start) for start in starts) if len(s.followed.times) > least]
    seen = [replace(s, at=replace(s.at, rotation=T @ s.at.rotation)) for s in once for T in turns]
    if not seen:
        raise EstimationError(
            f"{followed.name}: too few of its images fall within the trajectory of the other sensors; check its clock."
        )
    best = sorted(seen, key=_cost)[:FOLLOWED]
    found = [(*s.sought(held), len(s.f)) for s in best]
    mount, result, _ = min(found, key=lambda x: x[1].cost / x[2])  # not all see the same rays
    for every in ROUNDS:
        mount, result = _PairResiduals.of(followed.every(every), motion, mount).sought(held)
    _check(_PairResiduals.of(followed, motion, mount), result, held)
    return mount


def _in_common(followed: ImagePairs, motion: EstimatedMotion) -> float:
    """The share of its pairs of images that a camera can have made while the motion is known, wherever its clock is."""
    span, known = np.ptp(followed.times), np.ptp(motion.state.seconds)
    return min(1.0, float(known / span)) if span > 0.0 else 1.0


def _cost(seen: _PairResiduals) -> float:
    return float(np.log1p((seen.missed / (BENDS * RAY_SIGMA)) ** 2).mean())


def _check(seen: _PairResiduals, result: OptimizeResult, held: np.ndarray) -> None:
    name = seen.followed.name
    miss = float(np.quantile(np.abs(seen.missed), MOST_RAYS))
    if miss > LARGEST_MISS:
        raise EstimationError(
            f"{name}: its feature tracks contradict the motion of the other sensors (rays miss each other by "
            f"{np.rad2deg(miss):.1f} deg); check that all come from the same recording, and its intrinsics."
        )
    if held[0]:
        return
    sigma = UNITS[:3] * np.sqrt(np.diag(np.linalg.pinv(result.jac.T @ result.jac)))[:3]
    if np.linalg.norm(sigma) > LARGEST_SIGMA:
        raise EstimationError(
            f"{name}: the motion does not determine its rotation; turn the robot about two axes or more and move "
            "along each, or give rotation in the rig file."
        )
