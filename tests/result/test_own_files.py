"""Files that icalib did not write are never replaced or deleted; its own are, as long as nobody changed them."""

from __future__ import annotations

import io
import json
import os
import signal
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from icalib.base.files import (
    COMMIT,
    PREFIX,
    below,
    is_ours,
    read_file,
    refuse_foreign,
    refuse_foreign_set,
    sealed,
    staged,
    write_files,
    write_texts,
)
from icalib.cli import main
from icalib.errors import CalibrationError

TEXTS = {
    "a.yaml": b"a: 1",
    "a.json": b'{\n "a": {}\n}\n',
    "a.html": b"<!DOCTYPE html>\n<p>a</p>",
    "a.urdf": b"\xef\xbb\xbf<robot/>\n",
    "a.pdf": b"%PDF-1.4\n%%EOF\n",
    "cam0.yaml": b"%YAML:1.0\n---\na: 1\n",
    "a.png": b"\x89PNG\r\n\x1a\n\0\0",
}


@pytest.mark.parametrize("name", TEXTS)
def test_a_sealed_file_is_ours_until_it_is_changed(tmp_path: Path, name: str):
    path, content = tmp_path / name, sealed(TEXTS[name])
    for mine in (TEXTS[name], content + b"\n", content.replace(b"a", b"b", 1), content[:-1], b""):
        path.write_bytes(mine)
        assert is_ours(path) == (mine == content), mine
    path.write_bytes(content)
    assert is_ours(path) and sealed(content) == (content if name != "a.json" else sealed(content))
    (tmp_path / "link").symlink_to(path)
    assert not is_ours(tmp_path / "link")
    if name.endswith(".json"):
        assert json.loads(content)["a"] == {}


def kalibr_folder(folder: Path) -> dict[str, bytes]:
    files = {"imu.yaml": b"rostopic: /imu0\n", "camchain.yaml": b"cam0: {}\n", "notes.txt": b"mine\n"}
    for name, content in files.items():
        (folder / name).write_bytes(content)
    return files


@pytest.mark.parametrize("command", ["calibrate", "allan", "montecarlo", "fleet", "target", "inspect", "reproduce"])
def test_commands_refuse_before_they_start(command: str, tmp_path: Path, capsys, monkeypatch):
    """The inputs do not even exist, or are empty: the refusal comes first."""
    monkeypatch.chdir(tmp_path)
    names = {
        "allan": "noise.yaml",
        "montecarlo": "consistency.html",
        "fleet": "fleet.html",
        "target": "board.pdf",
        "inspect": "found.json",
        "calibrate": "imu.yaml",
        "reproduce": "reproduce.html",
    }
    files = kalibr_folder(tmp_path) | {names[command]: b"mine"}
    (tmp_path / names[command]).write_bytes(b"mine")
    rig = Path(__file__).parents[2] / "examples" / "euroc" / "rig.yaml"
    scenario = Path(__file__).parents[2] / "src/icalib/tools/montecarlo/paper/table2-3d.yaml"
    (tmp_path / "jobs.yaml").write_text(f"jobs: [{{robot: a, rig: {rig}, recording: b}}]")
    board = ["--rows", "5", "--cols", "4", "--square-size", "0.02"]
    arguments = {
        "allan": ["allan", "rec", "-o", "."],
        "montecarlo": ["montecarlo", str(scenario), "--runs", "1", "-o", "."],
        "fleet": ["fleet", "jobs.yaml", "-o", "."],
        "target": ["target", "checkerboard", *board, "-o", "board.pdf"],
        "inspect": ["inspect", "rec", "--json", "found.json"],
        "calibrate": ["calibrate", str(rig), "rec", "-o", "."],
        "reproduce": ["reproduce", "-o", "."],
    }
    assert main(arguments[command]) == 1
    said = capsys.readouterr().err
    assert said.count("\n") == 1 and "was not written by icalib, or was changed since" in said
    assert {name: (tmp_path / name).read_bytes() for name in files} == files


def test_a_set_replaces_its_own_files_only(tmp_path: Path):
    own = {"imu.yaml": sealed(b"imu: 1"), "result.json": sealed(b'{"a": 1}')}
    refuse_foreign_set(tmp_path)
    write_files(tmp_path, own)
    refuse_foreign_set(tmp_path)
    with pytest.raises(CalibrationError, match=r"imu\.yaml is an input of this command and would be overwritten"):
        refuse_foreign_set(tmp_path, [tmp_path / "imu.yaml"])
    (tmp_path / "imu.yaml").write_bytes(own["imu.yaml"].replace(b"1", b"2", 1))
    with pytest.raises(CalibrationError, match=r"imu\.yaml was not written by icalib"):
        refuse_foreign_set(tmp_path)


def test_sealed_arrays_are_read_as_before(tmp_path: Path):
    buffer = io.BytesIO()
    np.savez(buffer, a=np.arange(3))
    path, content = tmp_path / "result.npz", sealed(buffer.getvalue())
    path.write_bytes(content)
    with np.load(path, allow_pickle=False) as found:
        np.testing.assert_array_equal(found["a"], np.arange(3))
    assert is_ours(path)
    path.write_bytes(buffer.getvalue())
    assert not is_ours(path)
    path.write_bytes(content.replace(b"a.npy", b"b.npy"))
    assert not is_ours(path)


def test_a_linked_commit_folder_moves_nothing(tmp_path: Path):
    (tmp_path / "mine").mkdir()
    (tmp_path / "mine" / "result.json").write_bytes(b"mine")
    (tmp_path / "out").mkdir()
    (tmp_path / "out" / COMMIT).symlink_to(tmp_path / "mine")
    for attempt in (
        lambda: write_files(tmp_path / "out", {"result.json": b"new"}),
        lambda: read_file(tmp_path / "out", "result.json"),
        lambda: refuse_foreign_set(tmp_path / "out"),
    ):
        with pytest.raises(CalibrationError, match=r"is a link, which icalib never writes; remove it\."):
            attempt()
    assert (tmp_path / "mine" / "result.json").read_bytes() == b"mine"


KILLED = """
import sys, time
from pathlib import Path
from icalib.base.files import staged
with staged(Path(sys.argv[1])) as place:
    (place / "half").write_bytes(b"half")
    print(place, flush=True)
    time.sleep(600)
"""


@pytest.mark.skipif(sys.platform == "win32", reason="there are no such locks")
def test_what_a_killed_writer_left_goes_and_what_one_at_work_has_stays(tmp_path: Path):
    writer = subprocess.Popen([sys.executable, "-c", KILLED, str(tmp_path)], stdout=subprocess.PIPE, text=True)
    try:
        assert writer.stdout is not None
        place = Path(writer.stdout.readline().strip())
        (tmp_path / f"{PREFIX}link").symlink_to(tmp_path)
        with staged(tmp_path) as mine:
            assert mine != place and (place / "half").read_bytes() == b"half"
        os.kill(writer.pid, signal.SIGKILL)
    finally:
        writer.kill()
        writer.communicate()
    write_texts(tmp_path, {"a.yaml": "a"})
    assert sorted(p.name for p in tmp_path.iterdir()) == [f"{PREFIX}link", "a.yaml"]


@pytest.mark.parametrize("name", ["", ".", "..", "../x", "/x", "a/b", "a\\b", "a\0b"])
def test_a_name_stays_in_its_folder(tmp_path: Path, name: str):
    with pytest.raises(CalibrationError, match="cannot be the name of a file"):
        below(tmp_path, name)
    with pytest.raises(CalibrationError):
        write_texts(tmp_path / "out", {name: "text"})
    assert not list((tmp_path / "out").iterdir())


@pytest.mark.parametrize("name", ["../../x", "/tmp/x", "a/b", "..", "x" * 101])
def test_a_scenario_writes_nowhere_else(tmp_path: Path, capsys, name: str):
    text = (Path(__file__).parents[2] / "src/icalib/tools/montecarlo/paper/table2-3d.yaml").read_text(encoding="utf-8")
    (tmp_path / "scenario.yaml").write_text(text.replace("  cam0:", f"  {name}:"), encoding="utf-8")
    assert main(["simulate", str(tmp_path / "scenario.yaml"), "-o", str(tmp_path / "a" / "out"), "-q"]) == 1
    assert "a sensor's name is a letter, then up to 99 letters, digits, _ or -" in capsys.readouterr().err
    assert [p.name for p in tmp_path.iterdir()] == ["scenario.yaml"]


def test_an_unreadable_file_is_named(tmp_path: Path):
    path = tmp_path / ("x" * 300)
    with pytest.raises(CalibrationError, match="cannot be read"):
        refuse_foreign([path])
