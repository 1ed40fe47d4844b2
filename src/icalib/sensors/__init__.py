"""The factors of all kinds of sensors."""
