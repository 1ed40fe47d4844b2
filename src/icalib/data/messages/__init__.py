"""Messages that several kinds of sensors are read from."""
