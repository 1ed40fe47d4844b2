"""Differences between two calibrations, or between a calibration and a Kalibr file, URDF or rig file of its rig."""
