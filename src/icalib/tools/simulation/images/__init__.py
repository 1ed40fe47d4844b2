"""Rendered images of targets and rooms."""
