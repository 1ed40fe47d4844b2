"""Checks corners and tracks: image bounds, order and rate of stamps, and number of corners per image."""

from __future__ import annotations

import numpy as np

from icalib.data.measurements import CornerStream, TrackStream
from icalib.data.stamps.clocks import rate_sentence
from icalib.errors import RecordingError

IMAGE_RATE_HZ = (1e-3, 1000.0)  # plausible range of image rates
_MIN_IMAGE_CORNERS = 4  # corners of an image; fewer do not determine a pose
_CORNER_MARGIN_PX = 1.0  # accepted distance outside the image, which corner refinement may cause
_MAX_OUTSIDE_SHARE = 0.1  # of all points; more points outside mean that the stated resolution is wrong


def checked_corners(
    corners: CornerStream, where: str, resolution: tuple[int, int]
) -> tuple[CornerStream, tuple[str, ...]]:
    """The corners inside the image of `resolution` (width, height) px, in images with four or more; notes on others.

    Raises RecordingError naming `where` (the file or topic) if there are no usable images, many corners are outside the
    image, or the image rate is impossible.
    """
    what = f"{where} ({corners.name})"
    if len(corners.stamps_ns) == 0:
        raise RecordingError(f"{what}: no corners at all; check the camera's path and the detector.")
    sentence = rate_sentence(what, corners.stamps_ns, *IMAGE_RATE_HZ) if len(corners.stamps_ns) > 1 else None
    if sentence:
        raise RecordingError(sentence)
    corners, outside = _inside(corners, what, resolution)
    corners, poor = _without_poor_images(corners, what)
    return corners, outside + poor


def _inside(corners: CornerStream, what: str, resolution: tuple[int, int]) -> tuple[CornerStream, tuple[str, ...]]:
    """The corners inside the image, and a note on corners outside. Raises RecordingError if many are outside."""
    inside = in_image(corners.uv, resolution, _CORNER_MARGIN_PX)
    if inside.all():
        return corners, ()
    tag, corner = divmod(int(corners.point[np.argmin(inside)]), 4)
    note = outside_note(corners, inside, f"corner {corner} of tag {tag}", what, resolution)
    count = np.bincount(corners.image[inside], minlength=len(corners.stamps_ns))
    return corners.of_rows(inside, corners.stamps_ns, count), (note,)


def image_starts(what: str, stamps_ns: np.ndarray) -> np.ndarray:
    """(M + 1,) first row of each image, then the number of rows N. stamps_ns (N,): stamp of each row.

    Raises RecordingError naming `what` and the instant if images are out of order."""
    step = np.diff(stamps_ns)
    if (step < 0).any():
        i = int(np.argmax(step < 0))
        raise RecordingError(
            f"{what}: the image at {stamps_ns[i + 1]} ns comes after the one at {stamps_ns[i]} ns; "
            "sort the rows by stamp."
        )
    return np.append(np.flatnonzero(np.concatenate([[True], step > 0])), len(stamps_ns)).astype(np.int64)


def in_image(uv: np.ndarray, resolution: tuple[int, int], margin_px: float) -> np.ndarray:
    """(N,) bool: points uv (N, 2) px that are inside the image of (width, height) px, or at most margin_px outside."""
    return np.logical_and.reduce((uv >= -0.5 - margin_px) & (uv <= np.array(resolution) - 0.5 + margin_px), axis=1)


def outside_note(
    stream: CornerStream | TrackStream, inside: np.ndarray, point: str, what: str, resolution: tuple[int, int]
) -> str:
    """A note on points that are not `inside` (N,) bool the image, at least one. `point`: text that names the first.

    Raises RecordingError if many points are outside."""
    first, count = int(np.argmin(inside)), int((~inside).sum())
    (u, v), (width, height) = stream.uv[first], resolution
    which = stream.which(int(stream.stamps_ns[stream.image[first]]))
    words = f"{point} lies at ({u:.1f}, {v:.1f}), outside the image of {width} x {height} px"
    sentence = f"{what}: in the image {which}, {words}"
    if count > _MAX_OUTSIDE_SHARE * len(inside):
        raise RecordingError(f"{sentence}; check the camera's resolution [width, height] in the rig file.")
    return f"{sentence}; {count} of {len(inside)} such points were left out."


def _without_poor_images(corners: CornerStream, what: str) -> tuple[CornerStream, tuple[str, ...]]:
    """The images with enough corners for a pose, and a note on others. Raises RecordingError if none has enough."""
    count = np.diff(corners.start)
    keep = count >= _MIN_IMAGE_CORNERS
    if keep.all():
        return corners, ()
    if not keep.any():
        raise RecordingError(f"{what}: no image has {_MIN_IMAGE_CORNERS} corners or more; check the detector.")
    rows = keep[corners.image]
    first = int(corners.stamps_ns[np.argmin(keep)])
    dropped = f"{int((~keep).sum())} images with fewer than {_MIN_IMAGE_CORNERS} corners were dropped"
    note = f"{what}: {dropped}, the first {corners.which(first)}."
    return corners.of_rows(rows, corners.stamps_ns[keep], count[keep]), (note,)
