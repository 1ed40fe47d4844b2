"""Pinhole cameras with OpenCV's rational distortion, which ROS calls "rational_polynomial" (Azure Kinect, Luxonis)."""

from __future__ import annotations

from functools import lru_cache

import numpy as np

from icalib.base.compiled import njit
from icalib.geometry.cameras.base import CameraModel
from icalib.geometry.cameras.radtan import MAX_NEWTON_STEPS, MIN_DEPTH, newton_step

_MAX_ITERATIONS = 100  # of the radius; bisection alone reaches rounding in 60


class PinholeRational(CameraModel):
    """OpenCV's CALIB_RATIONAL_MODEL (calib3d).

        a = x / z,  b = y / z,  s = a^2 + b^2
        d = N / D = (1 + k1 s + k2 s^2 + k3 s^3) / (1 + k4 s + k5 s^2 + k6 s^3)
        u = fx (a d + 2 p1 a b + p2 (s + 2 a^2)) + cx
        v = fy (b d + p1 (s + 2 b^2) + 2 p2 a b) + cy

    Parameters, in OpenCV's order: fx, fy, cx, cy, k1, k2, p1, p2, k3, k4, k5, k6. A point is valid if z > 1 um, and r =
    sqrt(s) is below the first extremum or pole of r d(r^2). Invalid points are projected to (0, 0) with zero Jacobians.
    """

    name = "pinhole-rational"
    parameter_names = ("fx", "fy", "cx", "cy", "k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6")
    start_distortions = ((0.0,) * 8,)
    # Numerator and denominator nearly cancel: coefficients can differ by 1 while projections differ by 0.01 px only.
    distortion_scale = 10.0

    def _fill_image(self, params, points, uv, valid) -> None:
        _project(params, points, _limit(params), uv, valid)

    def _fill_jacobians(self, params, points, uv, valid, j_point, j_params) -> None:
        _project_with_jacobians(params, points, _limit(params), uv, valid, j_point, j_params)

    def _fill_rays(self, params, uv, rays, valid) -> None:
        _unproject(params, uv, _limit(params), rays, valid)


def _limit(params: np.ndarray) -> float:
    """`monotonic_limit` for parameters (12,) of the model."""
    return monotonic_limit(tuple(params[[4, 5, 8]].tolist()), tuple(params[9:].tolist()))


@lru_cache(maxsize=64)  # called once for each chunk of points, with the same coefficients
def monotonic_limit(numerator: tuple[float, ...], denominator: tuple[float, ...]) -> float:
    """The smallest r > 0 at which r N(r^2) / D(r^2) has an extremum or a pole; inf if there is none.

    r is the tangent of the angle to the optical axis. numerator (n_1, n_2, ...): N(s) = 1 + n_1 s + n_2 s^2 + ...;
    denominator likewise. The derivative is (N D + 2 s (N' D - N D')) / D^2 at s = r^2. Returns 0 if a coefficient, also
    of the derivative's numerator, is not finite.
    """
    N, D = np.array([1.0, *numerator]), np.array([1.0, *denominator])
    with np.errstate(over="ignore", invalid="ignore"):
        slope = np.convolve(N, D)
        slope[1:] += 2.0 * (np.convolve(_derivative(N), D) - np.convolve(N, _derivative(D)))
    if not (np.isfinite(slope).all() and np.isfinite(D).all()):
        return 0.0
    return float(np.sqrt(min(_smallest_root(slope), _smallest_root(D))))


def _derivative(coefficients: np.ndarray) -> np.ndarray:
    """(n - 1,) coefficients of a polynomial's derivative, lowest power first as those (n,) of the polynomial."""
    return np.arange(1, len(coefficients)) * coefficients[1:]


def _smallest_root(coefficients: np.ndarray) -> float:
    """The smallest positive root of 1 + c_1 s + c_2 s^2 + ..., for coefficients (1, c_1, c_2, ...); inf if there is
    none.

    numpy.roots expects the highest power first, and therefore returns the roots in w = 1 / s. The polynomial is monic
    in w, so that vanishing leading coefficients need no special case.
    """
    inverses = np.roots(coefficients)
    positive = inverses.real[(inverses.imag == 0.0) & (inverses.real > 0.0)]
    return float(1.0 / positive.max()) if len(positive) else np.inf


@njit(cache=True, nogil=True, error_model="numpy")
def _radial(params, s):
    """d = N / D, 1 / D, and the derivative of d by s, at s = r^2."""
    numerator = 1.0 + s * (params[4] + s * (params[5] + s * params[8]))
    inverse = 1.0 / (1.0 + s * (params[9] + s * (params[10] + s * params[11])))
    n_slope = params[4] + s * (2.0 * params[5] + s * 3.0 * params[8])
    d_slope = params[9] + s * (2.0 * params[10] + s * 3.0 * params[11])
    d = numerator * inverse
    return d, inverse, (n_slope - d * d_slope) * inverse


@njit(cache=True, nogil=True, error_model="numpy")
def _distort(params, a, b):
    """Distorted (a, b); their derivatives by (a, b) as aa, ab (= ba), bb; d = N / D; and 1 / D."""
    p1, p2 = params[6], params[7]
    s = a * a + b * b
    d, inverse, slope = _radial(params, s)
    slope *= 2.0
    distorted_a = a * d + 2.0 * p1 * a * b + p2 * (s + 2.0 * a * a)
    distorted_b = b * d + p1 * (s + 2.0 * b * b) + 2.0 * p2 * a * b
    j_aa = d + a * a * slope + 2.0 * p1 * b + 6.0 * p2 * a
    j_ab = a * b * slope + 2.0 * p1 * a + 2.0 * p2 * b
    j_bb = d + b * b * slope + 6.0 * p1 * b + 2.0 * p2 * a
    return distorted_a, distorted_b, j_aa, j_ab, j_bb, d, inverse


@njit(cache=True, nogil=True, error_model="numpy")
def _on_plane(points, i, limit):
    """a = x / z, b = y / z, 1 / z of point i, and whether it is valid."""
    z = points[i, 2]
    inverse_z = 1.0 / z if z > MIN_DEPTH else 0.0
    a, b = points[i, 0] * inverse_z, points[i, 1] * inverse_z
    return a, b, inverse_z, z > MIN_DEPTH and a * a + b * b < limit * limit


@njit(cache=True, nogil=True, error_model="numpy")
def _project(params, points, limit, uv, valid):
    for i in range(len(points)):
        a, b, _, valid[i] = _on_plane(points, i, limit)
        uv[i] = 0.0
        if valid[i]:
            distorted_a, distorted_b, _, _, _, _, _ = _distort(params, a, b)
            uv[i, 0] = params[0] * distorted_a + params[2]
            uv[i, 1] = params[1] * distorted_b + params[3]


@njit(cache=True, nogil=True, error_model="numpy")
def _project_with_jacobians(params, points, limit, uv, valid, j_point, j_params):
    fx, fy = params[0], params[1]
    for i in range(len(points)):
        a, b, inverse_z, valid[i] = _on_plane(points, i, limit)
        if not valid[i]:
            uv[i] = 0.0
            continue
        distorted_a, distorted_b, j_aa, j_ab, j_bb, d, inverse = _distort(params, a, b)
        uv[i, 0], uv[i, 1] = fx * distorted_a + params[2], fy * distorted_b + params[3]
        scale_u, scale_v = fx * inverse_z, fy * inverse_z
        j_point[i, 0, 0], j_point[i, 0, 1] = scale_u * j_aa, scale_u * j_ab
        j_point[i, 1, 0], j_point[i, 1, 1] = scale_v * j_ab, scale_v * j_bb
        j_point[i, 0, 2] = -scale_u * (a * j_aa + b * j_ab)
        j_point[i, 1, 2] = -scale_v * (a * j_ab + b * j_bb)
        s = a * a + b * b
        j_params[i, 0, 0], j_params[i, 0, 2] = distorted_a, 1.0
        j_params[i, 1, 1], j_params[i, 1, 3] = distorted_b, 1.0
        j_params[i, 0, 6], j_params[i, 0, 7] = 2.0 * fx * a * b, fx * (s + 2.0 * a * a)
        j_params[i, 1, 6], j_params[i, 1, 7] = fy * (s + 2.0 * b * b), 2.0 * fy * a * b
        by_u, by_v = fx * a * inverse, fy * b * inverse  # d (u, v) / d N; d (u, v) / d D is -d times this
        j_params[i, 0, 4], j_params[i, 0, 5], j_params[i, 0, 8] = by_u * s, by_u * s * s, by_u * s * s * s
        j_params[i, 1, 4], j_params[i, 1, 5], j_params[i, 1, 8] = by_v * s, by_v * s * s, by_v * s * s * s
        by_u, by_v = -d * by_u, -d * by_v
        j_params[i, 0, 9], j_params[i, 0, 10], j_params[i, 0, 11] = by_u * s, by_u * s * s, by_u * s * s * s
        j_params[i, 1, 9], j_params[i, 1, 10], j_params[i, 1, 11] = by_v * s, by_v * s * s, by_v * s * s * s


@njit(cache=True, nogil=True, error_model="numpy")
def _undistorted_radius(params, distorted, limit):
    """The r below `limit` with r d(r^2) = distorted, by Newton's method in a bracket; close to the limit if there is no
    solution."""
    low, high = 0.0, limit
    if limit == np.inf:
        high = 1.0 + distorted
        while high * _radial(params, high * high)[0] < distorted:
            high *= 2.0
    r = min(distorted, 0.5 * (low + high))
    for _ in range(_MAX_ITERATIONS):
        d, _, slope = _radial(params, r * r)
        value = r * d
        if value < distorted:
            low = r
        else:
            high = r
        following = r + (distorted - value) / (d + 2.0 * r * r * slope)
        if not low <= following <= high:
            following = 0.5 * (low + high)
        if abs(following - r) <= 2e-16 * r:
            return following
        r = following
    return r


@njit(cache=True, nogil=True, error_model="numpy")
def _undistort(params, limit, distorted_a, distorted_b):
    """The undistorted (a, b), and whether Newton's method converged to a point in the monotonic range.

    It starts from the solution without tangential distortion.
    """
    distorted_r = np.hypot(distorted_a, distorted_b)
    # The radial slope is zero at the limit; 0.9 leaves a margin for tangential terms that exceed it slightly.
    r = min(_undistorted_radius(params, distorted_r, limit), 0.9 * limit)
    scale = r / distorted_r if distorted_r > 0.0 else 1.0
    a, b = scale * distorted_a, scale * distorted_b
    for _ in range(MAX_NEWTON_STEPS):
        value_a, value_b, j_aa, j_ab, j_bb, _, _ = _distort(params, a, b)
        is_folded, step_a, step_b = newton_step(value_a - distorted_a, value_b - distorted_b, j_aa, j_ab, j_bb)
        if is_folded:
            return a, b, False
        a, b = a - step_a, b - step_b
        if abs(step_a) + abs(step_b) <= 1e-14 * (1.0 + abs(a) + abs(b)):
            return a, b, a * a + b * b < limit * limit
    return a, b, False


@njit(cache=True, nogil=True, error_model="numpy")  # division by a zero focal length gives invalid rays, not an error
def _unproject(params, uv, limit, rays, valid):
    for i in range(len(uv)):
        mx, my = (uv[i, 0] - params[2]) / params[0], (uv[i, 1] - params[3]) / params[1]
        a, b, valid[i] = 0.0, 0.0, False
        if np.isfinite(mx) and np.isfinite(my) and limit > 0.0:
            a, b, valid[i] = _undistort(params, limit, mx, my)
        if not valid[i]:
            a, b = 0.0, 0.0
        norm = np.sqrt(1.0 + a * a + b * b)
        rays[i, 0], rays[i, 1], rays[i, 2] = a / norm, b / norm, 1.0 / norm
