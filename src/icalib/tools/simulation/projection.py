"""Projection by each camera model that can be simulated, written so that points may be complex.

The derivative of the projection along a direction d is then Im(project(P + i h d)) / h, exact to rounding (complex-step
differentiation). No Jacobian must be written by hand.
"""

from __future__ import annotations

import numpy as np

from icalib.tools.simulation.scenario import SimCamera

PARAMETER_COUNTS = {
    "pinhole-radtan": 4,
    "pinhole-rational": 8,
    "pinhole-equidistant": 4,
    "eucm": 2,
    "double-sphere": 2,
    "omni-radtan": 5,
}
_COMPLEX_STEP = 1e-30


def project(camera: SimCamera, points: np.ndarray) -> np.ndarray:
    """Image points (..., 2) [px] of points (..., 3) in the camera frame [m]; meaningless unless `visible`."""
    fx, fy, cx, cy = camera.intrinsics
    x, y = _PROJECTIONS[camera.model](camera.distortion, points[..., 0], points[..., 1], points[..., 2])
    return np.stack([fx * x + cx, fy * y + cy], axis=-1)


def image_velocity(camera: SimCamera, points: np.ndarray, directions: np.ndarray) -> np.ndarray:
    """(..., 2) d/ds project(P + s d) at s = 0 [px per unit of s], by complex-step differentiation."""
    return np.imag(project(camera, points + 1j * _COMPLEX_STEP * directions)) / _COMPLEX_STEP


def visible(camera: SimCamera, points: np.ndarray, uv: np.ndarray) -> np.ndarray:
    """(...,) bool: whether points (..., 3) are in the valid range of the model, and their projections uv (..., 2) are
    inside the image."""
    valid = in_range(camera, np.hypot(points[..., 0], points[..., 1]), points[..., 2])
    width, height = camera.resolution
    u, v = uv[..., 0], uv[..., 1]
    return valid & (u >= 0.0) & (u <= width - 1.0) & (v >= 0.0) & (v <= height - 1.0)


def in_range(camera: SimCamera, radius: np.ndarray, z: np.ndarray) -> np.ndarray:
    """(...,) bool: whether points at distance `radius` from the optical axis and depth z are in the range in which the
    model projects one-to-one."""
    d = camera.distortion
    if camera.model == "pinhole-radtan":
        return (z > 0.0) & (radius < _first_extremum(d[:2]) * z)
    if camera.model == "pinhole-rational":
        return (z > 0.0) & (radius < _rational_limit(d) * z)
    if camera.model == "pinhole-equidistant":
        return np.arctan2(radius, z) < min(_first_extremum(d), np.pi)
    if camera.model == "eucm":
        alpha, beta = d
        return z > -_shift_limit(alpha / (1.0 - alpha)) * np.sqrt(beta * radius**2 + z**2)
    if camera.model == "double-sphere":
        xi, alpha = d
        shifted = z + xi * np.hypot(radius, z)
        return shifted > -_shift_limit(alpha / (1.0 - alpha)) * np.hypot(radius, shifted)
    depth = z + d[0] * np.hypot(radius, z)
    on_sphere = z > -_shift_limit(d[0]) * np.hypot(radius, z)
    return on_sphere & (radius < _first_extremum(d[1:3]) * depth)


def _shift_limit(shift: float) -> float:
    """Negative cosine of the largest angle from the axis that is visible on the unit sphere from the point `shift`
    behind its centre."""
    return min(shift, 1.0 / shift) if shift > 0.0 else 0.0


def _radtan(
    distortion: tuple[float, ...], X: np.ndarray, Y: np.ndarray, Z: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Brown's model as in OpenCV: (k1, k2, p1, p2)."""
    k1, k2, p1, p2 = distortion
    x, y = X / Z, Y / Z
    r2 = x * x + y * y
    radial = 1.0 + k1 * r2 + k2 * r2**2
    return (
        x * radial + 2.0 * p1 * x * y + p2 * (r2 + 2.0 * x * x),
        y * radial + p1 * (r2 + 2.0 * y * y) + 2.0 * p2 * x * y,
    )


def _rational(
    distortion: tuple[float, ...], X: np.ndarray, Y: np.ndarray, Z: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """OpenCV's rational model: (k1, k2, p1, p2, k3, k4, k5, k6)."""
    k1, k2, p1, p2, k3, k4, k5, k6 = distortion
    x, y = X / Z, Y / Z
    r2 = x * x + y * y
    radial = (1.0 + k1 * r2 + k2 * r2**2 + k3 * r2**3) / (1.0 + k4 * r2 + k5 * r2**2 + k6 * r2**3)
    return (
        x * radial + 2.0 * p1 * x * y + p2 * (r2 + 2.0 * x * x),
        y * radial + p1 * (r2 + 2.0 * y * y) + 2.0 * p2 * x * y,
    )


def _equidistant(
    distortion: tuple[float, ...], X: np.ndarray, Y: np.ndarray, Z: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Kannala and Brandt: radius = theta + k1 theta^3 + k2 theta^5 + k3 theta^7 + k4 theta^9."""
    radius = np.sqrt(X * X + Y * Y)
    radius = np.where(radius == 0.0, 1e-300, radius)
    # NumPy's arctan2 takes no complex numbers; the two branches keep the argument of arctan below one.
    steep = np.real(radius) > np.abs(np.real(Z))
    theta = np.where(
        steep,
        0.5 * np.pi - np.arctan(np.where(steep, Z, 0.0) / radius),
        np.arctan(radius / np.where(steep, 1.0, Z)) + np.where(np.real(Z) < 0.0, np.pi, 0.0),
    )
    bent = theta * (1.0 + sum(k * theta ** (2 * i + 2) for i, k in enumerate(distortion)))
    return bent * X / radius, bent * Y / radius


def _eucm(distortion: tuple[float, ...], X: np.ndarray, Y: np.ndarray, Z: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """EUCM of Khomutenko et al.: (alpha, beta). The depth is the mean, weighted by alpha, of the distance with x and y
    scaled by sqrt(beta) and of z."""
    alpha, beta = distortion
    depth = alpha * np.sqrt(beta * (X * X + Y * Y) + Z * Z) + (1.0 - alpha) * Z
    return X / depth, Y / depth


def _double_sphere(
    distortion: tuple[float, ...], X: np.ndarray, Y: np.ndarray, Z: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Double sphere of Usenko et al.: (xi, alpha). Points are shifted along z by xi times their distance, and then
    projected by the unified model (EUCM with beta = 1)."""
    xi, alpha = distortion
    return _eucm((alpha, 1.0), X, Y, Z + xi * np.sqrt(X * X + Y * Y + Z * Z))


def _omni(distortion: tuple[float, ...], X: np.ndarray, Y: np.ndarray, Z: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Omnidirectional model of Mei: (xi, k1, k2, p1, p2). Points are shifted along z by xi times their distance, and
    then projected by Brown's model."""
    return _radtan(distortion[1:], X, Y, Z + distortion[0] * np.sqrt(X * X + Y * Y + Z * Z))


_PROJECTIONS = {
    "pinhole-radtan": _radtan,
    "pinhole-rational": _rational,
    "pinhole-equidistant": _equidistant,
    "eucm": _eucm,
    "double-sphere": _double_sphere,
    "omni-radtan": _omni,
}


def _rational_limit(distortion: tuple[float, ...]) -> float:
    """Smallest positive r at which r N(r^2) / D(r^2) has an extremum or a pole, from the roots of polynomials in r;
    infinity if there is none."""
    k1, k2, _, _, k3, k4, k5, k6 = distortion
    above = np.array([k3, 0.0, k2, 0.0, k1, 0.0, 1.0, 0.0])
    below = np.array([k6, 0.0, k5, 0.0, k4, 0.0, 1.0])
    slope = np.polysub(np.polymul(np.polyder(above), below), np.polymul(above, np.polyder(below)))
    roots = np.concatenate([np.roots(slope), np.roots(below)])
    radii = roots[(np.abs(roots.imag) < 1e-9) & (roots.real > 0.0)].real
    return float(radii.min()) if len(radii) else np.inf


def _first_extremum(coefficients: tuple[float, ...]) -> float:
    """Smallest positive r at which r (1 + k1 r^2 + k2 r^4 + ...) has an extremum; infinity if there is none."""
    slope = [(2 * i + 3) * k for i, k in enumerate(coefficients)]
    roots = np.roots([*reversed(slope), 1.0])
    squares = roots[(np.abs(roots.imag) < 1e-12) & (roots.real > 0.0)].real
    return float(np.sqrt(squares.min())) if len(squares) else np.inf
