"""Initial guess of cameras: intrinsics, distortion, extrinsics, time offsets, and the trajectory from their images.

The guess comes from images of a target (`boards`) or from feature tracks (`tracks`).
"""

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
from icalib.sensors.camera.initialize.boards.symmetry import resolve_symmetry
from icalib.sensors.camera.initialize.guess import Guess
from icalib.sensors.camera.initialize.initial_state import initial_state
from icalib.sensors.camera.initialize.multi_recording import initial_guesses
from icalib.sensors.camera.initialize.parallax import no_parallax
from icalib.sensors.camera.initialize.tracks.placement import track_camera_values


class CameraInitializer(Initializer[Camera]):
    """Initial guess of all cameras of a rig.

    Cameras that see a target are the preferred source of the trajectory. Cameras with feature tracks come after LiDARs;
    if another sensor gives the trajectory, they are aligned to it.
    """

    hosts_keyframes = True
    refined_alone = False  # a refinement would repeat the first pass of the estimator

    def motion_rank(self, rig: Rig) -> int | None:
        """See `Initializer`: `BY_TARGET` with a target, `BY_TRACKS` with an IMU but no target, else None."""
        if not rig.cameras:
            return None
        if rig.has_target:
            return BY_TARGET
        return None if rig.imu is None else BY_TRACKS

    def unambiguous(self, rig: Rig, recordings: Sequence[Measurements]) -> Sequence[Measurements]:
        """See `Initializer`: the points of symmetric targets are numbered consistently."""
        return resolve_symmetry(rig, recordings)

    def trajectory(self, inputs: Inputs, fallback: Callable[[], InputsWithMotion]) -> State:
        """See `Initializer`: the trajectory interpolated between camera poses, and the guess of all cameras."""
        return initial_state(inputs, *_guesses_by_recording(inputs, fallback))

    def refined(self, inputs: Inputs, state: State) -> tuple[Inputs, State, Values]:
        """See `Initializer`: refines the trajectory by the first pass of the estimator."""
        return inputs, first_pass(inputs, state), state.values

    def place(self, inputs: Inputs, state: State, sensors: Sequence[Camera]) -> Values:
        """Values of cameras with feature tracks, aligned to the trajectory in `state`."""
        del sensors
        return track_camera_values(inputs, state)

    def body_poses(self, rig: Rig, recordings: Sequence[Measurements]) -> tuple[list[BodyPoses], Values]:
        """See `Initializer`: poses of the body from the images of all cameras, without an IMU."""
        cameras_only = rig.only(*(c.name for c in rig.cameras))
        inputs = inputs_for(cameras_only, [m.only(*cameras_only.sensors) for m in recordings])
        (guess,) = initial_guesses(cameras_only, inputs.bodies, [m.measurements for m in inputs.motions])
        t, R, p = guess.body_poses(inputs.measurements)
        begins = [part.begin for part in inputs.parts]
        recording = np.searchsorted(begins, t, side="right") - 1
        poses = [
            BodyPoses(t[recording == k] - begin, R[recording == k], p[recording == k]) for k, begin in enumerate(begins)
        ]
        return poses, guess.values()

    def explained(
        self, rig: Rig, recordings: Sequence[Measurements], converges: Callable[[Rig], bool]
    ) -> EstimationError | None:
        """See `Initializer`: the error that feature tracks lack parallax, else None. None for rigs with a target."""
        del converges
        return None if rig.has_target else no_parallax(rig, recordings)


def _guesses_by_recording(inputs: Inputs, fallback: Callable[[], InputsWithMotion]) -> tuple[Guess, ...]:
    """The initial guess of each recording.

    A rig that rotated about one axis only leaves the camera's rotation about that axis unobservable from angular rates.
    That rotation then comes from hand-eye calibration with the trajectory that `fallback` returns, of the next kind of
    sensor. Raises OneAxisError if this fails, too; EstimationError if a recording gives no guess.
    """
    rig, recordings = inputs.rig, [m.measurements for m in inputs.motions]
    try:
        return initial_guesses(rig, inputs.bodies, recordings)
    except OneAxisError as error:
        if not rig.has_target:
            raise
        try:
            rig = with_hand_eye_guess(rig, inputs, *fallback())
        except EstimationError:
            raise error from None
        return initial_guesses(rig, inputs.bodies, recordings)


INITIALIZER = CameraInitializer()
