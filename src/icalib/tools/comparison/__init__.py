"""What changed between two calibrations, or between a calibration and what others say of the same rig."""
