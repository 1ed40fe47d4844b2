"""The IMU in the report: its residuals."""

from __future__ import annotations

from collections.abc import Iterator

from icalib.report.figures import Figure, ResidualCurve, stacked_panels, thin
from icalib.report.page import Group, Plot, Presenter, Section
from icalib.report.rig_figures import MAX_PLOTTED_KEYFRAMES
from icalib.result import Calibration
from icalib.sensors.imu.stream import ImuResiduals

LEGEND = "the axes of an IMU are those of its gyroscope"
BLOCKS = ("rotation", "velocity", "position", "gyro walk", "accel walk")  # titles of three columns each
_WORDS = (
    "Whitened: between two keyframes, in units of what the IMU's noise allows. "
    f"At most {MAX_PLOTTED_KEYFRAMES} intervals are drawn."
)


def sections(c: Calibration) -> Iterator[Section]:
    """A section for each IMU, with the residuals of the intervals between keyframes."""
    for k, residuals in enumerate(c.imu_residuals):
        title = f"Residuals of {residuals.sensor}" if len(c.imu_residuals) > 1 else "IMU residuals"
        place = f"imu-residuals-{k}" if k else "imu-residuals"
        plot = Plot(place, residuals_over_time(residuals), f"{residuals.sensor}: residuals over time")
        yield Section(f"inertial-{k}" if k else "inertial", title, _WORDS, [Group(plots=[plot])])


def residuals_over_time(r: ImuResiduals) -> Figure:
    """Whitened residuals over time: standard normal, or smaller where the trajectory absorbs noise."""
    keep = thin(len(r.seconds), MAX_PLOTTED_KEYFRAMES)
    panels = [(r.seconds[keep], r.whitened[keep, 3 * b : 3 * b + 3]) for b in range(len(BLOCKS))]
    return stacked_panels(panels, BLOCKS, 680)


def curves(r: ImuResiduals) -> Iterator[ResidualCurve]:
    """The curves of whitened residuals over time, for each block of three columns."""
    for b, block in enumerate(BLOCKS):
        yield ResidualCurve(block, r.seconds, r.whitened[:, 3 * b : 3 * b + 3], ("x", "y", "z"))


PRESENTER = Presenter(
    sections=sections,
    over_time=residuals_over_time,
    curves=curves,
    legend=LEGEND,
)
