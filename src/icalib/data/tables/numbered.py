"""Stamps for images without timestamps, from the rows of a pose table (hand-eye calibration).

The robot stops, takes an image, and logs a pose. Images and rows are matched by order or by number.
"""

from __future__ import annotations

import re
from collections.abc import Callable
from itertools import pairwise
from pathlib import Path

import numpy as np

from icalib.data.images.image_checks import Note, ignore
from icalib.data.images.image_files import are_most, pictures_in, stamped_by_name
from icalib.data.stamps.clocks import is_rate
from icalib.errors import RecordingError

_IMAGE_RATE_HZ = (1e-3, 1000.0)  # names are stamps only if they make an image rate within this range


def numbered_pictures(folder: Path, note: Note = ignore) -> list[tuple[int, Path]]:
    """Number and file of each image in `folder` or its subfolder `data`, sorted by number.

    The number is the last one in the file name. Empty without images, if they have stamps (`data.csv`, or names that
    are stamps), or if most names have no number. note: see `are_most`.
    """
    data = pictures_in(folder / "data")
    files = data or pictures_in(folder)
    if not files or (data and (folder / "data.csv").is_file()) or stamped_by_name(files) is not None:
        return []
    images = sorted((int(digits[-1]), path) for path in files if (digits := re.findall(r"\d+", path.stem)))
    if not are_most([path for _, path in images], files, note):
        return []
    numbers = np.array([number for number, _ in images], dtype=object)
    stamps = data and all(path.stem.isdecimal() for _, path in images) and numbers[-1] < 2**63
    return [] if stamps and is_rate(numbers.astype(np.int64), *_IMAGE_RATE_HZ) else images


def stamped_by_rows(
    images: list[tuple[int, Path]], table: Path, read: Callable[[], tuple[dict[int, int], int]], note: Note
) -> list[tuple[int, Path]]:
    """Stamp [ns] and file of each image of `images` (from `numbered_pictures`); the stamp is that of a row of `table`.

    With as many images as rows, they are matched in order. Otherwise the number of an image is its row, counted from 0
    if there is an image 0, else from 1. A note says which. read: returns stamps by row and the number of rows, as
    `TableFile.rows`. Images of unreadable rows are rejected, with a note. Raises RecordingError for two images of the
    same number, for an image without a row, and (by `read`) if many rows are unreadable.
    """
    folder, numbers = images[0][1].parent, [number for number, _ in images]
    _refuse_twice(images)
    stamp_of, count = read()
    in_order = len(numbers) == count
    first = min(1, numbers[0])  # the number of the first row
    rows = list(range(len(numbers))) if in_order else [n - first for n in numbers]
    if rows[-1] >= count:
        raise RecordingError(
            f"{folder} holds {len(images)} images without timestamps, up to number {numbers[-1]}, and {table} "
            f"has {count} rows; number each image as the row of its pose, or use stamps as file names."
        )
    how = "in order" if in_order else f"by number, {first} being that of the first row"
    note(
        f"{folder}: {len(images)} images have no timestamps. Each takes that of its row of {table}, {how}: "
        f"image {images[0][1].name} belongs to row {rows[0] + 1}."
    )
    paths = [path for _, path in images]
    lost = [path for row, path in zip(rows, paths, strict=True) if row not in stamp_of]
    if lost:
        note(
            f"{folder}: {len(lost)} of {len(images)} images are ignored, the first is {lost[0].name}: the row "
            f"of its pose in {table} cannot be read."
        )
    return [(stamp_of[row], path) for row, path in zip(rows, paths, strict=True) if row in stamp_of]


def _refuse_twice(images: list[tuple[int, Path]]) -> None:
    """Raises RecordingError if two images, sorted by number, have the same number."""
    for (number, path), (other, second) in pairwise(images):
        if number == other:
            raise RecordingError(
                f"{path} and {second.name} have the same number, {number}; number each image as the row of its pose."
            )
