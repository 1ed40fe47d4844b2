"""From bags of rendered images to calibrations, against the truth: `python benchmarks/rendered.py FOLDER --seeds 8`.

Bags are kept in FOLDER (290 MB for each camera of 40 s), so that only the first run renders. Each is calibrated from
nothing by `icalib.calibrate`; then the first once more in a process of its own, whose corners nobody has kept, for the
time; `memory.py` measures the memory. Needs icalib[bags,images].
"""

from __future__ import annotations

import argparse
import dataclasses
import os
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import numpy as np

import icalib
from icalib.result import Calibration
from icalib.rig import Parameter, Rig, Settings
from icalib.sensors.imu.spec import FREE
from icalib.tools.simulation import Scenario, SimCamera, Truth, film, handheld, rig_for, simulate, tag_map, write_film

KINDS = ("pinhole", "fisheye", "stereo", "tags")
UNITS = ("deg", "mm", "us")
TARGETS = (0.010, 0.35, 7.0)  # RMS over the seeds at most, of the pinhole camera
TARGET_S = 10.0


def main() -> int:
    options = _options()
    if options.child:
        return _child(options)
    options.folder.mkdir(parents=True, exist_ok=True)
    scenario = scenario_of(options.kind, options.duration)
    rows: dict[str, list[np.ndarray]] = {camera.name: [] for camera in scenario.cameras}
    print(f"{'seed camera':<14}" + "".join(f"{u:>10}{'/ sigma':>9}" for u in UNITS) + "   converged", flush=True)
    for seed in range(options.first, options.first + options.seeds):
        path = _rendered(options, scenario, seed)
        result = icalib.calibrate(rig_of(scenario), path)
        truth = simulate(scenario, seed).truth
        for name, found in rows.items():
            found.append(errors(result, truth, name))
            print(f"{f'{seed} {name}':<14}{_line(found[-1])}   {result.converged}", flush=True)
    for name, found in rows.items():
        print(f"{f'RMS {name}':<14}{_line(np.sqrt(np.mean(np.square(found), axis=0)))}")
    if options.kind == "pinhole":
        print(f"{'at most':<14}" + "".join(f"{t:>10.4g}{'':>9}" for t in TARGETS))
    _end_to_end(options)
    return 0


def _options() -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folder", type=Path, metavar="FOLDER", help="where the bags are kept")
    parser.add_argument(
        "--kind", choices=KINDS, default="pinhole", help="the camera, two of an imperfect IMU, or a map of tags"
    )
    parser.add_argument("--seeds", type=int, default=8, metavar="N", help="recordings (8)")
    parser.add_argument("--first", type=int, default=0, metavar="SEED", help="the first of the seeds (0)")
    parser.add_argument("--duration", type=float, default=40.0, metavar="S", help="length of each recording (40)")
    parser.add_argument("--exposure", type=float, default=0.0, metavar="S", help="motion blur of this long (0)")
    parser.add_argument("--child", action="store_true", help=argparse.SUPPRESS)
    return parser.parse_args()


def scenario_of(kind: str, duration_s: float) -> Scenario:
    """EuRoC's cam0 and IMU; a fisheye in its place, nearer to the board; both cameras, the IMU 1 % wrong; or cam0 in a
    room with tags and a small grid, none of whose poses is known."""
    base = handheld(duration_s)
    cam0 = base.cameras[0]
    if kind == "tags":
        room = tag_map(duration_s, with_grid=True)
        return dataclasses.replace(room, cameras=(room.cameras[0],))
    if kind == "stereo":
        return dataclasses.replace(base, imu_intrinsics=imperfect_imu())
    if kind == "pinhole":
        return dataclasses.replace(base, cameras=(cam0,))
    fisheye: SimCamera = dataclasses.replace(
        cam0,
        model="pinhole-equidistant",
        intrinsics=(230.0, 229.5, 372.2, 241.4),
        distortion=(0.0035, 0.0007, -0.0021, 0.0002),
    )
    return dataclasses.replace(base, cameras=(fisheye,), motion=dataclasses.replace(base.motion, distance_m=0.6))


def imperfect_imu() -> np.ndarray:
    """(24,) of either sign: 1 % of scale and misalignment, 0.01 rad between the triads, 0.001 rad/s for each m/s^2."""
    size = np.repeat([0.01, 0.01, 0.001], [12, 3, 9])
    return size * np.random.default_rng(24).uniform(-1.0, 1.0, 24)


def rig_of(scenario: Scenario) -> Rig:
    """As a user would write it who knows the target, the models and the IMU's data sheet, and nothing else."""
    broad = Parameter("prior", np.zeros(24), FREE.sigma)  # what `free` means in a rig file
    imu = broad if scenario.imu_intrinsics.any() else Parameter("fixed")
    rig = rig_for(scenario, settings=Settings(), intrinsics="free", distortion="free", imu_intrinsics=imu)
    return rig.with_(cameras=tuple(dataclasses.replace(c, corner_noise_px=None) for c in rig.cameras))


def _path(options: argparse.Namespace, seed: int) -> Path:
    blur = f"-{options.exposure:g}s-exposure" if options.exposure else ""
    return options.folder / f"{options.kind}-{options.duration:g}s{blur}-{seed}.bag"


def _rendered(options: argparse.Namespace, scenario: Scenario, seed: int) -> Path:
    path = _path(options, seed)
    if not path.exists():
        part = path.with_suffix(".part")
        part.unlink(missing_ok=True)  # of a run that was interrupted
        write_film(film(scenario, seed, exposure_s=options.exposure), {"ros1": part})
        part.rename(path)
    return path


def errors(result: Calibration, truth: Truth, camera: str) -> np.ndarray:
    """(6,): errors of rotation [deg], translation [mm] and time offset [us], each before its ratio to the standard
    deviation that the result states."""
    T, true = result.T_imu_sensor(camera), truth.T_imu_sensor[camera]
    apart = true[:3, :3].T @ T[:3, :3]
    sine = 0.5 * np.linalg.norm([apart[2, 1] - apart[1, 2], apart[0, 2] - apart[2, 0], apart[1, 0] - apart[0, 1]])
    error = [
        np.arcsin(sine),
        np.linalg.norm(T[:3, 3] - true[:3, 3]),
        abs(result.group(camera, "time_offset").value[0] - truth.time_offset[camera]),
    ]
    std = [np.linalg.norm(result.group(camera, n).std) for n in ("rotation", "translation", "time_offset")]
    return np.stack([error * np.array([np.degrees(1.0), 1e3, 1e6]), np.divide(error, std)], axis=1).ravel()


def _line(row: np.ndarray) -> str:
    return "".join(f"{value:>10.4f}{ratio:>9.2f}" for value, ratio in row.reshape(-1, 2))


def _end_to_end(options: argparse.Namespace) -> None:
    """In a process of its own, twice: the second time nothing is compiled."""
    print(f"one bag, {os.cpu_count()} cores, load of all {os.getloadavg()[0]:.1f}; in a process of its own:")
    for kernels in ("perhaps compiling", "compiled"):
        with tempfile.TemporaryDirectory() as empty:
            started = time.perf_counter()
            command = [sys.executable, __file__, *sys.argv[1:], "--child"]
            done = subprocess.run(
                command, env=os.environ | {"ICALIB_CACHE": empty}, stdout=subprocess.PIPE, text=True, check=True
            )
            seconds = time.perf_counter() - started
        print(f"  {kernels:<18} {seconds:6.2f} s; {done.stdout.strip()}")
    print(f"  at most            {TARGET_S:6.2f} s")


def _child(options: argparse.Namespace) -> int:
    scenario = scenario_of(options.kind, options.duration)
    result = icalib.calibrate(rig_of(scenario), _path(options, options.first))
    stages = ", ".join(f"{stage} {seconds:.2f} s" for stage, seconds in result.timings.items())
    print(f"of all processors {time.process_time():.2f} s; {stages}")
    return 0


if __name__ == "__main__":
    sys.exit(main())
