"""Initial guess of wheels on a known trajectory, and the trajectory by dead reckoning for rigs without an IMU."""

from __future__ import annotations

from collections.abc import Sequence

from icalib.data.measurements import Measurements
from icalib.estimate.problem.inputs import Inputs
from icalib.initialize.steps.initializer import BY_DEAD_RECKONING, Initializer, SmoothMotion, Values, kinds_of
from icalib.initialize.steps.smooth_trajectory import BodyPoses
from icalib.optim.state import State
from icalib.rig import Rig, Wheels
from icalib.sensors.wheels.initialize.increment_noise import wheel_noise
from icalib.sensors.wheels.initialize.path_on_fixes import paths_on_fixes
from icalib.sensors.wheels.initialize.placement import wheel_values
from icalib.sensors.wheels.initialize.planar_path import wheel_path


class WheelInitializer(Initializer[Wheels]):
    """Guesses the parameters of wheels from the trajectory of other sensors. In rigs without an IMU and other sensors
    that show the motion, the trajectory comes from dead reckoning on a flat floor."""

    asks_for_vertical = True
    # Turn rates are known by the wheels alone. A prior as tight as the motion would shrink them and enlarge the
    # baseline: by 0.7 % in simulated drives, by 0.15 % with a factor of 10, below 0.05 % with this one.
    prior_factor = 100.0

    def place(self, inputs: Inputs, state: State, sensors: Sequence[Wheels]) -> Values:
        return wheel_values(inputs, state, sensors)

    def motion_rank(self, rig: Rig) -> int | None:
        return BY_DEAD_RECKONING if rig.imu is None else None

    def sources(self, rig: Rig) -> tuple[str, ...]:
        return (rig.wheels[0].name,)

    def body_poses(self, rig: Rig, recordings: Sequence[Measurements]) -> tuple[list[BodyPoses], Values]:
        """See `Initializer`. Positions of a point of the vehicle bound the drift, and determine sizes of the wheels."""
        wheels, streams = rig.wheels[0], [m.wheels[0] for m in recordings]
        fixes = [f for m in recordings for kind in kinds_of(rig) for f in kind.fixes(m)[:1]][: len(recordings)]
        if fixes:
            return paths_on_fixes(wheels, streams, fixes)
        return [wheel_path(wheels, stream) for stream in streams], {}

    def longest_spacing(self, rig: Rig, recordings: Sequence[Measurements], motion: SmoothMotion) -> float:
        noise = [
            wheel_noise(wheels, [m.wheels[k] for m in recordings], motion.paths) for k, wheels in enumerate(rig.wheels)
        ]
        return min(motion.spacing_for_increments(turn, distance) for distance, turn in noise)


INITIALIZER = WheelInitializer()
