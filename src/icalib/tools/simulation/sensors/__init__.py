"""Simulated measurements of IMU and cameras, by direct formulas without approximations for speed."""
