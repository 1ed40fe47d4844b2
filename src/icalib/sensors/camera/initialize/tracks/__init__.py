"""Initial guess from feature tracks."""
