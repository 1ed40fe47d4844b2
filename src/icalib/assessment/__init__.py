"""From an estimate to a `Calibration`: standard deviations, empirical factors, verdicts, warnings."""

from icalib.assessment.assess import assess, visited

__all__ = ["assess", "visited"]
