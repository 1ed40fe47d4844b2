"""Definitions of the parameters of the scene: target, its bodies, planes, and frames of pose and position sensors."""

from __future__ import annotations

from math import radians

from icalib.sensors.parameter import AXES, ParameterSpec
from icalib.sensors.sensor import ROTATION, TRANSLATION

# True length / length in the rig file, of all lengths of the target.
SIZE = ParameterSpec("size", 1, "nuisance", "", ("size",), 1e-2, 0.1)
# Magnitude of gravity, see `Gravity`; it belongs to the WORLD.
WORLD = "world"
GRAVITY = ParameterSpec("gravity", 1, "nuisance", "m/s^2", ("gravity",), 0.05, 0.1)
# Out-of-plane deviation of a body from its design, second order in x, y; basis: `model.bodies.shape_basis`.
BOW_LABELS = ("bow_xx", "bow_xy", "bow_yy")
# In-plane deviations by printing and mounting, to second order in x, y. Rotation and translation are omitted, as they
# belong to the pose of the board, and the scale, as it belongs to the size of the target.
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
# The middle of a target's sheet from the middle of its points, in the frame of its body. Prior: the example of
# cam_lidar_calibration (Tsai et al. 2021) has 10 and 30 mm. With twice as much the edges of a sheet add less.
SHEET_MIDDLE = ParameterSpec(
    name="sheet_middle",
    size=2,
    manifold="vector",
    unit="m",
    labels=AXES[:2],
    tolerance=1e-2,
    prior_sigma=1e-2,
    is_auxiliary=True,
    meaning="how far the middle of the target's sheet is from that of its print",
)
# Scene parameters have a wide prior sigma, as users give no guess of the vertical, walls or frames. An unobservable
# direction that moves a sensor and the scene together thus has the prior uncertainty of the sensor.
# Wide tolerances, so that an unobservable direction is attributed to a sensor and not to a board, plane or frame.
TILT = ParameterSpec(
    name="tilt",
    size=2,
    manifold="tilt",
    unit="rad",
    labels=AXES[:2],
    tolerance=radians(10.0),
    prior_sigma=10.0,
    is_auxiliary=True,
    meaning="of the target against the vertical",
    motion="turn the rig through larger angles, so that gravity shows on every axis",
    motion_on_wheels="drive over ramps",
)
PLANE = ParameterSpec(
    "plane", 3, "plane", "", ("turn 1", "turn 2", "distance"), (radians(10.0), radians(10.0), 0.5), 10.0
)
FRAME_ROTATION = ParameterSpec("frame_rotation", 3, "rotation", "rad", AXES, radians(10.0), 10.0)
FRAME_YAW = ParameterSpec("frame_yaw", 1, "vector", "rad", ("frame_yaw",), radians(10.0), 10.0)
FRAME_TRANSLATION = ParameterSpec("frame_translation", 3, "vector", "m", AXES, 0.5, 10.0)
# Slowly varying offset of position fixes in that frame, at one instant. The prior is wide: the random walk of an hour
# may reach metres.
FRAME_OFFSET = ParameterSpec("frame_offset", 3, "vector", "m", AXES, 0.5, 10.0)
FRAME = (FRAME_ROTATION, FRAME_TRANSLATION)  # pose of a pose sensor's static frame in the world frame
LEVEL_FRAME = (FRAME_YAW, FRAME_TRANSLATION)  # the same for a frame whose z axis is vertical, as that of the world
BODY = (ROTATION, TRANSLATION)  # pose of a body, if the target has several
SCENE = (SIZE, GRAVITY, TILT, SHAPE, SHEET_MIDDLE, PLANE, FRAME_YAW, FRAME_OFFSET, *FRAME, *BODY)
