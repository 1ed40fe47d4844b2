"""Initial guess of cameras: lens, poses or tracks, extrinsics, and the motion that they show."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np

from icalib.data.measurements import Measurements
from icalib.errors import EstimationError
from icalib.estimate.estimate import first_pass
from icalib.estimate.problem.inputs import Inputs, inputs_for
from icalib.initialize.steps.initializer import BY_TARGET, BY_TRACKS, Initializer, InputsWithMotion, Values
from icalib.initialize.steps.rate_alignment import OneAxisError
from icalib.initialize.steps.smooth_trajectory import BodyPoses
from icalib.optim.state import State
from icalib.rig import Camera, Rig
from icalib.sensors.camera.initialize.boards.hand_eye_guess import with_hand_eye_guess
from icalib.sensors.camera.initialize.guess import Guess
from icalib.sensors.camera.initialize.initial_state import initial_state
from icalib.sensors.camera.initialize.multi_recording import initial_guesses
from icalib.sensors.camera.initialize.parallax import no_parallax
from icalib.sensors.camera.initialize.tracks.placement import track_camera_values


class CameraInitializer(Initializer[Camera]):
    """Cameras that see a target give the motion before all others; those with feature tracks after LiDARs, or they are
    placed on a motion."""

    hosts_keyframes = True
    refined_alone = False  # the estimate begins with the same pass

    def motion_rank(self, rig: Rig) -> int | None:
        if not rig.cameras:
            return None
        if rig.has_target:
            return BY_TARGET
        return None if rig.imu is None else BY_TRACKS

    def trajectory(self, inputs: Inputs, other: Callable[[], InputsWithMotion]) -> State:
        return initial_state(inputs, *_guesses(inputs, other))

    def refined(self, inputs: Inputs, state: State) -> tuple[Inputs, State, Values]:
        return inputs, first_pass(inputs, state), state.values

    def place(self, inputs: Inputs, state: State, sensors: Sequence[Camera]) -> Values:
        """Cameras with feature tracks."""
        del sensors
        return track_camera_values(inputs, state)

    def body_poses(self, rig: Rig, recordings: Sequence[Measurements]) -> tuple[list[BodyPoses], Values]:
        seeing = rig.only(*(c.name for c in rig.cameras))
        alone = inputs_for(seeing, [m.only(*seeing.sensors) for m in recordings])
        (guess,) = initial_guesses(seeing, alone.bodies, [m.measurements for m in alone.motions])
        t, R, p = guess.body_poses(alone.measurements)
        begins = [part.begin for part in alone.parts]
        own = np.searchsorted(begins, t, side="right") - 1
        found = [BodyPoses(t[own == k] - begin, R[own == k], p[own == k]) for k, begin in enumerate(begins)]
        return found, guess.values()

    def explained(
        self, rig: Rig, recordings: Sequence[Measurements], converges: Callable[[Rig], bool]
    ) -> EstimationError | None:
        """Of feature tracks: whether they have parallax."""
        del converges
        return None if rig.has_target else no_parallax(rig, recordings)


def _guesses(inputs: Inputs, other: Callable[[], InputsWithMotion]) -> tuple[Guess, ...]:
    """A guess for each recording. If the rig turned about one axis only, the motion of `other` kinds shows the rotation
    about it."""
    rig, seen = inputs.rig, [m.measurements for m in inputs.motions]
    try:
        return initial_guesses(rig, inputs.bodies, seen)
    except OneAxisError as error:
        if not rig.has_target:
            raise
        try:
            rig = with_hand_eye_guess(rig, inputs, *other())
        except EstimationError:
            raise error from None
        return initial_guesses(rig, inputs.bodies, seen)


INITIALIZER = CameraInitializer()
