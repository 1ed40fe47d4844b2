"""Calibrates cameras, LiDARs, wheels, pose sensors and an IMU jointly, in space and in time, from recordings."""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from icalib.calibration import Calibration
    from icalib.errors import CalibrationError
    from icalib.pipeline import calibrate
    from icalib.recordings import open_recording
    from icalib.rig_file import load_rig

__version__ = "0.1.0"
__all__ = ["Calibration", "CalibrationError", "__version__", "calibrate", "load_rig", "open_recording"]

_HOME = {
    "Calibration": "icalib.calibration",
    "CalibrationError": "icalib.errors",
    "calibrate": "icalib.pipeline",
    "load_rig": "icalib.rig_file",
    "open_recording": "icalib.recordings",
}


def __getattr__(name: str) -> Any:
    # Lazy (PEP 562): numba alone takes longer to import than most commands take to answer.
    if name not in _HOME:
        raise AttributeError(f"module 'icalib' has no attribute {name!r}; it has {', '.join(__all__)}")
    return getattr(import_module(_HOME[name]), name)


def __dir__() -> list[str]:
    return sorted(set(globals()) | set(__all__))
