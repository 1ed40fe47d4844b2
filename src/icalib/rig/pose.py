"""A pose sensor: motion capture, or another program's odometry."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar, Literal

import numpy as np

from icalib.rig.parameter import Parameter
from icalib.rig.parameter_spec import ParameterSpec
from icalib.rig.sensor import MOUNTED, PLAIN_TABLE, Axes, Sensor, TableLayout

PoseKind = Literal["absolute", "relative"]
SCALE = ParameterSpec("scale", 1, "nuisance", "", ("scale",), 1e-2, 0.1)  # true lengths over reported ones


@dataclass(frozen=True)
class PoseSensor(Sensor):
    """Something that says where it is: motion capture, or another program's odometry.

    absolute: in a frame that stands still, whose place in the world is estimated; noise is white, rad and m. relative:
    only the way from each pose to the next counts; noise is a random walk, rad/sqrt(s) and m/sqrt(s). level: z of its
    frame points up, as far as the motion does not say otherwise; used where neither an IMU nor a target shows it.
    """

    sensor_type: ClassVar[str] = "pose"
    parameters: ClassVar[tuple[ParameterSpec, ...]] = (*MOUNTED, SCALE)

    path: str
    kind: PoseKind = "absolute"
    rotation_noise: float | None = None  # of each axis; None: estimated from the residuals
    position_noise: float | None = None
    level: bool = True
    position_axes: Axes | None = None  # of positions as recorded, in the order and with the signs of rotations
    rotation: Parameter = Parameter()
    translation: Parameter = Parameter()
    time_offset: Parameter = Parameter()
    clock_restarts: bool = False  # from recording to recording: each has a time offset of its own
    topic: str | None = None  # of its poses; None: the one with the sensor's name, or the only one
    layout: TableLayout = PLAIN_TABLE
    inverted: bool = False  # what is recorded is T_sensor_frame
    frames: tuple[str, str] | None = None  # parent and child in a topic of transforms; None: it is not one
    scale_sigma: float = 0.001  # of all its lengths, relative: true over reported ones is about 1; 0: exact

    @property
    def scale(self) -> Parameter:
        """True lengths over reported ones."""
        one = np.ones(1)
        return Parameter("prior", one, self.scale_sigma * one) if self.scale_sigma > 0.0 else Parameter("fixed", one)
