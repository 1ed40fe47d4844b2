"""A sensor's own trajectory against the IMU or a known motion: what sensors of several kinds share."""
