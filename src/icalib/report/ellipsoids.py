"""Ellipsoids of the position uncertainty of each sensor, for the report and the 3D view."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from icalib.report import rig_shapes
from icalib.result import Calibration, joint_covariance
from icalib.result.verdict import worst

SIGMAS = 3.0
VERDICT_COLORS = {"determined": "#15803d", "weak": "#d97706", "too uncertain": "#dc2626", "unobservable": "#dc2626"}
_LARGEST = 0.4  # largest half size of determined ellipsoids when magnified, as a fraction of the rig's size


@dataclass(frozen=True)
class Ellipsoid:
    """Uncertainty ellipsoid of a sensor's position in the imu frame. axes (3, 3): unit vectors of the principal axes as
    columns. half_sizes (3,): half lengths of these axes [m], SIGMAS standard deviations with empirical factors.
    verdict: the worst of the three components."""

    sensor: str
    verdict: str
    axes: np.ndarray
    half_sizes: np.ndarray


def ellipsoids(c: Calibration) -> list[Ellipsoid]:
    """Uncertainty ellipsoids of all estimated translations."""
    shapes = []
    for name in c.mounted:
        group = c.group(name, "translation")
        if group.columns is None:
            continue
        values, axes = np.linalg.eigh(joint_covariance(c, [group]))
        axes[:, 0] *= np.sign(np.linalg.det(axes))
        shapes.append(Ellipsoid(name, worst(group.verdict), axes, SIGMAS * np.sqrt(np.maximum(values, 0.0))))
    return shapes


def magnification(c: Calibration) -> float:
    """Largest power of ten, at least 1, by which all determined ellipsoids can be magnified and stay smaller than the
    rig. If none is determined, the smallest ellipsoid is used."""
    sizes = [(e.verdict, float(e.half_sizes.max())) for e in ellipsoids(c)]
    reference_sizes = [size for verdict, size in sizes if verdict == "determined"] or [
        min((x for _, x in sizes), default=0.0)
    ]
    if not 0.0 < max(reference_sizes) < np.inf:
        return 1.0
    return max(1.0, 10.0 ** float(np.floor(np.log10(_LARGEST * rig_shapes.spread_of(c) / max(reference_sizes)))))


def outline(e: Ellipsoid, factor: float) -> np.ndarray:
    """(n, 3) polylines [m]: three ellipses in the principal planes, centred at the origin, magnified by `factor`, with
    the axes of the imu frame. Rows of NaN separate the ellipses."""
    x, y = rig_shapes.CIRCLE.T
    circles = [np.insert(np.stack([x, y], axis=1), k, 0.0, axis=1) for k in range(3)]
    return np.vstack([p for c in circles for p in (factor * (c * e.half_sizes) @ e.axes.T, rig_shapes.PEN_UP)])
