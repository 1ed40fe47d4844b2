"""OpenCV, an extra: imported on use, so that icalib works on detected corners without it."""

from __future__ import annotations

import importlib
from typing import Any

from icalib.errors import RecordingError

_DICTIONARIES = {
    "tag16h5": "DICT_APRILTAG_16h5",
    "tag25h9": "DICT_APRILTAG_25h9",
    "tag36h10": "DICT_APRILTAG_36h10",
    "tag36h11": "DICT_APRILTAG_36h11",
    "aruco_original": "DICT_ARUCO_ORIGINAL",
    "aruco_mip_36h12": "DICT_ARUCO_MIP_36h12",
    **{f"{n}x{n}_{size}": f"DICT_{n}X{n}_{size}" for n in (4, 5, 6, 7) for size in (50, 100, 250, 1000)},
}
FAMILIES = tuple(_DICTIONARIES)  # names of the families of tags that can be detected


def opencv() -> Any:
    """The module cv2. Raises RecordingError where it is not installed."""
    try:
        return importlib.import_module("cv2")
    except ImportError:
        raise RecordingError(
            "images are read with OpenCV, which is not installed; run `pip install icalib[images]`."
        ) from None


def dictionary(family: str) -> Any:
    """OpenCV's dictionary of a family of `FAMILIES`. Raises RecordingError for another name, listing what there is."""
    if family not in _DICTIONARIES:
        raise RecordingError(f"tag family {family!r} is not known; choose one of {', '.join(FAMILIES)}.")
    aruco = opencv().aruco
    if not is_available(family):
        raise RecordingError(f"the installed OpenCV has no tags of {family}; update opencv-python-headless.")
    return aruco.getPredefinedDictionary(getattr(aruco, _DICTIONARIES[family]))


def is_available(family: str) -> bool:
    """Whether the installed OpenCV has this family of `FAMILIES`; older ones lack some."""
    return hasattr(opencv().aruco, _DICTIONARIES[family])
