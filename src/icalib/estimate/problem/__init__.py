"""The least-squares problem of one pass, from rig and data, and its solution."""
