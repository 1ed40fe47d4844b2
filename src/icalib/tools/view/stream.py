"""Sends data to Rerun: to its viewer, or to a file that is written atomically.

Colours from values, for points.
"""

from __future__ import annotations

import contextlib
import os
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from icalib.base.files import staged
from icalib.errors import CalibrationError

TIMELINE = "imu clock"
_PATIENCE_S = 30.0  # time limit for the viewer to receive all data


@dataclass(frozen=True)
class RerunStream:
    """A Rerun recording. rr: the rerun package; rec: its stream. Time-dependent data are on one timeline, in seconds of
    the result's clock."""

    rr: Any
    rec: Any

    def still(self, entity: str, *what: Any) -> None:
        """Sends archetypes that are valid at all times."""
        self.rec.log(entity, *what, static=True, strict=True)

    def at(self, entity: str, seconds: float, *what: Any) -> None:
        """Sends archetypes that are valid from an instant on."""
        self.rec.set_time(TIMELINE, duration=_rounded(np.array([seconds]))[0])
        self.rec.log(entity, *what, strict=True)

    def over(self, entity: str, seconds: np.ndarray, columns: Any) -> None:
        """Sends columns with a row for each of the seconds (n,)."""
        if len(seconds):
            index = self.rr.TimeColumn(TIMELINE, duration=_rounded(seconds))
            self.rec.send_columns(entity, [index], columns, strict=True)


@contextlib.contextmanager
def opened(rr: Any, blueprint: Any, save: Path | None) -> Iterator[RerunStream]:
    """Context with a stream to the file `save`, which replaces an old file at the end; save None: to a viewer, which is
    started. Raises CalibrationError if the file cannot be written, or there is no viewer."""
    rec = rr.RecordingStream("icalib")
    rec.set_log_time_enabled(False)
    if save is None:
        with _sentence("Rerun's viewer cannot be started or does not answer", "write a file by --save"):
            rec.spawn(default_blueprint=blueprint)
        yield RerunStream(rr, rec)
        with _sentence("Rerun's viewer cannot be started or does not answer", "write a file by --save"):
            rec.flush(timeout_sec=_PATIENCE_S)
        return
    try:
        with contextlib.ExitStack() as stack:
            with _sentence(f"{save} cannot be written", "choose another place"):
                if save.is_dir():
                    raise IsADirectoryError(0, "it is a folder")
                part = stack.enter_context(staged(save.parent)) / save.name
                rec.save(part, default_blueprint=blueprint)
            yield RerunStream(rr, rec)
            with _sentence(f"{save} cannot be written", "choose another place"):
                rec.flush()
                rec.disconnect()
                os.replace(part, save)
    finally:
        rec.disconnect()


@contextlib.contextmanager
def _sentence(what: str, advice: str) -> Iterator[None]:
    try:
        yield
    except (OSError, RuntimeError, ValueError) as error:
        reason = (error.strerror if isinstance(error, OSError) else None) or str(error).splitlines()[0]
        raise CalibrationError(f"{what} ({reason}); {advice}.") from error


def _rounded(seconds: np.ndarray) -> np.ndarray:
    """Seconds (n,) as whole nanoseconds, Rerun's unit of time."""
    return np.rint(1e9 * seconds).astype(np.int64).astype("timedelta64[ns]")


# Five colours of matplotlib's viridis, whose brightness increases steadily, also for colour-blind people.
_STOPS = np.array([[68, 1, 84], [59, 82, 139], [33, 145, 140], [94, 201, 98], [253, 231, 37]], np.float64)


def by_value(values: np.ndarray, low: float, high: float) -> np.ndarray:
    """(N, 3) uint8 RGB of values (N,): dark at `low` and below, bright at `high` and above."""
    share = np.clip((values - low) / max(high - low, np.finfo(float).tiny), 0.0, 1.0)
    at = np.linspace(0.0, 1.0, len(_STOPS))
    return np.stack([np.interp(share, at, channel) for channel in _STOPS.T], axis=1).round().astype(np.uint8)


def rgb(*colors: str) -> np.ndarray:
    """(n, 3) uint8 RGB of colours in HTML notation, "#rrggbb"."""
    return np.array([list(bytes.fromhex(color[1:])) for color in colors], np.uint8)
