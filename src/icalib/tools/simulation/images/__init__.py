"""Rendered images of a room."""
