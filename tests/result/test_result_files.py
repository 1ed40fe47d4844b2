"""A folder holds one whole set of files, whatever happens while it is written."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from icalib.base.files import COMMIT, check_writable, read_file, write_files
from icalib.errors import CalibrationError
from icalib.result import Calibration, calibration_files, load_calibration

NAMES = ("calibration.yaml", "result.json", "result.npz")
OLD, NEW = ({name: f"{word} {name}".encode() for name in NAMES} for word in ("old", "new"))


def contents(folder: Path) -> dict[str, bytes]:
    return {name: read_file(folder, name) for name in NAMES}


class Crash(BaseException):
    """A power cut: nothing that comes later runs."""


def test_writes_anew_and_again(tmp_path: Path):
    for files in (OLD, NEW):
        write_files(tmp_path / "out", files)
        assert contents(tmp_path / "out") == files
        assert sorted(p.name for p in (tmp_path / "out").iterdir()) == sorted(NAMES)


def test_keeps_foreign_files(tmp_path: Path):
    (tmp_path / "photo.jpg").write_bytes(b"mine")
    (tmp_path / "folder").mkdir()
    (tmp_path / "folder" / "result.json").write_bytes(b"mine too")
    write_files(tmp_path, OLD)
    write_files(tmp_path, NEW)
    assert (tmp_path / "photo.jpg").read_bytes() == b"mine"
    assert (tmp_path / "folder" / "result.json").read_bytes() == b"mine too"


def test_removes_what_an_earlier_result_derived(tmp_path: Path):
    write_files(tmp_path, OLD | {"report.html": b"old", "camchain-imucam.yaml": b"old"})
    write_files(tmp_path, NEW)
    assert not (tmp_path / "report.html").exists()
    assert not (tmp_path / "camchain-imucam.yaml").exists()


@pytest.mark.parametrize("calls", range(6))
def test_a_crash_at_any_step_leaves_one_whole_set(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, calls: int):
    write_files(tmp_path, OLD)
    left = [calls]

    def crashing(name: str):
        real = getattr(Path, name)

        def step(self: Path, *args: object) -> object:
            if left[0] == 0:
                raise Crash
            left[0] -= 1
            return real(self, *args)

        return step

    with monkeypatch.context() as patch:
        for name in ("rename", "replace", "rmdir"):
            patch.setattr(Path, name, crashing(name))
        if calls < 5:  # one rename, three replaces, one rmdir
            with pytest.raises(Crash):
                write_files(tmp_path, NEW)
        else:
            write_files(tmp_path, NEW)
    assert contents(tmp_path) == (OLD if calls == 0 else NEW)
    write_files(tmp_path, OLD)
    assert contents(tmp_path) == OLD
    assert not (tmp_path / COMMIT).exists()


def test_a_full_disk_leaves_the_old_set(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    write_files(tmp_path, OLD)

    def full(_: int) -> None:
        raise OSError(28, "No space left on device")

    with monkeypatch.context() as patch:
        patch.setattr("icalib.base.files.os.fsync", full)
        with pytest.raises(CalibrationError, match="No space left on device"):
            write_files(tmp_path, NEW)
    assert contents(tmp_path) == OLD
    assert sorted(p.name for p in tmp_path.iterdir()) == sorted(NAMES)


def test_a_target_that_is_no_folder(tmp_path: Path):
    (tmp_path / "file").write_bytes(b"")
    for attempt in (lambda f: write_files(f, NEW), check_writable):
        for folder in (tmp_path / "file", tmp_path / "file" / "below"):
            with pytest.raises(CalibrationError, match="cannot be written"):
                attempt(folder)


def test_check_leaves_nothing_behind(tmp_path: Path):
    check_writable(tmp_path / "new")
    assert list((tmp_path / "new").iterdir()) == []


@pytest.mark.parametrize("value", ["null", "NaN", "-Infinity", "1e300"])
def test_values_that_are_no_numbers_are_not_loaded(calibration: Calibration, tmp_path: Path, value: str):
    """Exports would hold axes of NaN."""
    write_files(tmp_path, calibration_files(calibration))
    whole = (tmp_path / "result.json").read_text(encoding="utf-8")
    for name in ("translation", "rotation", "time_offset"):
        group = next(g for g in calibration.groups if name in g.name)
        plain = json.loads(whole)
        values = next(g for g in plain["groups"] if (g["sensor"], g["name"]) == (group.sensor, group.name))["value"]
        (values[0] if isinstance(values[0], list) else values)[0] = "here"
        (tmp_path / "result.json").write_text(json.dumps(plain).replace('"here"', value), encoding="utf-8")
        with pytest.raises(CalibrationError, match=f"{group.sensor}.{group.name} holds a value that is no number, or"):
            load_calibration(tmp_path)
