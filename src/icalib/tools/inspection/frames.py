"""The frames of transforms (/tf) in a bag."""

from __future__ import annotations

from icalib.data.recordings import BagRecording, Recording
from icalib.errors import RecordingError
from icalib.sensors.pose.read.transforms import TRANSFORMS, read_edges, transform_topics
from icalib.tools.inspection.facts import FramePair


def frame_pairs(recording: Recording) -> tuple[tuple[FramePair, ...], tuple[str, ...]]:
    """All pairs of frames with a transform, sorted by topic and name, and notes on topics that cannot be read. Both are
    empty for recordings that are not bags."""
    if not isinstance(recording, BagRecording):
        return (), ()
    topics = recording.topics()
    found: list[FramePair] = []
    notes: list[str] = []
    for name in sorted({t.name.removesuffix("_static") for t in topics if t.kind == TRANSFORMS and t.count}):
        try:
            edges = read_edges(recording, transform_topics(topics, name), notes.append)
        except RecordingError as error:
            notes.append(str(error))
            continue
        for (parent, child), e in sorted(edges.items()):
            found.append(FramePair(name, parent, child, len(e.stamps_ns), e.rate_hz, not e.static and e.changes))
    return tuple(found), tuple(notes)
