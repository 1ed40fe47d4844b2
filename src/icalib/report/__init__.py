"""The calibration as an HTML page, `report.html`, and as a table for the terminal."""

from icalib.report.page import report_html

__all__ = ["report_html"]
