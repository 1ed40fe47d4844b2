"""From an estimate to a `Calibration`: standard deviations, empirical factors, verdicts, warnings."""

from icalib.assessment.assess import assess, visited
from icalib.assessment.stated import stated_words

__all__ = ["assess", "stated_words", "visited"]
