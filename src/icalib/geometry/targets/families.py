"""Families of square tags by name: how many bits a side, how many tags, and the bits, which OpenCV knows.

AprilTags are called as their authors do (tag36h11), others as OpenCV does, without DICT_ (4x4_50).
"""

from __future__ import annotations

import re
from dataclasses import dataclass
from functools import lru_cache
from typing import Any

import numpy as np

from icalib.base.extras import load_cv2
from icalib.base.suggestion import suggestion
from icalib.errors import RecordingError, RigError

# name -> (bits along a side without the border, number of ids); `original` is that of the ArUco library.
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
    """Tags that are on a target: `ids` of `family`, with black borders of `border_bits` cells."""

    family: str
    border_bits: int
    ids: tuple[int, ...]

    def shared_with(self, other: TagSet) -> list[int]:
        """Ids under which either set has the same tag as the other."""
        # Of OpenCV's families with the same number of bits, the larger ones begin with the smaller ones.
        kinds = [t.family.split("_")[0] if "x" in t.family else t.family for t in (self, other)]
        same = kinds[0] == kinds[1] and self.border_bits == other.border_bits
        return sorted(set(self.ids) & set(other.ids)) if same else []


def family_name(text: str) -> str:
    """The name in `FAMILIES` of a family that is called so by its authors, by ROS or by OpenCV, with DICT_ or without.

    Raises RigError where there is none.
    """
    name = text.lower().removeprefix("dict_")
    if april := _APRILTAG.fullmatch(name):
        name = f"tag{april[1]}"
    if name not in FAMILIES:
        near = suggestion(name, FAMILIES)
        raise RigError(f"there is no tag family {text!r}{near}; available are {', '.join(FAMILIES)}.")
    return name


def checked_family(text: str, ids: int) -> str:
    """As `family_name`. Raises RigError also where the family has fewer than `ids` tags."""
    family = family_name(text)
    if FAMILIES[family][1] < ids:
        raise RigError(f"needs {ids} tags, but {family} has {FAMILIES[family][1]}; choose a larger family.")
    return family


def is_apriltag(family: str) -> bool:
    """Whether OpenCV draws the tags of this family of `FAMILIES` upside down."""
    return family.startswith("tag")


def is_available(family: str) -> bool:
    """Whether the installed OpenCV has this family of `FAMILIES`; older ones lack some."""
    return hasattr(load_cv2().aruco, _opencvs_name(family))


@lru_cache(maxsize=32)
def opencv_bits(family: str) -> np.ndarray:
    """(ids, n, n) bool, True where white: all tags of this family of `FAMILIES` as OpenCV draws them, alone and on its
    boards; row 0 at the top, without the black border. AprilTags are rotated by 180 deg.

    Raises RecordingError where OpenCV, which knows the bits, is not installed or does not know these.
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
    """(n, n) bool, True where white: the tag upright, as its authors draw it, Kalibr too; row 0 at the top, without its
    black border.

    Raises as `opencv_bits`, and RigError where there is no such tag.
    """
    family = checked_family(family, tag_id + 1)
    bits = opencv_bits(family)[tag_id]
    return bits[::-1, ::-1] if is_apriltag(family) else bits


def _opencvs_name(family: str) -> str:
    if is_apriltag(family):
        return f"DICT_APRILTAG_{family.removeprefix('tag')}"
    return _OPENCVS.get(family) or f"DICT_{family.upper()}"
