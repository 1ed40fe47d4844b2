"""Projection by each camera model that can be simulated, written so that complex points pass through.

A direction in the image is then Im(project(P + i h d)) / h, exact to rounding: no Jacobian to get wrong.
"""

from __future__ import annotations

import numpy as np

from icalib.tools.simulation.scenario.scenario import SimCamera

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
    """Points (..., 3) in the camera frame [m] -> (..., 2) [px]; meaningful where `visible`."""
    fx, fy, cx, cy = camera.intrinsics
    x, y = _PROJECTIONS[camera.model](camera.distortion, points[..., 0], points[..., 1], points[..., 2])
    return np.stack([fx * x + cx, fy * y + cy], axis=-1)


def image_velocity(camera: SimCamera, points: np.ndarray, directions: np.ndarray) -> np.ndarray:
    """d/ds project(P + s d) at s = 0, (..., 2) [px per unit of s], by the complex step."""
    return np.imag(project(camera, points + 1j * _COMPLEX_STEP * directions)) / _COMPLEX_STEP


def visible(camera: SimCamera, points: np.ndarray, uv: np.ndarray) -> np.ndarray:
    """(...,) bool: where the model has an image, before it folds back, and inside the picture."""
    seen = in_range(camera, np.hypot(points[..., 0], points[..., 1]), points[..., 2])
    width, height = camera.resolution
    u, v = uv[..., 0], uv[..., 1]
    return seen & (u >= 0.0) & (u <= width - 1.0) & (v >= 0.0) & (v <= height - 1.0)


def in_range(camera: SimCamera, radius: np.ndarray, z: np.ndarray) -> np.ndarray:
    """(...,) bool: whether the model has an image, not folded back, of points at `radius` from the axis and depth z."""
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
    """Cosine of the ray furthest behind a unit sphere that is seen from `shift` behind its centre, sign changed."""
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
    # arctan2 has no complex form; the two branches keep its argument below one.
    steep = np.real(radius) > np.abs(np.real(Z))
    theta = np.where(
        steep,
        0.5 * np.pi - np.arctan(np.where(steep, Z, 0.0) / radius),
        np.arctan(radius / np.where(steep, 1.0, Z)) + np.where(np.real(Z) < 0.0, np.pi, 0.0),
    )
    bent = theta * (1.0 + sum(k * theta ** (2 * i + 2) for i, k in enumerate(distortion)))
    return bent * X / radius, bent * Y / radius


def _eucm(distortion: tuple[float, ...], X: np.ndarray, Y: np.ndarray, Z: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Khomutenko: (alpha, beta), the depth a mean of z and of the distance in a space stretched across the axis."""
    alpha, beta = distortion
    depth = alpha * np.sqrt(beta * (X * X + Y * Y) + Z * Z) + (1.0 - alpha) * Z
    return X / depth, Y / depth


def _double_sphere(
    distortion: tuple[float, ...], X: np.ndarray, Y: np.ndarray, Z: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Usenko: (xi, alpha), the unified model (EUCM with beta = 1) after the points moved by xi times their distance."""
    xi, alpha = distortion
    return _eucm((alpha, 1.0), X, Y, Z + xi * np.sqrt(X * X + Y * Y + Z * Z))


def _omni(distortion: tuple[float, ...], X: np.ndarray, Y: np.ndarray, Z: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Mei: (xi, k1, k2, p1, p2), Brown's model after the points moved by xi times their distance."""
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
    """Smallest positive r where r N(r^2) / D(r^2) stops growing or has a pole, as polynomials in r; infinity if
    nowhere."""
    k1, k2, _, _, k3, k4, k5, k6 = distortion
    above = np.array([k3, 0.0, k2, 0.0, k1, 0.0, 1.0, 0.0])
    below = np.array([k6, 0.0, k5, 0.0, k4, 0.0, 1.0])
    slope = np.polysub(np.polymul(np.polyder(above), below), np.polymul(above, np.polyder(below)))
    roots = np.concatenate([np.roots(slope), np.roots(below)])
    radii = roots[(np.abs(roots.imag) < 1e-9) & (roots.real > 0.0)].real
    return float(radii.min()) if len(radii) else np.inf


def _first_extremum(coefficients: tuple[float, ...]) -> float:
    """Smallest positive r where r (1 + k1 r^2 + k2 r^4 + ...) stops growing; infinity if nowhere."""
    slope = [(2 * i + 3) * k for i, k in enumerate(coefficients)]
    roots = np.roots([*reversed(slope), 1.0])
    squares = roots[(np.abs(roots.imag) < 1e-12) & (roots.real > 0.0)].real
    return float(np.sqrt(squares.min())) if len(squares) else np.inf
