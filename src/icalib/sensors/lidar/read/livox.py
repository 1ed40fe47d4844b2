"""Parser of the point message of Livox: CustomMsg of livox_ros_driver, livox_ros_driver2 and livox_ros2_driver.

Its definition, which ROS does not include:

Header header; uint64 timebase; uint32 point_num; uint8 lidar_id; uint8[3] rsvd; CustomPoint[] points
CustomPoint: uint32 offset_time [ns]; float32 x, y, z [m]; uint8 reflectivity, tag, line
"""

from __future__ import annotations

import struct
from collections import namedtuple
from dataclasses import dataclass

import numpy as np

TYPES = ("livox_ros_driver/msg/CustomMsg", "livox_ros_driver2/msg/CustomMsg", "livox_interfaces/msg/CustomMsg")
_POINT_FIELDS = {"offset_time": "u4", "x": "f4", "y": "f4", "z": "f4", "reflectivity": "u1", "tag": "u1", "line": "u1"}
_POINT_BYTES = 19  # size of a point; in CDR padded to a multiple of 4


# Stamp [s, ns since 1970] and header of a message, with the field names of ROS.
Stamp, Header = namedtuple("Stamp", "sec nanosec"), namedtuple("Header", "stamp frame_id")


@dataclass(frozen=True)
class LivoxCloud:
    """A CustomMsg. points (N,): structured array with the fields of CustomPoint."""

    header: Header
    points: np.ndarray


def parse_ros1(content: bytes) -> LivoxCloud:
    """Parses a message in ROS 1 serialisation. Raises ValueError or struct.error if the bytes are no such message."""
    _, sec, nanosec, length = struct.unpack_from("<4I", content)
    at = 16 + length
    header = Header(Stamp(sec, nanosec), content[16:at].decode("utf-8", "replace"))
    return LivoxCloud(header, _points(content, at + 16, "<", _POINT_BYTES))


def parse_cdr(content: bytes) -> LivoxCloud:
    """Parses a message in CDR (ROS 2). Raises ValueError or struct.error if the bytes are no such message."""
    body = content[4:]  # alignment counts from here
    order = "<" if content[1:2] == b"\x01" else ">"
    sec, nanosec, length = struct.unpack_from(order + "iII", body)
    name = body[12 : 12 + length].rstrip(b"\0").decode("utf-8", "replace")
    timebase = -(-(12 + length) // 8) * 8
    return LivoxCloud(Header(Stamp(sec, nanosec), name), _points(body, timebase + 16, order, -(-_POINT_BYTES // 4) * 4))


def _points(content: bytes, at: int, order: str, step: int) -> np.ndarray:
    """Points (N,), structured. N is stored at byte `at`; the points follow, `step` bytes each. order: byte order."""
    (count,) = struct.unpack_from(order + "I", content, at)
    size = step * count - (step - _POINT_BYTES) * (count > 0)
    data = content[at + 4 : at + 4 + size]
    if len(data) < size:
        raise ValueError(f"{count} points do not fit {len(content)} bytes")
    offsets = np.cumsum([0, *(np.dtype(kind).itemsize for kind in _POINT_FIELDS.values())])[:-1].tolist()
    kinds = [order + kind for kind in _POINT_FIELDS.values()]
    dtype = np.dtype({"names": list(_POINT_FIELDS), "formats": kinds, "offsets": offsets, "itemsize": step})
    return np.frombuffer(data + bytes(step * count - size), dtype)
