"""Bad input through the command line: one sentence, exit code 1, no traceback, and an earlier result left whole."""

from __future__ import annotations

import dataclasses
import gzip
import re
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
import pytest
import yaml
from tests.typed import instance

from icalib import pipeline
from icalib.base.files import sealed
from icalib.cli import main
from icalib.errors import CalibrationError
from icalib.geometry import so3
from icalib.geometry.targets import AprilGrid
from icalib.pipeline import calibrate_measurements
from icalib.result import Calibration
from icalib.rig import Settings
from icalib.tools.simulation import handheld, rig_for, simulate

EXAMPLE = Path(__file__).parents[2] / "examples" / "euroc"
SECONDS = 10
DEGREES = 180.0 / np.pi


def stamp(line: str) -> int:
    return int(line.split(",", 1)[0])


def stamped(line: str, t: int) -> str:
    return f"{t},{line.split(',', 1)[1]}"


@dataclass
class Tables:
    """Lines of a small recording and its rig, to be broken."""

    imu: list[str]
    cam0: list[str]
    rig: str
    origin: int = field(init=False)

    def __post_init__(self) -> None:
        self.origin = stamp(self.imu[0])

    def seconds(self, line: str) -> float:
        return 1e-9 * (stamp(line) - self.origin)

    def write(self, folder: Path) -> tuple[Path, Path]:
        """Paths of the rig and the recording."""
        for name, lines in (("imu0/data.csv", self.imu), ("cam0/corners.csv", self.cam0)):
            path = folder / "recording" / name
            path.parent.mkdir(parents=True)
            path.write_text("\n".join(["t,header", *lines]) + "\n")
        (folder / "rig.yaml").write_text(self.rig)
        return folder / "rig.yaml", folder / "recording"

    def scale(self, columns: slice, factor: float) -> None:
        self.imu = [_scaled(line, columns, factor) for line in self.imu]


def _scaled(line: str, columns: slice, factor: float) -> str:
    cells = line.split(",")
    cells[columns] = [repr(float(x) * factor) for x in cells[columns]]
    return ",".join(cells)


GYRO, ACCEL = slice(1, 4), slice(4, 7)


def _lines(name: str) -> list[str]:
    text = gzip.decompress((EXAMPLE / "recording" / name).read_bytes()).decode()
    return [line for line in text.splitlines() if line[0].isdigit()]


@pytest.fixture(scope="module")
def excerpt() -> dict[str, list[str]]:
    return {"imu": _lines("imu0/data.csv.gz"), "cam0": _lines("cam0/corners.csv.gz")}


RIG = """\
sensors:
  imu0:
    type: imu
    noise: {gyro: 1.6968e-4, gyro_walk: 1.9393e-5, accel: 2.0e-3, accel_walk: 3.0e-3}
    intrinsics: fixed # the simulated IMU is ideal
  cam0:
    type: camera
    model: pinhole-radtan
    resolution: [752, 480]
    intrinsics: {fixed: [458.654, 457.296, 367.215, 248.375]}
    distortion: {fixed: [-0.28340811, 0.07395907, 0.00019359, 1.76187114e-05]}
target: {type: aprilgrid, rows: 6, cols: 6, tag_size: 0.088, tag_spacing: 0.3}
settings: {board_shape: false, segments: 0}
"""


@pytest.fixture
def tables(excerpt) -> Tables:
    """The first seconds of the excerpt."""
    end = stamp(excerpt["imu"][0]) + SECONDS * 10**9
    imu, cam0 = ([x for x in excerpt[k] if stamp(x) < end] for k in ("imu", "cam0"))
    return Tables(imu, cam0, RIG)


@pytest.fixture(scope="module")
def good(excerpt, tmp_path_factory) -> Calibration:
    end = stamp(excerpt["imu"][0]) + SECONDS * 10**9
    imu, cam0 = ([x for x in excerpt[k] if stamp(x) < end] for k in ("imu", "cam0"))
    return pipeline.calibrate(*Tables(imu, cam0, RIG).write(tmp_path_factory.mktemp("good")))


def run(tables: Tables, folder: Path, *more: str) -> int:
    rig, recording = tables.write(folder)
    return main(["calibrate", str(rig), str(recording), "--output", str(folder / "out"), *more])


def refusal(tables: Tables, folder: Path, capsys) -> str:
    """The sentence of a refused run. An earlier result in the folder is untouched."""
    earlier = folder / "out" / "calibration.yaml"
    earlier.parent.mkdir()
    earlier.write_bytes(sealed(b"earlier"))
    assert run(tables, folder) == 1
    captured = capsys.readouterr()
    assert captured.out == ""
    lines = captured.err.strip().splitlines()
    assert len(lines) == 1 and lines[0].startswith("icalib: "), captured.err
    assert [p.name for p in earlier.parent.iterdir()] == ["calibration.yaml"]
    assert earlier.read_bytes() == sealed(b"earlier")
    return lines[0]


def no_corners(t: Tables) -> None:
    t.cam0 = []


def one_frame(t: Tables) -> None:
    t.cam0 = [x for x in t.cam0 if stamp(x) == stamp(t.cam0[0])]


def unknown_tag(t: Tables) -> None:
    cells = t.cam0[100].split(",")
    t.cam0[100] = ",".join([cells[0], "36", *cells[2:]])


def nan_in_imu(t: Tables) -> None:
    t.imu[50] = _scaled(t.imu[50], ACCEL, np.nan)


def nan_in_corners(t: Tables) -> None:
    t.cam0[50] = _scaled(t.cam0[50], slice(3, 5), np.nan)


def imu_out_of_order(t: Tables) -> None:
    t.imu[100], t.imu[101] = t.imu[101], t.imu[100]


def images_out_of_order(t: Tables) -> None:
    first = [x for x in t.cam0 if stamp(x) == stamp(t.cam0[0])]
    t.cam0 = t.cam0[len(first) :] + first


def imu_stamp_with_two_readings(t: Tables) -> None:
    t.imu.insert(101, stamped(t.imu[101], stamp(t.imu[100])))


def corner_twice(t: Tables) -> None:
    t.cam0.insert(101, t.cam0[100])


def other_motion(t: Tables) -> None:
    """The IMU's readings backwards: another motion."""
    t.imu = [stamped(x, stamp(y)) for x, y in zip(reversed(t.imu), t.imu, strict=True)]


def motionless(t: Tables) -> None:
    rng = np.random.default_rng(0)
    noise = rng.normal(scale=[2e-3] * 3 + [2e-2] * 3, size=(len(t.imu), 6)) + [0, 0, 0, 9.0, 0, -3.9]
    t.imu = [f"{stamp(x)},{','.join(map(repr, map(float, n)))}" for x, n in zip(t.imu, noise, strict=True)]
    first = [x.split(",", 1)[1] for x in t.cam0 if stamp(x) == stamp(t.cam0[0])]
    t.cam0 = [f"{s},{x}" for s in sorted({stamp(x) for x in t.cam0}) for x in first]


def degrees(t: Tables) -> None:
    t.scale(GYRO, DEGREES)


def slow_degrees(t: Tables) -> None:
    """So slow that the numbers alone could be rad/s: time stretched fivefold."""
    t.scale(GYRO, DEGREES / 5.0)
    t.imu = [stamped(x, t.origin + 5 * (stamp(x) - t.origin)) for x in t.imu]
    t.cam0 = [stamped(x, t.origin + 5 * (stamp(x) - t.origin)) for x in t.cam0]


def degrees_from_radians(t: Tables) -> None:
    t.scale(GYRO, 1.0 / DEGREES)


def units_of_g(t: Tables) -> None:
    t.scale(ACCEL, 1.0 / 9.80665)


def stamps_in_microseconds(t: Tables) -> None:
    t.imu = [stamped(x, stamp(x) // 1000) for x in t.imu]


def tag_size_halved(t: Tables) -> None:
    t.rig = t.rig.replace("0.088", "0.044")


def other_focal_length(t: Tables) -> None:
    t.rig = t.rig.replace("458.654, 457.296", "700.0, 700.0")


def mirrored_images(t: Tables) -> None:
    cells = [x.split(",") for x in t.cam0]
    t.cam0 = [",".join([*c[:3], repr(751.0 - float(c[3])), c[4]]) for c in cells]


def stopped_imu(t: Tables) -> None:
    t.imu = t.imu[:1]


def small_image(t: Tables) -> None:
    t.rig = t.rig.replace("[752, 480]", "[480, 752]")


BROKEN: list[tuple[Callable[[Tables], None], str]] = [
    (no_corners, r"cam0/corners\.csv"),
    (one_frame, r"cam0.* 1 .*image|cam0.*record"),
    (unknown_tag, r"corners\.csv.*36"),
    (imu_out_of_order, r"imu0/data\.csv.*comes after"),
    (images_out_of_order, r"cam0/corners\.csv.*after"),
    (corner_twice, r"cam0/corners\.csv.*(twice|two|again)"),
    (other_motion, r"cam0 does not match that of imu0"),
    (motionless, r"motionless"),
    (degrees, r"deg/s"),
    (slow_degrees, r"deg/s"),
    (degrees_from_radians, r"imu0 turns 0\.017"),
    (tag_size_halved, r"tag_size"),
    (other_focal_length, r"intrinsics|tag_size|focal"),
    (mirrored_images, r"cam0 would see the target from behind.*mirrored"),
    (stopped_imu, r"imu0/data\.csv.*only 1 reading"),
    (small_image, r"resolution"),
]


@pytest.mark.parametrize("damage, words", BROKEN)
def test_a_broken_recording_is_refused_in_one_sentence(tables, tmp_path, capsys, damage, words):
    damage(tables)
    assert re.search(words, refusal(tables, tmp_path, capsys))


def test_what_can_be_mended_is_mended_with_a_note(tables, tmp_path, capsys):
    for damage in (nan_in_imu, nan_in_corners, imu_stamp_with_two_readings, stamps_in_microseconds):
        damage(tables)
    rig, recording = tables.write(tmp_path)
    assert main(["calibrate", str(rig), str(recording), "-o", str(tmp_path / "out")]) == 0
    notes = yaml.safe_load((tmp_path / "out" / "calibration.yaml").read_text())["notes"]
    words = " ".join(sentence for note in notes for sentence in note.values())
    assert re.search(r"imu0/data\.csv:52: .*not a finite number; the line was left out", words)
    assert re.search(r"cam0/corners\.csv:52: .*the line was left out", words)
    assert re.search(r"imu0/data\.csv: the stamps are read as microseconds", words)


WRONG_RIGS = [
    ("type: imu", "type: gyroscope", r":3:.*gyroscope"),
    ("    resolution: [752, 480]\n", "", r"cam0.*resolution"),
    ("0.088", "eighty-eight", r":12:.*tag_size"),
    ("pinhole-radtan", "fisheye", r":8:.*fisheye"),
    ("fixed: [458.654,", "fixd: [458.654,", r":10:.*fixd"),
    ("segments: 0", "split: 0", r":13:.*split"),
    ("sensors:", "sensors: [", r"line"),
]


@pytest.mark.parametrize("old, new, words", WRONG_RIGS)
def test_a_wrong_rig_file_is_refused_in_one_sentence(tables, tmp_path, capsys, old, new, words):
    tables.rig = tables.rig.replace(old, new)
    sentence = refusal(tables, tmp_path, capsys)
    assert "rig.yaml" in sentence and re.search(words, sentence)


def test_truncated_gzip(tables, tmp_path, capsys):
    rig, recording = tables.write(tmp_path)
    plain = recording / "cam0" / "corners.csv"
    packed = gzip.compress(plain.read_bytes())
    plain.unlink()
    (recording / "cam0" / "corners.csv.gz").write_bytes(packed[: len(packed) // 2])
    assert main(["calibrate", str(rig), str(recording), "-o", str(tmp_path / "out")]) == 1
    assert re.fullmatch(r"icalib: .*corners\.csv\.gz.*\n", capsys.readouterr().err)


@pytest.mark.parametrize("missing", ["rig.yaml", "recording", "recording/imu0/data.csv"])
def test_missing_files(tables, tmp_path, capsys, missing):
    rig, recording = tables.write(tmp_path)
    (tmp_path / missing).rename(tmp_path / "elsewhere")
    assert main(["calibrate", str(rig), str(recording), "-o", str(tmp_path / "out")]) == 1
    assert re.fullmatch(rf"icalib: .*{Path(missing).name}.*\n", capsys.readouterr().err)


def test_output_that_is_a_file(tables, tmp_path, capsys):
    (tmp_path / "out").write_text("mine")
    assert run(tables, tmp_path) == 1
    assert re.fullmatch(r"icalib: .*out.*\n", capsys.readouterr().err)
    assert (tmp_path / "out").read_text() == "mine"


def test_splits_of_one(tables, tmp_path, capsys):
    assert run(tables, tmp_path, "--segments", "1") == 1
    assert "--segments" in capsys.readouterr().err


@pytest.mark.parametrize("stage", ["estimating the initial guess", "solving (final pass)", "writing"])
def test_an_interrupt_leaves_the_earlier_result(tables, tmp_path, capsys, monkeypatch, stage):
    import icalib.cli.console

    class Interrupting:
        def __init__(self, _quiet: bool) -> None: ...

        def __enter__(self):
            return self

        def __exit__(self, *_) -> None: ...

        def __call__(self, name: str, _done: float) -> None:
            if name == stage:
                raise KeyboardInterrupt

    (tmp_path / "out").mkdir()
    (tmp_path / "out" / "calibration.yaml").write_bytes(sealed(b"earlier"))
    monkeypatch.setattr(icalib.cli.console, "console_progress", Interrupting)
    assert run(tables, tmp_path) == 130
    assert re.fullmatch(r"icalib: interrupted.*\n", capsys.readouterr().err)
    assert [p.read_bytes() for p in (tmp_path / "out").iterdir()] == [sealed(b"earlier")]


# What is odd but usable: the result is still right.


def same(found: Calibration, good: Calibration, degrees: float, metres: float, seconds: float) -> None:
    assert found.converged, found.status
    R, S = (c.group("cam0", "rotation").value for c in (found, good))
    assert np.rad2deg(np.linalg.norm(so3.log(np.ascontiguousarray(R.T @ S)))) < degrees
    assert np.linalg.norm(found.T_imu_sensor("cam0")[:3, 3] - good.T_imu_sensor("cam0")[:3, 3]) < metres
    assert abs((found.group("cam0", "time_offset").value - good.group("cam0", "time_offset").value)[0]) < seconds


def calibrated(tables: Tables, folder: Path) -> Calibration:
    return pipeline.calibrate(*tables.write(folder))


def test_repeated_readings_are_dropped(tables, tmp_path, good):
    tables.imu.insert(101, tables.imu[100])
    found = calibrated(tables, tmp_path)
    assert any("repeated" in n for n in found.notes)
    same(found, good, 1e-6, 1e-8, 1e-9)


def test_units_of_g_are_recognised(tables, tmp_path, good):
    units_of_g(tables)
    found = calibrated(tables, tmp_path)
    assert any("accelerometer is in units of g" in n for n in found.notes), found.notes
    same(found, good, 1e-4, 1e-5, 1e-6)


def test_a_short_gap_in_the_imu_is_bridged(tables, tmp_path, good):
    tables.imu = [x for x in tables.imu if not 4.0 < tables.seconds(x) < 4.2]
    found = calibrated(tables, tmp_path)
    assert any(
        re.search(r"gap of 0\.20\d s at 3\.99\d s, bridged|gap of 0\.2\d+ s at [34]\.\d+ s, bridged", n)
        for n in found.notes
    ), found.notes
    same(found, good, 0.06, 3e-3, 1.2e-4)


def test_a_long_gap_in_the_imu_splits_the_recording(tables, tmp_path, good):
    tables.imu = [x for x in tables.imu if not 4.0 < tables.seconds(x) < 6.0]
    found = calibrated(tables, tmp_path)
    assert any(re.search(r"gap of (2\.0\d\d|1\.99\d) s.*left out", n) for n in found.notes), found.notes
    same(found, good, 0.06, 3e-3, 1.2e-4)
    assert not ((found.trajectory.seconds > 4.05) & (found.trajectory.seconds < 5.95)).any()
    corners = found.corner_residuals[0]
    image = np.repeat(corners.seconds, np.diff(corners.start))
    assert corners.rejected[(image > 4.05) & (image < 5.95)].all()


def test_an_imu_that_starts_after_the_first_image(tables, tmp_path, good):
    tables.imu = [x for x in tables.imu if tables.seconds(x) > 1.5]
    found = calibrated(tables, tmp_path)
    same(found, good, 0.06, 3e-3, 1.2e-4)
    assert any(re.search(r"images of cam0 are left out: imu0 was not running", n) for n in found.notes), found.notes


def test_clocks_with_other_origins_are_found(tables, tmp_path, good):
    tables.imu = [stamped(x, stamp(x) - tables.origin + 10**9) for x in tables.imu]
    found = calibrated(tables, tmp_path)
    shift = 1.0 - 1e-9 * tables.origin
    offset = good.group("cam0", "time_offset").value[0] + shift
    assert abs(found.group("cam0", "time_offset").value[0] - offset) < 1e-6


def test_clocks_that_never_overlap_with_a_fixed_offset(tables, tmp_path, capsys):
    tables.imu = [stamped(x, stamp(x) + 10**12) for x in tables.imu]
    tables.rig = tables.rig.replace("resolution: [752, 480]", "resolution: [752, 480]\n    time_offset: {fixed: 0}")
    assert re.search(
        r"fixed value of time offset of cam0, 0 ms, contradicts the data", refusal(tables, tmp_path, capsys)
    )


def test_the_error_class_of_all_these_is_one(tables, tmp_path):
    no_corners(tables)
    with pytest.raises(CalibrationError):
        calibrated(tables, tmp_path)


def test_a_wrong_tag_spacing_is_warned_about():
    simulation = simulate(handheld(8.0), 1)
    rig = rig_for(simulation.scenario, settings=Settings(segments=0))
    target = instance(rig.target, AprilGrid)
    target = dataclasses.replace(target, tag_spacing=0.25, tag_size=target.tag_size * 1.3 / 1.25)
    found = calibrate_measurements(dataclasses.replace(rig, target=target), simulation.measurements)
    assert [w for w in found.warnings if "check tag_size and tag_spacing" in w]
