"""Least squares on manifolds: layout and state, normal equations, elimination, acceleration."""
