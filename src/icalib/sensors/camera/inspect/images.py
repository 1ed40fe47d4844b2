"""Reads the images of a camera for an inspection."""

from __future__ import annotations

import numpy as np

from icalib.data.recordings import DamagedImageError, Payload, Recording, TopicInfo, decode
from icalib.errors import RecordingError
from icalib.sensors.camera.inspect.facts import ImageFacts
from icalib.tools.inspection.facts import StreamFacts
from icalib.tools.inspection.frame_ids import frame_id
from icalib.tools.inspection.timing import timing_of

SAMPLE = 16  # images per camera that are decoded, spread over the recording


def read_images(recording: Recording, topic: TopicInfo) -> tuple[StreamFacts, ImageFacts]:
    """Reads all images of a topic, and decodes a sample."""
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
    frame = frame_id(recording, topic)
    facts = ImageFacts(sample.resolution, sample.encoding, frame, sample.decoded, sample.damaged)
    content = f"{facts.resolution[0]} x {facts.resolution[1]} {facts.encoding}" if facts.resolution else ""
    return StreamFacts(topic, timing_of(np.array(stamps, np.int64)), problem, content), facts


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
