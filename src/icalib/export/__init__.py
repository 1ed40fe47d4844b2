"""Exports a calibration to the formats of other programs."""
