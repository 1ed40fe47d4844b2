"""Whether what a calibration leaves unexplained is white: each whitened residual against the next in time."""

from __future__ import annotations

import numpy as np

from icalib.result import Calibration, ImageResiduals, ImuResiduals, RowResiduals, image_of
from icalib.sensors.lidar.record import LidarResiduals
from icalib.tools.montecarlo.record import Whiteness

SAME_WALL_S = 0.3  # between two points of a plane that are neighbours in time
IMU_ROWS = ("rotation", "velocity", "position", "gyroscope walk", "accelerometer walk")  # three columns each


def whiteness(result: Calibration) -> tuple[Whiteness, ...]:
    """Of every kind of residual that the result holds."""
    found = [_of_image_points(r) for r in result.image_residuals]
    for r in result.residuals.values():
        if isinstance(r, ImuResiduals):
            blocks = zip(IMU_ROWS, np.split(r.whitened, len(IMU_ROWS), axis=1), strict=True)
            found += [_statistics(r.sensor, kind, rows, rows[:-1], rows[1:]) for kind, rows in blocks]
        elif isinstance(r, LidarResiduals):
            found.append(_of_points(r))
        elif isinstance(r, RowResiduals):
            found += _of_rows(r)
    return tuple(found)


def _of_points(r: LidarResiduals) -> Whiteness:
    """A point's next one is on the same plane, and soon after."""
    order = np.lexsort((r.seconds, r.plane))
    whitened = (r.residual[order] / r.sigma[order])[:, None]
    follows = (np.diff(r.plane[order]) == 0) & (np.diff(r.seconds[order]) < SAME_WALL_S)
    return _statistics(r.sensor, "points", whitened, whitened[:-1][follows], whitened[1:][follows])


def _of_rows(r: RowResiduals) -> list[Whiteness]:
    """Each column of every row against that of the next row."""
    columns = np.split(r.whitened, r.whitened.shape[1], axis=1)
    return [_statistics(r.sensor, name, x, x[:-1], x[1:]) for name, x in zip(r.labels, columns, strict=True)]


def _of_image_points(r: ImageResiduals) -> Whiteness:
    """Whiteness between consecutive images: of the same corner of the target, or of the same tracked point."""
    image, point = image_of(r), r.point
    order = np.lexsort((image, point))
    order = order[r.used[order]]
    follows = (np.diff(point[order]) == 0) & (np.diff(image[order]) == 1)
    whitened = r.whitened[order].astype(np.float64)
    return _statistics(r.sensor, r.kind, whitened, whitened[:-1][follows], whitened[1:][follows])


def _statistics(sensor: str, kind: str, values: np.ndarray, first: np.ndarray, second: np.ndarray) -> Whiteness:
    """values (n, d); first, second (m, d): pairs of them, one after the other."""
    mean_square = float(np.mean(values**2)) if values.size else 0.0
    power = float(np.sqrt((first**2).sum() * (second**2).sum()))
    return Whiteness(sensor, kind, mean_square, float((first * second).sum()) / power if power > 0.0 else 0.0)
