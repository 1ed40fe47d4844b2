"""Calibrates cameras, LiDARs, wheels, pose sensors and an IMU jointly, in space and in time, from recordings."""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from icalib.cli.console import progress_bar
    from icalib.data.recordings import open_recording
    from icalib.errors import CalibrationError
    from icalib.pipeline import calibrate, calibrate_measurements
    from icalib.result import Calibration, load_calibration
    from icalib.rig.file import load_rig
    from icalib.sensors.parameter import Parameter, fixed, free, guess, prior
    from icalib.tools.check import check_calibration as check
    from icalib.tools.comparison.reading import compare_files as compare
    from icalib.tools.inspection import inspect_recording as inspect

__version__ = "0.2.0"
__all__ = [
    "Calibration",
    "CalibrationError",
    "Parameter",
    "__version__",
    "calibrate",
    "calibrate_measurements",
    "check",
    "compare",
    "fixed",
    "free",
    "guess",
    "inspect",
    "load_calibration",
    "load_rig",
    "open_recording",
    "prior",
    "progress_bar",
]

_HOME = {
    "Calibration": "icalib.result",
    "CalibrationError": "icalib.errors",
    "Parameter": "icalib.sensors.parameter",
    "calibrate": "icalib.pipeline",
    "calibrate_measurements": "icalib.pipeline",
    "check": "icalib.tools.check",
    "compare": "icalib.tools.comparison.reading",
    "fixed": "icalib.sensors.parameter",
    "free": "icalib.sensors.parameter",
    "guess": "icalib.sensors.parameter",
    "inspect": "icalib.tools.inspection",
    "load_calibration": "icalib.result",
    "load_rig": "icalib.rig.file",
    "open_recording": "icalib.data.recordings",
    "prior": "icalib.sensors.parameter",
    "progress_bar": "icalib.cli.console",
}

_NAMED = {"check": "check_calibration", "compare": "compare_files", "inspect": "inspect_recording"}  # in their modules


def __getattr__(name: str) -> Any:
    # Lazy (PEP 562): numba alone takes longer to import than most commands take to answer.
    if name not in _HOME:
        raise AttributeError(f"module 'icalib' has no attribute {name!r}; it has {', '.join(__all__)}")
    return getattr(import_module(_HOME[name]), _NAMED.get(name, name))


def __dir__() -> list[str]:
    return sorted(set(globals()) | set(__all__))
