"""Sentences for messages: axes about which a body rotated, and about which it hardly did."""

from __future__ import annotations

import numpy as np

from icalib.geometry import so3

# RMS rate about an axis over that about the strongest one: below it, rotation about the axis is too weak
WEAK_AXIS_RATIO = 0.1
NAMED_AXIS_COSINE = 0.9  # component of a unit vector: above it, the direction is called by the axis' name
MIN_KEYFRAMES_FOR_AXES = 2  # keyframes with a rotation between them


def hardly_turned(seconds: np.ndarray, rotation: np.ndarray, body: str) -> str:
    """Words for the axes about which `body` hardly rotated, such as "the y and z axes of imu0"; empty if it rotated
    about all three.

    seconds (K,), rotation (K, 3, 3) R_world_body: its keyframes. Backward steps in time, between recordings, are
    ignored.
    """
    if len(seconds) < MIN_KEYFRAMES_FOR_AXES:
        return ""
    step = np.diff(seconds)
    turn = so3.log_many(np.ascontiguousarray(np.swapaxes(rotation[:-1], 1, 2) @ rotation[1:]))
    rate = turn[step > 0.0] / np.sqrt(step[step > 0.0])[:, None]
    squares, axes = np.linalg.eigh(rate.T @ rate)
    weak = np.sqrt(np.maximum(squares, 0.0)) < WEAK_AXIS_RATIO * np.sqrt(max(squares[-1], 0.0))
    if not weak.any():
        return ""
    return axis_words(body, axes[:, 0]) if weak.sum() == 1 else other_axes(body, axes[:, -1])


def axis_words(body: str, direction: np.ndarray | tuple[float, float, float]) -> str:
    """Words for a unit vector (3,) in the axes of `body`: "the z axis of imu0" if it is close to an axis."""
    k = int(np.argmax(np.abs(direction)))
    if abs(direction[k]) > NAMED_AXIS_COSINE:
        return f"the {'xyz'[k]} axis of {body}"
    return f"the direction {_numbers(direction)} in the axes of {body}"


def other_axes(body: str, direction: np.ndarray | tuple[float, float, float]) -> str:
    """Words for the two axes perpendicular to a unit vector (3,) in the axes of `body`, such as "the x and y axes of
    imu0"."""
    k = int(np.argmax(np.abs(direction)))
    if abs(direction[k]) > NAMED_AXIS_COSINE:
        return f"the {' and '.join(c for c in 'xyz' if c != 'xyz'[k])} axes of {body}"
    return f"two axes perpendicular to the direction {_numbers(direction)} in the axes of {body}"


def _numbers(direction: np.ndarray | tuple[float, float, float]) -> str:
    return f"({', '.join(f'{x:.2f}' for x in direction)})"
