"""Initial guess of cameras that see a target of one or several bodies."""
