"""From rig and data to the problem, and from there to its solution."""
