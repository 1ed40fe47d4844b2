"""Input that would never end, take all memory or kill the process ends in one sentence instead."""

from __future__ import annotations

import gzip
import io
import os
import subprocess
import sys
import zipfile
import zlib
from pathlib import Path

import numpy as np
import pytest
from tests.cases import each

from icalib.base.files import FREE_BYTES
from icalib.base.yaml_nodes import parse_yaml, read_yaml
from icalib.cli import main
from icalib.data.images import DamagedImageError, decode, file_payload
from icalib.data.tables import read_bytes
from icalib.errors import RecordingError, RigError
from icalib.sensors.position.read.fixes import read_pos
from icalib.tools.inspection import read_target
from icalib.tools.inspection.kalibr import yaml_mapping

COMMANDS = {
    "simulate": ("simulate", "{}", "-o", "made"),
    "rig": ("calibrate", "{}", "rec", "-o", "made"),
    "recording": ("inspect", "{}"),
    "target": ("inspect", "rec", "--target", "{}"),
    "compare": ("compare", "{}", "{}"),
    "allan": ("allan", "{}", "-o", "made"),
    "fleet": ("fleet", "{}", "-o", "made"),
    "result": ("view", "{}"),
}
LAUGHS = "a: &a [x,x,x,x,x,x,x,x,x]\n" + "".join(
    f"{b}: &{b} [{','.join([f'*{a}'] * 9)}]\n" for a, b in zip("abcdefghijkl", "bcdefghijklm", strict=True)
)


def sentence(capsys: pytest.CaptureFixture[str], *command: str) -> str:
    """What the command says; it must fail in one line."""
    assert main(list(command)) in (1, 2)
    out, error = capsys.readouterr()
    assert not out and error.startswith("icalib: ") and error.endswith(".\n") and error.count("\n") == 1
    return error


@pytest.mark.skipif(sys.platform == "win32", reason="there are no such devices")
@each("command", COMMANDS)
@each("place", ["/dev/zero", "pipe"])
def test_devices_and_pipes_are_not_read(command: str, place: str, tmp_path: Path, capsys, monkeypatch):
    monkeypatch.chdir(tmp_path)
    os.mkfifo("pipe")
    Path("rec").mkdir()
    said = sentence(capsys, *(word.format(place) for word in COMMANDS[command]))
    assert f"{place} cannot be read (a pipe or a device, not a file); " in said or f"{place} is not a folder" in said
    assert not any(Path("made").glob("*"))


@pytest.mark.skipif(sys.platform == "win32", reason="there are no such devices")
def test_a_table_of_a_recording_may_be_none(tmp_path: Path):
    (tmp_path / "data.csv").symlink_to("/dev/zero")
    with pytest.raises(RecordingError, match=r"data.csv cannot be read \(a pipe or a device, not a file\)"):
        read_bytes(tmp_path / "data.csv")


@each("path", ["", " ", "a\0b"])
@each("command", [*COMMANDS, "output"])
def test_paths_that_are_none(command: str, path: str, capsys, tmp_path: Path, monkeypatch):
    """An empty one would be the current folder."""
    monkeypatch.chdir(tmp_path)
    words = COMMANDS.get(command, ("simulate", "scenario.yaml", "-o", "{}"))
    with pytest.raises(SystemExit) as stop:
        main([word.format(path) for word in words])
    assert stop.value.code == 2 and f"must be a path, but is {path!r}" in capsys.readouterr().err
    assert not list(tmp_path.iterdir())


def test_names_with_zero_bytes(tmp_path: Path, capsys, monkeypatch):
    monkeypatch.chdir(tmp_path)
    Path("rec").mkdir()
    Path("rig.yaml").write_text('sensors:\n  imu0: {type: imu, path: "a\\0b"}\n')
    said = sentence(capsys, "calibrate", "rig.yaml", "rec", "-o", "made")
    assert r"sensors.imu0.path: must be text without zero bytes, but is 'a\x00b'" in said
    Path("rig.yaml").write_text('sensors:\n  "i\\0\\e[2Jmu0": {type: imu}\n')
    assert r"sensors.i\x00\x1b[2Jmu0: a sensor's name is" in sentence(
        capsys, "calibrate", "rig.yaml", "rec", "-o", "made"
    )


def test_aliases_are_counted_as_written_out(tmp_path: Path):
    most = r"rig.yaml: its aliases \(\*name\) stand for more than 1048576 values; write them out\."
    for text in (LAUGHS, "a: &a [*a]", "a: &a {b: *a}"):
        with pytest.raises(RigError, match=most):
            parse_yaml(text, "rig.yaml")
    few = parse_yaml("a: &a [1, 2]\nb: [*a, *a]\n", "rig.yaml").entries()
    assert [one.vector(2).tolist() for one in few["b"].items()] == [[1.0, 2.0]] * 2
    (tmp_path / "april.yaml").write_text(f"{LAUGHS}target_type: *m\n")
    with pytest.raises(RigError, match="its aliases"):
        read_target(tmp_path / "april.yaml")


@each("value", ['!!int ""', '!!float ""', "!!bool x", "!!timestamp x", "!!binary é", "{[1]: 2}"])
def test_tags_of_a_kalibr_file_that_fit_no_value(value: str, tmp_path: Path):
    (tmp_path / "imu.yaml").write_text(f"update_rate: {value}\n")
    assert yaml_mapping(tmp_path / "imu.yaml") == {}


def test_a_yaml_file_has_a_largest_size(tmp_path: Path):
    path = tmp_path / "rig.yaml"
    with path.open("wb") as file:
        file.truncate(1 << 40)  # without blocks on the disk
    with pytest.raises(RigError, match=r"rig.yaml is larger than 1 MiB; give the path of a rig file\."):
        read_yaml(path)


def test_a_table_that_unpacks_to_too_much(tmp_path: Path):
    path = tmp_path / "gnss.pos.gz"
    path.write_bytes(gzip.compress(bytes(2 * FREE_BYTES)))
    with pytest.raises(RecordingError, match=r"unpacks to more than 16 MiB and 256 times its size; unpack it"):
        read_pos("gnss0", path)
    path.write_bytes(gzip.compress(b"% GPST\n" * 9)[:-12])
    with pytest.raises(RecordingError, match="is a damaged or truncated gzip file"):
        read_pos("gnss0", path)


def png(width: int, height: int, size: int | None = None) -> bytes:
    """A black image. size: that its block of data states, in bytes."""
    rows = zlib.compress(bytes(min(height * (width + 1), 1 << 20)))
    head = width.to_bytes(4) + height.to_bytes(4) + bytes([8, 0, 0, 0, 0])
    parts = [(b"IHDR", head, len(head)), (b"IDAT", rows, len(rows) if size is None else size), (b"IEND", b"", 0)]
    return b"\x89PNG\r\n\x1a\n" + b"".join(n.to_bytes(4) + k + c + zlib.crc32(k + c).to_bytes(4) for k, c, n in parts)


@pytest.mark.parametrize("image", [png(16000, 16000), png(40, 30, 2**31 - 1)], ids=["pixels", "block"])
def test_pictures_that_claim_more_than_they_hold(image: bytes, monkeypatch):
    assert decode(file_payload(5, "cam0", png(40, 30))).shape == (30, 40)
    monkeypatch.setattr("cv2.imdecode", lambda *_: pytest.fail("OpenCV takes gigabytes for it"))
    with pytest.raises(DamagedImageError, match="cam0: the image .* is damaged; leave it out"):
        decode(file_payload(5, "cam0", image))


def test_a_terminal_sees_no_warnings_of_python(tmp_path: Path):
    """An array's header with an escape that Python does not know, and one that Python 2 wrote."""
    scans = tmp_path / "lidar0" / "scans.npz"
    scans.parent.mkdir()
    for text in (r"{'descr': '\d', 'fortran_order': False, 'shape': (1,)}", "{'descr': '<i8', 'shape': (1L,)}"):
        buffer = io.BytesIO()
        with zipfile.ZipFile(buffer, "w") as file:
            head = f"{text}\n".encode("latin1")
            file.writestr("stamps_ns.npy", b"\x93NUMPY\x01\x00" + len(head).to_bytes(2, "little") + head + bytes(8))
        scans.write_bytes(buffer.getvalue())
        program = "import sys; from icalib.cli import main; sys.exit(main())"
        command = [sys.executable, "-c", program, "inspect", str(tmp_path)]
        ended = subprocess.run(command, capture_output=True, text=True, timeout=300, check=False)
        assert ended.returncode in (0, 1) and "Warning" not in ended.stderr + ended.stdout, ended.stderr


def test_scans_without_points(tmp_path: Path, capsys):
    (tmp_path / "lidar0").mkdir()
    arrays = {"offset_s": np.zeros(0, np.float32), "xyz": np.zeros((0, 3), np.float32)}
    (tmp_path / "rig.yaml").write_text("sensors:\n  imu0: {type: imu}\n  lidar0: {type: lidar}\n")
    (tmp_path / "imu0").mkdir()
    rows = [f"{10**18 + k * 10**7},{0.01 * (k % 3)},0.02,{0.01 * (k % 5)},0.1,{0.1 * (k % 7)},9.8" for k in range(400)]
    (tmp_path / "imu0" / "data.csv").write_text("\n".join(rows))
    for n in (0, 1, 9):
        np.savez(tmp_path / "lidar0/scans.npz", stamps_ns=10**18 + np.arange(n) * 10**8, start=[0] * (n + 1), **arrays)
        command = ("calibrate", str(tmp_path / "rig.yaml"), str(tmp_path), "-o", str(tmp_path / "made"), "-q")
        assert main(list(command)) == 1
        error = capsys.readouterr().err
        assert error.count("\n") == 1 and f"0 of {n} scans have usable points" in error
