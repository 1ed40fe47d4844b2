"""Images -> feature tracks: corners of the scene, tracked from image to image (Shi and Tomasi, CVPR 1994)."""
