"""The factor of a sensor that gives its own pose."""
