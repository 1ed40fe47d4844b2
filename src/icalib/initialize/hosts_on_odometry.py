"""Aligns sensors that host keyframes to a trajectory by odometry, which takes the place of a pose sensor.

The body is the first of these sensors. Poses and extrinsics relative to the odometry are converted to the body.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from icalib.data.measurements import Measurements
from icalib.estimate.problem.inputs import Inputs
from icalib.initialize.assumed_sensors import pose_sensor_for
from icalib.initialize.steps.contradicted_guesses import merged_values, stated_values
from icalib.initialize.steps.initializer import Values, keyframe_hosts
from icalib.initialize.steps.smooth_trajectory import BodyPoses
from icalib.rig import Parameter, Rig, Sensor
from icalib.sensors.sensor import MOUNTED_NAMES


def hosts_without_body(rig: Rig) -> list[Sensor]:
    """The sensors at whose measurements keyframes are set, without the body."""
    return [s for s in keyframe_hosts(rig.mounted) if s.name != rig.reference_without_imu]


def with_pose_sensor(rig: Rig, sensor: str) -> Rig:
    """A rig of the sensors of `rig` that host keyframes, and a pose sensor named `sensor` in place of the odometry.
    Extrinsics of the hosts are unknown."""
    free = dict.fromkeys(MOUNTED_NAMES, Parameter())
    hosts = (replace(s, clock_restarts=False, **free) for s in keyframe_hosts(rig.mounted))
    return rig.only().with_sensors(*hosts, pose_sensor_for(sensor))


def body_poses_by(
    rig: Rig, recordings: Sequence[Measurements], sensor: str, paths: Sequence[BodyPoses], values: Values
) -> list[BodyPoses]:
    """Poses of the body, on its clock, from trajectories `paths` of `sensor`. values: extrinsics and time offset of the
    body relative to `sensor`."""
    R, p, offset = (values[rig.reference, name] for name in MOUNTED_NAMES)
    between = [(m.origin_ns - m.streams[sensor].origin_ns) * 1e-9 for m in recordings]
    return [
        BodyPoses(path.seconds - offset[0] + between[0] - b, path.rotation @ R, path.position + path.rotation @ p)
        for path, b in zip(paths, between, strict=True)
    ]


def relative_to_body(rig: Rig, sensor: str, values: Values) -> Values:
    """Extrinsics and time offsets of `sensor` and of the other hosts relative to the body. `values` has those of the
    hosts relative to `sensor`. Also returns their other `values`, and the other parameters of `sensor` as the rig file
    gives them."""
    others = [s.name for s in hosts_without_body(rig)]
    R, p, offset = (values[rig.reference, name] for name in MOUNTED_NAMES)
    out = {key: value for key, value in values.items() if key[1] not in MOUNTED_NAMES}
    mounts = {sensor: (np.eye(3), np.zeros(3), np.zeros(1))}
    mounts |= {host: tuple(values[host, name] for name in MOUNTED_NAMES) for host in others}
    for name, (Q, q, dt) in mounts.items():
        out |= {(name, "rotation"): R.T @ Q, (name, "translation"): R.T @ (q - p), (name, "time_offset"): dt - offset}
    for spec in rig.sensors[sensor].specs():
        if spec.name not in MOUNTED_NAMES:
            value = getattr(rig.sensors[sensor], spec.name).value
            usual = np.full(spec.size, float(spec.is_positive))
            out[sensor, spec.name] = usual if value is None else np.asarray(value)
    return out


def with_stated_values(inputs: Inputs, sensor: str, estimates: Values) -> Values:
    """`estimates`, completed by values of the rig file for the hosts and `sensor` that do not contradict it. The height
    of `sensor` is taken from the rig file if stated, because planar motion does not show it."""
    out, rig = dict(estimates), inputs.rig
    for rig_sensor in (*hosts_without_body(rig), rig.sensors[sensor]):
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
