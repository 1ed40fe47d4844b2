"""Checks of image streams: one camera, ordered stamps, no frozen images. Rejected images are counted in notes."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterable, Iterator
from itertools import chain, islice

import numpy as np

from icalib.data.images.images import (
    NO_PICTURE,
    DamagedImageError,
    DecodedImage,
    Payload,
    decode,
    is_known,
    unknown_encoding,
)
from icalib.errors import RecordingError

Note = Callable[[str], None]
LOOK_AHEAD = 5  # number of first images; their most frequent resolution is that of the camera
ODD, ODD_SHARE = 2, 0.1  # tolerated images of another resolution, as number or share; more: several cameras
_LATE_NS = 1_000_000_000  # an image late by more means that the clock was set back


def ignore(sentence: str) -> None:
    """A `Note` that discards the sentence."""


def checked_payloads(payloads: Iterable[Payload], where: str, note: Note) -> Iterator[Payload]:
    """Images of `payloads` with strictly increasing stamps and one resolution; a note on rejected images at the end.

    Rejected are files that are no images, images of zeros, exact repetitions of the previous image (frozen camera),
    late images, and a few of another resolution. Raises RecordingError, naming `where` and the image, for an unknown
    encoding, many images of another resolution, a clock that was set back, or no usable image.
    """
    dropped = _Dropped()
    kept, odd = 0, 0
    last: Payload | None = None
    size, ahead = _usual_size(payloads)
    for payload in ahead:
        if (fault := _content_fault(payload)) is not None:
            dropped.add(fault[0], payload, fault[1])
            continue
        if size and payload.width and (payload.width, payload.height) != size:
            odd += 1
            error = _other_size(payload, size, where)
            if odd > max(ODD, ODD_SHARE * kept):
                raise RecordingError(error)
            dropped.add(f"have another size than {size[0]} x {size[1]} px", payload, error)
            continue
        if last is not None and (reason := _does_not_follow(last, payload, where)):
            dropped.add(reason, payload)
            continue
        last = payload
        kept += 1
        yield payload
    if not kept and dropped.first_error:
        raise RecordingError(dropped.first_error)
    _refuse_too_few(kept, dropped, where)
    dropped.note(where, note)


def _content_fault(payload: Payload) -> tuple[str, str] | None:
    """Reason to reject a payload without image content, and the error message in case no image remains; None for an
    image. Raises RecordingError for an unknown encoding."""
    if not np.frombuffer(payload.data, np.uint8).any():
        return "consist of zeros", ""
    if payload.encoding == NO_PICTURE:
        return "are not images", unknown_encoding(payload)
    if not is_known(payload.encoding):
        raise RecordingError(unknown_encoding(payload))
    return None


def _does_not_follow(last: Payload, payload: Payload, where: str) -> str:
    """Reason to reject an image that follows the image `last`; empty if there is none. Raises RecordingError if the
    clock was set back."""
    _refuse_other_clock(last, payload, where)
    if payload.stamp_ns <= last.stamp_ns:
        return "are not later than their predecessor"
    return "repeat their predecessor exactly (the camera froze)" if payload.data == last.data else ""


def frames(payloads: Iterable[Payload], where: str, note: Note) -> Iterator[DecodedImage]:
    """The decoded images. Damaged ones are rejected, with a note at the end.

    Raises RecordingError if all are damaged.
    """
    dropped = _Dropped()
    kept = 0
    for payload in payloads:
        try:
            image = decode(payload)
        except DamagedImageError as error:
            dropped.add("are damaged", payload, str(error))
            continue
        kept += 1
        yield DecodedImage(payload.stamp_ns, image)
    if not kept and dropped.first_error:
        raise RecordingError(dropped.first_error)
    dropped.note(where, note)


class _Dropped:
    """Rejected images by reason: their number, the first image, and the first error message."""

    def __init__(self) -> None:
        self.count: dict[str, int] = {}
        self._first: dict[str, str] = {}
        self.first_error = ""

    def add(self, reason: str, payload: Payload, error: str = "") -> None:
        self.count[reason] = self.count.get(reason, 0) + 1
        self._first.setdefault(reason, payload.which)
        self.first_error = self.first_error or error

    def note(self, where: str, note: Note) -> None:
        for reason, count in self.count.items():
            note(f"{where}: {count} images that {reason} were left out, the first {self._first[reason]}.")


def _usual_size(payloads: Iterable[Payload]) -> tuple[tuple[int, int], Iterator[Payload]]:
    """Most frequent width and height [px] of the first images, (0, 0) if unknown; and an iterator of all payloads."""
    rest = iter(payloads)
    first = list(islice(rest, LOOK_AHEAD))
    sizes = Counter((p.width, p.height) for p in first if p.width)
    return sizes.most_common(1)[0][0] if sizes else (0, 0), chain(first, rest)


def _other_size(payload: Payload, size: tuple[int, int], where: str) -> str:
    return (
        f"{where}: the image {payload.which} has {payload.width} x {payload.height} px, others have "
        f"{size[0]} x {size[1]} px; record each resolution under its own name."
    )


def _refuse_other_clock(last: Payload, payload: Payload, where: str) -> None:
    if payload.stamp_ns < last.stamp_ns - _LATE_NS:
        raise RecordingError(
            f"{where}: the image {payload.which} comes after the one {last.which}, so the camera's clock was "
            "set back; record again, or cut the recording there with --from and --to."
        )


def _refuse_too_few(kept: int, dropped: _Dropped, where: str) -> None:
    total = kept + sum(dropped.count.values())
    if not total:
        raise RecordingError(f"{where}: there are no images; check that the camera was running.")
    if kept > 1 or not dropped.count:
        return
    reasons = ", ".join(f"{count} {reason}" for reason, count in dropped.count.items())
    raise RecordingError(f"{where}: of {total} images, {reasons}; check the camera and record again.")
