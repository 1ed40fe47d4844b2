"""Image folders in the format of EuRoC (`cam0/data/*.png`, and `cam0/data.csv` with t [ns], file name) or of Kalibr's
bagcreater (`cam0/STAMP.png`)."""

from __future__ import annotations

import re
from collections.abc import Iterator, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from icalib.base.file_hashes import hash_of
from icalib.data.images.image_checks import Note, ignore
from icalib.data.images.images import Payload, file_payload
from icalib.data.images.unreadable import HEAD_BYTES, not_data
from icalib.data.stamps.clocks import is_rate, nanoseconds, unit_by_date, unit_of_stamps
from icalib.errors import RecordingError
from icalib.rig import TimeUnit

SUFFIXES = (".png", ".jpg", ".jpeg", ".bmp", ".tif", ".tiff", ".pgm", ".ppm", ".webp")
_RATE_HZ = (1e-3, 1000.0)
_STAMPED = re.compile(r"[^0-9]*?(?P<stamp>[0-9]{9,19}(\.[0-9]+)?)")  # a word such as left_ may precede it


def image_files(folder: Path, note: Note = ignore) -> list[tuple[int, Path]]:
    """Stamps [ns] and files of the images of a camera folder, in the order of data.csv; without one, sorted by stamp.

    The images are in the subfolder `data`, or in `folder` itself if their names are dates. Empty without images. note:
    called if files have another suffix than data.csv says. Raises RecordingError naming an unreadable line.
    """
    data = folder / "data"
    paths = pictures_in(data)
    if not paths:
        return stamped_by_name(pictures_in(folder)) or []
    table = folder / "data.csv"
    if table.is_file():
        return _with_other_endings(_listed(table, data), paths, table, note)
    if named := stamped_by_name(paths):
        return named
    unnamed = next((p for p in paths if not (p.stem.isdecimal() and int(p.stem) < 2**63)), None)
    if unnamed:
        raise RecordingError(
            f"{folder} has no data.csv, and the name of {unnamed.name} is not a stamp in ns; write data.csv with "
            "lines t [ns],file name."
        )
    return sorted((int(p.stem), p) for p in paths)


def pictures_in(folder: Path) -> list[Path]:
    return sorted(p for p in folder.iterdir() if p.suffix.lower() in SUFFIXES) if folder.is_dir() else []


def stamped_by_name(files: Sequence[Path], names: Sequence[str] = ()) -> list[tuple[int, Path]] | None:
    """Stamps [ns] and files, sorted by stamp, if all names are times since 1970 in the same unit; else None.

    names: the part of each name that contains the stamp; default: the name without suffix.
    """
    matches = [_STAMPED.fullmatch(name) for name in names or [p.stem for p in files]]
    texts = [m["stamp"] for m in matches if m]
    unit = unit_by_date([float(text) for text in texts]) if len(texts) == len(files) else None
    if unit is None or not files:
        return None
    return sorted((nanoseconds(text, unit), p) for text, p in zip(texts, files, strict=True))


def file_payloads(files: list[tuple[int, Path]], where: str, note: Note) -> Iterator[Payload]:
    """Undecoded images of `files` (stamp [ns], path). Missing and empty files and Git LFS pointers are rejected, with a
    note at the end.

    Raises RecordingError if no file is left and some are pointers.
    """
    missing: list[Path] = []
    pointers: list[str] = []
    for stamp_ns, path in files:
        data = path.read_bytes() if path.is_file() else b""
        if data:
            hash_of(path).saw(0, data)
        if sentence := not_data(path, data[:HEAD_BYTES]):
            pointers.append(sentence)
        elif data:
            yield replace(file_payload(stamp_ns, where, data), name=path.name)
        else:
            missing.append(path)
    if pointers:
        if len(pointers) + len(missing) == len(files):
            raise RecordingError(pointers[0])
        note(f"{where}: {len(pointers)} of {len(files)} images cannot be read, the first: {pointers[0]}")
    if missing:
        note(f"{where}: {len(missing)} of {len(files)} images are missing or empty, the first is {missing[0].name}.")


def _listed(table: Path, data: Path) -> list[tuple[int, Path]]:
    """Stamps, converted to ns from the detected unit, and files of data.csv. Raises RecordingError naming the line."""
    rows: list[tuple[int, str, str]] = []
    try:
        lines = table.read_text(encoding="utf-8-sig").splitlines()
    except (OSError, UnicodeDecodeError) as error:
        raise RecordingError(f"{table} cannot be read ({error}); copy it again.") from error
    for number, line in enumerate(lines, 1):
        stamp, name = (*(part.strip() for part in re.split(r"[,;\s]", line.strip(), maxsplit=1)), "")[:2]
        if not line.strip() or stamp.startswith("#") or (not rows and stamp[:1].isalpha()):
            continue
        if not re.fullmatch(r"[0-9]+(\.[0-9]*)?", stamp) or not name:
            raise RecordingError(_line_sentence(table, number, line))
        rows.append((number, stamp, name.strip(",; ")))
    if not rows:
        raise RecordingError(f"{table} holds no rows; write one line for each image, t [ns],file name.")
    unit = unit_of_texts([stamp for _, stamp, _ in rows])
    if unit == "ns":
        for number, stamp, _ in rows:
            if not stamp.isdecimal():
                raise RecordingError(_line_sentence(table, number, lines[number - 1]))
    return [(nanoseconds(stamp, unit), data / name) for _, stamp, name in rows]


def unit_of_texts(stamps: Sequence[str]) -> TimeUnit:
    """Detected unit of stamps: that in which they are dates; else ns if integers in ns give an image rate from 1 mHz to
    1 kHz; else the unit that does; ns by default."""
    numbers = np.array([float(stamp) for stamp in stamps])
    if dated := unit_by_date(numbers.tolist()):
        return dated
    if all(stamp.isdecimal() for stamp in stamps) and is_rate(numbers, *_RATE_HZ):
        return "ns"
    return (unit_of_stamps(numbers, *_RATE_HZ) if len(numbers) > 1 else None) or "ns"


def _line_sentence(table: Path, number: int, line: str) -> str:
    return f"{table}:{number}: {line.strip()[:60]!r} is not t [ns],file name; correct the line."


def _with_other_endings(
    listed: list[tuple[int, Path]], paths: Sequence[Path], table: Path, note: Note
) -> list[tuple[int, Path]]:
    """`listed`, with file names corrected if all suffixes in the table differ from those of the files `paths`."""
    if any(path.is_file() for _, path in listed):
        return listed
    by_stem = {p.stem: p for p in paths}
    renamed = [(stamp, by_stem.get(path.stem, path)) for stamp, path in listed]
    same = sum(path.stem in by_stem for _, path in listed)
    names = f"{table} names {listed[0][1].name}, and {table.parent / 'data'} holds {paths[0].name}"
    if not same:
        raise RecordingError(
            f"{names}: none of its {len(listed)} images is there; correct the names, or copy the images."
        )
    note(f"{names}: {same} images were found under the same name with another ending.")
    return renamed
