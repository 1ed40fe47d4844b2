"""Mei's omnidirectional camera with radial-tangential distortion, Kalibr's "omni" with "radtan"."""

from __future__ import annotations

import numpy as np

from icalib.base.compiled import njit
from icalib.geometry.cameras import radial
from icalib.geometry.cameras.base import MIN_DISTANCE, CameraModel
from icalib.geometry.cameras.radtan import distort, undistort


class OmniRadtan(CameraModel):
    """Unified model of Mei and Rives (2007, section II) with the distortion of `pinhole-radtan`.

    A point is projected to the unit sphere, then from a centre at distance xi behind the sphere's centre, and
    distorted:

        d = sqrt(x^2 + y^2 + z^2),  a = x / (z + xi d),  b = y / (z + xi d),  s = a^2 + b^2
        u = fx (a (1 + k1 s + k2 s^2) + 2 p1 a b + p2 (s + 2 a^2)) + cx
        v = fy (b (1 + k1 s + k2 s^2) + p1 (s + 2 b^2) + 2 p2 a b) + cy

    Parameters: fx, fy, cx, cy, xi, k1, k2, p1, p2. fx and fy are gamma in the paper, so that the scale at the optical
    axis is fx / (1 + xi). A point is valid if it is farther than 1 um from the centre, z + xi d > 0 and d + xi z > 0,
    that is z > -d min(xi, 1 / xi). Also, sqrt(s) must be below the first zero of 1 + 3 k1 r^2 + 5 k2 r^4. Invalid
    points are projected to (0, 0) with zero Jacobians.
    """

    name = "omni-radtan"
    parameter_names = ("fx", "fy", "cx", "cy", "xi", "k1", "k2", "p1", "p2")
    start_distortions = ((0.1, 0.0, 0.0, 0.0, 0.0), (1.0, 0.0, 0.0, 0.0, 0.0), (2.0, 0.0, 0.0, 0.0, 0.0))

    def _fill_image(self, params, points, uv, valid) -> None:
        _project(params[4], np.delete(params, 4), points, radial.monotonic_limit(params[5:7]), uv, valid)

    def _fill_jacobians(self, params, points, uv, valid, j_point, j_params) -> None:
        limit = radial.monotonic_limit(params[5:7])
        _project_with_jacobians(params[4], np.delete(params, 4), points, limit, uv, valid, j_point, j_params)

    def _fill_rays(self, params, uv, rays, valid) -> None:
        coefficients = params[5:7].copy()
        _unproject(params[4], np.delete(params, 4), coefficients, uv, radial.monotonic_limit(coefficients), rays, valid)


@njit(cache=True, nogil=True)
def _on_plane(xi, limit, x, y, z):
    """d, z + xi d, a, b and whether the point is valid."""
    d = np.sqrt(x * x + y * y + z * z)
    depth = z + xi * d
    if not (d > MIN_DISTANCE and depth > 0.0 and d + xi * z > 0.0):
        return 1.0, 1.0, 0.0, 0.0, False
    a, b = x / depth, y / depth
    return d, depth, a, b, a * a + b * b < limit * limit


@njit(cache=True, nogil=True)
def _project(xi, lens, points, limit, uv, valid):
    for i in range(len(points)):
        _, _, a, b, valid[i] = _on_plane(xi, limit, points[i, 0], points[i, 1], points[i, 2])
        if valid[i]:
            distorted_a, distorted_b, _, _, _ = distort(lens, 0.0, a, b)
            uv[i, 0] = lens[0] * distorted_a + lens[2]
            uv[i, 1] = lens[1] * distorted_b + lens[3]
        else:
            uv[i] = 0.0


@njit(cache=True, nogil=True)
def _project_with_jacobians(xi, lens, points, limit, uv, valid, j_point, j_params):
    """lens: the parameters without xi, in the order of `pinhole-radtan`."""
    fx, fy = lens[0], lens[1]
    for i in range(len(points)):
        x, y, z = points[i, 0], points[i, 1], points[i, 2]
        d, depth, a, b, valid[i] = _on_plane(xi, limit, x, y, z)
        if not valid[i]:
            uv[i] = 0.0
            continue
        distorted_a, distorted_b, j_aa, j_ab, j_bb = distort(lens, 0.0, a, b)
        uv[i, 0], uv[i, 1] = fx * distorted_a + lens[2], fy * distorted_b + lens[3]
        # d (a, b) = (dx - a d_depth, dy - b d_depth) / depth.
        u_a, u_b, v_a, v_b = fx * j_aa / depth, fx * j_ab / depth, fy * j_ab / depth, fy * j_bb / depth
        u_depth, v_depth = -(u_a * a + u_b * b), -(v_a * a + v_b * b)
        depth_x, depth_y, depth_z = xi * x / d, xi * y / d, xi * z / d + 1.0
        j_point[i, 0, 0], j_point[i, 1, 0] = u_a + u_depth * depth_x, v_a + v_depth * depth_x
        j_point[i, 0, 1], j_point[i, 1, 1] = u_b + u_depth * depth_y, v_b + v_depth * depth_y
        j_point[i, 0, 2], j_point[i, 1, 2] = u_depth * depth_z, v_depth * depth_z
        s = a * a + b * b
        j_params[i, 0, 0], j_params[i, 0, 2], j_params[i, 0, 4] = distorted_a, 1.0, u_depth * d
        j_params[i, 1, 1], j_params[i, 1, 3], j_params[i, 1, 4] = distorted_b, 1.0, v_depth * d
        j_params[i, 0, 5], j_params[i, 0, 6] = fx * a * s, fx * a * s * s
        j_params[i, 1, 5], j_params[i, 1, 6] = fy * b * s, fy * b * s * s
        j_params[i, 0, 7], j_params[i, 0, 8] = 2.0 * fx * a * b, fx * (s + 2.0 * a * a)
        j_params[i, 1, 7], j_params[i, 1, 8] = fy * (s + 2.0 * b * b), 2.0 * fy * a * b


@njit(cache=True, nogil=True, error_model="numpy")  # division by a zero focal length gives invalid rays, not an error
def _unproject(xi, lens, coefficients, uv, limit, rays, valid):
    for i in range(len(uv)):
        mx, my = (uv[i, 0] - lens[2]) / lens[0], (uv[i, 1] - lens[3]) / lens[1]
        a, b, valid[i] = 0.0, 0.0, False
        if np.isfinite(mx) and np.isfinite(my):
            a, b, valid[i] = undistort(lens, coefficients, limit, mx, my)
        s = a * a + b * b
        # The farther intersection of the sphere with the ray from the projection centre, xi behind the sphere's centre.
        scale = (xi + np.sqrt(1.0 + (1.0 - xi * xi) * s)) / (s + 1.0)
        x, y, z = scale * a, scale * b, scale - xi
        # If the ray misses the sphere, the point is NaN and therefore invalid.
        valid[i] = valid[i] and _on_plane(xi, np.inf, x, y, z)[4]
        if not valid[i]:
            x, y, z = 0.0, 0.0, 1.0
        norm = np.sqrt(x * x + y * y + z * z)
        rays[i, 0], rays[i, 1], rays[i, 2] = x / norm, y / norm, z / norm
