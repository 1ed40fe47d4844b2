"""Tools around calibration: simulation, inspection, comparison, studies.

Only `cli` and the modules `simulate` and `inspect` of sensors import them; calibration itself does not.
"""
