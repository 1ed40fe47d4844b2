"""Time offsets of sensor clocks against the clock of the body: one, or one per recording if the clock restarts.

The value of the block time_offset is (1,) or (R,): seconds to add to a sensor's time since its first stamp to get the
time of the body.
"""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from icalib.data.measurements import Stream
from icalib.optim.state import Key, Layout, State

RECORDING_MARGIN_S = 5.0  # a measurement may precede its stamp by as much; recordings are further apart


def instants(stream: Stream, values: dict[Key, np.ndarray], seconds: np.ndarray | None = None) -> np.ndarray:
    """Times (n,) on the clock of the body. seconds (n,): times since the first stamp of the stream, by default those of
    its stamps."""
    t, offset = stream.seconds if seconds is None else seconds, values[stream.name, "time_offset"]
    if len(offset) == 1:
        return t + offset[0]
    joins = np.array([1e-9 * (ns - stream.origin_ns) for ns in stream.joins_ns]) - RECORDING_MARGIN_S
    assert len(joins) == len(offset) - 1
    return t + offset[np.searchsorted(joins, t, side="right")]


def clock_numbers(state: State, name: str, keyframe: np.ndarray) -> np.ndarray:
    """Number (n,) of the time offset that applies to measurements at `keyframe` (n,)."""
    if len(state.values[name, "time_offset"]) == 1:
        return np.zeros(len(keyframe), dtype=np.int64)
    return np.searchsorted(state.starts, keyframe, side="right") - 1


def offset_at(state: State, name: str, keyframe: np.ndarray) -> np.ndarray:
    """Time offset (n,) s of a sensor's measurements at `keyframe` (n,)."""
    return state.values[name, "time_offset"][clock_numbers(state, name, keyframe)]


def slices_by_clock(state: State, name: str, keyframe: np.ndarray) -> Iterator[tuple[int, slice]]:
    """For each time offset, its number and the slice of measurements at `keyframe` (n,), sorted, that it applies to."""
    if len(state.values[name, "time_offset"]) == 1:
        yield 0, slice(0, len(keyframe))
        return
    edges = np.searchsorted(keyframe, (*state.starts, len(state.seconds)))
    for k, (a, b) in enumerate(zip(edges[:-1], edges[1:], strict=True)):
        if a < b:
            yield k, slice(int(a), int(b))


def pose_columns(layout: Layout, name: str, clock: int = 0) -> np.ndarray:
    """Calibration columns (7,) of a sensor's rotation (-1 if it has none), translation, and time offset number `clock`
    or the only one."""
    offset = layout.columns(name, "time_offset")
    offset_column = offset[clock if len(offset) > 1 else 0]
    rotation = layout.columns(name, "rotation") if layout.has(name, "rotation") else np.full(3, -1)
    return np.concatenate([rotation, layout.columns(name, "translation"), [offset_column]])
