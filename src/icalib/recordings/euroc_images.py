"""Images in a folder, as EuRoC has them: `cam0/data/*.png`, and `cam0/data.csv` with t [ns], file name."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

from icalib.errors import RecordingError
from icalib.recordings.image_checks import Note
from icalib.recordings.images import Payload, file_payload
from icalib.recordings.unreadable import HEAD_BYTES, not_data

SUFFIXES = (".png", ".jpg", ".jpeg")


def image_files(folder: Path) -> list[tuple[int, Path]]:
    """Stamps [ns] and files of the images of `folder`, in the order of its data.csv; without one, by the files' names.

    Empty where there is no folder `data` of images. Raises RecordingError naming the line that cannot be read.
    """
    data = folder / "data"
    there = sorted(p for p in data.iterdir() if p.suffix.lower() in SUFFIXES) if data.is_dir() else []
    if not there:
        return []
    table = folder / "data.csv"
    if table.is_file():
        return _listed(table, data)
    unnamed = next((p for p in there if not p.stem.isdecimal()), None)
    if unnamed:
        raise RecordingError(f"{folder} has no data.csv, and {unnamed.name} is no stamp in ns; write t [ns],file name.")
    return sorted((int(p.stem), p) for p in there)


def file_payloads(files: list[tuple[int, Path]], where: str, note: Note) -> Iterator[Payload]:
    """The images as files; empty and missing ones, and pointers of Git LFS, are left out, with a note at the end.

    Raises RecordingError where all are pointers.
    """
    missing: list[Path] = []
    pointers: list[str] = []
    for stamp_ns, path in files:
        data = path.read_bytes() if path.is_file() else b""
        if sentence := not_data(path, data[:HEAD_BYTES]):
            pointers.append(sentence)
        elif data:
            yield file_payload(stamp_ns, f"{where} ({path.name})", data)
        else:
            missing.append(path)
    if pointers:
        if len(pointers) + len(missing) == len(files):
            raise RecordingError(pointers[0])
        note(f"{where}: {len(pointers)} of {len(files)} images cannot be read, the first: {pointers[0]}")
    if missing:
        note(f"{where}: {len(missing)} of {len(files)} images are missing or empty, the first is {missing[0].name}.")


def _listed(table: Path, data: Path) -> list[tuple[int, Path]]:
    files: list[tuple[int, Path]] = []
    try:
        lines = table.read_text(encoding="utf-8-sig").splitlines()
    except (OSError, UnicodeDecodeError) as error:
        raise RecordingError(f"{table} cannot be read ({error}); copy it again.") from error
    for number, line in enumerate(lines, 1):
        stamp, comma, name = (part.strip() for part in line.partition(","))
        if not line.strip() or stamp.startswith("#") or (not files and stamp[:1].isalpha()):
            continue
        if not stamp.isdecimal() or not comma or not name:
            raise RecordingError(f"{table}:{number}: {line.strip()[:60]!r} is not t [ns],file name; correct the line.")
        files.append((int(stamp), data / name))
    if not files:
        raise RecordingError(f"{table} holds no rows; write one line for each image, t [ns],file name.")
    return files
