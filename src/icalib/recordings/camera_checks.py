"""Do these corners belong to this camera, and are they enough?"""

from __future__ import annotations

import numpy as np

from icalib.errors import RecordingError
from icalib.measurements import CornerStream
from icalib.recordings.clocks import rate_sentence

_RATE_HZ = (1e-3, 1000.0)
_MIN_CORNERS = 4  # fewer do not give a pose
_MARGIN_PX = 1.0  # corner refinement may step over the edge


def checked_corners(
    corners: CornerStream, where: str, resolution: tuple[int, int]
) -> tuple[CornerStream, tuple[str, ...]]:
    """`corners` without images of fewer than four, and a note on these.

    Raises RecordingError naming `where` (the file) and the instant: no usable images, a corner that is not finite or
    outside the image of `resolution` (width, height) px, images at an impossible rate.
    """
    what = f"{where} ({corners.name})"
    if len(corners.stamps_ns) == 0:
        raise RecordingError(f"{what}: no corners at all; check the camera's path and the detector.")
    sentence = rate_sentence(what, corners.stamps_ns, *_RATE_HZ) if len(corners.stamps_ns) > 1 else None
    if sentence:
        raise RecordingError(sentence)
    _refuse_outside(corners, what, resolution)
    return _without_poor_images(corners, what)


def _refuse_outside(corners: CornerStream, what: str, resolution: tuple[int, int]) -> None:
    low = -0.5 - _MARGIN_PX
    high = np.array(resolution) - 0.5 + _MARGIN_PX
    inside = ((corners.uv >= low) & (corners.uv <= high)).all(axis=1)
    if not inside.all():
        row = int(np.argmin(inside))
        u, v = corners.uv[row]
        tag, corner = divmod(int(corners.point[row]), 4)
        raise RecordingError(
            f"{what}: in the image at {corners.stamps_ns[corners.image[row]]} ns, corner {corner} of tag {tag} lies at "
            f"({u:.1f}, {v:.1f}), outside the image of {resolution[0]} x {resolution[1]} px; "
            "check the camera's resolution [width, height] in the rig file."
        )


def _without_poor_images(corners: CornerStream, what: str) -> tuple[CornerStream, tuple[str, ...]]:
    count = np.diff(corners.start)
    keep = count >= _MIN_CORNERS
    if keep.all():
        return corners, ()
    if not keep.any():
        raise RecordingError(f"{what}: no image has {_MIN_CORNERS} corners or more; check the detector.")
    rows = keep[corners.image]
    first = corners.stamps_ns[np.argmin(keep)]
    dropped = f"{int((~keep).sum())} images with fewer than {_MIN_CORNERS} corners were dropped"
    note = f"{what}: {dropped}, the first at {first} ns."
    return corners.of_rows(rows, corners.stamps_ns[keep], count[keep]), (note,)
