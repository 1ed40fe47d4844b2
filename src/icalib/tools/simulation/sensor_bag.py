"""A simulated recording as a bag of what the sensors' drivers send: ROS 1, or MCAP of ROS 2."""

from __future__ import annotations

import heapq
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np

from icalib.data.measurements import ImuStream, LidarStream, PoseStream, WheelPoses, WheelStream
from icalib.errors import RigError
from icalib.tools.simulation.bag_writer import IMAGE, IMU, IMU_TOPIC, JOINTS, POINTS, POSE, TWIST, BagWriter
from icalib.tools.simulation.images.filming import Film
from icalib.tools.simulation.images.rendering import Imaging
from icalib.tools.simulation.sensors.poses import quaternion
from icalib.tools.simulation.sensors.simulate import Simulation
from icalib.tools.simulation.tables import whole, write_truth

Event = tuple[int, str, Callable[[BagWriter], Any]]  # when on the IMU's clock [ns], topic, what makes the message
_EXPOSURE_S = 0.004
_AT_A_TIME = 10_000  # readings as Python numbers, which take ten times the memory
_JOINTS = {"pair": ["left_wheel", "right_wheel"], "steered": ["wheel", "steering"]}


def write_sensors(
    simulation: Simulation, seed: int, path: Path, progress: Callable[[float], None] = lambda done: None
) -> tuple[str, ...]:
    """Writes a bag and the truth beside it into the new folder `path`, all or nothing; a `path` that ends in .bag is a
    bag of ROS 1, and has no truth.

    Topics are /imu0 (Imu), /NAME/points (PointCloud2: x, y, z and `time` [s] from the stamp), /NAME/joint_states
    (JointState) or /NAME/twist (TwistStamped), /NAME/pose (PoseStamped) and /NAME/image_raw (Image, mono8) of the
    target, or without one of the room.
    Returns sentences on what was left out. Raises RecordingError where `path` exists or cannot be written,
    CalibrationError where a package is missing, RigError for a board that is not flat.
    """
    if any(simulation.scenario.bow):
        raise RigError("boards are rendered flat; set the scenario's bow to zero.")
    ros1 = path.suffix == ".bag"
    topics, streams, notes = _streams(simulation, seed)
    last_ns = simulation.truth.imu_clock_origin_ns + int(simulation.truth.seconds[-1] * 1e9)
    span_ns = max(last_ns - simulation.truth.imu_clock_origin_ns, 1)
    with whole(path) as place:
        with BagWriter("ros1" if ros1 else "mcap", place, topics) as bag:
            for at_ns, topic, make in heapq.merge(*streams, key=lambda event: event[0]):
                bag.write(topic, make(bag), at_ns)
                progress(1.0 - (last_ns - at_ns) / span_ns)
        if not ros1:
            write_truth(simulation, seed, place)
    return notes


def _streams(simulation: Simulation, seed: int) -> tuple[dict[str, str], list[Iterator[Event]], tuple[str, ...]]:
    """The type of each topic, the events of each stream, and sentences on what has none."""
    measured, truth = simulation.measurements, simulation.truth
    assert measured.imu is not None  # of every scenario
    topics, streams, notes = {IMU_TOPIC: IMU}, [_readings(measured.imu)], []
    for lidar in measured.lidars:
        topics[f"/{lidar.name}/points"] = POINTS
        streams.append(_clouds(lidar, round(truth.time_offset[lidar.name] * 1e9)))
    for wheels in measured.wheels:
        if isinstance(wheels, WheelPoses):
            notes.append(f"{wheels.name} reports relative poses, which no driver sends; they are not written.")
            continue
        offset_ns = round(truth.time_offset[wheels.name] * 1e9)
        if wheels.kind == "twist":
            topics[f"/{wheels.name}/twist"] = TWIST
            streams.append(_twists(wheels, offset_ns))
            continue
        topics[f"/{wheels.name}/joint_states"] = JOINTS
        streams.append(_joints(wheels, offset_ns))
    for poses in measured.poses:
        topics[f"/{poses.name}/pose"] = POSE
        streams.append(_poses(poses, round(truth.time_offset[poses.name] * 1e9)))
    if simulation.scenario.board or simulation.scenario.room:
        topics |= {f"/{camera.name}/image_raw": IMAGE for camera in simulation.scenario.cameras}
        streams.append(_images(simulation, seed))
    elif simulation.scenario.cameras:
        notes.append("images show targets or a room, and the scenario has neither, so no images are written.")
    return topics, streams, tuple(notes)


def _readings(imu: ImuStream) -> Iterator[Event]:
    for first in range(0, len(imu.stamps_ns), _AT_A_TIME):
        some = slice(first, first + _AT_A_TIME)
        values = np.concatenate([imu.gyro[some], imu.accel[some]], axis=1).tolist()
        for stamp_ns, row in zip(imu.stamps_ns[some].tolist(), values, strict=True):
            yield stamp_ns, IMU_TOPIC, lambda bag, stamp_ns=stamp_ns, row=row: bag.imu(stamp_ns, row)


def _images(simulation: Simulation, seed: int) -> Iterator[Event]:
    """Rendered a few ahead, on all cores."""
    imu, truth = simulation.measurements.imu, simulation.truth
    assert imu is not None  # of every scenario
    for shot in Film(simulation.scenario, seed, Imaging(blur_px=0.8, noise=2.0), _EXPOSURE_S, imu, truth).shots():
        yield (
            truth.imu_clock_origin_ns + round(shot.seconds * 1e9),
            f"/{shot.camera}/image_raw",
            lambda bag, shot=shot: bag.image(shot.stamp_ns, shot.camera, shot.pixels),
        )


def _clouds(lidar: LidarStream, offset_ns: int) -> Iterator[Event]:
    """A cloud is received when its last point was measured."""
    for i, stamp_ns in enumerate(lidar.stamps_ns.tolist()):
        points = slice(lidar.start[i], lidar.start[i + 1])
        xyz, offset_s = lidar.xyz[points], lidar.offset_s[points]
        lasted_ns = int(offset_s[-1] * 1e9) if len(offset_s) else 0
        yield (
            stamp_ns + offset_ns + lasted_ns,
            f"/{lidar.name}/points",
            lambda bag, stamp_ns=stamp_ns, xyz=xyz, offset_s=offset_s: bag.points(stamp_ns, lidar.name, xyz, offset_s),
        )


def _joints(wheels: WheelStream, offset_ns: int) -> Iterator[Event]:
    """Positions are the angles turned since the first stamp, where the readings are means; else there are none, but
    steering angles, which have no velocity."""
    angles, rates = np.full(wheels.rate.shape, np.nan), wheels.rate.copy()
    if wheels.sampling == "interval-mean":
        turned = wheels.rate[1:] * np.diff(wheels.stamps_ns)[:, None] * 1e-9
        angles = np.concatenate([np.zeros((1, 2)), np.cumsum(turned, axis=0)])
    if wheels.kind == "steered":
        angles[:, 1], rates[:, 1] = wheels.rate[:, 1], np.nan
    elif wheels.sampling == "instantaneous":
        angles = np.empty((len(rates), 0))
    for stamp_ns, angle, rate in zip(wheels.stamps_ns.tolist(), angles, rates, strict=True):
        yield (
            stamp_ns + offset_ns,
            f"/{wheels.name}/joint_states",
            lambda bag, stamp_ns=stamp_ns, angle=angle, rate=rate: bag.joints(
                stamp_ns, wheels.name, _JOINTS[wheels.kind], angle, rate
            ),
        )


def _twists(wheels: WheelStream, offset_ns: int) -> Iterator[Event]:
    for stamp_ns, values in zip(wheels.stamps_ns.tolist(), wheels.rate.tolist(), strict=True):
        yield (
            stamp_ns + offset_ns,
            f"/{wheels.name}/twist",
            lambda bag, stamp_ns=stamp_ns, values=values: bag.twist(stamp_ns, wheels.name, *values),
        )


def _poses(poses: PoseStream, offset_ns: int) -> Iterator[Event]:
    for stamp_ns, R, position in zip(poses.stamps_ns.tolist(), poses.rotation, poses.position, strict=True):
        yield (
            stamp_ns + offset_ns,
            f"/{poses.name}/pose",
            lambda bag, stamp_ns=stamp_ns, R=R, position=position: bag.pose(
                stamp_ns, f"{poses.name}_frame", position, quaternion(R)
            ),
        )
