"""Reads a table of feature tracks into the checked track stream of one camera, grouped by image."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from icalib.data.images.image_checks import Note, ignore
from icalib.data.measurements import TrackStream
from icalib.data.stamps.clocks import rate_sentence
from icalib.data.tables.columns import STAMP, TableKind
from icalib.data.tables.table import read_table
from icalib.errors import RecordingError
from icalib.rig import PLAIN_TABLE, TableLayout
from icalib.sensors.camera.read.checks import IMAGE_RATE_HZ, image_starts, in_image, outside_note

_TRACK_TABLE = TableKind(
    ("t [ns]", "feature"),
    ("u [px]", "v [px]"),
    (STAMP, (r"(feature|track|point|landmark)(_?id)?|id",), (r"u(_?px)?|x(_?px)?",), (r"v(_?px)?|y(_?px)?",)),
    IMAGE_RATE_HZ,
)
_TRACK_MARGIN_PX = 5.0  # accepted distance outside the image: a few times the noise of trackers


def read_track_stamps(path: Path) -> np.ndarray:
    """(M,) int64 ns: one stamp for each image of the table at `path`. Raises RecordingError as `read_table`."""
    return np.unique(read_table(path, _TRACK_TABLE).integers[:, 0])


def read_tracks(
    name: str, path: Path, resolution: tuple[int, int], layout: TableLayout = PLAIN_TABLE, note: Note = ignore
) -> TrackStream:
    """Feature tracks from the table t [ns], feature, u, v [px] at `path`.

    resolution: (width, height) px of the camera; note: called with a sentence on data that are left out. Raises
    RecordingError naming file and line or instant if the table cannot be read, images are out of order or at an
    impossible rate, a feature is twice in an image, many are outside the image, or no feature is in two images.
    """
    table = read_table(path, _TRACK_TABLE, layout)
    for sentence in table.notes:
        note(sentence)
    stamps_ns, feature, uv = table.integers[:, 0].copy(), table.integers[:, 1].copy(), table.decimals
    what = f"{path} ({name})"
    start = image_starts(what, stamps_ns)
    stream = TrackStream(name, stamps_ns[start[:-1]], start, feature, np.ascontiguousarray(uv))
    inside = in_image(stream.uv, resolution, _TRACK_MARGIN_PX)
    if not inside.all():
        first = stream.feature[np.argmin(inside)]
        note(outside_note(stream, inside, f"feature {first}", what, resolution))
        stream = _selected(stream, inside)
    _check(stream, what)
    return stream


def _selected(stream: TrackStream, kept: np.ndarray) -> TrackStream:
    """The observations that `kept` (N,) bool selects; images without such observations are left out."""
    count = np.bincount(stream.image[kept], minlength=len(stream.stamps_ns))
    has_rows = count > 0
    start = np.concatenate([[0], np.cumsum(count[has_rows])]).astype(np.int64)
    return TrackStream(stream.name, stream.stamps_ns[has_rows], start, stream.feature[kept], stream.uv[kept])


def _check(stream: TrackStream, what: str) -> None:
    """Raises RecordingError for a repeated feature, an impossible image rate, or if no feature is in two images."""
    key = np.lexsort((stream.feature, stream.image))
    repeated = key[1:][(np.diff(stream.feature[key]) == 0) & (np.diff(stream.image[key]) == 0)]
    if len(repeated):
        row = int(repeated.min())
        raise RecordingError(
            f"{what}: the image at {stream.stamps_ns[stream.image[row]]} ns has feature {stream.feature[row]} "
            "twice; remove one, for a feature is one point of the scene."
        )
    sentence = rate_sentence(what, stream.stamps_ns, *IMAGE_RATE_HZ) if len(stream.stamps_ns) > 1 else None
    if sentence:
        raise RecordingError(sentence)
    if np.unique(stream.feature).size == len(stream.feature):
        raise RecordingError(
            f"{what}: no feature is in more than one image; a point keeps its number from image to image."
        )
