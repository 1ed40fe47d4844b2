"""Initial guess from point clouds."""
