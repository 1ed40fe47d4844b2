"""Pinhole camera with equidistant distortion (Kannala-Brandt), as in Kalibr ("equidistant") and OpenCV (fisheye)."""

from __future__ import annotations

import numpy as np

from icalib.base.compiled import njit
from icalib.geometry.cameras import radial
from icalib.geometry.cameras.base import MIN_DISTANCE, CameraModel


class PinholeEquidistant(CameraModel):
    """Kannala-Brandt model (Kannala and Brandt 2006, eq. 6, odd powers only, first coefficient 1).

        r = sqrt(x^2 + y^2),  theta = atan2(r, z)
        theta_d = theta (1 + k1 theta^2 + k2 theta^4 + k3 theta^6 + k4 theta^8)
        u = fx theta_d x / r + cx,  v = fy theta_d y / r + cy

    A point is valid if it is farther than 1 um from the centre, and theta is below pi and below the first zero of d
    theta_d / d theta. Points beside and behind the camera (z <= 0) can therefore be valid. Invalid points are projected
    to (0, 0) with zero Jacobians.
    """

    name = "pinhole-equidistant"
    parameter_names = ("fx", "fy", "cx", "cy", "k1", "k2", "k3", "k4")
    start_distortions = ((0.0, 0.0, 0.0, 0.0),)

    def _fill_image(self, params, points, uv, valid) -> None:
        _project(params, points, _theta_limit(params), uv, valid)

    def _fill_jacobians(self, params, points, uv, valid, j_point, j_params) -> None:
        _project_with_jacobians(params, points, _theta_limit(params), uv, valid, j_point, j_params)

    def _fill_rays(self, params, uv, rays, valid) -> None:
        _unproject(params, uv, _theta_limit(params), rays, valid)


def _theta_limit(params: np.ndarray) -> float:
    """The angle to the optical axis [rad] below which theta_d grows with theta; at most pi."""
    return min(np.pi, radial.monotonic_limit(params[4:8]))


@njit(cache=True, nogil=True)
def _direction(x, y, z, limit):
    """r, theta, theta / r and whether the point is valid. On the optical axis theta / r is its limit 1 / z."""
    r = np.sqrt(x * x + y * y)
    theta = np.arctan2(r, z)
    valid = r + abs(z) > MIN_DISTANCE and theta < limit
    theta_by_r = 0.0
    if valid:
        theta_by_r = theta / r if r > 0.0 else 1.0 / z
    return r, theta, theta_by_r, valid


@njit(cache=True, nogil=True)
def _project(params, points, limit, uv, valid):
    k1, k2, k3, k4 = params[4], params[5], params[6], params[7]
    for i in range(len(points)):
        x, y = points[i, 0], points[i, 1]
        _, theta, theta_by_r, valid[i] = _direction(x, y, points[i, 2], limit)
        if valid[i]:
            s = theta * theta
            tangential = theta_by_r * (1.0 + s * (k1 + s * (k2 + s * (k3 + s * k4))))
            uv[i, 0] = params[0] * tangential * x + params[2]
            uv[i, 1] = params[1] * tangential * y + params[3]
        else:
            uv[i] = 0.0


@njit(cache=True, nogil=True)
def _project_with_jacobians(params, points, limit, uv, valid, j_point, j_params):
    fx, fy, k1, k2, k3, k4 = params[0], params[1], params[4], params[5], params[6], params[7]
    for i in range(len(points)):
        x, y, z = points[i, 0], points[i, 1], points[i, 2]
        r, theta, theta_by_r, valid[i] = _direction(x, y, z, limit)
        if not valid[i]:
            uv[i] = 0.0
            continue
        s = theta * theta
        tangential = theta_by_r * (1.0 + s * (k1 + s * (k2 + s * (k3 + s * k4))))
        slope = 1.0 + s * (3.0 * k1 + s * (5.0 * k2 + s * (7.0 * k3 + s * 9.0 * k4)))
        slope_by_square = slope / (r * r + z * z)
        uv[i, 0], uv[i, 1] = fx * tangential * x + params[2], fy * tangential * y + params[3]
        # d (x, y) stretches by slope_by_square z along (cos, sin), by `tangential` across. The difference vanishes on
        # the axis, so this form stays exact there, whatever direction (cos, sin) is.
        cos, sin = (x / r, y / r) if r > 0.0 else (1.0, 0.0)
        excess = slope_by_square * z - tangential
        j_point[i, 0, 0], j_point[i, 0, 1] = fx * (tangential + cos * cos * excess), fx * cos * sin * excess
        j_point[i, 1, 0], j_point[i, 1, 1] = fy * cos * sin * excess, fy * (tangential + sin * sin * excess)
        j_point[i, 0, 2], j_point[i, 1, 2] = -fx * slope_by_square * x, -fy * slope_by_square * y
        j_params[i, 0, 0], j_params[i, 0, 2] = tangential * x, 1.0
        j_params[i, 1, 1], j_params[i, 1, 3] = tangential * y, 1.0
        power_x, power_y = fx * theta_by_r * x, fy * theta_by_r * y
        for k in range(4):
            power_x *= s
            power_y *= s
            j_params[i, 0, 4 + k], j_params[i, 1, 4 + k] = power_x, power_y


@njit(cache=True, nogil=True, error_model="numpy")  # division by a zero focal length gives invalid rays, not an error
def _unproject(params, uv, limit, rays, valid):
    max_distorted = radial.evaluate(params[4:8], limit)[0]
    for i in range(len(uv)):
        mx, my = (uv[i, 0] - params[2]) / params[0], (uv[i, 1] - params[3]) / params[1]
        distorted = np.hypot(mx, my)
        valid[i] = distorted < max_distorted
        theta = radial.invert(params[4:8], distorted, limit) if valid[i] else 0.0
        sin_by_distorted = np.sin(theta) / distorted if valid[i] and distorted > 0.0 else 0.0
        rays[i, 0], rays[i, 1], rays[i, 2] = sin_by_distorted * mx, sin_by_distorted * my, np.cos(theta)
        if not valid[i]:
            rays[i, 0], rays[i, 1] = 0.0, 0.0
