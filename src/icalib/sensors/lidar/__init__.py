"""LiDARs: rig-file fields, reading, initial guess, factor of points on planes, report and simulation."""
