"""Plausibility checks of readings.

Detection of stop-and-go poses: a robot that stands still while each pose is recorded.
"""

from __future__ import annotations

import numpy as np

from icalib.geometry import so3

STREAM_S = 0.25  # longest step between poses of one run; longer steps are breaks
STILL = 0.2  # share of the whole motion; less within runs of poses is noise


def stands_still_between(seconds: np.ndarray, rotation: np.ndarray, position: np.ndarray) -> bool:
    """True if poses at seconds (n,), rotation (n, 3, 3) R_frame_body and position (n, 3), hardly move within runs.

    Breaks longer than STREAM_S separate runs. The motion within a run is the largest (`moved`) from its first pose. The
    sum over runs must be less than STILL of the whole motion, which includes that across breaks.
    """
    breaks = np.flatnonzero(np.diff(seconds) > STREAM_S)
    first, last = np.append(0, breaks + 1), np.append(breaks, len(seconds) - 1)
    run = np.repeat(first, last - first + 1)
    size = moved(rotation, position, run, np.arange(len(run)))
    within = float(np.maximum.reduceat(size, first).sum()) if len(size) else 0.0
    between = float(moved(rotation, position, last[:-1], first[1:]).sum())
    return within < STILL * (within + between)


def moved(rotation: np.ndarray, position: np.ndarray, a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """(n,) motion from poses of index a (n,) to those of index b (n,).

    It is the rotation angle [rad] plus the distance over the largest distance of all positions from their median.
    """
    turn = so3.log_many(np.ascontiguousarray(rotation[a].transpose(0, 2, 1) @ rotation[b]))
    spread = float(np.linalg.norm(position - np.median(position, axis=0), axis=1).max(initial=0.0))
    distance = np.linalg.norm(position[b] - position[a], axis=1) / max(spread, 1e-9)
    return np.linalg.norm(turn, axis=1) + distance
