"""Pose sensors: motion capture, or the odometry of another program."""
