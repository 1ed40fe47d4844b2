"""A differential drive with encoders under motion capture, without an IMU, from tables as a user has them.

Heading and position are planar. Encoders are those of the motors: 64 counts a turn, gears of 43.7. The makers of the
recording state wheels of 84 mm and a baseline of 200 mm, "within about 1 %".
"""

from __future__ import annotations

from collections.abc import Callable
from functools import cache
from pathlib import Path
from types import ModuleType

import numpy as np
import pytest

import icalib
from icalib.errors import EstimationError
from icalib.result import Calibration, joint_covariance

NOMINAL = np.array([0.042, 0.042, 0.2])  # left and right radius, baseline
COUNTS = 64 * 43.7
RIG = f"""
sensors:
  mocap0: {{type: pose, path: mocap0/poses.tum}}
  wheel0: {{type: wheels, measures: ticks, counts_per_turn: {COUNTS}, wheel_noise: 0.02}}
"""


def run(folder: Path, name: str) -> np.ndarray:
    """(n, 6): t [s], x, y [m], heading [rad], right and left ticks of each 50 ms."""
    kind, _, number = name.rpartition("-")
    (path,) = folder.glob(f"diff/{kind}/*/*_run-{number}.csv")
    return np.loadtxt(path, delimiter=",")


@pytest.fixture(scope="module")
def record(benchmark_program: Callable[[str], ModuleType]) -> Callable[[Path, np.ndarray], Path]:
    """Writes a recording of tables, as the golden record has them, and its rig file beside it."""

    def write(folder: Path, rows: np.ndarray) -> Path:
        benchmark_program("golden_cases").write_wheel_tables(folder, rows)
        (folder / "rig.yaml").write_text(RIG)
        return folder

    return write


def turned(rows: np.ndarray, drive: np.ndarray) -> float:
    """Degrees that the wheels say too many at the end."""
    right, left = 2.0 * np.pi / COUNTS * rows[:, 4:].sum(axis=0)
    heading = np.unwrap(rows[:, 3])
    return float(np.rad2deg((drive[1] * right - drive[0] * left) / drive[2] - (heading[-1] - heading[0])))


def drive_of(result: Calibration) -> tuple[np.ndarray, np.ndarray]:
    groups = [result.group("wheel0", name) for name in ("radii", "baseline")]
    return np.concatenate([g.value for g in groups]), np.concatenate([g.std for g in groups])


RUNS = ("square-01", "square-02", "free-01")  # along squares, which are short, and the free one
EACH_RUN = [RUNS[0], *(pytest.param(name, marks=pytest.mark.full) for name in RUNS[1:])]


@pytest.fixture(scope="module")
def found(record, wheel_mocap: Path, tmp_path_factory) -> Callable[[str], Calibration]:
    """Calibrates a run, once."""

    @cache
    def result(name: str) -> Calibration:
        folder = record(tmp_path_factory.mktemp(name), run(wheel_mocap, name))
        return icalib.calibrate(folder / "rig.yaml", folder)

    return result


@pytest.mark.parametrize("name", EACH_RUN)
def test_a_run_gives_the_stated_drive_and_what_it_does_not_show(found, name):
    result = found(name)
    value, std = drive_of(result)
    assert result.converged and np.abs(value / NOMINAL - 1.0).max() < 0.015
    assert (std < [2e-4, 2e-4, 4.5e-3]).all()
    ratios = {f.kind: f.chi2_per_dof for f in result.fits if f.sensor == "wheel0"}
    assert 0.7 < ratios["wheels"] < 1.4, ratios
    assert result.group("wheel0", "rotation").verdict[0] == "unobservable"
    assert result.group("wheel0", "translation").verdict[2] == "unobservable"


@pytest.mark.full
def test_runs_agree(found):
    drives = {name: drive_of(found(name)) for name in RUNS}
    for a, b in zip(RUNS, RUNS[1:] + RUNS[:1], strict=True):
        (x, s), (y, t) = drives[a], drives[b]
        assert (np.abs(x - y) < 3.0 * np.hypot(s, t)).all(), (a, b, x - y, s, t)
        assert np.abs(x - y)[:2].max() < 1e-4 and abs(x - y)[2] < 1e-3


@pytest.mark.parametrize(
    ("made", "checked"),
    [
        ("square-01", "square-02"),
        *(pytest.param(*x, marks=pytest.mark.full) for x in (("square-02", "free-01"), ("free-01", "square-01"))),
    ],
)
def test_heading_at_the_end_of_another_run(found, wheel_mocap, made, checked):
    """It drifts less than by the stated geometry, and no more than the standard deviations allow for."""
    rows, result = run(wheel_mocap, checked), found(made)
    drive, _ = drive_of(result)
    stated, ours = turned(rows, NOMINAL), turned(rows, drive)
    assert abs(stated) > 2.0 and abs(ours) < 0.7 * abs(stated)
    by_drive = np.array([turned(rows, drive + 1e-6 * e) - turned(rows, drive - 1e-6 * e) for e in np.eye(3)]) / 2e-6
    P = joint_covariance(result, [result.group("wheel0", name) for name in ("radii", "baseline")])
    assert abs(ours) < 3.0 * np.sqrt(by_drive @ P @ by_drive)


@pytest.mark.full
def test_runs_together_with_an_offset_each(found, record, wheel_mocap, tmp_path):
    """They were aligned by hand, each by itself. Together they show the drive better than any does, and each the time
    offset that it shows alone."""
    names = RUNS
    folders = [record(tmp_path / name, run(wheel_mocap, name)) for name in names]
    rig = tmp_path / "rig.yaml"
    rig.write_text(RIG.replace("wheel_noise: 0.02", "wheel_noise: 0.02, clock_restarts: true"))
    together = icalib.calibrate(rig, folders)
    assert together.converged
    offsets = together.group("wheel0", "time_offset")
    assert offsets.labels == ("in recording 1", "in recording 2", "in recording 3")
    drive, std = drive_of(together)
    for k, name in enumerate(names):
        alone = found(name).group("wheel0", "time_offset")
        assert abs(offsets.value[k] - alone.value[0]) < 3.0 * np.hypot(offsets.std[k], alone.std[0])
        x, s = drive_of(found(name))
        assert (np.abs(drive - x) < 3.0 * np.hypot(std, s)).all()
    # Not so of the baseline: what it owes to the guess of how the wheels are tilted no further run makes less.
    formal = [found(name).group("wheel0", "radii").std_formal for name in names]
    assert (together.group("wheel0", "radii").std_formal < np.min(formal, axis=0)).all()


@pytest.mark.parametrize("name", ["circular-01", pytest.param("circular-02", marks=pytest.mark.full)])
def test_circles_alone_are_refused(record, wheel_mocap, tmp_path, name):
    """They show one ratio of radii and baseline."""
    folder = record(tmp_path / "recording", run(wheel_mocap, name))
    with pytest.raises(EstimationError, match="wheel0: the vehicle drove a single arc"):
        icalib.calibrate(folder / "rig.yaml", folder)
    rig = folder / "rig.yaml"
    rig.write_text(RIG.replace("wheel_noise: 0.02", "wheel_noise: 0.02, time_offset: {guess: 0}"))
    with pytest.raises(EstimationError, match="wheel0: the vehicle drove a single arc"):
        icalib.calibrate(rig, folder)
