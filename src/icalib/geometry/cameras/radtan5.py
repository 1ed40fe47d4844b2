"""Pinhole camera with radial-tangential distortion of five coefficients, ROS's "plumb_bob" and OpenCV's default."""

from __future__ import annotations

from icalib.geometry.cameras.radtan import RadialTangential


class PinholeRadtan5(RadialTangential):
    """Radial-tangential distortion with a third radial coefficient, for lenses that two do not describe in the image
    corners.

    k3 is the last parameter, as in OpenCV's distCoeffs and ROS's CameraInfo.D.
    """

    name = "pinhole-radtan5"
    parameter_names = ("fx", "fy", "cx", "cy", "k1", "k2", "p1", "p2", "k3")
    start_distortions = ((0.0, 0.0, 0.0, 0.0, 0.0),)
