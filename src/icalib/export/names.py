"""Names of the export formats. They are separate from the exporters, so that the command line imports them quickly."""

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
FRAMED = ("ros2-static", "urdf", "autoware")  # formats that contain names of sensor frames
ONE_FILE = ("ros2-static", "urdf", "json")  # formats whose output path is a file, not a folder
