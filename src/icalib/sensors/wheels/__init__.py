"""The factors of wheel odometry, and of the ground that wheels stand on."""
