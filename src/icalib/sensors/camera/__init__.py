"""Factors of cameras: corners of targets."""
