"""Images -> feature tracks: corners of the scene, followed from image to image (Shi and Tomasi, CVPR 1994)."""
