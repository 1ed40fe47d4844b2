"""Initial guess of LiDARs: trajectory by registration of scans, extrinsics, and association of points with planes."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from itertools import product

import numpy as np

from icalib.data.measurements import Measurements
from icalib.errors import EstimationError
from icalib.estimate.inputs import Inputs, with_association
from icalib.initialize.initializer import (
    BY_SCANS,
    BodyTrajectory,
    FailedEstimate,
    InitialGuess,
    Initializer,
    InputsWithMotion,
    MotionSource,
    SmoothMotion,
    Values,
    stated_values,
)
from icalib.initialize.smooth_trajectory import BodyPoses
from icalib.optim.state import State
from icalib.rig import Lidar, Rig
from icalib.sensors.lidar.initialize.association import lidar_values, state_from_lidar, with_lidars
from icalib.sensors.lidar.initialize.boards import at_places, guess_at_rest, stands_still
from icalib.sensors.lidar.initialize.extrinsics import scan_poses
from icalib.sensors.lidar.initialize.self_returns import without_self_returns
from icalib.sensors.lidar.initialize.surroundings import are_stops, at_stops, guess_by_surroundings, stops
from icalib.sensors.lidar.initialize.voxel_map import degeneracy_error, leading
from icalib.sensors.lidar.residual import RINGS_SEEN, rings_seen
from icalib.sensors.lidar.spec import OF_RINGS, RANGE_OFFSET, RANGE_SCALE


class LidarInitializer(Initializer[Lidar]):
    """Initializer of LiDARs. The first one gives the trajectory if no camera sees a target; all other LiDARs are
    aligned to it."""

    moves_keyframes = True

    def prepared(self, rig: Rig, recordings: Sequence[Measurements]) -> Sequence[Measurements]:
        """The recordings without points on the robot itself. At rest, which a rig without an IMU that sees a target may
        be, all points keep their place; one that stops has a cloud of each stop."""
        if rig.imu is None and rig.has_target:
            return at_places(rig, recordings)
        recordings = at_stops(rig, recordings)
        return recordings if are_stops(rig, recordings) else [without_self_returns(m) for m in recordings]

    def motion_source(self, rig: Rig) -> MotionSource | None:
        return MotionSource(BY_SCANS, tuple(s.name for s in rig.lidars)) if rig.lidars else None

    def body_poses(self, rig: Rig, recordings: Sequence[Measurements]) -> BodyTrajectory:
        """See `Initializer`: by the first LiDAR, or another one that shows all directions far better; at rest at
        the stops of the first."""
        if are_stops(rig, recordings):
            return BodyTrajectory([stops(m) for m in recordings])
        best = leading(recordings) if rig.reference == rig.lidars[0].name else 0
        reference = rig.lidars[best].name if best else ""
        return BodyTrajectory([scan_poses(m.lidars[best]) for m in recordings], reference=reference)

    def longest_spacing(self, rig: Rig, recordings: Sequence[Measurements], motion: SmoothMotion) -> float:
        """As short as allowed: points are measured at all times, and thousands of them average out noise."""
        return 0.0

    def trajectory(self, inputs: Inputs, fallback: Callable[[], InputsWithMotion]) -> State:
        return state_from_lidar(inputs)

    def refined(self, inputs: Inputs, source_inputs: Inputs, state: State) -> InitialGuess:
        lidars = source_inputs.rig.lidars
        state = replace(state, values=state.values | self.place(source_inputs, state, lidars))
        alone, associated, changed = self.associated(source_inputs, state)
        measured = replace(inputs.measurements.with_streams(*alone.measurements.lidars), notes=alone.measurements.notes)
        inputs = with_association(replace(inputs, measurements=measured), alone.association)
        return replace(inputs, guess=alone.guess), associated, state.values | changed

    def place(self, inputs: Inputs, state: State, sensors: Sequence[Lidar]) -> Values:
        return lidar_values(inputs, state)

    def associated(self, inputs: Inputs, state: State) -> InitialGuess:
        """Inputs and state with points associated with planes, and known values. The rounds may change parameters that
        the motion does not determine, so the inputs keep the initial guess from before the rounds."""
        known = {key: value for lidar in inputs.rig.lidars for key, value in stated_values(inputs, lidar).items()}
        errors: Values = {(s.name, RINGS_SEEN): rings_seen(s) for s in inputs.measurements.lidars}
        for lidar, spec in product(inputs.rig.lidars, (RANGE_OFFSET, RANGE_SCALE, *OF_RINGS)):
            value = getattr(lidar, spec.name).value
            errors[lidar.name, spec.name] = np.zeros(spec.size) if value is None else value
        state = replace(state, values=errors | state.values)
        guess = replace(state, values=state.values | known)
        inputs, state = with_lidars(inputs, state)
        return replace(inputs, guess=guess), state, known

    def start_at_rest(
        self, rig: Rig, recordings: Sequence[Measurements], body_poses: Sequence[BodyPoses], values: Values
    ) -> InitialGuess | None:
        """See `Initializer`: by the target in images and clouds, or by what LiDARs see alike."""
        if are_stops(rig, recordings):
            return guess_by_surroundings(rig, recordings)
        if rig.has_target and stands_still(rig, body_poses):
            return guess_at_rest(rig, recordings, body_poses, values)
        return None

    def explained(self, failed: FailedEstimate) -> EstimationError | None:
        """See `Initializer`: during an attempt, the error that names a degenerate scene."""
        if failed.converges is not None or failed.rig.cameras:
            return None
        return degeneracy_error([stream for m in failed.recordings for stream in m.lidars])


INITIALIZER = LidarInitializer()
