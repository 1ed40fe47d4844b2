"""How a camera turned from image to image, from the points that it followed: epipolar geometry, no guess needed."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np

from icalib.base.compiled import njit
from icalib.errors import EstimationError
from icalib.geometry import so3
from icalib.geometry.cameras.base import CameraModel
from icalib.geometry.small import solve_definite
from icalib.initialize.steps.rate_correlation import SensorRates
from icalib.sensors.camera.stream import TrackStream, shared_rows

MIN_SHARED_POINTS = 12  # points in two images
MIN_TRACK_RATES = 20
SAMPLED_PAIRS = 30  # that tell how long points are followed
MIN_TRACK_RATE_CORRELATION = 0.5  # with the IMU's rates; these here are noisy
EPIPOLAR_ITERATIONS = 10
DIRECTION_ITERATIONS = 4
TRACK_RATE_STEP_S = 0.4  # between images: over less, turning and moving sideways look alike
THINNED_STEP_SHARE = 0.3  # of an interval that the next one begins later, at most: those between say little more
NOISE_EVERY = 5  # so many rates, the noise of one
EPIPOLAR_DAMPING = 1e-9  # of the mean diagonal: a camera that does not move has no direction of motion


@njit(cache=True, nogil=True)
def _tangent_basis(t, a, b):
    """Two unit vectors at right angles to t."""
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
def _epipolar_sums(f, h, f_by, h_by, R, t, a, b, A, x):
    """A (5 + L, 5 + L) and x (5 + L,): normal equations of a left turn of R, of t along a and b, and of the lens along
    its L slopes f_by and h_by (n, L, 3) of the rays, for e = t . (R f x h) by its own standard deviation, Cauchy's
    weights of the median error. Returns the sum of the weighted squares of the errors [rad^2]."""
    n, m = len(f), f_by.shape[1]
    g, c, e, spread, row = np.empty((n, 3)), np.empty((n, 3)), np.empty(n), np.empty(n), np.empty(5 + m)
    for i in range(n):
        for r in range(3):
            g[i, r] = R[r, 0] * f[i, 0] + R[r, 1] * f[i, 1] + R[r, 2] * f[i, 2]
        c[i, 0] = g[i, 1] * h[i, 2] - g[i, 2] * h[i, 1]
        c[i, 1] = g[i, 2] * h[i, 0] - g[i, 0] * h[i, 2]
        c[i, 2] = g[i, 0] * h[i, 1] - g[i, 1] * h[i, 0]
        tg = t[0] * g[i, 0] + t[1] * g[i, 1] + t[2] * g[i, 2]
        th = t[0] * h[i, 0] + t[1] * h[i, 1] + t[2] * h[i, 2]
        spread[i] = np.sqrt(max(2.0 - tg * tg - th * th, 1e-4))
        e[i] = (t[0] * c[i, 0] + t[1] * c[i, 1] + t[2] * c[i, 2]) / spread[i]
    scale, left = 3.0 * np.median(np.abs(e)) + 1e-12, 0.0
    _tangent_basis(t, a, b)
    A[:] = 0.0
    x[:] = 0.0
    for i in range(n):
        m0, m1 = h[i, 1] * t[2] - h[i, 2] * t[1], h[i, 2] * t[0] - h[i, 0] * t[2]
        m2 = h[i, 0] * t[1] - h[i, 1] * t[0]
        row[0], row[1] = g[i, 1] * m2 - g[i, 2] * m1, g[i, 2] * m0 - g[i, 0] * m2
        row[2] = g[i, 0] * m1 - g[i, 1] * m0
        row[3] = a[0] * c[i, 0] + a[1] * c[i, 1] + a[2] * c[i, 2]
        row[4] = b[0] * c[i, 0] + b[1] * c[i, 1] + b[2] * c[i, 2]
        for j in range(m):
            # t . (R f_by x h + R f x h_by), with m = h x t and t x R f.
            row[5 + j] = 0.0
            for r in range(3):
                by = R[r, 0] * f_by[i, j, 0] + R[r, 1] * f_by[i, j, 1] + R[r, 2] * f_by[i, j, 2]
                row[5 + j] += by * (m0 if r == 0 else m1 if r == 1 else m2)
                p, q = (r + 1) % 3, (r + 2) % 3
                row[5 + j] += h_by[i, j, r] * (t[p] * g[i, q] - t[q] * g[i, p])
        w = 1.0 / (1.0 + (e[i] / scale) ** 2)
        left += w * e[i] ** 2
        for r in range(5 + m):
            row[r] /= spread[i]
            x[r] -= w * row[r] * e[i]
            for k in range(r + 1):
                A[r, k] += w * row[r] * row[k]
    for r in range(5 + m):
        for k in range(r):
            A[k, r] = A[r, k]
    return left


@njit(cache=True, nogil=True)
def _move_direction(t, a, b, da, db):
    """t turned by da along a and db along b, half a radian at most."""
    size = np.sqrt(da * da + db * db)
    shorter = 0.5 / size if size > 0.5 else 1.0
    for r in range(3):
        t[r] += shorter * (da * a[r] + db * b[r])
    norm = np.sqrt(t[0] * t[0] + t[1] * t[1] + t[2] * t[2])
    for r in range(3):
        t[r] /= norm


@njit(cache=True, nogil=True)
def refine_relative_pose(f, h, R, t):
    """R and t (unit), improved: rays f (n, 3) and h (n, 3) of the same points in two images lie in planes with t,
    h ~ R f + s t. Returns the sum of the weighted squares of the errors [rad^2] before the last step, infinite where
    that is singular."""
    a, b, A, x, stiff = np.empty(3), np.empty(3), np.empty((5, 5)), np.empty(5), np.empty((len(f), 0, 3))
    left = np.inf
    for _ in range(EPIPOLAR_ITERATIONS):
        left = _epipolar_sums(f, h, stiff, stiff, R, t, a, b, A, x)
        mean = EPIPOLAR_DAMPING * (A[0, 0] + A[1, 1] + A[2, 2])
        for r in range(5):
            A[r, r] += mean
        if not solve_definite(A, x):
            return np.inf
        R[:] = so3.exp(x[:3].copy()) @ R
        _move_direction(t, a, b, x[3], x[4])
    return left


@njit(cache=True, nogil=True)
def _direction_step(A, x, y):
    """Solves the part of A (5, 5) that belongs to the direction for (x, y)."""
    mean = EPIPOLAR_DAMPING * (A[0, 0] + A[1, 1] + A[2, 2])
    p, q, r = A[3, 3] + mean, A[3, 4], A[4, 4] + mean
    inverse = 1.0 / (p * r - q * q)
    return inverse * (r * x - q * y), inverse * (p * y - q * x)


@njit(cache=True, nogil=True)
def rotation_information(f, h, f_by, h_by, R, t, H, g):
    """H (3 + L, 3 + L) and g (3 + L,): what two images say of a left turn of R and of the lens, and what step they ask
    for, H step = g; the direction of motion t is found on the way. Returns the sum of the weighted squares of the
    errors [rad^2]."""
    a, b, A, x, stiff = np.empty(3), np.empty(3), np.empty((5, 5)), np.empty(5), np.empty((len(f), 0, 3))
    for _ in range(DIRECTION_ITERATIONS):
        _epipolar_sums(f, h, stiff, stiff, R, t, a, b, A, x)
        u, v = _direction_step(A, x[3], x[4])
        _move_direction(t, a, b, u, v)
    n = 5 + f_by.shape[1]
    A, x = np.empty((n, n)), np.empty(n)
    left = _epipolar_sums(f, h, f_by, h_by, R, t, a, b, A, x)
    for i in range(n - 2):
        r = i if i < 3 else i + 2
        u, v = _direction_step(A, A[3, r], A[4, r])
        g[i] = x[r] - u * x[3] - v * x[4]
        for k in range(n - 2):
            c = k if k < 3 else k + 2
            H[i, k] = A[r, c] - u * A[3, c] - v * A[4, c]
    return left


@njit(cache=True, nogil=True)
def direction_for_rotation(f, h, R):
    """(3,) the direction of motion that rays f and h leave once turned by R."""
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
def rotation_information_of_pairs(f, h, f_by, h_by, begin, R, H, g, left):
    """H (M, 3 + L, 3 + L), g (M, 3 + L) and left (M,) of `turn_information` for pairs of images with turns
    R (M, 3, 3); rays of pair i are begin[i]..begin[i + 1] of f and h (n, 3), and of their slopes (n, L, 3)."""
    for i in range(len(R)):
        own = slice(begin[i], begin[i + 1])
        t = direction_for_rotation(f[own], h[own], R[i])
        left[i] = rotation_information(f[own], h[own], f_by[own], h_by[own], R[i], t, H[i], g[i])


def rotation_without_translation(f: np.ndarray, h: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The turn that brings rays f nearest to h, and the direction of motion that is left."""
    U, _, Vt = np.linalg.svd(h.T @ f)
    R = U @ np.diag([1.0, 1.0, np.sign(np.linalg.det(U @ Vt))]) @ Vt
    return np.ascontiguousarray(R), direction_for_rotation(f, h, R)


def track_rates(
    stream: TrackStream,
    model: CameraModel,
    params: np.ndarray,
    step: float = TRACK_RATE_STEP_S,
    thinned: bool = False,
    chained: bool = False,
) -> SensorRates:
    """Mean angular rates from images to the ones about `step` s later, with their noise, from how far rays miss their
    epipolar planes; `thinned`: not from every image, where intervals overlap much; `chained`: sought from the turn of
    the interval before, too. Raises EstimationError where hardly any images share enough points."""
    rays, valid = model.unproject(params, stream.uv)
    t, found, noise, before = stream.seconds, [], [], None
    every = max(1, int(THINNED_STEP_SHARE * step / float(np.median(np.diff(t))))) if thinned else 1
    for i, j in image_pairs(stream, step)[::every]:
        p, q = shared_points(stream, valid, i, j)
        if len(p) < MIN_SHARED_POINTS:
            continue
        f, h = rays[p], rays[q]
        left, R, direction = _best_relative_pose(f, h, before)
        if np.isfinite(left):
            before = (R, direction) if chained else None
            found.append((t[i], t[j], *(-so3.log(R) / (t[j] - t[i]))))
            if len(found) % NOISE_EVERY == 0:
                noise.append(rotation_error(f, h, R, direction)[0] / (t[j] - t[i]))
    if len(found) < MIN_TRACK_RATES:
        raise EstimationError(
            f"{stream.name}: only {len(found)} pairs of images {step:.2g} s apart share {MIN_SHARED_POINTS} "
            "tracked points or more; record for longer, or with longer feature tracks."
        )
    rows = np.array(found)
    start, end, rate = rows[:, 0].copy(), rows[:, 1].copy(), rows[:, 2:].copy()
    return SensorRates(start, end, rate, MIN_TRACK_RATE_CORRELATION, noise=float(np.median(noise)))


def _best_relative_pose(
    f: np.ndarray, h: np.ndarray, before: tuple[np.ndarray, np.ndarray] | None
) -> tuple[float, np.ndarray, np.ndarray]:
    """What is left, and turn and direction of two images, from the turn that fits best without any motion, or where
    there are some from those of the two images `before`, whichever leaves less."""
    found = []
    for start in (rotation_without_translation(f, h), before):
        if start is not None:
            R, t = start[0].copy(), start[1].copy()
            found.append((refine_relative_pose(f, h, R, t), R, t))
    return min(found, key=lambda x: x[0])


def rotation_error(f: np.ndarray, h: np.ndarray, R: np.ndarray, t: np.ndarray) -> tuple[float, float]:
    """Standard deviation [rad] of a turn about each axis, RMS over the axes, and of a ray across its epipolar plane."""
    H, g, stiff = np.empty((3, 3)), np.empty(3), np.empty((len(f), 0, 3))
    left = rotation_information(f, h, stiff, stiff, R, t.copy(), H, g)
    H[range(3), range(3)] += EPIPOLAR_DAMPING * np.trace(H)
    return float(np.sqrt(left / len(f) * np.trace(np.linalg.inv(H)) / 3.0)), float(np.sqrt(left / len(f)))


def image_pairs(stream: TrackStream, step: float) -> list[tuple[int, int]]:
    """Each image and the one about `step` seconds later."""
    t = stream.seconds
    after = np.searchsorted(t, t + step - 0.5 * float(np.median(np.diff(t))))
    return [(i, int(j)) for i, j in enumerate(after) if i < j < len(t)]


def pairs_with_shared_points(
    stream: TrackStream, valid: np.ndarray, steps: Sequence[float], most: int
) -> Iterator[tuple[int, int, np.ndarray, np.ndarray]]:
    """About `most` pairs of images for each of the `steps` between them that share points enough, and their rows, as
    `common` has them. Where points are lost before the first of the steps, all are halved until they are not."""
    for step in _shortened_steps(stream, valid, steps):
        every = image_pairs(stream, step)
        for i, j in every[:: max(1, len(every) // most)]:
            p, q = shared_points(stream, valid, i, j)
            if len(p) >= MIN_SHARED_POINTS:
                yield i, j, p, q


def _shortened_steps(stream: TrackStream, valid: np.ndarray, steps: Sequence[float]) -> Sequence[float]:
    """The steps, or a half, a quarter or an eighth of them: the longest of which half of the pairs share points enough
    at the first."""
    for shorter in (1.0, 0.5, 0.25, 0.125):
        every = image_pairs(stream, shorter * steps[0])
        some = every[:: max(1, len(every) // SAMPLED_PAIRS)]
        enough = sum(len(shared_points(stream, valid, i, j)[0]) >= MIN_SHARED_POINTS for i, j in some)
        if 2 * enough > len(some):
            return [shorter * step for step in steps]
    return steps


def shared_points(stream: TrackStream, valid: np.ndarray, i: int, j: int) -> tuple[np.ndarray, np.ndarray]:
    """Rows of the points that images i and j share, as i and as j saw them."""
    p, q = shared_rows(stream.start, stream.feature, i, j)
    seen = valid[p] & valid[q]
    return p[seen], q[seen]
