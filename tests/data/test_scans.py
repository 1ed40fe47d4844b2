"""Scans as arrays in a file: what is read, and what is refused."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from tests.cases import each
from tests.remarks import named, names

from icalib.base.remark import Remark
from icalib.cli import main
from icalib.data.measurements import LidarStream
from icalib.data.recordings import FolderRecording, open_recording, read_measurements
from icalib.errors import RecordingError
from icalib.rig import Lidar
from icalib.rig.file import load_rig
from icalib.sensors.lidar.read import scans
from icalib.sensors.lidar.read.point_clouds import checked_lidar

LIDAR = Lidar("lidar0", "lidar0/scans.npz")
RNG = np.random.default_rng(2)
GOOD: dict[str, Any] = {
    "stamps_ns": 10**18 + 10**8 * np.arange(5),
    "start": np.array([0, 40, 80, 80, 150, 200]),
    "offset_s": RNG.uniform(0, 0.1, 200).astype(np.float32),
    "xyz": RNG.uniform(1, 9, (200, 3)).astype(np.float32),
}


def read(tmp_path, arrays: dict[str, Any]) -> tuple[LidarStream, tuple[Remark, ...]]:
    (tmp_path / "lidar0").mkdir(exist_ok=True)
    np.savez(tmp_path / "lidar0" / "scans.npz", **arrays)
    folder = FolderRecording(tmp_path)
    stream, notes = checked_lidar(scans(folder, LIDAR), folder.where(LIDAR))
    assert folder.files() == [tmp_path / "lidar0" / "scans.npz"]
    return stream, folder.notes() + notes


def test_scans_of_others(tmp_path):
    """float64, no planes; the third scan is empty."""
    wide = GOOD | {name: GOOD[name].astype(np.float64) for name in ("xyz", "offset_s")}
    stream, notes = read(tmp_path, wide)
    np.testing.assert_array_equal(stream.xyz, GOOD["xyz"], strict=True)
    np.testing.assert_array_equal(stream.offset_s, GOOD["offset_s"], strict=True)
    assert stream.start.tolist() == [0, 40, 80, 150, 200] and (stream.plane == -1).all()
    assert stream.stamps_ns.tolist() == GOOD["stamps_ns"][[0, 1, 3, 4]].tolist()
    assert len(notes) == 1 and "(lidar0): 1 of 5 scans have no usable point" in notes[0]


def test_points_that_cannot_be_used(tmp_path):
    """A whole scan among them; planes stay with their points."""
    xyz, plane = GOOD["xyz"].copy(), np.arange(200, dtype=np.int32)
    xyz[3], xyz[90, 0], xyz[160] = 0.0, np.nan, [0.1, 0.1, 0.1]
    xyz[40:80] = 300.0
    stream, notes = read(tmp_path, GOOD | {"xyz": xyz, "plane": plane})
    kept = np.setdiff1d(plane, [3, 90, 160, *range(40, 80)])
    np.testing.assert_array_equal(stream.plane, kept)
    np.testing.assert_array_equal(stream.xyz, xyz[kept])
    np.testing.assert_array_equal(stream.offset_s, GOOD["offset_s"][kept])
    assert stream.start.tolist() == [0, 39, 108, 157]
    assert "of 200 points 1 without numbers, 1 at zero, 1 nearer than 0.5 m, 40 farther than 100 m were" in notes[0]
    assert "2 of 5 scans have no usable point" in notes[1]


@each(
    ("changed", "words"),
    [
        ({"xyz": None}, "has no array xyz; it needs stamps_ns, start, offset_s, xyz"),
        ({"xyz": GOOD["xyz"][:, :2]}, "xyz must have shape"),
        ({"xyz": GOOD["xyz"].ravel()}, "xyz must be numbers with 2 axes, but is float32 of shape \\(600,\\)"),
        ({"stamps_ns": GOOD["stamps_ns"] * 1e-9}, "stamps_ns must be whole numbers with 1 axes, but is float64"),
        ({"start": GOOD["start"][:-1]}, "start must have shape \\(6,\\)"),
        ({"start": GOOD["start"] + 1}, "start must run upwards from 0"),
        ({"start": np.zeros(0, np.int64)}, "start must be whole numbers"),
        ({"offset_s": GOOD["offset_s"][1:]}, "offset_s must have a row for each of the 200 points"),
        ({"offset_s": GOOD["offset_s"] * 1e-3}, "they look like another unit; multiply them by 1000"),
        ({"offset_s": GOOD["offset_s"] + 5}, "points are 5[.\\d]* to 5.\\d* s from the stamp of their scan"),
        ({"stamps_ns": GOOD["stamps_ns"][::-1]}, "the scan at \\d* ns comes after the one at \\d* ns"),
        ({"stamps_ns": GOOD["stamps_ns"] // 10**6}, "they look like milliseconds; export them in nanoseconds"),
        ({"xyz": np.array([object()] * 200)}, "cannot be read \\(Object arrays cannot be loaded"),
    ],
)
def test_what_is_refused(tmp_path, changed, words):
    arrays = {name: array for name, array in (GOOD | changed).items() if array is not None}
    with pytest.raises(RecordingError, match=words) as error:
        read(tmp_path, arrays)
    assert str(tmp_path / "lidar0" / "scans.npz") in str(error.value)


@each(("unit", "factor"), [("ms", 1e3), ("us", 1e6), ("ns", 1e9)])
def test_the_unit_of_times_is_the_one_that_fits(tmp_path, unit, factor):
    stream, notes = read(tmp_path, GOOD | {"offset_s": GOOD["offset_s"] * factor})
    np.testing.assert_allclose(stream.offset_s, GOOD["offset_s"], rtol=1e-6)
    assert f"they are read as {unit}, the only unit that fits" in notes[0]


@each("bad", [np.nan, 4.29, -3e20])
def test_single_bad_times(tmp_path, bad):
    offset_s = GOOD["offset_s"].copy()
    offset_s[[5, 60, 199]] = bad
    stream, notes = read(tmp_path, GOOD | {"offset_s": offset_s})
    kept = np.setdiff1d(np.arange(200), [5, 60, 199])
    np.testing.assert_array_equal(stream.offset_s, GOOD["offset_s"][kept])
    np.testing.assert_array_equal(stream.xyz, GOOD["xyz"][kept])
    assert "of 200 points 3 without a time within their scan were left out" in notes[0]


MANY = {
    "stamps_ns": 10**18 + 10**8 * np.arange(24),
    "start": 10 * np.arange(25),
    "offset_s": np.tile(np.linspace(0.0, 0.099, 10), 24).astype(np.float32),
    "xyz": RNG.uniform(1, 9, (240, 3)).astype(np.float32),
}


def scan_of(order: np.ndarray, **changed: Any) -> dict[str, Any]:
    """The scans of MANY in another order, some more than once."""
    rows = (10 * order[:, None] + np.arange(10)).ravel()
    arrays = {"stamps_ns": MANY["stamps_ns"][order], "start": 10 * np.arange(len(order) + 1)}
    return arrays | {"offset_s": MANY["offset_s"][rows], "xyz": MANY["xyz"][rows]} | changed


def expect(stream: LidarStream, scans: list[int]):
    assert stream.stamps_ns.tolist() == MANY["stamps_ns"][scans].tolist()
    np.testing.assert_array_equal(stream.xyz, MANY["xyz"].reshape(24, 10, 3)[scans].reshape(-1, 3))
    assert stream.start.tolist() == [10 * k for k in range(len(scans) + 1)]


@each("late", [0, 1, 2])
@each("delay_ns", [0, 10**7, 3 * 10**8])
def test_copies_of_scans_are_dropped(tmp_path, late, delay_ns):
    """With the stamp of the first or with a later one, at once or after other scans."""
    order = np.insert(np.arange(24), [8 + late, 15 + late], [7, 14])
    arrays = scan_of(order)
    arrays["stamps_ns"][[8 + late, 16 + late]] += delay_ns
    stream, notes = read(tmp_path, arrays)
    expect(stream, list(range(24)))
    assert "2 scans that repeat an earlier one exactly were dropped, the first at" in notes[0] and len(notes) == 1


def test_scans_that_overtook_each_other_are_sorted(tmp_path):
    order = np.arange(24)
    order[[4, 5, 11, 12, 13]] = [5, 4, 12, 13, 11]
    stream, notes = read(tmp_path, scan_of(order))
    expect(stream, list(range(24)))
    assert names(notes) == ["scans_out_of_order"]


@each("stamp_ns", [0, 10**18 + 5 * 10**10, 10**18 + 12 * 10**8, 10**18 + 3 * 10**8, 2**62])
def test_a_scan_with_a_wrong_stamp_is_left_out(tmp_path, stamp_ns):
    arrays = scan_of(np.arange(24))
    arrays["stamps_ns"][7] = stamp_ns
    stream, notes = read(tmp_path, arrays)
    expect(stream, [*range(7), *range(8, 24)])
    assert (
        f"1 of 24 scans have a stamp that does not fit their neighbours' and were removed, the first at {stamp_ns} ns"
        in (notes[0])
    )


@each("jitter_ns", [0, 10**6])
@each("late_ns", [3 * 10**7, -2 * 10**7])
def test_a_scan_stamped_too_early_or_too_late_is_left_out(tmp_path, jitter_ns, late_ns):
    arrays = scan_of(np.arange(24))
    arrays["stamps_ns"] += (jitter_ns * np.random.default_rng(0).normal(size=24)).astype(np.int64)
    arrays["stamps_ns"][7] += late_ns
    stream, notes = read(tmp_path, arrays)
    assert stream.stamps_ns.tolist() == np.delete(arrays["stamps_ns"], 7).tolist()
    assert "1 of 24 scans are stamped more than 5% of a period too early or too late relative to" in notes[0]


@each("kind", ["late", "lost", "cut at packets"])
def test_stamps_of_arrival_are_made_even_and_those_of_scans_that_differ_in_length_are_not(tmp_path, kind):
    """Scans that begin with a packet are as long as the time to the next one, so their stamps are true."""
    rng = np.random.default_rng(1)
    number = np.delete(np.arange(200), [20, 70, 71, 120] if kind == "lost" else [])
    n = len(number)
    true = 10**18 + 10**8 * number
    arrays: dict[str, Any] = {"stamps_ns": true.copy(), "start": 10 * np.arange(n + 1)}
    arrays["offset_s"] = np.tile(MANY["offset_s"][:10], n)
    arrays["xyz"] = rng.uniform(1, 9, (10 * n, 3)).astype(np.float32)
    if kind == "cut at packets":
        early = rng.integers(0, 3, n) * 1_300_000
        arrays["stamps_ns"] = true - early
        longer = np.repeat(np.diff(early, append=early[-1]) * -1e-8, 10)
        arrays["offset_s"] = (arrays["offset_s"] * (1.0 + longer)).astype(np.float32)
    else:
        arrays["stamps_ns"] = true + rng.exponential(3e6, len(true)).astype(np.int64)
    stream, notes = read(tmp_path, arrays)
    if kind == "cut at packets":
        assert stream.stamps_ns.tolist() == arrays["stamps_ns"].tolist() and notes == ()
    else:
        assert np.ptp(stream.stamps_ns - true) < 2e5
        assert "the stamps jitter by" in notes[0] and "made even at 10.00 Hz" in notes[0]


@each("case", ["jitter", "lost", "sector", "uneven"])
def test_stamps_that_are_no_faults(tmp_path, case):
    """Stamps of a driver that jitters; lost scans; a sector without returns, where a clock of the points begins later;
    scans at two periods by turns."""
    arrays = scan_of(np.arange(24))
    if case == "jitter":
        arrays["stamps_ns"] += (4e6 * np.random.default_rng(0).normal(size=24)).astype(np.int64)
    elif case == "lost":
        arrays = scan_of(np.delete(np.arange(24), [7, 12, 13]))
    elif case == "sector":
        kept = np.delete(np.arange(240), range(70, 74))
        arrays = {**arrays, "start": np.array([10 * k - 4 * (k > 7) for k in range(25)]), "xyz": arrays["xyz"][kept]}
        arrays["offset_s"] = arrays["offset_s"][kept]
        arrays["offset_s"][70:76] -= np.float32(0.044)
        arrays["stamps_ns"][7] += 44_000_000
    else:
        arrays["stamps_ns"][1::2] += 30_000_000
    stream, notes = read(tmp_path, arrays)
    assert stream.stamps_ns.tolist() == arrays["stamps_ns"].tolist() and notes == ()


@each("i", [0, 7, 23])
@each("stamp_ns", [0, 10**18 + 10**15, 10**18 - 3 * 10**12])
def test_a_wrong_stamp_is_no_jump_of_the_clock(tmp_path, i, stamp_ns):
    """Nor is it at the ends."""
    arrays = scan_of(np.arange(24))
    arrays["stamps_ns"][i] = stamp_ns
    write_imu(tmp_path)
    read(tmp_path, arrays)
    (tmp_path / "rig.yaml").write_text("sensors:\n  imu0: {type: imu}\n  lidar0: {type: lidar}\n")
    found = read_measurements(open_recording(tmp_path), load_rig(tmp_path / "rig.yaml"))
    expect(found.lidars[0], [k for k in range(24) if k != i])
    assert "1 of 24 scans" in named("scan_stamps_wrong", found.notes)


def test_a_clock_of_scans_that_jumps(tmp_path):
    """The longer part is used."""
    arrays = scan_of(np.arange(24))
    arrays["stamps_ns"][9:] += 10**15
    write_imu(tmp_path)
    read(tmp_path, arrays)
    (tmp_path / "rig.yaml").write_text("sensors:\n  imu0: {type: imu}\n  lidar0: {type: lidar}\n")
    found = read_measurements(open_recording(tmp_path), load_rig(tmp_path / "rig.yaml"))
    assert found.lidars[0].stamps_ns.tolist() == arrays["stamps_ns"][9:].tolist()
    assert "recording_clock_jumps" in names(found.notes)


def write_imu(folder: Path):
    (folder / "imu0").mkdir()
    rows = np.random.default_rng(0).normal(size=(300, 6)) + [0, 0, 0, 0, 0, 9.81]
    lines = (f"{10**18 + k * 10**7}," + ",".join(f"{v:.6f}" for v in row) for k, row in enumerate(rows))
    (folder / "imu0" / "data.csv").write_text("\n".join(lines) + "\n")


def test_a_scan_far_from_its_stamp_is_left_out(tmp_path):
    arrays = scan_of(np.arange(24))
    arrays["offset_s"][70:80] += 4.3
    stream, notes = read(tmp_path, arrays)
    expect(stream, [*range(7), *range(8, 24)])
    words = "1 of 24 scans have points that are far from their stamp and were left out, the first at"
    assert f"{words} {10**18 + 7 * 10**8} ns" in notes[0]


def test_a_lidar_that_froze_is_refused(tmp_path):
    arrays = scan_of(np.zeros(24, np.int64), stamps_ns=MANY["stamps_ns"])
    with pytest.raises(RecordingError, match="all scans are the same; the LiDAR or its driver froze"):
        read(tmp_path, arrays)


def test_a_refusal_says_what_was_repaired_before(tmp_path, capsys):
    """On standard output; the sentence itself stays alone. A rest of few points calibrates nothing."""
    read(tmp_path, GOOD | {"offset_s": GOOD["offset_s"] * 1e3})
    write_imu(tmp_path)
    (tmp_path / "rig.yaml").write_text("sensors:\n  imu0: {type: imu}\n  lidar0: {type: lidar}\n")
    command = [
        "calibrate",
        str(tmp_path / "rig.yaml"),
        str(tmp_path),
        "-o",
        str(tmp_path.parent / f"{tmp_path.name}_out"),
    ]
    assert main(command) == 1
    out, error = capsys.readouterr()
    assert "Note: " in out and "they are read as ms, the only unit that fits" in out
    assert error.count("\n") == 1 and "0 of 4 usable scans have 100 points or more, and 20 are needed" in error
    assert main([*command, "--quiet"]) == 1
    assert capsys.readouterr().out == ""


def test_files_that_are_none(tmp_path):
    read(tmp_path, GOOD)
    path = tmp_path / "lidar0" / "scans.npz"
    content = path.read_bytes()
    for damaged, words in (
        (b"hello", "is not a file of arrays"),
        (content[: len(content) // 2], "is not a file of arrays"),
        (content.replace(b"\x93NUMPY", b"\x93NUMBY"), "cannot be read"),
        (content[:2000] + bytes(300) + content[2300:], "cannot be read"),
    ):
        path.write_bytes(damaged)
        with pytest.raises(RecordingError, match=words):
            scans(FolderRecording(tmp_path), LIDAR)
    np.save(tmp_path / "lidar0" / "scans.npy", GOOD["xyz"])
    with pytest.raises(RecordingError, match="is not a file of arrays"):
        scans(FolderRecording(tmp_path), Lidar("lidar0", "lidar0/scans.npy"))


def test_there_are_no_scans_among_pictures(tmp_path):
    (tmp_path / "0001.png").write_bytes(b"")
    with pytest.raises(RecordingError, match="holds images without timestamps, and lidar0 needs them. Remove lidar0"):
        scans(open_recording(tmp_path), LIDAR)
