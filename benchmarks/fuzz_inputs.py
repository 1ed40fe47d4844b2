"""The good inputs of the fuzzer: small recordings, rig files, results, and files of other programs."""

from __future__ import annotations

import contextlib
import dataclasses
import os
import shutil
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import yaml

from icalib.cli import main
from icalib.rig.file import rig_to_dict
from icalib.sensors.pose.simulate import SimPoses
from icalib.tools.simulation import (
    Scenario,
    Simulation,
    handheld,
    load_scenario,
    rig_for,
    simulate,
    write_sensors,
    write_tables,
)
from icalib.tools.simulation.output import IMU, IMU_TOPIC, BagForm, BagWriter

_AT = "[[1, 0, 0, 0.1], [0, 1, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]]"
_ABOVE = "[[1, 0, 0, 0.1], [0, 1, 0, 0], [0, 0, 1, 1.5], [0, 0, 0, 1]]"
_AHEAD = "[[0, 0, 1, 0.1], [-1, 0, 0, 0], [0, -1, 0, 0], [0, 0, 0, 1]]"
_SCENARIO = f"""\
duration: %g
seed: 0
motion: {{kind: ramps}}
sensors:
  imu0:
    type: imu
    rate: 100
    noise: {{gyro: 1.7e-4, gyro_walk: 1.9e-5, accel: 2.0e-3, accel_walk: 3.0e-3}}
  cam0:
    type: camera
    rate: %g
    model: pinhole-radtan
    resolution: [320, 240]
    intrinsics: [200, 200, 160, 120]
    distortion: [0, 0, 0, 0]
    noise_px: 0.3
    T_imu_sensor: {_AHEAD}
  lidar0: {{type: lidar, rate: 5, rings: 16, azimuth_steps: 90, noise: 0.02, T_imu_sensor: {_ABOVE}}}
  pose0: {{type: pose, rate: 20, rotation_noise: 0.002, position_noise: 0.002, T_imu_sensor: {_AT}}}
  wheel0: {{type: wheels, rate: 20, radii: [0.1, 0.1], baseline: 0.4, noise: 0.03, T_imu_sensor: {_AT}}}
room:
  size: [8, 6, 3]
  slope_deg: 2
target: {{type: aprilgrid, rows: 6, cols: 6, tag_size: 0.3, tag_spacing: 0.3, T_world_board: {_AT}}}
"""
QUIET = ("--segments", "0", "-q")
_DRIVE = {"pose": ("imu0", "pose0"), "lidar": ("imu0", "lidar0", "wheel0"), "mocap": ("pose0", "wheel0")}
_BOARD = {"cam": ("imu0", "cam0")}
_STOPS = {"hand": ("cam0", "pose0")}
# A result, the rig and the recording that it is of.
RESULTS = {"out": ("pose.yaml", "rec"), "cam-out": ("cam.yaml", "board"), "lidar-out": ("lidar.yaml", "rec")}
_START_NS = 1_700_000_000_000_000_000


def good_workspace(folder: Path) -> Path:
    """Small inputs of all kinds in `folder`, all of which are good: a drive, a camera that is waved before a board, a
    robot's hand that stops before it, an IMU at rest."""
    folder.mkdir(parents=True)
    (folder / "scenario.yaml").write_text(_SCENARIO % (1, 4))
    (folder / "drive.yaml").write_text(_SCENARIO % (6, 10))
    drive = simulate(load_scenario(folder / "drive.yaml"), 0)
    (folder / "drive.yaml").unlink()
    _write_recording(folder, "rec", drive, _DRIVE)
    _write_recording(folder, "board", simulate(_waved(), 0), _BOARD)
    _write_recording(folder, "stops", simulate(_stopping(), 0), _STOPS)
    _write_bags(folder, drive)
    _write_still(folder)
    _write_pictures(folder / "pictures")
    _write_jobs(folder)
    (folder / "kalibr").mkdir()
    with inside(folder):
        for name, inputs in RESULTS.items():
            succeed("calibrate", *inputs, "-o", name, *QUIET)
            if name != "out":
                Path(name, "report.html").unlink()  # large, and read by nothing
            shutil.copytree(name, f"good-{name}", ignore=shutil.ignore_patterns("report.html"))
        succeed("export", "out", "--to", "urdf", "-o", "robot.urdf", "-q")
        succeed("export", "cam-out", "--to", "kalibr", "-o", "kalibr", "-q")
    _write_kalibr(folder)
    return folder


def succeed(*command: str) -> None:
    """Runs a command in this process. Raises AssertionError where it does not end with exit code 0."""
    code = main(list(command))
    assert code == 0, f"icalib {' '.join(command)} on good input ended with {code}"


@contextlib.contextmanager
def inside(folder: Path) -> Iterator[None]:
    """With `folder` as the working directory."""
    before = Path.cwd()
    os.chdir(folder)
    try:
        with contextlib.redirect_stderr(sys.stdout):
            yield
    finally:
        os.chdir(before)


def _waved() -> Scenario:
    scenario = handheld(4.0)
    camera = dataclasses.replace(scenario.cameras[0], rate_hz=10.0)
    return dataclasses.replace(scenario, cameras=(camera,), imu_rate_hz=100.0)


def _stopping() -> Scenario:
    """An image and a pose a second."""
    scenario = handheld(11.8)
    clock = {"rate_hz": 1.0, "phase_s": 0.5, "time_offset_s": 0.0, "clock_origin_ns": _START_NS}
    camera = dataclasses.replace(scenario.cameras[0], **clock)
    mount = np.array(yaml.safe_load(_AT), dtype=float)
    poses = SimPoses("pose0", mount, rotation_noise=2e-3, position_noise=1e-3, **clock)
    return dataclasses.replace(scenario, cameras=(camera,), sensors=(poses,), imu_clock_origin_ns=_START_NS)


def _write_recording(folder: Path, name: str, made: Simulation, rigs: dict[str, tuple[str, ...]]) -> None:
    """Its tables, and a rig file for each of the groups of sensors; cameras have a rough lens."""
    write_tables(made, 0, folder / name)
    plain = rig_to_dict(rig_for(made.scenario))
    sensors: dict[str, Any] = plain["sensors"]
    for camera in made.scenario.cameras:
        lens = [1.005 * value for value in camera.intrinsics]
        sensors[camera.name] |= {"intrinsics": {"guess": lens}, "distortion": {"guess": list(camera.distortion)}}
    for rig, kept in rigs.items():
        one = plain | {"sensors": {key: sensors[key] for key in kept}}
        if "cam0" not in kept:
            one = {key: value for key, value in one.items() if key not in ("target", "targets")}
        (folder / f"{rig}.yaml").write_text(yaml.safe_dump(one, sort_keys=False))


def _write_bags(folder: Path, made: Simulation) -> None:
    """Without images, which would be rendered."""
    blind = dataclasses.replace(made, scenario=dataclasses.replace(made.scenario, board=False, cameras=()))
    for name in ("run.bag", "run"):
        write_sensors(blind, 0, folder / name)


def _write_still(folder: Path) -> None:
    """Readings of an IMU that lies on a table for 30 s, as a table and as bags."""
    values = np.random.default_rng(0).normal([0.0] * 5 + [9.81], [1e-3] * 3 + [1e-2] * 3, (1500, 6))
    stamps_ns = _START_NS + 20_000_000 * np.arange(len(values))
    rows = list(zip(stamps_ns.tolist(), values.tolist(), strict=True))
    (folder / "still" / "imu0").mkdir(parents=True)
    text = "".join(f"{stamp_ns},{','.join(map(repr, six))}\n" for stamp_ns, six in rows)
    (folder / "still" / "imu0" / "data.csv").write_text(text)
    bags: dict[str, BagForm] = {"quiet.bag": "ros1", "quiet": "mcap", "db": "sqlite3"}
    for name, form in bags.items():
        with BagWriter(form, folder / name, {IMU_TOPIC: IMU}) as writer:
            for stamp_ns, six in rows:
                writer.write(IMU_TOPIC, writer.imu(stamp_ns, six), stamp_ns)


def _write_pictures(folder: Path) -> None:
    import cv2

    folder.mkdir()
    rng = np.random.default_rng(0)
    for k, suffix in enumerate((".png", ".jpg", ".bmp")):
        image = cv2.resize(rng.integers(0, 255, (12, 16), dtype=np.uint8), (320, 240), interpolation=cv2.INTER_NEAREST)
        cv2.imwrite(str(folder / f"{k:04d}{suffix}"), image)


def _write_jobs(folder: Path) -> None:
    (folder / "jobs.yaml").write_text(
        "defaults: {rig: pose.yaml}\njobs:\n  - {robot: a, recording: rec}\n  - {robot: a, recording: rec, "
        "name: second, time: 2026-01-02}\n"
    )


def _write_kalibr(folder: Path) -> None:
    """A recording as Kalibr's bagcreater takes it, beside Kalibr's files."""
    (folder / "kalibr" / "imu0.csv").write_bytes((folder / "board/imu0/data.csv").read_bytes())
    (folder / "kalibr" / "pose0.csv").write_bytes((folder / "rec/pose0/poses.csv").read_bytes())
    (folder / "kalibr" / "april.yaml").write_text(
        "target_type: aprilgrid\ntagCols: 6\ntagRows: 6\ntagSize: 0.3\ntagSpacing: 0.3\n"
    )
