"""Pinhole cameras with radial-tangential distortion, as in OpenCV and Kalibr ("radtan", Brown-Conrady).

Pinhole camera with radial-tangential distortion of five coefficients, ROS's "plumb_bob" and OpenCV's default.
"""

from __future__ import annotations

import numpy as np

from icalib.base.compiled import njit
from icalib.geometry.cameras import radial
from icalib.geometry.cameras.base import CameraModel

MIN_DEPTH = 1e-6  # m; points with smaller z are invalid
MAX_NEWTON_STEPS = 30  # of the unprojection; pixels that need more are invalid


class RadialTangential(CameraModel):
    """Brown-Conrady model (OpenCV, calib3d, "radial" and "tangential"), with k3 = 0 for four coefficients.

        a = x / z,  b = y / z,  s = a^2 + b^2,  d = 1 + k1 s + k2 s^2 + k3 s^3
        u = fx (a d + 2 p1 a b + p2 (s + 2 a^2)) + cx
        v = fy (b d + p1 (s + 2 b^2) + 2 p2 a b) + cy

    Parameters: fx, fy, cx, cy, k1, k2, p1, p2 and, for five coefficients, k3. A point is valid if z > 1 um, and r =
    sqrt(s) is below the first zero of 1 + 3 k1 r^2 + 5 k2 r^4 + 7 k3 r^6. Invalid points are projected to (0, 0) with
    zero Jacobians.
    """

    def _fill_image(self, params, points, uv, valid) -> None:
        _project(params, points, radial.monotonic_limit(_radial_coefficients(params)), uv, valid)

    def _fill_jacobians(self, params, points, uv, valid, j_point, j_params) -> None:
        limit = radial.monotonic_limit(_radial_coefficients(params))
        _project_with_jacobians(params, points, limit, uv, valid, j_point, j_params)

    def _fill_rays(self, params, uv, rays, valid) -> None:
        coefficients = _radial_coefficients(params)
        _unproject(params, coefficients, uv, radial.monotonic_limit(coefficients), rays, valid)


class PinholeRadtan(RadialTangential):
    """Radial-tangential distortion with two radial coefficients: Kalibr's "radtan"."""

    name = "pinhole-radtan"
    parameter_names = ("fx", "fy", "cx", "cy", "k1", "k2", "p1", "p2")
    start_distortions = ((0.0, 0.0, 0.0, 0.0),)


def _radial_coefficients(params: np.ndarray) -> np.ndarray:
    """(k1, k2) or (k1, k2, k3). In OpenCV's order, p1 and p2 are between k2 and k3."""
    return np.concatenate([params[4:6], params[8:]])


@njit(cache=True, nogil=True)
def _third_coefficient(params):
    return params[8] if len(params) > 8 else 0.0


@njit(cache=True, nogil=True)
def distort(params, k3, a, b):
    """Distorted (a, b), and their derivatives by (a, b) as aa, ab (= ba), bb; the Jacobian of this distortion is
    symmetric."""
    k1, k2, p1, p2 = params[4], params[5], params[6], params[7]
    s = a * a + b * b
    # Not Horner's scheme: its longer chain of dependent products makes the model without k3 8 % slower.
    d = 1.0 + s * k1 + s * s * (k2 + s * k3)
    slope = 2.0 * k1 + s * (4.0 * k2 + s * (6.0 * k3))
    distorted_a = a * d + 2.0 * p1 * a * b + p2 * (s + 2.0 * a * a)
    distorted_b = b * d + p1 * (s + 2.0 * b * b) + 2.0 * p2 * a * b
    j_aa = d + a * a * slope + 2.0 * p1 * b + 6.0 * p2 * a
    j_ab = a * b * slope + 2.0 * p1 * a + 2.0 * p2 * b
    j_bb = d + b * b * slope + 6.0 * p1 * b + 2.0 * p2 * a
    return distorted_a, distorted_b, j_aa, j_ab, j_bb


@njit(cache=True, nogil=True)
def _project(params, points, limit, uv, valid):
    k3 = _third_coefficient(params)
    for i in range(len(points)):
        z = points[i, 2]
        inverse_z = 1.0 / z if z > MIN_DEPTH else 0.0
        a, b = points[i, 0] * inverse_z, points[i, 1] * inverse_z
        valid[i] = z > MIN_DEPTH and a * a + b * b < limit * limit
        if valid[i]:
            distorted_a, distorted_b, _, _, _ = distort(params, k3, a, b)
            uv[i, 0] = params[0] * distorted_a + params[2]
            uv[i, 1] = params[1] * distorted_b + params[3]
        else:
            uv[i] = 0.0


@njit(cache=True, nogil=True)
def _project_with_jacobians(params, points, limit, uv, valid, j_point, j_params):
    fx, fy, k3 = params[0], params[1], _third_coefficient(params)
    for i in range(len(points)):
        z = points[i, 2]
        inverse_z = 1.0 / z if z > MIN_DEPTH else 0.0
        a, b = points[i, 0] * inverse_z, points[i, 1] * inverse_z
        s = a * a + b * b
        valid[i] = z > MIN_DEPTH and s < limit * limit
        if not valid[i]:
            uv[i] = 0.0
            continue
        distorted_a, distorted_b, j_aa, j_ab, j_bb = distort(params, k3, a, b)
        uv[i, 0], uv[i, 1] = fx * distorted_a + params[2], fy * distorted_b + params[3]
        scale_u, scale_v = fx * inverse_z, fy * inverse_z
        j_point[i, 0, 0], j_point[i, 0, 1] = scale_u * j_aa, scale_u * j_ab
        j_point[i, 1, 0], j_point[i, 1, 1] = scale_v * j_ab, scale_v * j_bb
        j_point[i, 0, 2] = -scale_u * (a * j_aa + b * j_ab)
        j_point[i, 1, 2] = -scale_v * (a * j_ab + b * j_bb)
        j_params[i, 0, 0], j_params[i, 0, 2] = distorted_a, 1.0
        j_params[i, 0, 4], j_params[i, 0, 5] = fx * a * s, fx * a * s * s
        j_params[i, 0, 6], j_params[i, 0, 7] = 2.0 * fx * a * b, fx * (s + 2.0 * a * a)
        j_params[i, 1, 1], j_params[i, 1, 3] = distorted_b, 1.0
        j_params[i, 1, 4], j_params[i, 1, 5] = fy * b * s, fy * b * s * s
        j_params[i, 1, 6], j_params[i, 1, 7] = fy * (s + 2.0 * b * b), 2.0 * fy * a * b
        if len(params) > 8:
            j_params[i, 0, 8], j_params[i, 1, 8] = fx * a * s * s * s, fy * b * s * s * s


@njit(cache=True, nogil=True, error_model="numpy")
def newton_step(error_a, error_b, j_aa, j_ab, j_bb):
    """Whether the determinant of the symmetric Jacobian is not positive (singular, or orientation reversed); and the
    Newton step to subtract from (a, b)."""
    determinant = j_aa * j_bb - j_ab * j_ab
    step_a = (j_bb * error_a - j_ab * error_b) / determinant
    step_b = (j_aa * error_b - j_ab * error_a) / determinant
    return not determinant > 0.0, step_a, step_b


@njit(cache=True, nogil=True)
def undistort(params, coefficients, limit, distorted_a, distorted_b):
    """Undistorted (a, b), and whether Newton's method converged in the monotonic range. It starts from the solution
    without tangential distortion."""
    distorted_r = np.hypot(distorted_a, distorted_b)
    # The radial slope is zero at the limit; 0.9 leaves a margin for tangential terms that exceed it slightly.
    r = min(radial.invert(coefficients, distorted_r, limit), 0.9 * limit)
    scale = r / distorted_r if distorted_r > 0.0 else 1.0
    a, b = scale * distorted_a, scale * distorted_b
    k3 = _third_coefficient(params)
    for _ in range(MAX_NEWTON_STEPS):
        value_a, value_b, j_aa, j_ab, j_bb = distort(params, k3, a, b)
        is_folded, step_a, step_b = newton_step(value_a - distorted_a, value_b - distorted_b, j_aa, j_ab, j_bb)
        if is_folded:
            return a, b, False
        a, b = a - step_a, b - step_b
        if abs(step_a) + abs(step_b) <= 1e-14 * (1.0 + abs(a) + abs(b)):
            return a, b, a * a + b * b < limit * limit
    return a, b, False


@njit(cache=True, nogil=True, error_model="numpy")  # division by a zero focal length gives invalid rays, not an error
def _unproject(params, coefficients, uv, limit, rays, valid):
    for i in range(len(uv)):
        mx, my = (uv[i, 0] - params[2]) / params[0], (uv[i, 1] - params[3]) / params[1]
        a, b, valid[i] = 0.0, 0.0, False
        if np.isfinite(mx) and np.isfinite(my):
            a, b, valid[i] = undistort(params, coefficients, limit, mx, my)
        if not valid[i]:
            a, b = 0.0, 0.0
        norm = np.sqrt(1.0 + a * a + b * b)
        rays[i, 0], rays[i, 1], rays[i, 2] = a / norm, b / norm, 1.0 / norm


class PinholeRadtan5(RadialTangential):
    """Radial-tangential distortion with a third radial coefficient, for lenses that two do not describe in the image
    corners.

    k3 is the last parameter, as in OpenCV's distCoeffs and ROS's CameraInfo.D.
    """

    name = "pinhole-radtan5"
    parameter_names = ("fx", "fy", "cx", "cy", "k1", "k2", "p1", "p2", "k3")
    start_distortions = ((0.0, 0.0, 0.0, 0.0, 0.0),)
