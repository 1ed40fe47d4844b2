"""Where the world's origin is and which way x points, in a rig without a target: the first keyframe stays where it is.

A target's frame is the world's; planes and points have none of their own, and turning all about gravity or moving
it changes no measurement.
"""

from __future__ import annotations

import numpy as np

from icalib.optim.arrowhead import Piece
from icalib.optim.state import State
from icalib.rig.scene import FRAME as SENSOR_FRAME
from icalib.rig.scene import FRAME_OFFSET, LEVEL_FRAME, PLANE

# Blocks that are estimated along, in a world of which gravity alone is known.
IN_THE_WORLD = (PLANE.name, *(spec.name for spec in (*SENSOR_FRAME, *LEVEL_FRAME, FRAME_OFFSET)))

# Information [1/m^2, 1/rad^2] along what nothing sees. Any number does if everything else is observable. But a
# step could move along a fixed direction of planes and sensors all the same, and compensate by a rotation of the world
# as far as this information allows. With a small one the solver then drifts.
FRAME_INFORMATION = 1e10


def hold_frame(
    state: State, piece: Piece, keyframe: int, levelled: bool, information: float = FRAME_INFORMATION
) -> None:
    """Fixes the position of a keyframe, and its turn about gravity, or where this is not known (`levelled`) its
    rotation, where they are: without a target nothing in the world says where its origin is. Adds to the sums of
    `piece`; there is no gradient, and what is seen does not depend on it."""
    k, up = keyframe - piece.first, state.rotation[keyframe][2]
    piece.diagonal[k, 0:3, 0:3] += information * (np.outer(up, up) if levelled else np.eye(3))
    piece.diagonal[k, range(3, 6), range(3, 6)] += information
