"""Maximum a posteriori estimate of calibration and trajectory: problem, solver, and the reweighting loop."""
