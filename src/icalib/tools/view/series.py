"""Curves over time: residuals, velocity and biases."""

from __future__ import annotations

import re
from collections.abc import Sequence

import numpy as np

from icalib.report.plot import AXIS_COLORS, COLORS, REJECTED
from icalib.report.residual_views import curves
from icalib.result import Calibration
from icalib.tools.view.colors import rgb
from icalib.tools.view.scene import place
from icalib.tools.view.stream import RerunStream

_DOT = 3.0  # radius, in screen points
_GOOD, _LEFT_OUT = "#22c55e", "#9ca3af"


def log_residuals(s: RerunStream, c: Calibration) -> None:
    """Sends the residuals of all sensors over time, and for cameras also the measured image points."""
    for r in c.residuals.values():
        for curve in curves(c, r):
            name = re.sub(r"[^0-9a-zA-Z]+", "_", curve.name)
            entity = f"residuals/{r.sensor}/{name}" if name else f"residuals/{r.sensor}"
            log_lines(s, entity, curve.seconds, curve.values, curve.labels)
    _log_observations(s, c)


def log_states(s: RerunStream, c: Calibration) -> None:
    """Sends velocity [m/s] and biases [deg/s, m/s^2] at the keyframes; nothing without an IMU."""
    path = c.trajectory
    if c.imu is None:
        return
    log_lines(s, "motion/velocity", path.seconds, path.velocity, "xyz")
    log_lines(s, "motion/gyro_bias", path.seconds, np.rad2deg(path.gyro_bias), "xyz")
    log_lines(s, "motion/accel_bias", path.seconds, path.accel_bias, "xyz")


def log_lines(s: RerunStream, entity: str, seconds: np.ndarray, values: np.ndarray, names: Sequence[str]) -> None:
    """Sends curves over time. seconds (n,); values (n, m): a column for each of the m names."""
    colors = AXIS_COLORS if len(names) == 3 else COLORS[: len(names)]
    s.still(entity, s.rr.SeriesLines(names=list(names), colors=rgb(*colors)))
    n, m = values.shape
    s.over(entity, seconds, s.rr.Scalars.columns(scalars=values.reshape(-1)).partition([m] * n))


def _log_observations(s: RerunStream, c: Calibration) -> None:
    """Sends measured corners and tracked points in the images; rejected ones are red, those of unused tracks grey."""
    rr = s.rr
    for r in c.image_residuals:
        entity = f"{place(c, r.sensor)}/image/{r.kind}"
        s.still(entity, rr.Points2D.from_fields(radii=rr.Radius.ui_points(_DOT)))
        colors = rgb(_LEFT_OUT, _GOOD, REJECTED)[np.where(r.rejected, 2, r.used.astype(np.int64))]
        columns = rr.Points2D.columns(positions=r.uv + 0.5, colors=colors).partition(np.diff(r.start))
        s.over(entity, r.seconds, columns)
