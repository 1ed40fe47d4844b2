"""Aligns cameras with feature tracks to a trajectory by odometry, which takes the place of a pose sensor.

The body is the first camera. Poses and extrinsics relative to the odometry are converted to this camera.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from icalib.data.measurements import Measurements, PoseStream
from icalib.estimate.problem.inputs import Inputs
from icalib.initialize.steps.contradicted_guesses import merged_values
from icalib.initialize.steps.initializer import Values
from icalib.initialize.steps.rig_file_values import stated_values
from icalib.initialize.steps.smooth_trajectory import BodyPoses
from icalib.rig import Parameter, PoseSensor, Rig
from icalib.sensors.sensor import MOUNTED_NAMES


def with_pose_sensor(rig: Rig, sensor: str) -> Rig:
    """A rig of the cameras of `rig` and a pose sensor named `sensor` in place of the odometry. Extrinsics of the
    cameras are unknown."""
    free = dict.fromkeys(MOUNTED_NAMES, Parameter())
    cameras = tuple(replace(c, clock_restarts=False, **free) for c in rig.cameras)
    return rig.only().with_sensors(*cameras, PoseSensor(sensor, "", "absolute"))


def pose_streams(recordings: Sequence[Measurements], sensor: str, paths: Sequence[BodyPoses]) -> list[PoseStream]:
    """The trajectories `paths` of `sensor`, one for each recording, as measurements of a pose sensor."""
    stamps = [m.streams[sensor].stamps_ns for m in recordings]
    return [PoseStream(sensor, t, p.rotation, p.position) for t, p in zip(stamps, paths, strict=True)]


def camera_poses(
    rig: Rig, recordings: Sequence[Measurements], sensor: str, paths: Sequence[BodyPoses], values: Values
) -> list[BodyPoses]:
    """Poses of the first camera, on its clock, from trajectories `paths` of `sensor`. values: extrinsics and time
    offsets of the cameras relative to `sensor`."""
    first = rig.cameras[0].name
    R, p, offset = (values[first, name] for name in MOUNTED_NAMES)
    between = [(m.tracks[0].origin_ns - m.streams[sensor].origin_ns) * 1e-9 for m in recordings]
    return [
        BodyPoses(path.seconds - offset[0] + between[0] - b, path.rotation @ R, path.position + path.rotation @ p)
        for path, b in zip(paths, between, strict=True)
    ]


def relative_to_first_camera(rig: Rig, sensor: str, values: Values) -> Values:
    """Extrinsics and time offsets of `sensor` and of the other cameras relative to the first camera. `values` has those
    of the cameras relative to `sensor`. Also returns the intrinsics, and the other parameters of `sensor` as the rig
    file gives them."""
    first, *others = rig.cameras
    R, p, offset = (values[first.name, name] for name in MOUNTED_NAMES)
    out = {key: value for key, value in values.items() if key[1] in ("intrinsics", "distortion")}
    mounts = {sensor: (np.eye(3), np.zeros(3), np.zeros(1))}
    mounts |= {c.name: tuple(values[c.name, name] for name in MOUNTED_NAMES) for c in others}
    for name, (Q, q, dt) in mounts.items():
        out |= {(name, "rotation"): R.T @ Q, (name, "translation"): R.T @ (q - p), (name, "time_offset"): dt - offset}
    for spec in rig.sensors[sensor].specs():
        if spec.name not in MOUNTED_NAMES:
            value = getattr(rig.sensors[sensor], spec.name).value
            usual = np.full(spec.size, float(spec.is_positive))
            out[sensor, spec.name] = usual if value is None else np.asarray(value)
    return out


def with_stated_values(inputs: Inputs, sensor: str, estimates: Values) -> Values:
    """`estimates`, completed by values of the rig file for cameras and `sensor` that do not contradict it. The height
    of `sensor` is taken from the rig file if stated, because planar motion does not show it."""
    out, rig = dict(estimates), inputs.rig
    for rig_sensor in (*rig.cameras[1:], rig.sensors[sensor]):
        names = MOUNTED_NAMES if rig_sensor.name != sensor else [spec.name for spec in rig_sensor.specs()]
        stated, of_sensor = (
            stated_values(inputs, rig_sensor, names),
            {k: v for k, v in estimates.items() if k[0] == rig_sensor.name},
        )
        arm = sensor, "translation"
        if arm in stated and arm in of_sensor:
            up = of_sensor[sensor, "rotation"][:, 2]
            of_sensor[arm] = of_sensor[arm] + up * (up @ (stated[arm] - of_sensor[arm]))
        out |= merged_values(rig_sensor, stated, of_sensor)
    return out
