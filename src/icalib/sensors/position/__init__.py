"""A sensor that gives its own position and no orientation: a GNSS antenna, a total station's prism, a UWB tag."""
