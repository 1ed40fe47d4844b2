"""Parameters of the scene: the target, its bodies, planes, and the frames of absolute poses."""

from __future__ import annotations

from math import radians

from icalib.sensors.parameter_spec import AXES, ParameterSpec
from icalib.sensors.sensor import ROTATION, TRANSLATION

# Ratio of true lengths of the target to those in the rig file.
SIZE = ParameterSpec("size", 1, "nuisance", "", ("size",), 1e-2, 0.1)
# Deviation of a body from its design: see `model.bodies.shape_basis`.
BOW_LABELS = ("bow_xx", "bow_xy", "bow_yy")
# Deviations in the plane by printing and mounting, to second order. A rotation, a shift and the scale are left out: the
# first two belong to the pose of the board, and the scale to its size.
IN_PLANE_LABELS = ("stretch", "shear", "x_xx", "y_xx", "x_xy", "y_xy", "x_yy", "y_yy")
SHAPE_LABELS = BOW_LABELS + IN_PLANE_LABELS
SHAPE = ParameterSpec(
    name="shape",
    size=len(SHAPE_LABELS),
    manifold="vector",
    unit="m",
    labels=SHAPE_LABELS,
    tolerance=1e-3,
    prior_sigma=1e-3,
    is_auxiliary=True,
    meaning="how far the target deviates from its design",
    by_images=True,
    motion="show the target from more sides and closer",
)
# The prior sigma of scene parameters is wide, as nobody guesses the vertical, walls or frames. A direction in which
# they move with a sensor then keeps the prior uncertainty of the sensor.
TILT = ParameterSpec(
    name="tilt",
    size=2,
    manifold="tilt",
    unit="rad",
    labels=AXES[:2],
    tolerance=radians(0.1),
    prior_sigma=10.0,
    is_auxiliary=True,
    meaning="of the target against the vertical",
    motion="turn the rig through larger angles, so that gravity shows on every axis",
    motion_on_wheels="drive over ramps",
)
# Tolerances of planes and frames are wide: unobservable directions are named by the sensors that they belong to.
PLANE = ParameterSpec(
    "plane", 3, "plane", "", ("turn 1", "turn 2", "distance"), (radians(10.0), radians(10.0), 0.5), 10.0
)
FRAME_ROTATION = ParameterSpec("frame_rotation", 3, "rotation", "rad", AXES, radians(10.0), 10.0)
FRAME_YAW = ParameterSpec("frame_yaw", 1, "vector", "rad", ("frame_yaw",), radians(10.0), 10.0)
FRAME_TRANSLATION = ParameterSpec("frame_translation", 3, "vector", "m", AXES, 0.5, 10.0)
# Slow offset of fixes in it, at one instant. Wide, as random walks of an hour may reach metres.
FRAME_OFFSET = ParameterSpec("frame_offset", 3, "vector", "m", AXES, 0.5, 10.0)
FRAME = (FRAME_ROTATION, FRAME_TRANSLATION)  # pose of a pose sensor's frame in the world
LEVEL_FRAME = (FRAME_YAW, FRAME_TRANSLATION)  # the same of a frame that is as level as the world
BODY = (ROTATION, TRANSLATION)  # pose of one of several bodies of a target in the scene
SCENE = (SIZE, TILT, SHAPE, PLANE, FRAME_YAW, FRAME_OFFSET, *FRAME, *BODY)
