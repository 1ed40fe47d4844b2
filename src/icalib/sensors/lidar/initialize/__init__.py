"""Initial guess of LiDARs: trajectory by registration of scans, extrinsics, and association of points with planes."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from contextlib import AbstractContextManager
from dataclasses import replace

from icalib.data.measurements import Measurements
from icalib.estimate.inputs import Inputs, with_association
from icalib.initialize.initializer import BY_SCANS, Initializer, InputsWithMotion, Values, stated_values
from icalib.optim.state import State
from icalib.rig import Lidar, Rig
from icalib.sensors.lidar.initialize.association import lidar_values, state_from_lidar, with_lidars
from icalib.sensors.lidar.initialize.self_returns import without_self_returns
from icalib.sensors.lidar.initialize.voxel_map import explaining_degeneracy


class LidarInitializer(Initializer[Lidar]):
    """Initializer of LiDARs. The first one gives the trajectory if no camera sees a target; all other LiDARs are
    aligned to it."""

    moves_keyframes = True

    def motion_rank(self, rig: Rig) -> int | None:
        return BY_SCANS if rig.lidars else None

    def trajectory(self, inputs: Inputs, fallback: Callable[[], InputsWithMotion]) -> State:
        return state_from_lidar(inputs)

    def refined(self, inputs: Inputs, state: State) -> tuple[Inputs, State, Values]:
        state = replace(state, values=state.values | self.place(inputs, state, inputs.rig.lidars))
        inputs, associated, changed = self.associated(inputs, state)
        return inputs, associated, state.values | changed

    def adopted(self, inputs: Inputs, source_inputs: Inputs) -> Inputs:
        measured = replace(
            inputs.measurements.with_streams(*source_inputs.measurements.lidars), notes=source_inputs.measurements.notes
        )
        return replace(
            with_association(replace(inputs, measurements=measured), source_inputs.association),
            guess=source_inputs.guess,
        )

    def place(self, inputs: Inputs, state: State, sensors: Sequence[Lidar]) -> Values:
        return lidar_values(inputs, state)

    def associated(self, inputs: Inputs, state: State) -> tuple[Inputs, State, Values]:
        """Inputs and state with points associated with planes, and known values. The rounds may change parameters that
        the motion does not determine, so the inputs keep the initial guess from before the rounds."""
        known = {key: value for lidar in inputs.rig.lidars for key, value in stated_values(inputs, lidar).items()}
        guess = replace(state, values=state.values | known)
        inputs, state = with_lidars(inputs, state)
        return replace(inputs, guess=guess), state, known

    def cleaned(self, recording: Measurements) -> Measurements:
        return without_self_returns(recording)

    def explaining(self, inputs: Inputs) -> AbstractContextManager[None]:
        return explaining_degeneracy(() if inputs.rig.cameras else inputs.measurements.lidars)


INITIALIZER = LidarInitializer()
