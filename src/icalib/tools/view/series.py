"""What is left of the measurements, and the motion, over time."""

from __future__ import annotations

import re
from collections.abc import Sequence

import numpy as np

from icalib.report.motion_figures import BLOCKS
from icalib.report.plot import AXIS_COLORS, COLORS, REJECTED
from icalib.result import Calibration, ImageResiduals, rms_of_images
from icalib.sensors.lidar.record import LidarResiduals
from icalib.tools.view.colors import rgb
from icalib.tools.view.scene import place
from icalib.tools.view.stream import RerunStream

BIN_S = 0.1  # over which points of a LiDAR are taken together
_DOT = 3.0  # radius, in points of the screen
_GOOD, _LEFT_OUT = "#22c55e", "#9ca3af"


def log_residuals(s: RerunStream, c: Calibration) -> None:
    """Of cameras the RMS of each image [px], of LiDARs that of each tenth of a second [mm], of all else whitened."""
    for r in c.image_residuals:
        rms = rms_of_images(r)
        some = np.isfinite(rms)
        log_lines(s, f"residuals/{r.sensor}/{r.kind}", r.seconds[some], rms[some, None], [f"RMS of {r.kind} [px]"])
        _log_seen(s, c, r)
    for r in c.lidar_residuals:
        seconds, rms = rms_of_bins(r)
        log_lines(s, f"residuals/{r.sensor}", seconds, 1e3 * rms[:, None], ["RMS [mm]"])
    if c.imu is not None:
        for b, block in enumerate(BLOCKS):
            columns = c.imu_residuals.whitened[:, 3 * b : 3 * b + 3]
            log_lines(s, f"residuals/{c.imu}/{block.replace(' ', '_')}", c.imu_residuals.seconds, columns, "xyz")
    for r in (*c.wheel_residuals, *c.pose_residuals):
        for k, label in enumerate(r.labels):
            entity = f"residuals/{r.sensor}/{re.sub(r'[^0-9a-zA-Z]+', '_', label)}"
            log_lines(s, entity, r.seconds, r.whitened[:, k : k + 1], [f"{label}, whitened"])


def log_states(s: RerunStream, c: Calibration) -> None:
    """Velocity [m/s] and biases [deg/s, m/s^2] at the keyframes; without an IMU they say nothing."""
    path = c.trajectory
    if c.imu is None:
        return
    log_lines(s, "motion/velocity", path.seconds, path.velocity, "xyz")
    log_lines(s, "motion/gyro_bias", path.seconds, np.rad2deg(path.gyro_bias), "xyz")
    log_lines(s, "motion/accel_bias", path.seconds, path.accel_bias, "xyz")


def log_lines(s: RerunStream, entity: str, seconds: np.ndarray, values: np.ndarray, names: Sequence[str]) -> None:
    """Lines over time: values (n, m), a column for each of the m names."""
    colors = AXIS_COLORS if len(names) == 3 else COLORS[: len(names)]
    s.still(entity, s.rr.SeriesLines(names=list(names), colors=rgb(*colors)))
    n, m = values.shape
    s.over(entity, seconds, s.rr.Scalars.columns(scalars=values.reshape(-1)).partition([m] * n))


def rms_of_bins(r: LidarResiduals) -> tuple[np.ndarray, np.ndarray]:
    """(m,) middle [s] and RMS [m] of the stretches of time in which there are points."""
    number, of = np.unique(np.floor(r.seconds / BIN_S).astype(np.int64), return_inverse=True)
    total = np.bincount(of, r.residual.astype(np.float64) ** 2, len(number))
    return BIN_S * (number + 0.5), np.sqrt(total / np.bincount(of, minlength=len(number)))


def _log_seen(s: RerunStream, c: Calibration, r: ImageResiduals) -> None:
    """Corners, or points that were followed, as they were measured in the camera's image; red where they were
    rejected, grey where their track is not in use."""
    rr, entity = s.rr, f"{place(c, r.sensor)}/image/{r.kind}"
    s.still(entity, rr.Points2D.from_fields(radii=rr.Radius.ui_points(_DOT)))
    colors = rgb(_LEFT_OUT, _GOOD, REJECTED)[np.where(r.rejected, 2, r.used.astype(np.int64))]
    columns = rr.Points2D.columns(positions=r.uv + 0.5, colors=colors).partition(np.diff(r.start))
    s.over(entity, r.seconds, columns)
