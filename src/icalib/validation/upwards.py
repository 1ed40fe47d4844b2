"""Wheels where nothing shows which way is up: the vehicle may stand on its wheels, or have left and right mixed up."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from icalib.estimate.estimate import Estimate
from icalib.estimate.problem.inputs import Inputs
from icalib.initialize.robot import level_sensor
from icalib.initialize.wheels.wheels import OPPOSITE

UPRIGHT = 0.5  # cosine of the image's downward axis with the vehicle's: 60 degrees


def upwards_notes(inputs: Inputs, found: Estimate) -> Iterator[str]:
    """Where a camera that stands upright is all that speaks for the wheels as they are."""
    for wheels, up in _open(inputs, found):
        if not inputs.rig.moves_by_poses and _stance(up) is None:
            yield (
                f"{wheels}: nothing but {_body(inputs)}, which then stands upright, shows which way is up; if it is "
                f"upside down, {_opposite(inputs, wheels)}."
            )


def upwards_warnings(inputs: Inputs, found: Estimate) -> Iterator[str]:
    """Both readings of wheels that stand on the ground only if the first camera does not stand upright, or with a pose
    sensor whose frame is not level."""
    for wheels, up in _open(inputs, found):
        if inputs.rig.moves_by_poses:
            x, y, z = up
            yield (
                f"{wheels}: nothing shows which way is up: no frame of a pose sensor is level. Here up is ({x:.2f}, "
                f"{y:.2f}, {z:.2f}) in the axes of {_body(inputs)}; if that is down, {_opposite(inputs, wheels)}."
            )
        elif stance := _stance(up):
            yield (
                f"{wheels}: nothing shows which way is up. Either {_body(inputs)} {stance}, or "
                f"{_opposite(inputs, wheels)}."
            )


def _open(inputs: Inputs, found: Estimate) -> Iterator[tuple[str, np.ndarray]]:
    """Names of wheels of which the motion does not show what is up, nor the rig file, and z of their frame in the axes
    of the body."""
    values = found.outcome.state.values
    if not inputs.rig.assumes_motion or level_sensor(inputs, found.outcome.state) is not None:
        return
    for wheels in inputs.rig.wheels:
        if wheels.rotation.mode == "free":
            yield wheels.name, values[wheels.name, "rotation"][:, 2]


def _stance(up: np.ndarray) -> str | None:
    """How a camera stands in whose axes (x to the right, y down, z ahead) up is `up` (3,); None: upright."""
    _, down, ahead = up
    if down < -UPRIGHT:
        return None
    if down > UPRIGHT:
        return "stands upside down"
    return "looks up" if ahead > UPRIGHT else "looks down" if ahead < -UPRIGHT else "lies on its side"


def _body(inputs: Inputs) -> str:
    return inputs.rig.first_seeing


def _opposite(inputs: Inputs, name: str) -> str:
    wheels = next(w for w in inputs.rig.wheels if w.name == name)
    return OPPOSITE[wheels.kind]
