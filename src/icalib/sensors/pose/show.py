"""What the report shows of pose sensors: residuals over time."""

from __future__ import annotations

from collections.abc import Iterator

from icalib.report.sections import Section, row_sections
from icalib.result import Calibration

_WORDS = (
    "Rotation about the sensor's own axes, position along those in which it was measured. They should look like "
    "noise; slow waves are poses that drift or are filtered."
)


def sections(c: Calibration) -> Iterator[Section]:
    """Residuals of each pose sensor."""
    yield from row_sections(c, "pose", "poses", "Residuals of pose sensors", _WORDS)
