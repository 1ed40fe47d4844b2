"""The IMU: rig-file fields, reading, checks, preintegrated factor and report."""
