"""Simulated pose sensors, such as motion capture or an odometry."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import Any, ClassVar, Literal

import numpy as np

from icalib.base.yaml_nodes import YamlValue
from icalib.data.measurements import PoseStream
from icalib.sensors.pose.spec import PoseSensor
from icalib.tools.simulation.motion import rotation_from_vector
from icalib.tools.simulation.output import BagWriter, write_table
from icalib.tools.simulation.scenario import (
    BagEvent,
    BagTopic,
    Report,
    SimRecord,
    SimScene,
    SimSensor,
    TrueParameters,
    at_least,
    mounted_fields,
    pose,
    true_ratio,
)
from icalib.tools.simulation.trajectory import LEAD_S, stamped

_POSE_MESSAGE = "geometry_msgs/msg/PoseStamped"


@dataclass(frozen=True, eq=False)
class PoseTruth:
    """Poses without noise, as the sensor would report them. seconds (N,): on the IMU's clock; rotation (N, 3, 3)
    R_frame_sensor; position (N, 3) p_frame_sensor [m]."""

    seconds: np.ndarray
    rotation: np.ndarray
    position: np.ndarray


@dataclass(frozen=True, eq=False)
class SimPoses(SimSensor):
    """True parameters of one simulated sensor that reports T_frame_sensor. T_world_frame (4, 4): pose of its frame.

    absolute: poses have independent noise on each axis, rotation_noise [rad] and position_noise [m]. relative: steps
    between successive poses have independent noise, [rad/sqrt(s)] and [m/sqrt(s)], so that poses drift. scale: ratio of
    true to reported lengths.
    """

    sensor_type: ClassVar[str] = "pose"
    random_stream: ClassVar[int] = 4000
    effects: ClassVar = {"pose_scale": ("scale", true_ratio)}

    rate_hz: float = 100.0
    kind: Literal["absolute", "relative"] = "absolute"
    T_world_frame: np.ndarray = field(default_factory=lambda: np.eye(4))
    rotation_noise: float = 2e-3
    position_noise: float = 1e-3
    scale: float = 1.0

    @classmethod
    def parse(cls, name: str, value: YamlValue, start_ns: int) -> SimPoses:
        noises = ("rotation_noise", "position_noise")
        fields, common = mounted_fields(value, start_ns, options=("kind", "T_world_frame", *noises))
        chosen: dict[str, Any] = {key: at_least(fields[key], 0.0) for key in noises if key in fields}
        if "kind" in fields:
            chosen["kind"] = fields["kind"].choice("kind", ("absolute", "relative"))
        if "T_world_frame" in fields:
            chosen["T_world_frame"] = pose(fields["T_world_frame"])
        return cls(name, **common, **chosen)

    def true_parameters(self) -> TrueParameters:
        entries = {"kind": self.kind, "T_world_frame": self.T_world_frame.tolist()}
        return TrueParameters({"scale": np.array([self.scale])}, entries)

    def report(self, scene: SimScene, seed: list[int], progress: Callable[[float], None]) -> Report:
        """Poses while the IMU is running, with noise if the scene is noisy; and the poses without noise."""
        stamps, seconds = stamped(self, scene.imu_seconds[-1] - LEAD_S)
        R, p, _ = scene.trajectory.pose_at(seconds)
        T = np.tile(np.eye(4), (len(seconds), 1, 1))
        T[:, :3, :3], T[:, :3, 3] = R, p
        poses = np.linalg.inv(self.T_world_frame) @ T @ self.T_imu_sensor
        poses[:, :3, 3] /= self.scale
        truth = PoseTruth(seconds, poses[:, :3, :3].copy(), poses[:, :3, 3].copy())
        if scene.noisy:
            rng = np.random.default_rng(seed)
            is_absolute = self.kind == "absolute"
            poses = _with_white_noise(self, poses, rng) if is_absolute else _with_drift(self, poses, seconds, rng)
        return Report(PoseStream(self.name, stamps, poses[:, :3, :3].copy(), poses[:, :3, 3].copy()), truth)

    def rig_entry(self) -> PoseSensor:
        noise = self.rotation_noise, self.position_noise
        return PoseSensor(self.name, f"{self.name}/poses.csv", self.kind, *noise, scale_sigma=0.0)

    def record(self, stream: PoseStream, offset_ns: int) -> SimRecord:
        """A table, and messages PoseStamped."""
        topic = BagTopic(f"/{self.name}/pose", _POSE_MESSAGE, _messages(stream, offset_ns))
        return SimRecord(partial(_write_poses, stream), topic)


SIMULATED = SimPoses


def _write_poses(stream: PoseStream, folder: Path) -> None:
    header = "t [ns],x [m],y [m],z [m],qx,qy,qz,qw"
    xyzw = np.array([quaternion(R) for R in stream.rotation])
    write_table(folder / "poses.csv", header, stream.stamps_ns, stream.position, xyzw)


def _messages(poses: PoseStream, offset_ns: int) -> Iterator[BagEvent]:
    """One PoseStamped message for each pose, at its stamp."""
    frame = f"{poses.name}_frame"
    for stamp_ns, R, position in zip(poses.stamps_ns.tolist(), poses.rotation, poses.position, strict=True):
        yield (
            stamp_ns + offset_ns,
            lambda bag, stamp_ns=stamp_ns, R=R, position=position: _message(bag, stamp_ns, frame, position, R),
        )


def _message(bag: BagWriter, stamp_ns: int, frame: str, position: np.ndarray, R: np.ndarray) -> Any:
    """PoseStamped of a sensor in the frame `frame`: position (3,) [m] and rotation R (3, 3)."""
    point = bag.make("geometry_msgs/msg/Point", *position.tolist())
    turn = bag.make("geometry_msgs/msg/Quaternion", *quaternion(R).tolist())
    return bag.make(_POSE_MESSAGE, bag.header(stamp_ns, frame), bag.make("geometry_msgs/msg/Pose", point, turn))


def _with_white_noise(sensor: SimPoses, poses: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """Poses (N, 4, 4) with independent noise, for rotations about the axes of the sensor and for positions along the
    axes of the frame."""
    out = poses.copy()
    for T in out:
        T[:3, :3] = T[:3, :3] @ rotation_from_vector(sensor.rotation_noise * rng.standard_normal(3))
        T[:3, 3] += sensor.position_noise * rng.standard_normal(3)
    return out


def _with_drift(sensor: SimPoses, poses: np.ndarray, seconds: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """Poses (N, 4, 4) that drift, as independent noise is added to the steps between successive poses."""
    out = poses.copy()
    for k in range(1, len(poses)):
        step, root = np.linalg.inv(poses[k - 1]) @ poses[k], np.sqrt(seconds[k] - seconds[k - 1])
        step[:3, :3] = step[:3, :3] @ rotation_from_vector(sensor.rotation_noise * root * rng.standard_normal(3))
        step[:3, 3] += sensor.position_noise * root * rng.standard_normal(3)
        out[k] = out[k - 1] @ step
    return out


def quaternion(R: np.ndarray) -> np.ndarray:
    """(4,) quaternion x, y, z, w of a rotation (3, 3): eigenvector of a symmetric matrix, without singular angles
    (Bar-Itzhack, 2000)."""
    (a, b, c), (d, e, f), (g, h, i) = R
    K = [[a - e - i, b + d, c + g, h - f], [b + d, e - a - i, f + h, c - g], [c + g, f + h, i - a - e, d - b]]
    return np.linalg.eigh(np.array([*K, [h - f, c - g, d - b, a + e + i]]) / 3.0)[1][:, -1]
