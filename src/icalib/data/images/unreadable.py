"""Files and topics that hold no measurements icalib could read, though they look like it: what they are, what to do."""

from __future__ import annotations

import re
from pathlib import Path

VIDEO_FILE = "video file"  # the type of a topic
HEAD_BYTES = 64  # that `not_data` needs
VIDEO_SUFFIXES = (".mp4", ".mov", ".avi", ".mkv", ".webm", ".m4v", ".h264", ".h265", ".mjpeg", ".insv", ".360")
_POINTERS = {b"version https://git-lfs.github.com/spec": "git lfs pull", b"/annex/objects/": "git annex get"}
_CONTAINERS = ((4, b"ftyp"), (0, b"\x1aE\xdf\xa3"), (8, b"AVI "))  # MP4 and MOV, Matroska and WebM, AVI
_PACKETS = re.compile(
    r"(velodyne|ouster|hesai|pandar|rslidar|robosense|nebula|lslidar|seyond|innovusion|vanjee)\w*/msg/"
    r"\w*(scan|packets?|packetmsg|udpframe)",
    re.IGNORECASE,
)
_VIDEO = re.compile(r"\w+/msg/(CompressedVideo|FFMPEGPacket|H26[45]\w*)|theora_image_transport/msg/Packet")


def not_data(path: Path, head: bytes) -> str | None:
    """A sentence where a file that begins with `head` is a pointer of Git LFS or git-annex, or a video, else None."""
    for magic, command in _POINTERS.items():
        if head.startswith(magic):
            return f"{path} is a pointer to a file that was not downloaded; run `{command}` where it comes from."
    if any(head[at : at + len(magic)] == magic for at, magic in _CONTAINERS):
        return f"{path} is a video; give the folder that it lies in as the recording."
    return None


def is_video(path: Path) -> bool:
    """By its name."""
    return path.suffix.lower() in VIDEO_SUFFIXES


def type_not_read(kind: str) -> tuple[str, str] | None:
    """What a topic of type `kind` would have to be (points, image), and a phrase on what it holds instead and what to
    do, where it holds raw packets of a LiDAR or a video; None of other types."""
    if _PACKETS.fullmatch(kind):
        return "points", (
            "raw packets of a LiDAR; replay the recording with the LiDAR's driver, and record the "
            "sensor_msgs/PointCloud2 that it sends"
        )
    if _VIDEO.fullmatch(kind):
        return "image", "compressed video; decode it by its image transport, and record sensor_msgs/Image"
    return None
