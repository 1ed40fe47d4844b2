"""The frames of transforms (/tf) in a bag, and a pose sensor of the two with most motion between them."""

from __future__ import annotations

import json
from collections.abc import Iterator, Sequence

from icalib.data.recordings import BagRecording, Recording
from icalib.data.recordings.transforms import TRANSFORMS, read_edges, transform_topics
from icalib.errors import RecordingError
from icalib.tools.inspection.facts import FramePair


def frame_pairs(recording: Recording) -> tuple[tuple[FramePair, ...], tuple[str, ...]]:
    """All pairs of frames with a transform between them, by topic and name, and notes on topics that cannot be read."""
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


def frame_lines(pairs: Sequence[FramePair], shown: bool) -> Iterator[str]:
    """Lines of a rig file: a pose sensor of two frames, a comment unless `shown`; none where no frame moves."""
    chain = _most_motion(pairs)
    if not chain:
        return
    topic, frames = chain[0].topic, [chain[0].parent, chain[-1].child]
    kind = "relative" if "odom" in frames[0] else "absolute"
    if not shown:
        yield "  # Poses from transforms, as of a robot arm? Then remove the #. Choose any two of the frames"
        yield "  # listed, the fixed one (base) and the moving one (docs/rig-file.md#pose-sensor)."
    place = (f"  topic: {json.dumps(topic)}", f"  frames: {json.dumps(frames)}")
    for line in ("tf0:", "  type: pose", *place, f"  kind: {kind}"):
        yield f"  {'' if shown else '# '}{line}"


def _most_motion(pairs: Sequence[FramePair]) -> list[FramePair]:
    """From parent to child the pairs with most moving ones in a row of one topic, which begins and ends with such."""
    above = {(p.topic, p.child): p for p in pairs}
    best: list[FramePair] = []
    for last in pairs:
        if not last.moves:
            continue
        chain, seen = [last], {last.child}
        while (pair := above.get((last.topic, chain[0].parent))) is not None and pair.child not in seen:
            seen.add(pair.child)
            chain.insert(0, pair)
        first = next(k for k, pair in enumerate(chain) if pair.moves)
        best = max(best, chain[first:], key=lambda c: sum(pair.moves for pair in c))
    return best
