"""The calibration as a page to read: `report.html`."""
