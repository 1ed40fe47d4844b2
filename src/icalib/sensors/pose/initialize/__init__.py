"""Initial guess from poses."""
