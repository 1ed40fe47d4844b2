"""A first guess of everything, from the measurements alone."""
