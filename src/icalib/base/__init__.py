"""Utilities for all packages: files, YAML with line numbers, optional dependencies, compilation by numba."""
