"""Extrinsics of cameras by hand-eye calibration with the trajectory of a LiDAR or a pose sensor.

A robot on a floor rotates about one axis only. The rotation of a camera about that axis is then unobservable from
angular rates. The translations of both trajectories make it observable.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from icalib.estimate.problem.inputs import Inputs
from icalib.geometry.cameras import camera_model
from icalib.initialize.steps.single_recording import (
    KnownExtrinsics,
    naming_recording,
    single_recording,
    state_of_recording,
)
from icalib.initialize.trajectories.known_trajectory import extrinsics_on_trajectory
from icalib.initialize.trajectories.sensor_trajectory import SensorTrajectory
from icalib.optim.state import State
from icalib.rig import Camera, Parameter, Rig
from icalib.sensors.camera.initialize.boards.scene_intrinsics import find_scene, intrinsics_of
from icalib.sensors.camera.initialize.boards.target_scene import scene_poses
from icalib.sensors.sensor import mounted
from icalib.sensors.stream import seconds_since


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
