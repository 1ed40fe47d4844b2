"""Pose sensors in the report: residuals over time."""

from __future__ import annotations

from collections.abc import Iterator

from icalib.report.page import Presenter, Section, row_sections
from icalib.result import Calibration

_SECTION_WORDS = (
    "Rotation about the axes of the sensor, position along the axes of its frame. They should look like white noise; "
    "slow waves come from poses that drift or are filtered."
)


def sections(c: Calibration) -> Iterator[Section]:
    """One section with the residuals of each pose sensor."""
    yield from row_sections(c, "pose", "poses", "Residuals of pose sensors", _SECTION_WORDS)


PRESENTER = Presenter(
    sections=sections,
)
