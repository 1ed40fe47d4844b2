"""Wheels in the report and the 3D view: residuals over time, and two discs on an axle."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from icalib.report.page import Presenter, Section, row_sections
from icalib.report.rig_figures import CIRCLE, PEN_UP
from icalib.result import Calibration

LEGEND = "pairs of discs are wheels"
_WORDS = (
    "The angle that each wheel turned from one keyframe to the next, or the distance and the rotation that were "
    "reported. Slip is how far the axle moved sideways and off the ground, which should be zero. With steering "
    "angles it is how far the front axle moved across its wheels."
)


def sections(c: Calibration) -> Iterator[Section]:
    """A section with the residuals of each set of wheels."""
    yield from row_sections(c, "wheels", "wheels", "Wheel residuals", _WORDS)


def amounts(c: Calibration) -> Iterator[str]:
    """The number of intervals used, as text."""
    if c.wheel_residuals:
        yield f"{sum(len(r.seconds) for r in c.wheel_residuals)} stretches of wheel turns"


def shape(c: Calibration, name: str, spread: float) -> np.ndarray:
    """Polyline (n, 3) [m] of the wheels in the wheel frame; see `axle`."""
    return axle(c, name)


def axle(c: Calibration, name: str) -> np.ndarray:
    """Polyline (n, 3) [m] of two discs and their axle in the wheel frame, interrupted by NaN; nothing is drawn for
    wheels without radii."""
    known = {g.name: g.value for g in c.groups if g.sensor == name}
    if "radii" not in known:
        return PEN_UP
    left, right = (np.array([0.0, s * 0.5 * known["baseline"][0], 0.0]) for s in (1.0, -1.0))
    rim = np.insert(CIRCLE, 1, 0.0, axis=1)
    discs = [(hub + r * rim, hub + r * rim[::5]) for hub, r in zip((left, right), known["radii"], strict=True)]
    pen = [left, right, PEN_UP]
    for hub, (circle, ends) in zip((left, right), discs, strict=True):
        pen += [circle, PEN_UP, *(np.stack([hub, end, PEN_UP[0]]) for end in ends)]
    return np.vstack(pen)


PRESENTER = Presenter(
    sections=sections,
    amounts=amounts,
    shape=shape,
    legend=LEGEND,
)
