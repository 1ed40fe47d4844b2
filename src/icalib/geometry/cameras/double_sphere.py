"""Double sphere camera model, Kalibr's "ds"."""

from __future__ import annotations

import numpy as np

from icalib.base.compiled import njit
from icalib.geometry.cameras.base import MIN_DISTANCE, CameraModel
from icalib.geometry.cameras.eucm import unified_depth


class DoubleSphere(CameraModel):
    """Double sphere model (Usenko, Demmel and Cremers 2018, eq. 40 to 42).

        d1 = sqrt(x^2 + y^2 + z^2),  s = xi d1 + z,  d2 = sqrt(x^2 + y^2 + s^2)
        u = fx x / (alpha d2 + (1 - alpha) s) + cx,  v = fy y / (alpha d2 + (1 - alpha) s) + cy

    Parameters: fx, fy, cx, cy, xi, alpha, as in the paper, so that the scale at the optical axis is fx / (1 + xi). A
    point is valid if it is farther than 1 um from the centre and

        d1 + xi z > 0,  alpha d2 + (1 - alpha) s > 0,  alpha s + (1 - alpha) d2 > 0

    Then the denominator is positive and the image radius grows with the angle. For xi = 0 this is the range in the
    paper (eq. 43 to 45). For other xi the w2 of the paper is not exact: at xi = -0.5, alpha = 1 / 11, it admits points
    of negative depth. The conditions extend the model beyond xi in (-1, 1) and alpha in [0, 1], so that an estimate may
    pass there. Invalid points are projected to (0, 0) with zero Jacobians.
    """

    name = "double-sphere"
    parameter_names = ("fx", "fy", "cx", "cy", "xi", "alpha")
    # The cost has a second, wrong local minimum with xi of opposite sign; starts near both find the right one.
    start_distortions = ((-0.2, 0.5), (0.0, 0.5), (0.3, 0.7))

    def _fill_image(self, params, points, uv, valid) -> None:
        _project(params, points, uv, valid)

    def _fill_jacobians(self, params, points, uv, valid, j_point, j_params) -> None:
        _project_with_jacobians(params, points, uv, valid, j_point, j_params)

    def _fill_rays(self, params, uv, rays, valid) -> None:
        _unproject(params, uv, rays, valid)


@njit(cache=True, nogil=True)
def _depth(xi, alpha, square, z):
    """d1, s, d2, the denominator, and whether the point is valid. square: x^2 + y^2."""
    d1 = np.sqrt(square + z * z)
    s = xi * d1 + z
    d2 = np.sqrt(square + s * s)
    depth = alpha * d2 + (1.0 - alpha) * s
    valid = d1 > MIN_DISTANCE and d1 + xi * z > 0.0 and depth > 0.0 and alpha * s + (1.0 - alpha) * d2 > 0.0
    return d1, s, d2, depth, valid


@njit(cache=True, nogil=True)
def _project(params, points, uv, valid):
    for i in range(len(points)):
        x, y = points[i, 0], points[i, 1]
        _, _, _, depth, valid[i] = _depth(params[4], params[5], x * x + y * y, points[i, 2])
        if valid[i]:
            uv[i, 0] = params[0] * (x / depth) + params[2]
            uv[i, 1] = params[1] * (y / depth) + params[3]
        else:
            uv[i] = 0.0


@njit(cache=True, nogil=True)
def _project_with_jacobians(params, points, uv, valid, j_point, j_params):
    fx, fy, xi, alpha = params[0], params[1], params[4], params[5]
    for i in range(len(points)):
        x, y, z = points[i, 0], points[i, 1], points[i, 2]
        square = x * x + y * y
        d1, s, d2, depth, valid[i] = _depth(xi, alpha, square, z)
        if not valid[i]:
            uv[i] = 0.0
            continue
        a, b = x / depth, y / depth
        uv[i, 0], uv[i, 1] = fx * a + params[2], fy * b + params[3]
        by_s = alpha * s / d2 + 1.0 - alpha  # total derivative of the denominator by s, as d2 depends on s
        across = alpha / d2 + by_s * xi / d1
        depth_x, depth_y, depth_z = across * x, across * y, by_s * (xi * z / d1 + 1.0)
        # d2 - s without cancellation near the axis.
        depth_alpha = square / (d2 + s) if s > 0.0 else d2 - s
        depth_xi = by_s * d1
        u_scale, v_scale = fx / depth, fy / depth
        j_point[i, 0, 0], j_point[i, 0, 1] = u_scale * (1.0 - a * depth_x), -u_scale * a * depth_y
        j_point[i, 1, 0], j_point[i, 1, 1] = -v_scale * b * depth_x, v_scale * (1.0 - b * depth_y)
        j_point[i, 0, 2], j_point[i, 1, 2] = -u_scale * a * depth_z, -v_scale * b * depth_z
        j_params[i, 0, 0], j_params[i, 0, 2] = a, 1.0
        j_params[i, 1, 1], j_params[i, 1, 3] = b, 1.0
        j_params[i, 0, 4], j_params[i, 1, 4] = -u_scale * a * depth_xi, -v_scale * b * depth_xi
        j_params[i, 0, 5], j_params[i, 1, 5] = -u_scale * a * depth_alpha, -v_scale * b * depth_alpha


@njit(cache=True, nogil=True, error_model="numpy")  # division by a zero focal length gives invalid rays, not an error
def _unproject(params, uv, rays, valid):
    xi, alpha = params[4], params[5]
    for i in range(len(uv)):
        a, b = (uv[i, 0] - params[2]) / params[0], (uv[i, 1] - params[3]) / params[1]
        square = a * a + b * b
        # First the ray from the second sphere (m_z in the paper), then its intersection with the first (eq. 46 to 52).
        s = unified_depth(alpha, 1.0, square)
        scale = (s * xi + np.sqrt(s * s + (1.0 - xi * xi) * square)) / (s * s + square)
        x, y, z = scale * a, scale * b, scale * s - xi
        valid[i] = np.isfinite(x) and np.isfinite(y) and np.isfinite(z) and _depth(xi, alpha, x * x + y * y, z)[4]
        if not valid[i]:
            x, y, z = 0.0, 0.0, 1.0
        norm = np.sqrt(x * x + y * y + z * z)
        rays[i, 0], rays[i, 1], rays[i, 2] = x / norm, y / norm, z / norm
