"""The calibration in the formats of other programs."""
