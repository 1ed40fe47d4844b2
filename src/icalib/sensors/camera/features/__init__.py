"""Factor of feature tracks of all cameras, with points that may lie on planes of LiDARs."""
