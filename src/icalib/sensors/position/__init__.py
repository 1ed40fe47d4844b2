"""A sensor that measures its position and no orientation: a GNSS antenna, a total station's prism, a UWB tag."""
