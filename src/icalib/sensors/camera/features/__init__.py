"""Factors of cameras: feature tracks, and planes that their points lie on."""
