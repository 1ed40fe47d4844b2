"""Initial guess of cameras with feature tracks."""
