"""Initial guess of cameras: intrinsics, distortion, extrinsics, time offsets, and the trajectory from their images.

The guess comes from images of a target (`boards`) or from feature tracks (`tracks`).

Detects feature tracks without parallax, which leave the translation of cameras unobservable.

Extrinsics of cameras by hand-eye calibration with the trajectory of a LiDAR or a pose sensor.

A robot on a floor rotates about one axis only. The rotation of a camera about that axis is then unobservable from
angular rates. The translations of both trajectories make it observable.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np

from icalib.data.measurements import Measurements
from icalib.errors import EstimationError
from icalib.estimate.estimate import first_pass
from icalib.estimate.problem.inputs import Inputs, inputs_for
from icalib.geometry.cameras import camera_model
from icalib.initialize.steps.initializer import BY_TARGET, BY_TRACKS, Initializer, InputsWithMotion, Values
from icalib.initialize.steps.rate_alignment import OneAxisError
from icalib.initialize.steps.single_recording import (
    KnownExtrinsics,
    naming_recording,
    single_recording,
    state_of_recording,
)
from icalib.initialize.steps.smooth_trajectory import BodyPoses
from icalib.initialize.trajectories.trajectory_fit import SensorTrajectory, extrinsics_on_trajectory
from icalib.motion.imu_data import imu_data
from icalib.optim.state import State
from icalib.rig import Camera, Parameter, Rig
from icalib.sensors.camera.initialize.boards.scene_intrinsics import find_scene, intrinsics_of
from icalib.sensors.camera.initialize.boards.symmetry import resolve_symmetry
from icalib.sensors.camera.initialize.boards.target_scene import scene_poses
from icalib.sensors.camera.initialize.guess import Guess
from icalib.sensors.camera.initialize.multi_recording import initial_guesses, initial_state
from icalib.sensors.camera.initialize.tracks.epipolar_rotation import (
    refine_relative_pose,
    rotation_error,
    rotation_without_translation,
)
from icalib.sensors.camera.initialize.tracks.from_tracks import start_intrinsics
from icalib.sensors.camera.initialize.tracks.joint_alignment import SharedRays, shared_rays
from icalib.sensors.camera.initialize.tracks.placement import track_camera_values
from icalib.sensors.sensor import mounted
from icalib.sensors.stream import seconds_since


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


def with_hand_eye_guess(rig: Rig, camera_inputs: Inputs, others: Inputs, state: State) -> Rig:
    """`rig` with an initial guess of the extrinsics and time offset of each camera without a stated rotation.

    For each camera, the recording with most of its corners is used. camera_inputs: inputs of the cameras; others:
    inputs of the sensors whose trajectory is in `state`. Raises EstimationError if the motion does not determine the
    extrinsics.
    """
    recordings = [m.measurements for m in camera_inputs.motions]
    scene = find_scene(rig, camera_inputs.bodies, recordings)

    def with_guess(number: int, camera: Camera) -> Camera:
        best = int(np.argmax([len(r.cameras[number].uv) for r in recordings]))
        stream, inputs = recordings[best].cameras[number], single_recording(others, best)
        poses = scene_poses(stream, camera_model(camera.model), intrinsics_of(camera, stream, rig.target, scene), scene)
        ok, stamps = poses.ok, stream.stamps_ns[poses.ok]
        seconds = seconds_since(stamps, int(stamps[0]))
        path = SensorTrajectory(seconds, poses.rotation[ok], poses.position[ok], np.ones(len(stamps), dtype=bool))
        assert inputs.imu is not None
        with naming_recording(others, best):
            extrinsics, _ = extrinsics_on_trajectory(
                inputs.imu, camera.name, path, state_of_recording(others, best, state), KnownExtrinsics()
            )
        offset = extrinsics.offset - 1e-9 * (int(stamps[0]) - recordings[best].origin_ns)
        guess = mounted(extrinsics.rotation, extrinsics.position, np.array([offset]))
        return replace(
            camera, **{k: Parameter("free", v) for k, v in guess.items() if getattr(camera, k).value is None}
        )

    return rig.with_sensors(*(with_guess(k, c) for k, c in enumerate(rig.cameras) if c.rotation.value is None))


# Parallax over the median epipolar error. Noise alone gives up to 2.3, because parallax contains the errors of both
# rays in two axes, and the epipolar error those in one axis. Twice the value would refuse motion with usable parallax.
MIN_PARALLAX_RATIO = 3.0


def no_parallax(rig: Rig, recordings: Sequence[Measurements]) -> EstimationError | None:
    """An EstimationError, not raised, if no camera in any recording has parallax beyond noise; else None.

    It names the camera with the largest ratio of parallax to noise. Also None if a recording has no IMU data, or the
    intrinsics of a camera are not found.
    """
    ratios: list[tuple[float, float, str]] = []
    for m in recordings:
        imu = imu_data(rig, m)
        for k, (camera, stream) in enumerate(zip(rig.cameras, m.tracks, strict=True)):
            if imu is None:
                return None
            try:
                lens = start_intrinsics(camera, stream, imu, m)
            except EstimationError:
                return None
            pairs = [_parallax(pair) for pair in shared_rays(k, stream, camera_model(camera.model), lens)]
            if pairs:
                parallax, error = np.median(pairs, axis=0).tolist()
                ratios.append((parallax, error, camera.name))
    if not ratios:
        return None
    parallax, error, name = max(ratios, key=lambda x: x[0] / x[1])
    if parallax > MIN_PARALLAX_RATIO * error:
        return None
    return EstimationError(
        f"{name}: the tracked points move as in a pure rotation (parallax {np.rad2deg(parallax):.2g} deg, "
        f"noise {np.rad2deg(error):.2g} deg), so its translation is unobservable. Move the rig by a "
        "tenth of the distance to the scene or more, and turn it about all axes."
    )


def _parallax(pair: SharedRays) -> tuple[float, float]:
    """Parallax and epipolar error of two images, medians over their shared points [rad].

    The parallax is the distance between corresponding unit rays after the best rotation. The epipolar error is the
    angle between a ray and its epipolar plane.
    """
    R, t = rotation_without_translation(pair.f, pair.h)
    parallax = float(np.median(np.linalg.norm(pair.f @ R.T - pair.h, axis=1)))
    refine_relative_pose(pair.f, pair.h, R, t)
    return parallax, rotation_error(pair.f, pair.h, R, t)[1] + 1e-12
