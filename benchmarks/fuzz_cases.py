"""The good inputs of the fuzzer, and which command runs on which of them once one was changed."""

from __future__ import annotations

import dataclasses
import os
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import yaml

from icalib.cli import main
from icalib.rig_file import rig_to_dict
from icalib.simulation import load_scenario, rig_for, simulate, write_sensors, write_tables

_IDENTITY = "[[1, 0, 0, 0.1], [0, 1, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]]"
_AHEAD = "[[0, 0, 1, 0.1], [-1, 0, 0, 0], [0, -1, 0, 0], [0, 0, 0, 1]]"
SCENARIO = f"""\
duration: 6
seed: 0
motion: {{kind: ramps}}
sensors:
  imu0:
    type: imu
    rate: 100
    noise: {{gyro: 1.7e-4, gyro_walk: 1.9e-5, accel: 2.0e-3, accel_walk: 3.0e-3}}
  cam0:
    type: camera
    rate: 10
    model: pinhole-radtan
    resolution: [320, 240]
    intrinsics: [200, 200, 160, 120]
    distortion: [0, 0, 0, 0]
    noise_px: 0.3
    T_imu_sensor: {_AHEAD}
  lidar0: {{type: lidar, rate: 5, rings: 16, azimuth_steps: 90, noise: 0.02, T_imu_sensor: {_IDENTITY}}}
  pose0: {{type: pose, rate: 20, rotation_noise: 0.002, position_noise: 0.002, T_imu_sensor: {_IDENTITY}}}
  wheel0: {{type: wheels, rate: 20, radii: [0.1, 0.1], baseline: 0.4, noise: 0.03, T_imu_sensor: {_IDENTITY}}}
room:
  size: [8, 6, 3]
  slope_deg: 5
target: {{type: aprilgrid, rows: 6, cols: 6, tag_size: 0.3, tag_spacing: 0.3, T_world_board: {_IDENTITY}}}
"""
_QUIET = ("--splits", "0", "-q")
_OUT = ("-o", "made")
_EXPORTS = ("kalibr", "openvins", "vins-fusion", "ros2-static", "camera-info", "urdf", "mins", "fast-lio", "json")

# What is changed (a pattern below the workspace), how often, and what may run on it.
_INSPECT = ("inspect", "rec", "--json", "made.json", "-q")
_KINDS: dict[str, tuple[tuple[str, ...], float, tuple[tuple[str, ...], ...]]] = {
    "rig": (("pose.yaml", "cam.yaml", "lidar.yaml"), 3.0, (
        ("calibrate", "{file}", "rec", *_OUT, *_QUIET), ("inspect", "rec", "--target", "{file}", "-q"),
        ("compare", "{file}", "pose.yaml", "-q"),
    )),
    "table": (("rec/imu0/*", "rec/cam0/*", "rec/pose0/*", "rec/wheel0/*", "rec/lidar0/*"), 4.0, (
        _INSPECT,  ("calibrate", "pose.yaml", "rec", *_OUT, *_QUIET),
        ("calibrate", "cam.yaml", "rec", *_OUT, *_QUIET), ("calibrate", "lidar.yaml", "rec", *_OUT, *_QUIET),
    )),
    "still": (("still/imu0/*",), 1.0, (
        ("allan", "still", *_OUT, "-q"), ("inspect", "still", "--json", "made.json", "-q"),
    )),
    "bag": (("run.bag", "run/*.mcap", "run/metadata.yaml", "db/*.db3"), 3.0, (
        ("inspect", "{top}", "--rig", "made.yaml", "--json", "made.json", "-q"), ("allan", "{top}", *_OUT, "-q"),
        ("calibrate", "pose.yaml", "{top}", *_OUT, *_QUIET),
    )),
    "picture": (("pictures/*",), 1.0, (("inspect", "pictures", "--target", "cam.yaml", "--json", "made.json", "-q"),)),
    "scenario": (("scenario.yaml",), 2.0, (
        ("simulate", "{file}", *_OUT, "-q"), ("simulate", "{file}", "-o", "made.bag", "--level", "sensor", "-q"),
    )),
    "result": (("out/*",), 4.0, (
        ("compare", "out", "good-out", "--json", "made.json", "-q"), ("view", "out", "--save", "made.rrd", "-q"),
        ("view", "out", "rec", "--save", "made.rrd", "-q"),
        *((("export", "out", "--to", to, *_OUT, "-q")) for to in _EXPORTS),
        ("calibrate", "pose.yaml", "none", "-o", "out", "-q"),
    )),
    "jobs": (("jobs.yaml",), 0.3, (("fleet", "{file}", *_OUT, "--workers", "1", "-q"),)),
    "others": (("kalibr/*", "robot.urdf"), 2.0, (
        ("compare", "{file}", "good-out", "-q"), ("inspect", "rec", "--target", "{file}", "-q"),
        ("export", "good-out", "--to", "urdf", "--urdf", "{file}", "-o", "made.urdf", "-q"),
        ("inspect", "kalibr/rec", "--json", "made.json", "--rig", "made.yaml", "-q"),
    )),
}  # fmt: skip


@dataclass(frozen=True)
class Case:
    """One change and one command. file: what is changed, below the workspace."""

    seed: int
    number: int
    kind: str
    file: str
    command: tuple[str, ...]

    def rng(self) -> np.random.Generator:
        return np.random.default_rng([self.seed, self.number, 1])

    def described(self) -> str:
        return f"{self.kind} {self.file}: icalib {' '.join(self.command)}"


def case_of(seed: int, number: int, good: Path) -> Case:
    """The case of this number."""
    rng = np.random.default_rng([seed, number, 0])
    weights = np.array([weight for _, weight, _ in _KINDS.values()])
    kind = str(rng.choice(list(_KINDS), p=weights / weights.sum()))
    patterns, _, commands = _KINDS[kind]
    files = sorted(p for pattern in patterns for p in good.glob(pattern) if p.is_file())
    file = str(files[int(rng.integers(len(files)))].relative_to(good))
    command = commands[int(rng.integers(len(commands)))]
    return Case(seed, number, kind, file, tuple(a.format(file=file, top=file.split("/")[0]) for a in command))


def good_workspace(folder: Path) -> Path:
    """Small inputs of all kinds in `folder`, all of which are good."""
    folder.mkdir(parents=True)
    (folder / "scenario.yaml").write_text(SCENARIO)
    scenario = load_scenario(folder / "scenario.yaml")
    made = simulate(scenario, 0)
    write_tables(made, 0, folder / "rec")
    _write_rigs(folder, rig_for(scenario))
    _write_bags(folder, made)
    _write_pictures(folder / "pictures")
    _write_still(folder / "still" / "imu0")
    before = Path.cwd()
    os.chdir(folder)
    try:
        for out in ("out", "good-out"):
            assert main(["calibrate", "pose.yaml", "rec", "-o", out, *_QUIET]) == 0
        assert main(["export", "good-out", "--to", "urdf", "-o", "robot.urdf", "-q"]) == 0
    finally:
        os.chdir(before)
    (folder / "kalibr" / "rec" / "imu0").mkdir(parents=True)
    (folder / "kalibr" / "rec" / "imu0" / "data.csv").write_bytes((folder / "rec/imu0/data.csv").read_bytes())
    (folder / "kalibr" / "imu.yaml").write_bytes((folder / "good-out" / "imu.yaml").read_bytes())
    (folder / "kalibr" / "camchain.yaml").write_text(
        f"cam0:\n  camera_model: pinhole\n  distortion_model: radtan\n  intrinsics: [200, 200, 160, 120]\n"
        f"  distortion_coeffs: [0, 0, 0, 0]\n  resolution: [320, 240]\n  rostopic: /cam0/image_raw\n"
        f"  T_cam_imu: {_IDENTITY}\n"
        "  timeshift_cam_imu: 0.0\n"
    )
    (folder / "kalibr" / "april.yaml").write_text(
        "target_type: aprilgrid\ntagCols: 6\ntagRows: 6\ntagSize: 0.3\ntagSpacing: 0.3\n"
    )
    (folder / "jobs.yaml").write_text(
        "defaults: {rig: pose.yaml}\njobs:\n  - {robot: a, recording: none}\n  - {robot: b, recording: [none, gone], "
        "name: second, time: 2026-01-02}\n"
    )
    return folder


def _write_rigs(folder: Path, rig: object) -> None:
    plain = rig_to_dict(rig)  # type: ignore[arg-type]
    sensors = plain["sensors"]
    sensors["cam0"] |= {"intrinsics": {"guess": [201.0, 199.0, 160.0, 121.0]}, "distortion": {"guess": [0.0] * 4}}
    for name, kept in {
        "pose": ("imu0", "pose0"),
        "cam": ("imu0", "cam0"),
        "lidar": ("imu0", "lidar0", "wheel0"),
    }.items():
        one = plain | {"sensors": {key: sensors[key] for key in kept}}
        if name != "cam":
            one = {key: value for key, value in one.items() if key not in ("target", "targets")}
        (folder / f"{name}.yaml").write_text(yaml.safe_dump(one, sort_keys=False))


def _write_bags(folder: Path, made: object) -> None:
    """Without images, which would be rendered."""
    scenario = dataclasses.replace(made.scenario, board=False, cameras=())  # type: ignore[attr-defined]
    blind = dataclasses.replace(made, scenario=scenario)  # type: ignore[type-var]
    for name in ("run.bag", "run"):
        write_sensors(blind, 0, folder / name)  # type: ignore[arg-type]
    _write_database(folder / "db", folder / "run.bag")


def _write_database(folder: Path, bag: Path) -> None:
    """The readings of the bag's IMU as a database of ROS 2."""
    from icalib.measurements import ImuStream
    from icalib.recordings import open_recording
    from icalib.rig import ImuSensor
    from icalib.simulation.bag_writer import IMU, IMU_TOPIC, BagWriter

    stream = open_recording(bag).imu(ImuSensor("imu0", "", noise=None))  # type: ignore[arg-type]
    assert isinstance(stream, ImuStream)
    with BagWriter("sqlite3", folder, {IMU_TOPIC: IMU}) as writer:
        for stamp_ns, w, f in zip(stream.stamps_ns.tolist(), stream.gyro.tolist(), stream.accel.tolist(), strict=True):
            writer.write(IMU_TOPIC, writer.imu(stamp_ns, w + f), stamp_ns)


def _write_still(folder: Path) -> None:
    """Readings of an IMU that lies on a table for 30 s."""
    folder.mkdir(parents=True)
    values = np.random.default_rng(0).normal([0.0] * 5 + [9.81], [1e-3] * 3 + [1e-2] * 3, (1500, 6))
    rows = (
        f"{1_700_000_000_000_000_000 + k * 20_000_000},{','.join(map(repr, v))}" for k, v in enumerate(values.tolist())
    )
    (folder / "data.csv").write_text("\n".join(rows) + "\n")


def _write_pictures(folder: Path) -> None:
    import cv2

    folder.mkdir()
    rng = np.random.default_rng(0)
    for k, suffix in enumerate((".png", ".jpg", ".bmp")):
        image = cv2.resize(rng.integers(0, 255, (12, 16), dtype=np.uint8), (320, 240), interpolation=cv2.INTER_NEAREST)
        cv2.imwrite(str(folder / f"{k:04d}{suffix}"), image)
