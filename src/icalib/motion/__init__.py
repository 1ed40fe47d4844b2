"""The model of an IMU, preintegration, and the pose of a sensor at any instant."""
