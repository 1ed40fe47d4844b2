"""Groups the rows of a corner table into the corner stream of one camera, image by image."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from icalib.data.measurements import CornerStream
from icalib.data.tables.columns import STAMP, TableKind
from icalib.errors import RecordingError
from icalib.geometry.targets import Target
from icalib.sensors.camera.read.checks import IMAGE_RATE_HZ, image_starts

CORNER_TABLE = TableKind(
    ("t [ns]", "tag id", "corner"),
    ("u [px]", "v [px]"),
    (
        STAMP,
        (r"(tag|marker)(_?id)?|id",),
        (r"corner(_?(id|index))?",),
        (r"u(_?px)?|x(_?px)?",),
        (r"v(_?px)?|y(_?px)?",),
    ),
    IMAGE_RATE_HZ,
)


class CornerRows(NamedTuple):
    """Rows of a corner table: stamps_ns, tag, corner (N,) int64, and uv (N, 2) px."""

    stamps_ns: np.ndarray
    tag: np.ndarray
    corner: np.ndarray
    uv: np.ndarray


def group_corners(name: str, source: str, rows: CornerRows, target: Target) -> CornerStream:
    """The corner stream of one camera from the rows of its table.

    Raises RecordingError naming `source` and the instant: images out of order, a corner that the target does not have,
    or one that appears twice in an image.
    """
    start = image_starts(source, rows.stamps_ns)
    point = _point_index(source, rows, target)
    _refuse_repeated(source, rows, start, point)
    return CornerStream(name, rows.stamps_ns[start[:-1]], start, point, np.ascontiguousarray(rows.uv))


def _point_index(source: str, rows: CornerRows, target: Target) -> np.ndarray:
    """(N,) index of the target point of each row. Raises RecordingError naming the first unknown corner."""
    tag, corner = rows.tag, rows.corner
    try:
        return target.point_index(tag, corner)
    except RecordingError:
        row = _first_unknown(tag, corner, target)
    try:
        return target.point_index(tag[row : row + 1], corner[row : row + 1])
    except RecordingError as error:
        raise RecordingError(f"{source}: in the image at {rows.stamps_ns[row]} ns, {error}") from None


def _first_unknown(tag: np.ndarray, corner: np.ndarray, target: Target) -> int:
    """Index of the first row that `Target.point_index` refuses, found by bisection; there must be one."""
    known, refused = 0, len(tag)
    while refused - known > 1:
        middle = (known + refused) // 2
        try:
            target.point_index(tag[:middle], corner[:middle])
            known = middle
        except RecordingError:
            refused = middle
    return refused - 1


def _refuse_repeated(source: str, rows: CornerRows, start: np.ndarray, point: np.ndarray) -> None:
    """Raises RecordingError naming the instant if a corner appears twice in an image.

    start (M + 1,): first row of each image; point (N,): index of the target point of each row."""
    image = np.repeat(np.arange(len(start) - 1), np.diff(start))
    key = image * (1 + point.max(initial=0)) + point
    order = np.argsort(key, kind="stable")
    repeated = order[1:][np.diff(key[order]) == 0]
    if len(repeated):
        row = int(repeated.min())
        raise RecordingError(
            f"{source}: the image at {rows.stamps_ns[row]} ns has corner {rows.corner[row]} of tag {rows.tag[row]} "
            "twice; remove one, or give images taken at the same instant different cameras."
        )
