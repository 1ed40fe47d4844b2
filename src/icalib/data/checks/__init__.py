"""Plausibility checks of readings."""
