"""Whether poses are those of a thing that moves while they are taken, or of one that stops for each: stop-and-go."""

from __future__ import annotations

import numpy as np

from icalib.geometry import so3

STREAM_S = 0.25  # between poses of a stream; what moves over longer breaks was not seen to move
STILL = 0.2  # of all motion: so little within runs of poses is none but noise


def stands_still_between(seconds: np.ndarray, rotation: np.ndarray, position: np.ndarray) -> bool:
    """Whether poses at seconds (n,), rotation (n, 3, 3) and position (n, 3), hardly change but across breaks longer
    than STREAM_S: the largest turn and way within each run of poses add up to less than STILL of all."""
    breaks = np.flatnonzero(np.diff(seconds) > STREAM_S)
    first, last = np.append(0, breaks + 1), np.append(breaks, len(seconds) - 1)
    run = np.repeat(first, last - first + 1)
    size = moved(rotation, position, run, np.arange(len(run)))
    within = float(np.maximum.reduceat(size, first).sum()) if len(size) else 0.0
    between = float(moved(rotation, position, last[:-1], first[1:]).sum())
    return within < STILL * (within + between)


def moved(rotation: np.ndarray, position: np.ndarray, a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """(n,) from poses a (n,) to b (n,): the turn [rad] and the way in units of how far the positions spread."""
    turn = so3.log_many(np.ascontiguousarray(rotation[a].transpose(0, 2, 1) @ rotation[b]))
    spread = float(np.linalg.norm(position - np.median(position, axis=0), axis=1).max(initial=0.0))
    way = np.linalg.norm(position[b] - position[a], axis=1) / max(spread, 1e-9)
    return np.linalg.norm(turn, axis=1) + way
