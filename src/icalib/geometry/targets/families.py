"""Families of square tags: names, bits along a side, numbers of tags, and the bits, which OpenCV provides.

AprilTag families have their original names (tag36h11), all others the names in OpenCV without DICT_ (4x4_50).
"""

from __future__ import annotations

import re
from dataclasses import dataclass
from functools import lru_cache
from typing import Any

import numpy as np

from icalib.base.extras import load_cv2
from icalib.base.yaml_nodes import suggestion
from icalib.errors import RecordingError, RigError

# name -> (bits along a side without the border, number of ids); aruco_original is the family of the ArUco library.
FAMILIES = {
    **{f"{n}x{n}_{count}": (n, count) for n in (4, 5, 6, 7) for count in (50, 100, 250, 1000)},
    "aruco_original": (5, 1024),
    "aruco_mip_36h12": (6, 250),
    "tag16h5": (4, 30),
    "tag25h9": (5, 35),
    "tag36h10": (6, 2320),
    "tag36h11": (6, 587),
}
APRILGRID_FAMILY = "tag36h11"
_APRILTAG = re.compile(r"(?:april)?(?:tag)?_?([0-9]+h[0-9]+)")
_OPENCVS = {"aruco_original": "DICT_ARUCO_ORIGINAL", "aruco_mip_36h12": "DICT_ARUCO_MIP_36h12"}


@dataclass(frozen=True)
class TagSet:
    """Tags on a target: `ids` of `family`, with black borders of `border_bits` cells."""

    family: str
    border_bits: int
    ids: tuple[int, ...]

    def shared_with(self, other: TagSet) -> list[int]:
        """Ids, in increasing order, whose tags are the same in both sets."""
        # In OpenCV, larger families begin with the tags of smaller families with the same number of bits.
        kinds = [t.family.split("_")[0] if "x" in t.family else t.family for t in (self, other)]
        same = kinds[0] == kinds[1] and self.border_bits == other.border_bits
        return sorted(set(self.ids) & set(other.ids)) if same else []


def family_name(text: str) -> str:
    """The name in `FAMILIES` of a family named as by its authors, by ROS or by OpenCV, with or without DICT_.

    Raises RigError if there is none.
    """
    name = text.lower().removeprefix("dict_")
    if april := _APRILTAG.fullmatch(name):
        name = f"tag{april[1]}"
    if name not in FAMILIES:
        near = suggestion(name, FAMILIES)
        raise RigError(f"there is no tag family {text!r}{near}; available are {', '.join(FAMILIES)}.")
    return name


def checked_family(text: str, ids: int) -> str:
    """`family_name` of `text`. Raises RigError also if the family has fewer than `ids` tags."""
    family = family_name(text)
    if FAMILIES[family][1] < ids:
        raise RigError(f"needs {ids} tags, but {family} has {FAMILIES[family][1]}; choose a larger family.")
    return family


def is_apriltag(family: str) -> bool:
    """Whether a family of `FAMILIES` consists of AprilTags, which OpenCV draws rotated by 180 deg."""
    return family.startswith("tag")


def is_available(family: str) -> bool:
    """Whether the installed OpenCV has this family of `FAMILIES`; older versions lack some."""
    return hasattr(load_cv2().aruco, _opencvs_name(family))


@lru_cache(maxsize=32)
def opencv_bits(family: str) -> np.ndarray:
    """(ids, n, n) bool, True if white: all tags of this family of `FAMILIES` as OpenCV draws them, without the black
    border.

    Row 0 is at the top. AprilTags are rotated by 180 deg. Raises RecordingError if OpenCV, which provides the bits, is
    not installed or lacks the family.
    """
    if not is_available(family):
        raise RecordingError(f"the installed OpenCV has no tags of {family}; update opencv-python-headless.")
    aruco: Any = load_cv2().aruco
    dictionary = aruco.getPredefinedDictionary(getattr(aruco, _opencvs_name(family)))
    n, count = FAMILIES[family]
    pictures = [aruco.generateImageMarker(dictionary, i, n + 2, borderBits=1) for i in range(count)]
    bits = np.array(pictures)[:, 1:-1, 1:-1] > 0
    bits.setflags(write=False)
    return bits


def tag_bits(family: str, tag_id: int) -> np.ndarray:
    """(n, n) bool, True if white: one tag, upright as its authors and Kalibr draw it, without the black border.

    Row 0 is at the top. Raises as `opencv_bits`, and RigError if there is no such tag.
    """
    family = checked_family(family, tag_id + 1)
    bits = opencv_bits(family)[tag_id]
    return bits[::-1, ::-1] if is_apriltag(family) else bits


def _opencvs_name(family: str) -> str:
    """Name of the family's dictionary in OpenCV."""
    if is_apriltag(family):
        return f"DICT_APRILTAG_{family.removeprefix('tag')}"
    return _OPENCVS.get(family) or f"DICT_{family.upper()}"
