"""What works with calibrations: the library never imports it."""
