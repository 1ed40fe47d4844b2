"""Names of the formats, apart from what makes them, so that the command line knows them at once."""

from __future__ import annotations

FORMATS = (
    "kalibr", "openvins", "vins-fusion", "ros2-static", "camera-info", "urdf", "mins", "fast-lio", "json"
)  # fmt: skip
ONE_FILE = ("ros2-static", "urdf", "json")  # where the path is that of a file, not of a folder
