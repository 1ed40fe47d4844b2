"""Whether what a calibration leaves unexplained is white: each whitened residual against the next in time."""

from __future__ import annotations

import numpy as np

from icalib.calibration import Calibration, CornerResiduals
from icalib.montecarlo.record import Whiteness

IMU_ROWS = ("rotation", "velocity", "position", "gyroscope walk", "accelerometer walk")  # three columns each


def whiteness(result: Calibration) -> tuple[Whiteness, ...]:
    """Of every kind of residual that the result holds."""
    found = [_of_corners(r) for r in result.corner_residuals]
    if result.imu is not None:
        for k, kind in enumerate(IMU_ROWS):
            rows = result.imu_residuals.whitened[:, 3 * k : 3 * k + 3]
            found.append(_statistics(result.imu, kind, rows, rows[:-1], rows[1:]))
    return tuple(found)


def _of_corners(r: CornerResiduals) -> Whiteness:
    """A corner's next one is the same point of the target in the next image."""
    image = np.repeat(np.arange(len(r.seconds)), np.diff(r.start))
    order = np.lexsort((image, r.point))
    order = order[~r.rejected[order]]
    whitened = r.residual[order] / r.sigma[order, None]
    follows = (np.diff(r.point[order]) == 0) & (np.diff(image[order]) == 1)
    return _statistics(r.sensor, "corners", whitened, whitened[:-1][follows], whitened[1:][follows])


def _statistics(sensor: str, kind: str, values: np.ndarray, first: np.ndarray, second: np.ndarray) -> Whiteness:
    """values (n, d); first, second (m, d): pairs of them, one after the other."""
    mean_square = float(np.mean(values**2)) if values.size else 0.0
    power = float(np.sqrt((first**2).sum() * (second**2).sum()))
    return Whiteness(sensor, kind, mean_square, float((first * second).sum()) / power if power > 0.0 else 0.0)
