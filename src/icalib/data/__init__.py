"""What was measured: streams of all sensors, and the recordings that they are read from."""
