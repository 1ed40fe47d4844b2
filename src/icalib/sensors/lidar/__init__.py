"""The factor of a LiDAR: points on planes."""
