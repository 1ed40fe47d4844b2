"""Parameters of what the sensors see: the target, its bodies, planes, and the frames of pose sensors."""

from __future__ import annotations

from math import radians

from icalib.sensors.parameter_spec import AXES, ParameterSpec
from icalib.sensors.sensor import ROTATION, TRANSLATION

# True lengths of the target over those of the rig file.
SIZE = ParameterSpec("size", 1, "nuisance", "", ("size",), 1e-2, 0.1)
# How a body departs from its drawing: see `sensors.camera.board.shape_basis`.
BOW_LABELS = ("bow_xx", "bow_xy", "bow_yy")
# In the plane: what printing and mounting do to second order. A turn, a shift and the scale are left out: the first two
# belong to the board's pose, and the scale is what tag_size says.
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
# Nobody guesses which way is up in the scene, nor where walls and the frames of poses are: guesses of these have no
# weight. If they moved with a sensor, a direction would keep little of the uncertainty of the sensor's guess.
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
FRAME_TRANSLATION = ParameterSpec("frame_translation", 3, "vector", "m", AXES, 0.5, 10.0)
FRAME = (FRAME_ROTATION, FRAME_TRANSLATION)  # pose of a pose sensor's frame in the world
BODY = (ROTATION, TRANSLATION)  # pose of one of several bodies of a target in the scene
SCENE = (SIZE, TILT, SHAPE, PLANE, *FRAME, *BODY)
