"""Initial guess from targets."""
