"""The IMU in the report: its residuals."""

from __future__ import annotations

from collections.abc import Iterator

from icalib.report import motion_figures
from icalib.report.residual_views import ResidualCurve
from icalib.report.sections import Section, plot_place
from icalib.result import Calibration, ImuResiduals

_WORDS = (
    f"Whitened: between two keyframes, in units of what the IMU's noise allows. "
    f"At most {motion_figures.MAX_PLOTTED_KEYFRAMES} "
    "intervals are drawn."
)


def sections(c: Calibration) -> Iterator[Section]:
    """The section with the residuals of the intervals between keyframes."""
    if c.imu is not None:
        figures = {"imu-residuals": motion_figures.imu_residuals(c)}
        yield Section("inertial", "IMU residuals", _WORDS, plot_place("imu-residuals"), figures)


def curves(r: ImuResiduals) -> Iterator[ResidualCurve]:
    """The curves of whitened residuals over time, for each block of three columns."""
    for b, block in enumerate(motion_figures.BLOCKS):
        yield ResidualCurve(block, r.seconds, r.whitened[:, 3 * b : 3 * b + 3], ("x", "y", "z"))
