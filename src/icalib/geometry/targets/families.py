"""Families of square tags by name: how many bits a side, how many tags. The names are OpenCV's, without DICT_."""

from __future__ import annotations

import numpy as np

from icalib.errors import CalibrationError, RigError

# name -> (bits along a side without the border, number of ids); `original` is that of the ArUco library.
FAMILIES = {
    **{f"{n}x{n}_{count}": (n, count) for n in (4, 5, 6, 7) for count in (50, 100, 250, 1000)},
    "aruco_original": (5, 1024),
    "aruco_mip_36h12": (6, 250),
    "apriltag_16h5": (4, 30),
    "apriltag_25h9": (5, 35),
    "apriltag_36h10": (6, 2320),
    "apriltag_36h11": (6, 587),
}


def check_family(family: str, ids: int) -> None:
    """Raises RigError where there is no such family, or it has fewer than `ids` tags."""
    if family not in FAMILIES:
        raise RigError(f"there is no family of tags {family!r}; available are {', '.join(FAMILIES)}.")
    if FAMILIES[family][1] < ids:
        raise RigError(f"needs {ids} tags, but {family} has {FAMILIES[family][1]}; choose a larger family.")


def tag_bits(family: str, tag_id: int) -> np.ndarray:
    """(n, n) bool, True where white: the tag upright, row 0 at the top, without its black border.

    AprilTags stand as their authors and Kalibr draw them, which is upside down in OpenCV. Raises CalibrationError where
    OpenCV, which knows the bits, is not installed; RigError where there is no such tag.
    """
    check_family(family, tag_id + 1)
    try:
        from cv2 import aruco
    except ImportError:
        raise CalibrationError(
            "the bits of tags come from OpenCV, which is not installed; install icalib[images]."
        ) from None
    name = "DICT_" + (family.upper() if not family.startswith("apriltag") else family.replace("apriltag", "APRILTAG"))
    dictionary = aruco.getPredefinedDictionary(getattr(aruco, name))
    n = FAMILIES[family][0]
    image = aruco.generateImageMarker(dictionary, tag_id, n + 2, borderBits=1)
    bits = np.asarray(image)[1:-1, 1:-1] > 0
    return bits[::-1, ::-1] if family.startswith("apriltag") else bits
