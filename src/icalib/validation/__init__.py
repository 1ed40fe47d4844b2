"""Turns an estimate into a `Calibration`: standard deviations, empirical factors, verdicts and warnings."""

from icalib.validation.assess import assess, visited
from icalib.validation.guesses import stated_words

__all__ = ["assess", "stated_words", "visited"]
