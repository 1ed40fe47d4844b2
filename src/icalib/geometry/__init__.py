"""Rotations, camera models, calibration targets and other geometry."""
