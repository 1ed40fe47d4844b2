"""Names of the formats, apart from what makes them, so that the command line knows them at once."""

from __future__ import annotations

FORMATS = (
    "kalibr",
    "openvins",
    "vins-fusion",
    "orb-slam3",
    "ros2-static",
    "camera-info",
    "urdf",
    "autoware",
    "mins",
    "fast-lio",
    "fast-livo2",
    "lio-sam",
    "colmap",
    "json",
)
FRAMED = ("ros2-static", "urdf", "autoware")  # that name the sensors' frames
ONE_FILE = ("ros2-static", "urdf", "json")  # where the path is that of a file, not of a folder
