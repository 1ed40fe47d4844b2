"""Writes a simulated recording as a bag with the messages of the sensors' drivers: ROS 1, or MCAP of ROS 2."""

from __future__ import annotations

import heapq
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np

from icalib.base.files import write_new
from icalib.data.measurements import ImuStream
from icalib.errors import RigError
from icalib.tools.simulation.images.filming import Film
from icalib.tools.simulation.images.rendering import Imaging
from icalib.tools.simulation.output import IMAGE, IMU, IMU_TOPIC, BagWriter
from icalib.tools.simulation.rigs import rig_text
from icalib.tools.simulation.scenario.sensor import BagTopic
from icalib.tools.simulation.sensors.simulate import Simulation
from icalib.tools.simulation.tables import atomic_output, check_absent, write_truth

Event = tuple[int, str, Callable[[BagWriter], Any]]  # instant on the IMU's clock [ns], topic, maker of the message
_EXPOSURE_S = 0.004
_AT_A_TIME = 10_000  # readings that are converted to Python numbers at once, which take ten times the memory


def write_sensors(
    simulation: Simulation, seed: int, path: Path, progress: Callable[[float], None] = lambda done: None
) -> tuple[str, ...]:
    """Writes an MCAP bag, its truth and its rig file to the new folder `path`, atomically. If `path` ends with .bag,
    it is a ROS 1 bag, with only the rig file beside it, as `run.rig.yaml`.

    Topics are /imu0 (Imu), those of `SimSensor.bag_topic`, and /NAME/image_raw (Image, mono8), which shows the target,
    or the room if there is no target. Returns sentences on data that were left out. Raises RecordingError if `path`
    exists or cannot be written, CalibrationError if a package is missing, RigError for a board that is not flat.
    """
    if any(simulation.scenario.bow):
        raise RigError("boards are rendered flat; set the scenario's bow to zero.")
    ros1, rig = path.suffix == ".bag", path.with_suffix(".rig.yaml")
    if ros1:
        check_absent(rig)
    topics, streams, notes = _streams(simulation, seed)
    last_ns = simulation.truth.imu_clock_origin_ns + int(simulation.truth.seconds[-1] * 1e9)
    span_ns = max(last_ns - simulation.truth.imu_clock_origin_ns, 1)
    with atomic_output(path) as place:
        with BagWriter("ros1" if ros1 else "mcap", place, topics) as bag:
            for at_ns, topic, make in heapq.merge(*streams, key=lambda event: event[0]):
                bag.write(topic, make(bag), at_ns)
                progress(1.0 - (last_ns - at_ns) / span_ns)
        if not ros1:
            write_truth(simulation, seed, place, topics)
    if ros1:
        write_new(rig, rig_text(simulation.scenario, topics))
        notes += (f"the rig file of the bag is {rig}.",)
    return notes


def _streams(simulation: Simulation, seed: int) -> tuple[dict[str, str], list[Iterator[Event]], tuple[str, ...]]:
    """The message type of each topic, the events of each stream, and sentences on sensors without messages."""
    measured, truth = simulation.measurements, simulation.truth
    assert measured.imu is not None  # of every scenario
    topics, streams, notes = {IMU_TOPIC: IMU}, [_readings(measured.imu)], []
    for sensor in simulation.scenario.sensors:
        topic = sensor.bag_topic(measured.streams[sensor.name], round(truth.time_offset[sensor.name] * 1e9))
        if isinstance(topic, str):
            notes.append(topic)
            continue
        topics[topic.name] = topic.message
        streams.append(_on_topic(topic))
    if simulation.scenario.board or simulation.scenario.room:
        topics |= {f"/{camera.name}/image_raw": IMAGE for camera in simulation.scenario.cameras}
        streams.append(_images(simulation, seed))
    elif simulation.scenario.cameras:
        notes.append("images show targets or a room, and the scenario has neither, so no images are written.")
    return topics, streams, tuple(notes)


def _on_topic(topic: BagTopic) -> Iterator[Event]:
    return ((at_ns, topic.name, make) for at_ns, make in topic.events)


def _readings(imu: ImuStream) -> Iterator[Event]:
    for first in range(0, len(imu.stamps_ns), _AT_A_TIME):
        some = slice(first, first + _AT_A_TIME)
        values = np.concatenate([imu.gyro[some], imu.accel[some]], axis=1).tolist()
        for stamp_ns, row in zip(imu.stamps_ns[some].tolist(), values, strict=True):
            yield stamp_ns, IMU_TOPIC, lambda bag, stamp_ns=stamp_ns, row=row: bag.imu(stamp_ns, row)


def _images(simulation: Simulation, seed: int) -> Iterator[Event]:
    """Events of all images, which are rendered on all cores, a few of them ahead."""
    imu, truth = simulation.measurements.imu, simulation.truth
    assert imu is not None  # of every scenario
    for shot in Film(simulation.scenario, seed, Imaging(blur_px=0.8, noise=2.0), _EXPOSURE_S, imu, truth).shots():
        yield (
            truth.imu_clock_origin_ns + round(shot.seconds * 1e9),
            f"/{shot.camera}/image_raw",
            lambda bag, shot=shot: bag.image(shot.stamp_ns, shot.camera, shot.pixels),
        )
