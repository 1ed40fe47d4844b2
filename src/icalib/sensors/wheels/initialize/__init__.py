"""Initial guess from wheel odometry."""
