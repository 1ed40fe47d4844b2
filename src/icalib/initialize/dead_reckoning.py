"""Dead reckoning by wheels on a floor, in place of a pose sensor: what cameras without IMU and target are placed on."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from icalib.data.measurements import Measurements, PoseStream, WheelPoses, WheelStream
from icalib.errors import EstimationError
from icalib.estimate.problem.inputs import Inputs
from icalib.geometry import so3
from icalib.initialize.steps.contradicted import settled
from icalib.initialize.steps.known_values import given
from icalib.initialize.steps.smooth_path import BodyPoses
from icalib.optim.state import Key
from icalib.rig import Parameter, PoseSensor, Rig, Wheels
from icalib.sensors.sensor import MOUNTED_NAMES
from icalib.sensors.wheels.wheel_angles import integrals_of


def wheel_path(wheels: Wheels, stream: WheelStream | WheelPoses) -> BodyPoses:
    """Poses of the wheels' frame at their stamps, in the plane that they start in, z up.

    Raises EstimationError where the rig file does not say how large the wheels are.
    """
    if isinstance(stream, WheelPoses):
        turn, along = stream.pose[:, 0], stream.pose[:, 1:]
    else:
        turn, along = _increments(wheels, stream)
    yaw = np.concatenate([[0.0], np.cumsum(turn)])
    c, s = np.cos(yaw[:-1]), np.sin(yaw[:-1])
    steps = np.stack([c * along[:, 0] - s * along[:, 1], s * along[:, 0] + c * along[:, 1]], axis=1)
    position = np.zeros((len(yaw), 3))
    position[1:, :2] = np.cumsum(steps, axis=0)
    return BodyPoses(stream.seconds, so3.exp_many(yaw[:, None] * [0.0, 0.0, 1.0]), position)


def _increments(wheels: Wheels, stream: WheelStream) -> tuple[np.ndarray, np.ndarray]:
    """Yaw (n,) rad and way (n, 2) m in the frame at the beginning, from each reading to the next."""
    turned = np.diff(integrals_of(stream), axis=0)
    if stream.kind == "pair":
        path = turned * _size(wheels, "radii")
        ahead, yaw = path.mean(axis=1), (path[:, 1] - path[:, 0]) / _size(wheels, "baseline")[0]
    elif stream.kind == "twist":
        scales = np.ones(2) if wheels.scales.value is None else wheels.scales.value
        ahead, yaw = (turned * scales).T
    else:
        offset = 0.0 if wheels.steering_offset.value is None else float(wheels.steering_offset.value[0])
        ahead = turned[:, 0] * _size(wheels, "radius")[0]
        steer = np.arctan2(turned[:, 2], turned[:, 1]) + offset
        yaw = ahead * np.tan(steer) / _size(wheels, "wheelbase")[0]
    half = 0.5 * yaw  # the chord of an arc
    return yaw, (ahead * np.sinc(half / np.pi))[:, None] * np.stack([np.cos(half), np.sin(half)], axis=1)


def _size(wheels: Wheels, name: str) -> np.ndarray:
    value = getattr(wheels, name).value
    if value is None:
        raise EstimationError(
            f"without IMU, target and pose sensor only {wheels.name} determines the scale; give its "
            f"{' and '.join(spec.name for spec in wheels.drive_specs)} in the rig file, or add one of these sensors."
        )
    return np.asarray(value, dtype=np.float64)


def in_place_of_wheels(rig: Rig, wheels: Wheels) -> Rig:
    """The rig with a pose sensor in place of its wheels; nothing is known of where its cameras stand."""
    free = dict.fromkeys(MOUNTED_NAMES, Parameter())
    cameras = tuple(replace(c, clock_restarts=False, **free) for c in rig.cameras)
    return rig.with_(cameras=cameras, wheels=(), poses=(PoseSensor(wheels.name, "", "absolute"),))


def pose_stream(stream: WheelStream | WheelPoses, path: BodyPoses) -> PoseStream:
    return PoseStream(stream.name, stream.stamps_ns, path.rotation, path.position)


def camera_paths(
    rig: Rig, recordings: Sequence[Measurements], shown: Sequence[BodyPoses], values: dict[Key, np.ndarray]
) -> list[BodyPoses]:
    """The first camera's poses, on its own clock, where wheels were `shown`; `values`: where cameras stand on these."""
    first = rig.cameras[0].name
    R, p, offset = (values[first, name] for name in MOUNTED_NAMES)
    between = [(m.tracks[0].origin_ns - m.wheels[0].origin_ns) * 1e-9 for m in recordings]
    return [
        BodyPoses(w.seconds - offset[0] + between[0] - b, w.rotation @ R, w.position + w.rotation @ p)
        for w, b in zip(shown, between, strict=True)
    ]


def seen_from_first(rig: Rig, values: dict[Key, np.ndarray]) -> dict[Key, np.ndarray]:
    """Where cameras and the first wheels stand seen from the first camera, from `values` on the wheels; and lenses."""
    wheels, (first, *others) = rig.wheels[0], rig.cameras
    R, p, offset = (values[first.name, name] for name in MOUNTED_NAMES)
    out = {key: value for key, value in values.items() if key[1] in ("intrinsics", "distortion")}
    mounts = {wheels.name: (np.eye(3), np.zeros(3), np.zeros(1))}
    mounts |= {c.name: tuple(values[c.name, name] for name in MOUNTED_NAMES) for c in others}
    for name, (Q, q, dt) in mounts.items():
        out |= {(name, "rotation"): R.T @ Q, (name, "translation"): R.T @ (q - p), (name, "time_offset"): dt - offset}
    for spec in wheels.drive_specs:
        value = getattr(wheels, spec.name).value
        usual = np.full(spec.size, float(spec.is_positive))
        out[wheels.name, spec.name] = usual if value is None else np.asarray(value)
    return out


def as_given(inputs: Inputs, found: dict[Key, np.ndarray]) -> dict[Key, np.ndarray]:
    """`found`, but what the rig file gives of cameras and the first wheels where that does not contradict it. Nothing
    shows how high wheels are on a floor: that is as given."""
    wheels, (_, *others) = inputs.rig.wheels[0], inputs.rig.cameras
    out, drive = dict(found), [spec.name for spec in wheels.drive_specs]
    for sensor, names in (*((c, MOUNTED_NAMES) for c in others), (wheels, (*MOUNTED_NAMES, *drive))):
        known, own = given(inputs, sensor, names), {k: v for k, v in found.items() if k[0] == sensor.name}
        arm = wheels.name, "translation"
        if arm in known and arm in own:
            up = own[wheels.name, "rotation"][:, 2]
            own[arm] = own[arm] + up * (up @ (known[arm] - own[arm]))
        out |= settled(sensor, known, own)
    return out
