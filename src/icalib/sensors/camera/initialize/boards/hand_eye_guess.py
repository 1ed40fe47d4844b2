"""Cameras that see a target from a robot that turns about one axis, as on a floor, placed on the motion that a LiDAR
or a pose sensor shows.

The rotation about that axis is unobservable from angular rates. The trajectories of the cameras' poses and of the robot
show it.
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


def with_hand_eye_guess(rig: Rig, seen: Inputs, others: Inputs, state: State) -> Rig:
    """`rig` with a guess of how each camera stands whose rotation it does not give. Of several recordings the one in
    which it saw most says so. seen: what the cameras are estimated from; others: what `state`, which has the motion,
    is made from.

    Raises EstimationError where the motion does not show it.
    """
    recordings = [m.measurements for m in seen.motions]
    scene = find_scene(rig, seen.bodies, recordings)

    def placed(number: int, camera: Camera) -> Camera:
        best = int(np.argmax([len(r.cameras[number].uv) for r in recordings]))
        stream, own = recordings[best].cameras[number], single_recording(others, best)
        poses = scene_poses(stream, camera_model(camera.model), intrinsics_of(camera, stream, rig.target, scene), scene)
        ok, stamps = poses.ok, stream.stamps_ns[poses.ok]
        seconds = seconds_since(stamps, int(stamps[0]))
        path = SensorTrajectory(seconds, poses.rotation[ok], poses.position[ok], np.ones(len(stamps), dtype=bool))
        assert own.imu is not None
        with naming_recording(others, best):
            found, _ = extrinsics_on_trajectory(
                own.imu, camera.name, path, state_of_recording(others, best, state), KnownExtrinsics()
            )
        offset = found.offset - 1e-9 * (int(stamps[0]) - recordings[best].origin_ns)
        guess = mounted(found.rotation, found.position, np.array([offset]))
        return replace(
            camera, **{k: Parameter("free", v) for k, v in guess.items() if getattr(camera, k).value is None}
        )

    return rig.with_sensors(*(placed(k, c) for k, c in enumerate(rig.cameras) if c.rotation.value is None))
