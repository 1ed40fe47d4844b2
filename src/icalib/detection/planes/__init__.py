"""Planes in point clouds."""
