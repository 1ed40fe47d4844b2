"""Finds IMUs in a recording for `icalib inspect`: topics and tables of readings, and IMUs of two topics."""

from __future__ import annotations

import dataclasses
import itertools
import json
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, ClassVar

import numpy as np
from rich.table import Table
from rich.text import Text

from icalib.data.measurements import ImuStream
from icalib.data.recordings import Recording, TopicInfo
from icalib.data.stamps import ClockJumps
from icalib.errors import RecordingError
from icalib.motion.imu_data import axis_words, other_axes
from icalib.report.figures import MOST_ROWS, stacked_panels, thin
from icalib.report.page import Plot
from icalib.report.pictures import Drawing
from icalib.sensors.imu.assess import quiet_scatter
from icalib.sensors.imu.read import CARRIED, Saturation, checked_imu, one_stream, pair_of, readings, saturations
from icalib.sensors.imu.read.cleaning import gravity_spread
from icalib.sensors.imu.spec import (
    DEFAULT_CLASS,
    IMU_CLASSES,
    ImuNoise,
    ImuSensor,
    TwoSources,
    class_noise,
    class_of_noise,
)
from icalib.sensors.sensor import Sensor
from icalib.tools.inspection.console import plain_table
from icalib.tools.inspection.facts import (
    PICTURED,
    Draft,
    Facts,
    Finding,
    Inspection,
    Key,
    KindInspector,
    Printout,
    SensorSource,
    Sources,
    StreamFacts,
    Vector,
    comment,
    frame_id,
    imu_timing,
    in_frame,
    independent,
    inertial,
    moving,
    name_text,
    number,
    place_line,
    plain,
    problem_of,
    rolls,
    timing_of,
    topic_key,
    words_on_gaps,
)
from icalib.tools.inspection.kalibr import KalibrImu

# What a recording shows of its IMUs, as plain data.


@dataclass(frozen=True)
class ImuFacts:
    """Readings of one IMU, x y z in its axes: gyro [rad/s], accel [m/s^2], in the recorded units.

    frame: frame id. mean_accel: mean of |accel|. gyro_rms: RMS of each axis; accel_std: RMS about the mean.
    principal_rms: RMS rate about the directions `principal` (unit vectors), largest first. gravity_spread: result of
    `gravity_turns.gravity_spread` for rates taken as rad/s, as deg/s, and as zero. scatter: `quiet_scatter` of
    gyro and accel. problem: why `calibrate` would refuse the readings, else "". curves: seconds (n,), gyro and
    accel (n, 3) of some readings, evenly picked.
    """

    frame: str
    gyro_min: Vector
    gyro_max: Vector
    accel_min: Vector
    accel_max: Vector
    mean_accel: float
    gyro_rms: Vector
    accel_std: Vector
    principal_rms: Vector
    principal: tuple[Vector, Vector, Vector]
    gravity_spread: Vector | None
    scatter: tuple[float, float]
    saturated: tuple[Saturation, ...]
    notes: tuple[str, ...]
    problem: str = ""
    curves: tuple[np.ndarray, np.ndarray, np.ndarray] | None = field(default=None, metadata=PICTURED)


@dataclass(frozen=True)
class ImuSource(SensorSource):
    """One IMU. halves: its two topics if gyroscope and accelerometer have a topic each; `topic` is the gyroscope's."""

    halves: TwoSources | None = None


# Findings on IMUs: units, motion and gaps.

STILL_RAD_S = 0.03  # RMS rate below which the IMU is at rest
WEAK_RAD_S = 0.1  # RMS rate about one axis: below it, parameters about this axis are weakly observable
SECOND_AXIS = 0.05  # smallest ratio of the second principal rate to the first; `calibrate` refuses less
WEAK_M_S2 = 0.3  # RMS of the specific force about its mean, below which a warning is given
FASTEST_RAD_S = 12.0  # largest rate of a rig that is turned by hand
DEGREE = np.pi / 180.0
LIKELIER = 0.7  # rates are in deg/s if the spread of gravity is less than this times that for rad/s,
EXPLAINED = 0.95  # and less than this times the spread without rotation
SHORT_S = 20.0  # shortest recording without a warning


def refused(inspection: Inspection) -> Iterator[Finding]:
    """IMUs that cannot be used: problems if no other IMU remains, else warnings."""
    for name in inertial(inspection):
        if problem := problem_of(inspection, name):
            is_fatal = inspection.imu is None or inspection.imu == name
            yield Finding("problem" if is_fatal else "warning", problem)


def of_readings(inspection: Inspection) -> Iterator[Finding]:
    """Units and motion of the IMU to calibrate with."""
    if inspection.imu is None or inspection.facts[inspection.imu].problem:
        return
    facts, name = inspection.facts[inspection.imu], inspection.imu
    yield from (Finding("warning", _capital(note)) for note in facts.notes)
    fast = max(*map(abs, facts.gyro_min), *map(abs, facts.gyro_max))
    radians, degrees, none = facts.gravity_spread or (0.0, 0.0, 0.0)
    if degrees < LIKELIER * radians and degrees < EXPLAINED * none:
        yield Finding(
            "problem",
            f"{name}: the angular rates look like deg/s, for gravity rotates accordingly in the accelerometer; "
            "set gyro_unit: deg/s in the rig file.",
        )
        return
    if fast > FASTEST_RAD_S:
        yield Finding(
            "warning",
            f"{name} turns at up to {fast:.1f} rad/s ({fast / DEGREE:.0f} deg/s), which blurs images; turn the "
            "rig more slowly, or check that the driver sends rad/s.",
        )
    yield from _motion(inspection, name, facts)


def _motion(inspection: Inspection, name: str, facts: ImuFacts) -> Iterator[Finding]:
    strongest, second, weakest = facts.principal_rms
    if strongest < STILL_RAD_S:
        yield Finding(
            "problem",
            f"{name} hardly moves ({strongest:.3f} rad/s RMS); record again while turning the rig about all "
            f"three axes{' in front of the target' if independent(inspection) else ''}.",
        )
    elif second < SECOND_AXIS * strongest or second < STILL_RAD_S:
        # Rotations of cameras are found from rotations of the rig alone; those of other sensors from its path as well.
        is_fatal = not moving(inspection)
        rest = other_axes(name, facts.principal[0])
        yield Finding(
            "problem" if is_fatal else "warning",
            f"{name} turns about {axis_words(name, facts.principal[0])} only ({strongest:.2f} rad/s RMS; "
            f"{second:.2f} and {weakest:.2f} about the perpendicular axes), so some parameters are "
            "unobservable; "
            f"{'drive over ramps' if rolls(inspection) else f'turn the rig about {rest} as well'}.",
        )
    else:
        for rms, direction in zip(facts.principal_rms, facts.principal, strict=True):
            if rms < WEAK_RAD_S:
                yield Finding(
                    "warning",
                    f"Hardly any rotation about {axis_words(name, direction)} ({rms:.2f} rad/s RMS); turn the rig "
                    "about it as well.",
                )
    if strongest >= STILL_RAD_S and max(facts.accel_std) < WEAK_M_S2:
        yield Finding(
            "warning",
            f"Hardly any acceleration of {name} ({max(facts.accel_std):.2f} m/s^2 RMS about the mean); shake "
            "the rig briskly back and forth, along all three axes.",
        )


def gaps(inspection: Inspection) -> Iterator[Finding]:
    """Warnings on a short recording, and on gaps between readings."""
    imu = imu_timing(inspection)
    if imu is not None and imu.rate_hz and imu.duration_s < SHORT_S:
        yield Finding("warning", f"The IMU ran for {imu.duration_s:.1f} s; record for 30 to 90 s.")
    if imu is not None and imu.gaps:
        yield Finding(
            "warning", f"{inspection.imu} has {words_on_gaps(imu)}; check the load of the recorder and the bus."
        )


def _capital(sentence: str) -> str:
    return sentence[:1].upper() + sentence[1:] if sentence[:1].isalpha() else sentence


class ImuInspector(KindInspector):
    """Finds IMUs, and drafts their entries in the rig file."""

    sensor: ClassVar[type[Sensor]] = ImuSensor
    topic_kinds: ClassVar[tuple[str, ...]] = ("imu",)
    prefix: ClassVar[str] = "imu"
    plain_names: ClassVar[str] = r"data(_raw)?|sample|data\.csv"
    is_certain: ClassVar[bool] = True
    sets_origin: ClassVar[bool] = True
    section: ClassVar[str] = "imus"
    checks: ClassVar = {"use": refused, "quality": of_readings, "gaps": gaps}

    def sources(self, topics: Sequence[TopicInfo]) -> Iterator[tuple[Key, ImuSource]]:
        return ((topic_key(t), ImuSource(self.sensor.sensor_type, t)) for t in topics if t.kind in self.topic_kinds)

    def joined(self, recording: Recording, sources: Sources) -> Sources:
        """The sources, in which the two topics or tables of one IMU (gyroscope, accelerometer) are joined to one IMU.
        Its name is the first free one of imu0, imu1, ..."""
        imus = sources.of(self.sensor.sensor_type)
        topics = tuple(imu.topic for imu in imus.values())
        pair = pair_of(recording, topics)
        if pair is None:
            return sources
        gyro = next(t for t in topics if t.name == pair.gyro)
        halves = {name for name, imu in imus.items() if imu.topic.name in (pair.gyro, pair.accel)}
        others = {name: source for name, source in sources.sensors.items() if name not in halves}
        name = next(n for k in itertools.count() if (n := f"imu{k}") not in others)
        return dataclasses.replace(sources, sensors={name: ImuSource(self.sensor.sensor_type, gyro, pair), **others})

    def read(self, recording: Recording, name: str, source: ImuSource) -> Facts:
        """Reads all readings; no facts if they cannot be read."""
        topic = source.topic
        try:
            imu, where, notes = read_imu(recording, name, source.halves or topic.name)
        except RecordingError as error:
            return Facts(stream=StreamFacts(topic, None, str(error)))
        facts = imu_facts(imu, where, frame_id(recording, topic), notes)
        return Facts(facts, StreamFacts(topic, timing_of(imu.stamps_ns), facts.problem))

    def draft(self, inspection: Inspection, active: bool) -> Draft:
        """Lines of all IMUs, that of the body first."""
        return Draft(imu_lines(inspection, inspection.sources.of(self.sensor.sensor_type)))

    def figures(self, inspection: Inspection, name: str) -> dict[str, Any]:
        return {"topic": inspection.sources.sensors[name].topic.name} | plain(inspection.facts[name])

    def printout(self, inspection: Inspection) -> Printout:
        """Ranges and units of the readings."""
        imus = inspection.sources.of(self.sensor.sensor_type)
        facts = {name: inspection.facts[name] for name in imus if inspection.facts[name] is not None}
        return Printout(readings=[imu_table(facts)] if facts else [])

    def pictures(self, inspection: Inspection) -> tuple[list[Plot], list[Drawing]]:
        """Rates and specific forces over time."""
        titles, plots = ("rate [deg/s]", "specific force [m/s^2]"), []
        for name in inspection.sources.of(self.sensor.sensor_type):
            if inspection.facts[name] is not None and (curves := inspection.facts[name].curves):
                seconds, gyro, accel = curves
                motion = stacked_panels([(seconds, gyro / DEGREE), (seconds, accel)], titles, 380)
                plots.append(Plot(f"motion-{name}", motion, f"{name}: motion in its axes x, y, z"))
        return plots, []


INSPECTOR = ImuInspector()


# Lines of IMUs in a draft of the rig file.


def imu_lines(inspection: Inspection, imus: dict[str, ImuSource]) -> Iterator[str]:
    """Lines of the IMUs, that of the body first. Those that cannot be read, or are the same device as another one by
    the frame in their messages, are named in a comment."""
    frames: dict[str, str] = {}
    for name in sorted(imus, key=lambda n: n != inspection.imu):
        topic, facts = imus[name].topic, inspection.facts[name]
        frame = facts.frame if facts else ""
        if frames and (facts is None or facts.problem):
            yield f"  # Also recorded, but not usable: {name} ({comment(topic.name)})."
        elif frame and frame in frames:
            yield f"  # Also recorded: {name} ({comment(topic.name)}), readings in the frame of {frames[frame]}."
        else:
            yield from _lines_of(inspection, name, imus[name], first=not frames)
            frames[frame or name] = name


def _lines_of(inspection: Inspection, name: str, source: ImuSource, first: bool) -> Iterator[str]:
    """Lines of one IMU; first: it is the body."""
    topic, halves, facts = source.topic, source.halves, inspection.facts[name]
    frame = facts.frame if facts else ""
    yield from (f"  {name}:", "    type: imu")
    yield "    " + place_line(topic.name, topic.type, frame) if halves is None else _places(halves, topic.type, frame)
    kalibr = _kalibr_imu(inspection, topic.name)
    yield from _noise(kalibr)
    if facts and np.isfinite(facts.scatter).all():
        gyro, accel = facts.scatter
        yield f"    # Its readings in quiet moments show at least gyro: {gyro:.2g}, accel: {accel:.2g}."
    if first:
        yield "    # The most valuable line of this draft: how far axes and scales of this IMU may be off. Rotations"
        yield f"    # and lengths depend on it. One of {', '.join(IMU_CLASSES)}; `fixed` if it is calibrated."
    noise = class_noise(DEFAULT_CLASS) if kalibr is None else ImuNoise(**kalibr.densities, source="")
    yield f"    intrinsics: {class_of_noise(noise)}"


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


# Tables of IMUs for the terminal.


def imu_table(facts: Mapping[str, ImuFacts]) -> Table:
    """One row for each axis of each IMU; facts: by name."""
    table = plain_table(
        "IMU",
        ("sensor", "axis", "gyro [rad/s]", "RMS", "accel [m/s^2]", "RMS about mean", "saturated"),
        right=2,
        caption="; ".join(f"{n}: mean |accel| {f.mean_accel:.2f} m/s^2" for n, f in facts.items()),
    )
    for name, f in facts.items():
        for k, axis in enumerate("xyz"):
            saturated = ", ".join(f"{s.kind} at {s.limit:.4g}" for s in f.saturated if s.axis == axis)
            cells = (
                name if k == 0 else "",
                axis,
                _range(f.gyro_min, f.gyro_max, k),
                f"{f.gyro_rms[k]:.3f}",
                _range(f.accel_min, f.accel_max, k),
                f"{f.accel_std[k]:.2f}",
                saturated or "no",
            )
            table.add_row(*map(Text, cells), end_section=k == 2)
    return table


def _range(low: Vector, high: Vector, k: int) -> str:
    return f"{low[k]:.2f} to {high[k]:.2f}"


# Statistics of an IMU's readings: ranges, units, and principal axes of the rotation.

_DEGREE = np.pi / 180.0


def read_imu(recording: Recording, name: str, topic: str | TwoSources) -> tuple[ImuStream, str, tuple[str, ...]]:
    """The readings in recorded units, the name of their source for messages, and notes if two topics were joined.
    Raises RecordingError if they cannot be read."""
    sensor = ImuSensor(name, topic, class_noise(DEFAULT_CLASS), topic=topic)
    where = recording.where(sensor)
    imu, notes = one_stream(readings(recording, sensor), f"{where} ({name})")
    return imu, where, notes


def imu_facts(imu: ImuStream, where: str, frame: str, notes: tuple[str, ...] = ()) -> ImuFacts:
    """Statistics of `imu`; `problem` says why `calibrate` would refuse it. where: name of the source for messages;
    notes: to be put before those of this function."""
    problem, jumps = "", ClockJumps()
    try:
        imu, reading_notes = checked_imu(jumps.cut(imu, f"{where} ({imu.name})"), where)
        notes += jumps.notes + reading_notes
    except RecordingError as error:
        problem = str(error)
    finite = np.isfinite(imu.gyro).all(axis=1) & np.isfinite(imu.accel).all(axis=1)
    gyro, accel = (x[finite] if finite.any() else np.zeros((1, 3)) for x in (imu.gyro, imu.accel))
    some = thin(len(gyro), MOST_ROWS)
    # eigh sorts in ascending order; here the strongest direction comes first.
    squares, directions = np.linalg.eigh(gyro.T @ gyro / len(gyro))
    first, second, third = (_vector(d * np.sign(d[np.argmax(np.abs(d))])) for d in directions.T[::-1])
    return ImuFacts(
        frame=frame,
        gyro_min=_vector(gyro.min(axis=0)),
        gyro_max=_vector(gyro.max(axis=0)),
        accel_min=_vector(accel.min(axis=0)),
        accel_max=_vector(accel.max(axis=0)),
        mean_accel=float(np.linalg.norm(accel, axis=1).mean()),
        gyro_rms=_vector(np.sqrt((gyro**2).mean(axis=0))),
        accel_std=_vector(accel.std(axis=0)),
        principal_rms=_vector(np.sqrt(np.maximum(squares[::-1], 0.0))),
        principal=(first, second, third),
        gravity_spread=None if problem else _spreads(imu),
        scatter=(np.nan, np.nan)
        if problem
        else (quiet_scatter(imu.seconds, imu.gyro), quiet_scatter(imu.seconds, imu.accel)),
        saturated=saturations(imu) if finite.all() and len(imu.gyro) else (),
        notes=notes,
        problem=problem,
        curves=(imu.seconds[finite][some], gyro[some], accel[some]) if finite.any() else None,
    )


def _spreads(imu: ImuStream) -> Vector | None:
    radians, degrees, none = (gravity_spread(imu, unit) for unit in (1.0, _DEGREE, 0.0))
    return None if radians is None or degrees is None or none is None else (radians, degrees, none)


def _vector(x: np.ndarray) -> Vector:
    return float(x[0]), float(x[1]), float(x[2])
