"""Extended unified camera model (EUCM), Kalibr's "eucm"."""

from __future__ import annotations

import numpy as np

from icalib.base.compiled import njit
from icalib.geometry.cameras.base import MIN_DISTANCE, CameraModel


class ExtendedUnified(CameraModel):
    """EUCM (Khomutenko, Garcia and Martinet 2016, eq. 1 to 10).

        d = sqrt(beta (x^2 + y^2) + z^2)
        u = fx x / (alpha d + (1 - alpha) z) + cx,  v = fy y / (alpha d + (1 - alpha) z) + cy

    Parameters: fx, fy, cx, cy, alpha, beta. A point is valid if it is farther than 1 um from the centre and

        alpha d + (1 - alpha) z > 0,  alpha z + (1 - alpha) d > 0

    The second condition means that the image radius grows with the angle. For alpha in [0, 1] and beta > 0 this is the
    range in the paper: z > -d alpha / (1 - alpha) for alpha <= 1/2, and z > -d (1 - alpha) / alpha above. Both
    conditions extend the model beyond alpha = 0 and 1, so that an estimate may pass there. With beta <= 0 only points
    in front, with real d > 0, are valid. Invalid points are projected to (0, 0) with zero Jacobians.
    """

    name = "eucm"
    parameter_names = ("fx", "fy", "cx", "cy", "alpha", "beta")
    start_distortions = ((0.1, 1.0), (0.5, 1.0), (0.7, 1.0))

    def _fill_image(self, params, points, uv, valid) -> None:
        _project(params, points, uv, valid)

    def _fill_jacobians(self, params, points, uv, valid, j_point, j_params) -> None:
        _project_with_jacobians(params, points, uv, valid, j_point, j_params)

    def _fill_rays(self, params, uv, rays, valid) -> None:
        _unproject(params, uv, rays, valid)


@njit(cache=True, nogil=True)
def _depth(alpha, beta, square, z):
    """d, the denominator alpha d + (1 - alpha) z, and whether the point is valid. square: x^2 + y^2."""
    d_square = beta * square + z * z
    if not (d_square > 0.0 and (beta > 0.0 or z > 0.0) and square + z * z > MIN_DISTANCE * MIN_DISTANCE):
        return 1.0, 1.0, False
    d = np.sqrt(d_square)
    depth = alpha * d + (1.0 - alpha) * z
    return d, depth, depth > 0.0 and alpha * z + (1.0 - alpha) * d > 0.0


@njit(cache=True, nogil=True)
def _project(params, points, uv, valid):
    for i in range(len(points)):
        x, y = points[i, 0], points[i, 1]
        _, depth, valid[i] = _depth(params[4], params[5], x * x + y * y, points[i, 2])
        if valid[i]:
            uv[i, 0] = params[0] * (x / depth) + params[2]
            uv[i, 1] = params[1] * (y / depth) + params[3]
        else:
            uv[i] = 0.0


@njit(cache=True, nogil=True)
def _project_with_jacobians(params, points, uv, valid, j_point, j_params):
    fx, fy, alpha, beta = params[0], params[1], params[4], params[5]
    for i in range(len(points)):
        x, y, z = points[i, 0], points[i, 1], points[i, 2]
        square = x * x + y * y
        d, depth, valid[i] = _depth(alpha, beta, square, z)
        if not valid[i]:
            uv[i] = 0.0
            continue
        a, b = x / depth, y / depth
        uv[i, 0], uv[i, 1] = fx * a + params[2], fy * b + params[3]
        depth_x, depth_y, depth_z = alpha * beta * x / d, alpha * beta * y / d, alpha * z / d + 1.0 - alpha
        # d - z without cancellation near the axis.
        depth_alpha = beta * square / (d + z) if z > 0.0 else d - z
        depth_beta = alpha * square / (2.0 * d)
        u_scale, v_scale = fx / depth, fy / depth
        j_point[i, 0, 0], j_point[i, 0, 1] = u_scale * (1.0 - a * depth_x), -u_scale * a * depth_y
        j_point[i, 1, 0], j_point[i, 1, 1] = -v_scale * b * depth_x, v_scale * (1.0 - b * depth_y)
        j_point[i, 0, 2], j_point[i, 1, 2] = -u_scale * a * depth_z, -v_scale * b * depth_z
        j_params[i, 0, 0], j_params[i, 0, 2] = a, 1.0
        j_params[i, 1, 1], j_params[i, 1, 3] = b, 1.0
        j_params[i, 0, 4], j_params[i, 1, 4] = -u_scale * a * depth_alpha, -v_scale * b * depth_alpha
        j_params[i, 0, 5], j_params[i, 1, 5] = -u_scale * a * depth_beta, -v_scale * b * depth_beta


@njit(cache=True, nogil=True, error_model="numpy")  # division by zero gives invalid rays, not an error
def unified_depth(alpha, beta, square):
    """z of the ray (a, b, z) whose normalised image is (a, b), with a^2 + b^2 = `square` (Khomutenko et al., eq. 17).
    NaN if there is no such ray."""
    root = np.sqrt(1.0 - (2.0 * alpha - 1.0) * beta * square)
    # Two forms of the same root, which divide by zero at different values of alpha.
    if 0.0 <= alpha <= 1.0:
        return (1.0 - alpha * alpha * beta * square) / (alpha * root + 1.0 - alpha)
    return (1.0 - alpha - alpha * root) / (1.0 - 2.0 * alpha)


@njit(cache=True, nogil=True, error_model="numpy")  # division by a zero focal length gives invalid rays, not an error
def _unproject(params, uv, rays, valid):
    for i in range(len(uv)):
        a, b = (uv[i, 0] - params[2]) / params[0], (uv[i, 1] - params[3]) / params[1]
        square = a * a + b * b
        z = unified_depth(params[4], params[5], square)
        valid[i] = np.isfinite(square) and np.isfinite(z) and _depth(params[4], params[5], square, z)[2]
        if not valid[i]:
            a, b, z = 0.0, 0.0, 1.0
        norm = np.sqrt(a * a + b * b + z * z)
        rays[i, 0], rays[i, 1], rays[i, 2] = a / norm, b / norm, z / norm
