"""Lines of an IMU in a draft of the rig file."""

from __future__ import annotations

import json
from collections.abc import Iterator
from pathlib import Path

import numpy as np

from icalib.sensors.imu.inspect.facts import ImuSource
from icalib.sensors.imu.read.table_kinds import CARRIED
from icalib.sensors.imu.spec import DEFAULT_CLASS, IMU_CLASSES, ImuNoise, TwoSources, class_noise, class_of_noise
from icalib.tools.inspection.facts import Inspection
from icalib.tools.inspection.kalibr import KalibrImu
from icalib.tools.inspection.kinds import comment, in_frame, name_text, number, place_line


def imu_lines(inspection: Inspection, imus: dict[str, ImuSource]) -> Iterator[str]:
    """Lines of the IMU to calibrate with, among `imus` by name; none without any."""
    if not imus:
        return
    name = inspection.imu or next(iter(imus))
    topic, halves, facts = imus[name].topic, imus[name].halves, inspection.facts[name]
    frame = facts.frame if facts else ""
    yield from (f"  {name}:", "    type: imu")
    yield "    " + place_line(topic.name, topic.type, frame) if halves is None else _places(halves, topic.type, frame)
    kalibr = _kalibr_imu(inspection, topic.name)
    yield from _noise(kalibr)
    if facts and np.isfinite(facts.scatter).all():
        gyro, accel = facts.scatter
        yield f"    # Its readings in quiet moments show at least gyro: {gyro:.2g}, accel: {accel:.2g}."
    yield "    # The most valuable line of this draft: how far axes and scales of this IMU may be off. Rotations and"
    yield f"    # lengths depend on it. One of {', '.join(IMU_CLASSES)}; `fixed` if it is calibrated."
    noise = class_noise(DEFAULT_CLASS) if kalibr is None else ImuNoise(**kalibr.densities, source="")
    yield f"    intrinsics: {class_of_noise(noise)}"
    others = [f"{n} ({imu.topic.name})" for n, imu in imus.items() if n != name]
    if others:
        yield f"  # Also recorded: {comment(', '.join(others))}; a rig has one IMU, choose the best."


def _noise(kalibr: KalibrImu | None) -> Iterator[str]:
    if kalibr is None:
        yield "    # The noise of a class. Better: the densities of the data sheet or of an Allan variance,"
        yield "    # {gyro: , gyro_walk: , accel: , accel_walk: }, in rad/s/sqrt(Hz), rad/s^2/sqrt(Hz), m/s^2/sqrt(Hz),"
        yield "    # m/s^3/sqrt(Hz)."
        yield f"    noise: {DEFAULT_CLASS}"
        return
    values = ", ".join(f"{name}: {number(value)}" for name, value in kalibr.densities.items())
    source = json.dumps(f"{Path(kalibr.file).name} (Kalibr)")
    yield f"    noise: {{{values}, source: {source}}}  # from {comment(kalibr.file)}"


def _kalibr_imu(inspection: Inspection, topic: str) -> KalibrImu | None:
    """Kalibr's entry for the IMU's topic; else its only entry, if that names no topic of this recording."""
    entries = inspection.kalibr.imus
    topics = {s.topic.name.strip("/") for s in inspection.streams}
    matches = [k for k in entries if k.topic.strip("/") == topic.strip("/")]
    if not matches and len(entries) == 1 and entries[0].topic.strip("/") not in topics:
        matches = list(entries)
    return matches[0] if matches else None


def _places(halves: TwoSources, kind: str, frame: str) -> str:
    """The `topic` or `path` line of an IMU whose gyroscope and accelerometer have a topic or table each."""
    field = "path" if kind in CARRIED else "topic"
    topics = f"{{gyro: {name_text(halves.gyro)}, accel: {name_text(halves.accel)}}}"
    return f"    {field}: {topics}  # {comment(kind)}" + in_frame(frame)
