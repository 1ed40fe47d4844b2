"""Pose sensors: sensors that report poses, such as motion capture or the odometry of another program."""
