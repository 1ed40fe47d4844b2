"""The calibrations of the golden record: each gives a rig and its measurements."""

from __future__ import annotations

import tempfile
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np

from icalib.data.measurements import Measurements
from icalib.data.recordings import open_recording
from icalib.pipeline import measure
from icalib.rig import Rig
from icalib.rig.file import load_rig
from icalib.sensors.lidar.simulate import SimLidar
from icalib.tools.simulation import load_scenario, rig_for, simulate, with_drawn_guess

ROOT = Path(__file__).resolve().parent.parent
SEED, SECONDS = 1, 20.0
EPOCH_NS = 1_600_000_000_000_000_000
Case = Callable[[Path], tuple[Rig, list[Measurements]]]

STILLS = """
sensors:
  cam0: {type: camera, topic: images/*_0.jpg, model: pinhole-radtan5, resolution: [752, 480]}
  cam1: {type: camera, topic: images/*_1.jpg, model: pinhole-radtan5, resolution: [752, 480]}
target: {type: aprilgrid, rows: 6, cols: 6, tag_size: 0.088, tag_spacing: 0.3}
"""
WHEEL_MOCAP = """
sensors:
  mocap0: {type: pose, path: mocap0/poses.tum}
  wheel0: {type: wheels, measures: ticks, counts_per_turn: 2796.8, wheel_noise: 0.02}
"""


def _euroc(rig_file: str) -> Case:
    def case(data: Path) -> tuple[Rig, list[Measurements]]:
        return _measured(ROOT / "examples" / "euroc" / rig_file, data / "euroc_imu_april")

    return case


def _robot(motion: str, lidar_alone: bool = False) -> Case:
    """All sensors of the paper's robot, or its LiDAR and IMU; intrinsics of cameras are free."""

    def case(data: Path) -> tuple[Rig, list[Measurements]]:
        scenario = replace(load_scenario(ROOT / "examples" / "paper" / f"{motion}.yaml"), duration_s=SECONDS)
        if lidar_alone:
            scenario = replace(scenario, cameras=(), sensors=scenario.of(SimLidar), features=None)
        rig = rig_for(scenario, intrinsics="free", distortion="free")
        return with_drawn_guess(rig, scenario, SEED), [simulate(scenario, SEED).measurements]

    return case


def _stills(data: Path) -> tuple[Rig, list[Measurements]]:
    with tempfile.TemporaryDirectory() as folder:
        return _measured(_written(Path(folder) / "rig.yaml", STILLS), data / "aprilgrid_images")


def _wheel_mocap(data: Path) -> tuple[Rig, list[Measurements]]:
    """Encoder ticks and planar poses of a square, as tables."""
    (path,) = (data / "wheel_mocap").glob("diff/square/*/*_run-01.csv")
    with tempfile.TemporaryDirectory() as folder:
        write_wheel_tables(Path(folder), np.loadtxt(path, delimiter=","))
        return _measured(_written(Path(folder) / "rig.yaml", WHEEL_MOCAP), Path(folder))


def write_wheel_tables(folder: Path, rows: np.ndarray) -> None:
    """Tables of `wheel0` and `mocap0` from rows (n, 6): t [s], x, y [m], heading [rad], right and left ticks since the
    row before."""
    stamps = EPOCH_NS + np.round(rows[:, 0] * 1e9).astype(np.int64)
    ticks = np.cumsum(rows[:, 4:], axis=0).astype(np.int64)
    lines = [f"{t},{left},{right}" for t, (right, left) in zip(stamps, ticks, strict=True)]
    poses = [
        f"{t // 10**9}.{t % 10**9:09d} {x} {y} 0 0 0 {np.sin(0.5 * h)} {np.cos(0.5 * h)}"
        for t, (x, y, h) in zip(stamps, rows[:, 1:4], strict=True)
    ]
    _written(folder / "wheel0" / "ticks.csv", "\n".join(["#timestamp [ns],left,right", *lines]) + "\n")
    _written(folder / "mocap0" / "poses.tum", "\n".join(poses) + "\n")


def _measured(rig_file: Path, recording: Path) -> tuple[Rig, list[Measurements]]:
    rig = load_rig(rig_file)
    return rig, measure(rig, open_recording(recording))


def _written(path: Path, text: str) -> Path:
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(text, encoding="utf-8")
    return path


CASES: dict[str, Case] = {
    "euroc": _euroc("rig.yaml"),
    "euroc-equidistant": _euroc("rig-equidistant.yaml"),
    "euroc-from-nothing": _euroc("rig-from-nothing.yaml"),
    "table2-3d": _robot("table2-3d"),
    "table2-planar": _robot("table2-planar"),
    "table2-ramp": _robot("table2-ramp"),
    "lidar": _robot("table2-3d", lidar_alone=True),
    "wheel-mocap": _wheel_mocap,
    "stills": _stills,
}
