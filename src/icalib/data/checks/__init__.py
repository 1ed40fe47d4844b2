"""Whether readings can be what they say they are: units, axes, order, gaps."""
