"""Rays of pixels (unprojection) by each camera model that can be simulated; compiled, without code of the estimator.

The models with a sphere use the following formula. The ray with unit direction D from the point `shift` behind the
centre of the unit sphere meets the sphere at t D - shift e_z, where t = shift D_z + sqrt(1 - shift^2 (1 - D_z^2)).
"""

from __future__ import annotations

import numpy as np

from icalib.base.compiled import njit
from icalib.tools.simulation.scenario.projection import in_range
from icalib.tools.simulation.scenario.scenario import MODELS, SimCamera

RADTAN, EQUIDISTANT, EUCM, DOUBLE_SPHERE, OMNI, RATIONAL = range(6)
_CODES: dict[str, int] = dict(zip(MODELS, range(6), strict=True))
_STEPS = 20
_NONE = (0.0, 0.0, 0.0)


def lens_of(camera: SimCamera) -> tuple[int, np.ndarray]:
    """Code of the camera model, and its parameters (12,): fx, fy, cx, cy [px], distortion, zeros."""
    numbers = np.zeros(12)
    numbers[: 4 + len(camera.distortion)] = [*camera.intrinsics, *camera.distortion]
    return _CODES[camera.model], numbers


def unproject(camera: SimCamera, uv: np.ndarray) -> np.ndarray:
    """Unit rays (..., 3) in the camera frame of pixels uv (..., 2); NaN outside the range of the model."""
    code, numbers = lens_of(camera)
    flat = np.ascontiguousarray(uv, dtype=np.float64).reshape(-1, 2)
    rays = np.empty((len(flat), 3))
    _rays(code, numbers, flat, rays)
    with np.errstate(invalid="ignore"):
        rays /= np.linalg.norm(rays, axis=1, keepdims=True)
        rays[~in_range(camera, np.hypot(rays[:, 0], rays[:, 1]), rays[:, 2])] = np.nan
    return rays.reshape(*uv.shape[:-1], 3)


@njit(cache=True, nogil=True, error_model="numpy")
def _rays(code, numbers, uv, rays):
    for i in range(len(uv)):
        rays[i, 0], rays[i, 1], rays[i, 2] = ray(code, numbers, uv[i, 0], uv[i, 1])


@njit(cache=True, nogil=True, error_model="numpy")
def ray(code, n, u, v):
    """Direction (x, y, z) of pixel (u, v), not normalised; n: parameters of `lens_of`. Outside the range of the model
    it is NaN or meaningless."""
    a, b = (u - n[2]) / n[0], (v - n[3]) / n[1]
    if code in (RADTAN, RATIONAL):  # the coefficients that radtan lacks are zero
        w = _undistorted((n[4], n[5], n[8]), (n[9], n[10], n[11]), n[6], n[7], complex(a, b))
        return w.real, w.imag, 1.0
    if code == EQUIDISTANT:
        radius = np.sqrt(a * a + b * b)
        angle = _angle(n, radius)
        by_radius = np.sin(angle) / radius if radius > 0.0 else 1.0
        return by_radius * a, by_radius * b, np.cos(angle)
    if code == EUCM:
        # EUCM is the unified camera model with x and y scaled by sqrt(beta).
        stretch = np.sqrt(n[5])
        x, y, z = _from_behind(n[4] / (1.0 - n[4]), stretch * a * (1.0 - n[4]), stretch * b * (1.0 - n[4]), 1.0)
        return x / stretch, y / stretch, z
    if code == DOUBLE_SPHERE:
        x, y, z = _from_behind(n[5] / (1.0 - n[5]), a * (1.0 - n[5]), b * (1.0 - n[5]), 1.0)
        return _from_behind(n[4], x, y, z)
    w = _undistorted((n[5], n[6], 0.0), _NONE, n[7], n[8], complex(a, b))
    return _from_behind(n[4], w.real, w.imag, 1.0)


@njit(cache=True, nogil=True, error_model="numpy")
def _from_behind(shift, x, y, z):
    """Point at which the ray (x, y, z) from the point `shift` behind the centre meets the unit sphere."""
    norm = np.sqrt(x * x + y * y + z * z)
    x, y, z = x / norm, y / norm, z / norm
    t = shift * z + np.sqrt(1.0 - shift * shift * (1.0 - z * z))
    return t * x, t * y, t * z - shift


@njit(cache=True, nogil=True, error_model="numpy")
def _undistorted(above, below, p1, p2, image):
    """w with w N(s) / D(s) + 2 s q + w^2 conj(q) = image, s = |w|^2, q = p2 + i p1: Brown's model in one complex
    number, by Newton's method in w and conj(w). N, D: 1 + a s + b s^2 + c s^3 for above, below (a, b, c)."""
    q = complex(p2, p1)
    w = image
    for _ in range(_STEPS):
        s = w.real * w.real + w.imag * w.imag
        N = 1.0 + s * (above[0] + s * (above[1] + s * above[2]))
        D = 1.0 + s * (below[0] + s * (below[1] + s * below[2]))
        radial = N / D
        slope = (above[0] + s * (2.0 * above[1] + 3.0 * s * above[2])) / D
        slope -= radial * (below[0] + s * (2.0 * below[1] + 3.0 * s * below[2])) / D
        error = w * radial + 2.0 * s * q + w * w * q.conjugate() - image
        by_w = radial + s * slope + 2.0 * (w.conjugate() * q + w * q.conjugate())
        by_conj = w * w * slope + 2.0 * w * q
        scale = by_w.real**2 + by_w.imag**2 - by_conj.real**2 - by_conj.imag**2
        step = (by_conj * error.conjugate() - by_w.conjugate() * error) / scale
        w += step
        if abs(step.real) + abs(step.imag) < 1e-13:
            return w
    return complex(np.nan, np.nan)


@njit(cache=True, nogil=True, error_model="numpy")
def _angle(n, radius):
    """theta with theta + k1 theta^3 + k2 theta^5 + k3 theta^7 + k4 theta^9 = radius."""
    theta = radius
    for _ in range(_STEPS):
        s = theta * theta
        value = theta * (1.0 + s * (n[4] + s * (n[5] + s * (n[6] + s * n[7]))))
        slope = 1.0 + s * (3.0 * n[4] + s * (5.0 * n[5] + s * (7.0 * n[6] + s * 9.0 * n[7])))
        step = (radius - value) / slope
        theta += step
        if abs(step) < 1e-13:
            return theta
    return np.nan
