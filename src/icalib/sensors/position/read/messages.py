"""Positions in messages of a bag: NavSatFix, PointStamped, poses and Odometry."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

import numpy as np

from icalib.sensors.position.read.readings import NO_COVARIANCE, PositionReadings
from icalib.sensors.position.spec import STATUSES

# NavSatStatus: -1 no fix, 0 fix, 1 satellite-based, 2 ground-based augmentation (where receivers report RTK).
_NAVSAT_STATUS = {0: STATUSES.index("single"), 1: STATUSES.index("differential"), 2: STATUSES.index("fixed")}
COVARIANCE_UNKNOWN = 0


def from_navsat(name: str, stamped: Iterable[tuple[int, Any]]) -> tuple[PositionReadings, np.ndarray]:
    """Readings of sensor_msgs/NavSatFix, not yet in metres; and latitude, longitude [deg], height [m] (N, 3)."""
    messages = list(stamped)
    stamps_ns = np.array([stamp for stamp, _ in messages], np.int64)
    degrees = np.array([(m.latitude, m.longitude, m.altitude) for _, m in messages]).reshape(-1, 3)
    status = np.array([_NAVSAT_STATUS.get(int(m.status.status), -1) for _, m in messages], np.int64)
    covariance = np.array([np.asarray(m.position_covariance, float).reshape(3, 3) for _, m in messages]).reshape(
        -1, 3, 3
    )
    known = np.array([int(m.position_covariance_type) != COVARIANCE_UNKNOWN for _, m in messages], bool)
    fixed = (status >= 0) & np.isfinite(degrees).all(axis=1)
    return PositionReadings(name, stamps_ns, degrees, _usable(covariance, known, fixed), status), degrees


def from_positions(name: str, messages: Iterable[tuple[int, Any]]) -> PositionReadings:
    """Readings of PointStamped, PoseStamped, PoseWithCovarianceStamped, TransformStamped or Odometry."""
    stamps, positions, covariances = [], [], []
    for stamp, message in messages:
        stamps.append(stamp)
        point, covariance = _point(message)
        positions.append((point.x, point.y, point.z))
        covariances.append(
            np.zeros((3, 3)) if covariance is None else np.asarray(covariance, float).reshape(6, 6)[:3, :3]
        )
    position, covariance = np.array(positions).reshape(-1, 3), np.array(covariances).reshape(-1, 3, 3)
    everything = np.ones(len(stamps), bool)
    usable = _usable(covariance, everything, everything)
    return PositionReadings(name, np.array(stamps, np.int64), position, usable, np.zeros(0, np.int64))


def _point(message: Any) -> tuple[Any, Any]:
    """The position of a message, and its covariance (36,) where it has one."""
    if hasattr(message, "point"):
        return message.point, None
    if hasattr(message, "transform"):
        return message.transform.translation, None
    if hasattr(message.pose, "pose"):
        return message.pose.pose.position, message.pose.covariance
    return message.pose.position, None


def _usable(covariance: np.ndarray, known: np.ndarray, needed: np.ndarray) -> np.ndarray:
    """The covariances (N, 3, 3), or NO_COVARIANCE unless all that are `needed` (N,) are known and positive definite."""
    covariance = 0.5 * (covariance + covariance.transpose(0, 2, 1))
    finite = np.where(np.isfinite(covariance), covariance, 0.0)
    good = known & (np.linalg.eigvalsh(finite)[:, 0] > 0.0) if len(finite) else known
    if not needed.any() or not good[needed].all():
        return NO_COVARIANCE
    return np.where(needed[:, None, None], finite, np.eye(3))
