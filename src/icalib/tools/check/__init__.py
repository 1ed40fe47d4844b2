"""Tests whether a calibration is still valid on a new recording."""

from icalib.tools.check.check import (
    Check,
    GroupDifference,
    Validity,
    check_calibration,
    check_measurements,
    with_places,
)

__all__ = ["Check", "GroupDifference", "Validity", "check_calibration", "check_measurements", "with_places"]
