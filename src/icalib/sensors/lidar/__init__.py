"""LiDARs: the factor of points on planes, and all that other stages ask of the sensor."""
