"""Initial guess of wheels on a known trajectory."""

from __future__ import annotations

from collections.abc import Sequence

from icalib.estimate.problem.inputs import Inputs
from icalib.initialize.steps.initializer import Initializer, Values
from icalib.optim.state import State
from icalib.rig import Wheels
from icalib.sensors.wheels.initialize.extrinsics import wheel_values


class WheelInitializer(Initializer[Wheels]):
    """Wheels are placed on the motion of others."""

    asks_for_vertical = True

    def place(self, inputs: Inputs, state: State, sensors: Sequence[Wheels]) -> Values:
        return wheel_values(inputs, state, sensors)


INITIALIZER = WheelInitializer()
