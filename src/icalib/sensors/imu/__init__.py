"""The factor of an IMU between two keyframes."""
