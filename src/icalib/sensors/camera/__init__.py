"""Cameras: reading, initial guess, factors and report of target corners and feature tracks."""
