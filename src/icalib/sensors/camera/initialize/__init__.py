"""Initial guess of cameras."""
