"""Gauge freedom of the world frame in a rig without a target: the first keyframe is fixed.

A target defines the world frame. Planes and points do not: moving everything, or rotating everything about gravity,
changes no measurement.
"""

from __future__ import annotations

import numpy as np

from icalib.optim.arrowhead import Piece
from icalib.optim.state import State
from icalib.rig.scene import FRAME as SENSOR_FRAME
from icalib.rig.scene import FRAME_OFFSET, LEVEL_FRAME, PLANE

# Names of blocks that are estimated in a world frame of which only gravity is known.
IN_THE_WORLD = (PLANE.name, *(spec.name for spec in (*SENSOR_FRAME, *LEVEL_FRAME, FRAME_OFFSET)))

# Information [1/m^2, 1/rad^2] along the gauge directions. Its value does not matter if all else is observable.
# Otherwise a step may move planes and sensors along a fixed direction, and compensate by a rotation of the world as far
# as this information allows. With a small value the solver then drifts.
FRAME_INFORMATION = 1e10


def hold_frame(
    state: State, piece: Piece, keyframe: int, levelled: bool, information: float = FRAME_INFORMATION
) -> None:
    """Adds information to `piece` that fixes the position of `keyframe` and its rotation about gravity. If gravity is
    unknown (`levelled` False), the whole rotation is fixed. The gradient is zero, because no measurement depends on
    these directions."""
    k, up = keyframe - piece.first, state.rotation[keyframe][2]
    piece.diagonal[k, 0:3, 0:3] += information * (np.outer(up, up) if levelled else np.eye(3))
    piece.diagonal[k, range(3, 6), range(3, 6)] += information
