"""Sections of the report on position sensors: residuals over time, and a map of fixes with large residuals."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from icalib.report.figures import COLORS, Figure, axis, dots, figure, line, thin
from icalib.report.page import Group, Plot, Presenter, Section, row_sections
from icalib.result import Calibration, RowResiduals

OUTLIER_SIGMA = 3.0  # standard deviations: white noise exceeds it in 1 of 34 fixes (chi, three degrees of freedom)
MAX_PATH_POINTS = 4000  # of a trajectory in a figure
_WORDS = (
    "Along x, y and z of the sensor's frame: east, north and up of GNSS. They should look like noise; waves and steps "
    "are errors that last."
)
_MAP = (
    "The path of each antenna from above, and where its fixes are more than three standard deviations off. If they are "
    "in one place, look for walls and trees there. Axes are those of the estimated world, which need not be east and "
    "north."
)


def sections(c: Calibration) -> Iterator[Section]:
    """Residuals of each position sensor, and the map."""
    yield from row_sections(c, "position", "positions", "Residuals of position sensors", _WORDS)
    plots = [Plot(f"map-{i}", _map(c, r), r.sensor) for i, r in enumerate(_residuals_of_positions(c))]
    if plots:
        yield Section("maps", "Map of fixes", _MAP, [Group(plots=plots)])


def amounts(c: Calibration) -> Iterator[str]:
    """The number of fixes in use."""
    if records := _residuals_of_positions(c):
        yield f"{sum(len(r.seconds) for r in records)} fixes"


def _residuals_of_positions(c: Calibration) -> list[RowResiduals]:
    return [r for r in c.residuals.values() if isinstance(r, RowResiduals) and r.sensor in c.of_type("position")]


def _map(c: Calibration, r: RowResiduals) -> Figure:
    """The antenna's trajectory in the world from above, with the fixes off by more than OUTLIER_SIGMA."""
    at = c.trajectory
    path = at.position + at.rotation @ c.value(r.sensor, "translation")
    keep = thin(len(path), MAX_PATH_POINTS)
    off = r.seconds[np.linalg.norm(r.whitened, axis=1) > OUTLIER_SIGMA]
    x, y = (np.interp(off, at.seconds, path[:, k]) for k in range(2))
    traces = [
        line(path[keep, 0], path[keep, 1], "path", COLORS[0]),
        dots(x, y, f"{len(off)} of {len(r.seconds)} fixes, off by more than {OUTLIER_SIGMA:g} sigma", COLORS[1], 7),
    ]
    return figure(traces, 480, xaxis=axis("x [m]"), yaxis=axis("y [m]", scaleanchor="x"))


PRESENTER = Presenter(
    sections=sections,
    amounts=amounts,
)
