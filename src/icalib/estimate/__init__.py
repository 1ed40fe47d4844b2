"""From measurements to the most probable calibration: factors, problem, solver."""
