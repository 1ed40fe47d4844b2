"""A sensor's own trajectory, aligned to the IMU's readings or to a known trajectory."""
