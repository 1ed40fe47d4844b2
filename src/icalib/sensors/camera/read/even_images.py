"""Even stamps of images that a computer stamps on arrival, although the camera takes them evenly."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import replace
from functools import partial

import numpy as np

from icalib.data.measurements import CornerStream, TrackStream
from icalib.data.stamps.even import EvenStamps, even_stamps, followed, stamp_scatter

ReadImages = tuple[CornerStream | TrackStream, tuple[str, ...]]  # a stream, and notes for the user
_MIN_SHARED = 0.5  # of the images of a camera have stamps of another one, if both are triggered together


def with_even_stamps(read: Sequence[ReadImages], where: Mapping[str, str]) -> list[ReadImages]:
    """The streams of corners and tracks, with even stamps where the cameras run evenly, and notes on these.
    `jitter_s` of a stream is what even stamps may still be off, or the scatter of uneven ones.

    Streams with the same stamps, of one camera or of cameras that are triggered together, stay together. where: source
    of the images of each camera, for messages.
    """
    evened = list(read)
    for group in _groups([stream for stream, _ in read]):
        streams = [read[k][0] for k in group]
        stamps_ns = np.unique(np.concatenate([s.stamps_ns for s in streams]))
        even = even_stamps(stamps_ns, partial(followed, **_rows(streams, stamps_ns)))
        for k in group:
            stream, notes = read[k]
            if even is None:
                evened[k] = replace(stream, jitter_s=stamp_scatter(stream.stamps_ns)), notes
            else:
                evened[k] = _moved(stream, stamps_ns, even), (*notes, even.note(where[stream.name], "images"))
    return evened


def _groups(streams: Sequence[CornerStream | TrackStream]) -> list[list[int]]:
    """Indices of streams whose images share stamps."""
    groups: list[list[int]] = []
    for k, stream in enumerate(streams):
        shared = (np.isin(stream.stamps_ns, streams[group[0]].stamps_ns).mean() for group in groups)
        at = next((i for i, share in enumerate(shared) if share > _MIN_SHARED), None)
        if at is None:
            groups.append([k])
        else:
            groups[at].append(k)
    return groups


def _rows(streams: Iterable[CornerStream | TrackStream], stamps_ns: np.ndarray) -> dict[str, np.ndarray]:
    """Arguments of `followed`: the observations of each point by each stream are a series."""
    series, at, values, first = [], [], [], 0
    for stream in streams:
        point = stream.point if isinstance(stream, CornerStream) else stream.feature
        series.append(point + first)
        at.append(np.searchsorted(stamps_ns, stream.stamps_ns)[stream.image])
        values.append(stream.uv)
        first += 1 + int(point.max(initial=-1))
    return {"series": np.concatenate(series), "at": np.concatenate(at), "values": np.concatenate(values)}


def _moved(stream: CornerStream | TrackStream, stamps_ns: np.ndarray, even: EvenStamps) -> CornerStream | TrackStream:
    """The stream with even stamps. stamps_ns (M,): the original ones of `even`."""
    moved = even.stamps_ns[np.searchsorted(stamps_ns, stream.stamps_ns)]
    if isinstance(stream, TrackStream):
        return replace(stream, stamps_ns=moved, jitter_s=even.left_s)
    new = dict(zip(stream.stamps_ns.tolist(), moved.tolist(), strict=True))
    files = {new.get(stamp, stamp): file for stamp, file in stream.files.items()}
    return replace(stream, stamps_ns=moved, files=files, jitter_s=even.left_s)
