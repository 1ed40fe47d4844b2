"""Reads a recording and collects its facts; `findings` derives problems and warnings from them."""

from __future__ import annotations

import dataclasses
import itertools
from collections.abc import Callable, Iterator
from math import inf
from pathlib import Path
from typing import Any

import numpy as np

from icalib.data.recordings import (
    BagRecording,
    DamagedImageError,
    Payload,
    Recording,
    TopicInfo,
    decode,
    open_recording,
)
from icalib.detection.images.image_work import spread_images
from icalib.errors import RecordingError
from icalib.rig import TwoSources
from icalib.sensors.camera.read.camera_info import CameraInfo, read_camera_info
from icalib.sensors.imu.read.halves import pair_of
from icalib.tools.inspection.facts import (
    CameraSource,
    FramePair,
    GivenTarget,
    ImageFacts,
    ImuFacts,
    Inspection,
    Sources,
    StreamFacts,
    TargetView,
)
from icalib.tools.inspection.findings import findings
from icalib.tools.inspection.imu import imu_facts, read_imu
from icalib.tools.inspection.kalibr import KalibrFiles, find_kalibr_files
from icalib.tools.inspection.kinds import inspectors
from icalib.tools.inspection.sources import find_sources
from icalib.tools.inspection.timing import timing_of
from icalib.tools.inspection.views import target_in, target_view

SAMPLE = 16  # images per camera that are decoded, spread over the recording
READING_SHARE = 0.3  # progress after reading, if the target is then searched for
Progress = Callable[[str, float], None]  # called with the current step, and the progress of the whole, 0 to 1


def inspect_recording(
    path: str | Path,
    target: GivenTarget | None = None,
    progress: Progress = lambda *_: None,
    *,
    start_s: float = 0.0,
    end_s: float = inf,
) -> Inspection:
    """Reads the recording at `path`: its sensors, and whether it can be calibrated. start_s, end_s: part that is read,
    s after the start.

    The `target`, or that of a Kalibr file beside the recording, is searched for in all images; `calibrate` uses the
    found corners again. Raises RecordingError, one sentence, if there is no recording or it is empty. Faults of single
    topics become findings.
    """
    recording = open_recording(path, start_s, end_s)
    topics = recording.topics()
    if not any(t.count for t in topics):
        raise RecordingError(
            f"{path} holds no messages, images or tables; give a bag, or a folder with imu0/data.csv and cam0/data."
        )
    sources, kalibr = _joined_imu(recording, find_sources(topics)), find_kalibr_files(Path(path))
    target = target or _beside(kalibr)
    share = READING_SHARE if target else 1.0
    streams, images, imus = _read(recording, topics, sources, lambda what, done: progress(what, share * done))
    infos, imu = _infos(recording, sources), _choose(imus, sources, kalibr)
    inspection = Inspection(str(path), sources, streams, images, infos, imus, imu, target, kalibr)
    inspection = dataclasses.replace(inspection, facts=_facts(recording, sources))
    frames, frame_notes = _frames(recording)
    views = _views(recording, inspection, lambda what, done: progress(what, share + (1.0 - share) * done))
    notes = tuple(dict.fromkeys(recording.notes() + frame_notes)) + kalibr.notes
    inspection = dataclasses.replace(
        inspection, views=views, frames=frames, notes=notes, shown=_pattern_words(recording, inspection)
    )
    return dataclasses.replace(inspection, findings=findings(inspection))


def _beside(kalibr: KalibrFiles) -> GivenTarget | None:
    """The target of a Kalibr file beside the recording; None without one."""
    return GivenTarget(kalibr.target, kalibr.target_file, {}) if kalibr.target else None


def resolution_of(inspection: Inspection, camera: CameraSource) -> tuple[int, int] | None:
    """Resolution (width, height) px of the camera's images; without images, that of the rig file with the target or of
    Kalibr's camchain; else None."""
    if camera.images:
        return inspection.images[camera.name].resolution
    resolution = inspection.target.resolutions.get(camera.name) if inspection.target else None
    return resolution or next((c.resolution for c in inspection.kalibr.cameras if c.name == camera.name), None)


def _read(
    recording: Recording, topics: tuple[TopicInfo, ...], sources: Sources, progress: Progress
) -> tuple[tuple[StreamFacts, ...], dict[str, ImageFacts], dict[str, ImuFacts]]:
    """Reads every topic once. Returns facts by topic, on images by camera, and on IMUs by name. Images and IMU readings
    are read in full, other topics only for their stamps."""
    cameras = {c.images.name: c.name for c in sources.cameras if c.images}
    names = {t.name: name for name, t in sources.imus.items()}
    images: dict[str, ImageFacts] = {}
    imus: dict[str, ImuFacts] = {}
    streams: list[StreamFacts] = []
    for k, topic in enumerate(topics):
        progress(f"reading {topic.name}", k / len(topics))
        if topic.name in cameras:
            stream, images[cameras[topic.name]] = _read_images(recording, topic)
        elif topic.name in names and topic.count:
            stream, facts = _read_imu(recording, topic, names[topic.name], sources.halves.get(names[topic.name]))
            if facts is not None:
                imus[names[topic.name]] = facts
        else:
            stream = _read_stamps(recording, topic, topic.name in sources.left_out)
        streams.append(stream)
    return tuple(streams), images, imus


def _joined_imu(recording: Recording, sources: Sources) -> Sources:
    """The sources, in which the two topics of one IMU (gyroscope, accelerometer) are joined to one IMU. Its name is
    the first free one of imu0, imu1, ..."""
    pair = pair_of(recording, tuple(sources.imus.values())) if isinstance(recording, BagRecording) else None
    if pair is None:
        return sources
    gyro = next(t for t in sources.imus.values() if t.name == pair.gyro)
    others = {name: t for name, t in sources.imus.items() if t.name not in (pair.gyro, pair.accel)}
    taken = {*others, *(c.name for c in sources.cameras), *sources.others}
    name = next(n for k in itertools.count() if (n := f"imu{k}") not in taken)
    return dataclasses.replace(sources, imus={name: gyro, **others}, halves={name: pair})


def _facts(recording: Recording, sources: Sources) -> dict[str, Any]:
    """Facts on the sensors that are neither IMU nor camera, by name."""
    kinds = inspectors()
    return {name: kinds[s.kind].facts(recording, name, s.topic) for name, s in sources.others.items()}


def _frames(recording: Recording) -> tuple[tuple[FramePair, ...], tuple[str, ...]]:
    """Pairs of frames that kinds of sensors read poses from, and notes, see `KindInspector.frames`."""
    pairs, notes = list[FramePair](), list[str]()
    for inspector in inspectors().values():
        frames, sentences = inspector.frames(recording)
        pairs += frames
        notes += sentences
    return tuple(pairs), tuple(notes)


def _read_images(recording: Recording, topic: TopicInfo) -> tuple[StreamFacts, ImageFacts]:
    sample = _Sample(max(topic.count // SAMPLE, 1))
    stamps: list[int] = []
    problem = ""
    try:
        for payload in recording.payloads(topic.name):
            stamps.append(payload.stamp_ns)
            sample.look(payload)
    except RecordingError as error:
        problem = str(error)
    if sample.decoded and sample.damaged == sample.decoded:
        problem = problem or (
            f"{topic.name}: none of {sample.decoded} sampled images can be decoded "
            f"({sample.error.rstrip('.')}); check the driver, and record again."
        )
    frame = _frame(recording, topic)
    facts = ImageFacts(sample.resolution, sample.encoding, frame, sample.decoded, sample.damaged)
    return StreamFacts(topic, timing_of(np.array(stamps, np.int64)), problem), facts


class _Sample:
    """Decodes every n-th image, and counts those that are damaged."""

    def __init__(self, every: int) -> None:
        self._every, self._count = every, 0
        self.decoded = self.damaged = 0
        self.encoding = self.error = ""
        self.resolution: tuple[int, int] | None = None

    def look(self, payload: Payload) -> None:
        self._count += 1
        if self._count == 1:
            self.encoding = payload.encoding
        if self.resolution is None and payload.width:
            self.resolution = payload.width, payload.height
        if (self._count - 1) % self._every:
            return
        self.decoded += 1
        try:
            height, width = decode(payload).shape
        except DamagedImageError as error:
            self.damaged += 1
            self.error = self.error or str(error)
            return
        self.resolution = self.resolution or (width, height)


def _read_imu(
    recording: Recording, topic: TopicInfo, name: str, halves: TwoSources | None
) -> tuple[StreamFacts, ImuFacts | None]:
    try:
        imu, where, notes = read_imu(recording, name, halves or topic.name)
    except RecordingError as error:
        return StreamFacts(topic, None, str(error)), None
    facts = imu_facts(imu, where, _frame(recording, topic), notes)
    return StreamFacts(topic, timing_of(imu.stamps_ns), facts.problem), facts


def _read_stamps(recording: Recording, topic: TopicInfo, left_out: bool) -> StreamFacts:
    """Facts on a topic from its stamps. Timing is None for topics that icalib does not read, CameraInfo, transforms and
    images that are left out."""
    kinds_without_timing = (
        "",
        "camera info",
        *(kind for inspector in inspectors().values() for kind in inspector.frame_topics),
    )
    if left_out or not topic.count or topic.kind in kinds_without_timing:
        return StreamFacts(topic, None)
    try:
        return StreamFacts(topic, timing_of(recording.stamps(topic.name)))
    except RecordingError as error:
        return StreamFacts(topic, None, str(error))


def _frame(recording: Recording, topic: TopicInfo) -> str:
    """The frame id of the first message; empty in folders."""
    if not isinstance(recording, BagRecording):
        return ""
    first: Iterator = recording.messages(topic.name, topic.kind)
    try:
        _, message = next(first)
    except (RecordingError, StopIteration):
        return ""
    return str(message.header.frame_id)


def _infos(recording: Recording, sources: Sources) -> dict[str, CameraInfo]:
    """CameraInfo by name of the camera, without those whose messages cannot be read."""
    infos: dict[str, CameraInfo] = {}
    for c in sources.cameras:
        if c.info and isinstance(recording, BagRecording):
            try:
                infos[c.name] = read_camera_info(recording, c.info.name)
            except (RecordingError, ValueError):
                continue
    return infos


def _choose(imus: dict[str, ImuFacts], sources: Sources, kalibr: KalibrFiles) -> str | None:
    """Name of the IMU to calibrate with. An IMU without a problem is preferred, then one in Kalibr's file, then the
    first. None without any."""
    named = {k.topic.strip("/") for k in kalibr.imus}
    order = sorted(imus, key=lambda n: (bool(imus[n].problem), sources.imus[n].name.strip("/") not in named))
    return order[0] if order else None


def _pattern_words(recording: Recording, inspection: Inspection) -> dict[str, str]:
    """Words on the target in a few images of each camera, see `Inspection.shown`; empty if a target is known."""
    if inspection.target is not None:
        return {}
    cameras = [
        c for c in inspection.sources.cameras if c.images and not (c.corners or inspection.stream(c.topic).problem)
    ]
    return {c.name: target_in(spread_images(recording, c.images.name)) for c in cameras if c.images}


def _views(recording: Recording, inspection: Inspection, progress: Progress) -> dict[str, TargetView]:
    """Detections of the target by name of the camera, for cameras whose images can be read."""
    if inspection.target is None:
        return {}
    views: dict[str, TargetView] = {}
    cameras = [
        c for c in inspection.sources.cameras if c.corners or (c.images and not inspection.stream(c.topic).problem)
    ]
    for k, camera in enumerate(cameras):
        what = f"finding the target in the images of {camera.name}"

        def show(done: float, k: int = k, what: str = what) -> None:
            progress(what, (k + done) / len(cameras))

        show(0.0)
        views[camera.name] = target_view(
            recording, camera, inspection.target.target, resolution_of(inspection, camera), show
        )
    return views
