"""From bags of a textured room without a target to calibrations: `python benchmarks/targetless.py FOLDER --seeds 8`.

Bags are kept in FOLDER (145 MB for each camera of 40 s at 10 Hz), so that only the first run renders. Each is
calibrated from nothing by `icalib.calibrate`, the lens free and unknown, or with `--lens guess` given 3 % off.
`--tracks` compares what the tracker finds with where the tracked points of the surfaces truly are. Needs
icalib[bags,images].
"""

from __future__ import annotations

import argparse
import dataclasses
import sys
import time
from pathlib import Path

import numpy as np
from rendered import errors
from track_errors import print_track_errors

import icalib
from icalib.errors import CalibrationError
from icalib.rig import Parameter, Rig, Settings
from icalib.tools.montecarlo.one_run import compare
from icalib.tools.montecarlo.statistics import Sample, nees
from icalib.tools.simulation import ImageFaults, Scenario, Simulation, load_scenario, rig_for, simulate, write_sensors

PAPER = Path(__file__).parents[1] / "examples" / "paper"
KINDS = ("free", "lidar", "wheels", "stereo")
UNITS = ("deg", "mm", "us", "fx px")
TARGETS = {"free": (0.025, 1.5, 30.0, 0.15), "lidar": (0.03, 2.0, 50.0), "wheels": (0.03, 2.0, 50.0)}  # RMS
GUESSED = 1.03  # focal lengths with --lens guess, over the true ones
BASELINE_M = 0.12  # of the two cameras of `stereo`


def main() -> int:
    options = _options()
    options.folder.mkdir(parents=True, exist_ok=True)
    scenario = scenario_of(options.kind, options.duration, options.rate)
    if options.faults:
        scenario = dataclasses.replace(scenario, image_faults=FAULTS[options.faults])
    rows: dict[str, list[np.ndarray]] = {camera.name: [] for camera in scenario.cameras}
    whole: list[Sample] = []
    head = "".join(f"{unit:>10}{'/ sigma':>9}" for unit in UNITS)
    if not options.tracks:
        print(f"{'seed camera':<14}{head}{'NEES':>8}{'cpu s':>8}{'s':>7}   converged", flush=True)
    for seed in range(options.first, options.first + options.seeds):
        simulation = simulate(scenario, seed)
        path = _rendered(options, simulation, seed)
        rig = rig_of(scenario, options.lens)
        if options.tracks:
            print_track_errors(simulation, rig, path)
        else:
            _calibrated(rig, simulation, path, seed, rows, whole)
    if whole:
        _summary(options.kind, rows, whole)
    return 0


def _calibrated(
    rig: Rig, simulation: Simulation, path: Path, seed: int, rows: dict[str, list[np.ndarray]], whole: list[Sample]
) -> None:
    """One recording: prints its rows, and adds them to `rows` and `whole`."""
    begun, clock = time.process_time(), time.perf_counter()
    try:
        result = icalib.calibrate(rig, path)
    except CalibrationError as error:
        print(f"{seed}: {error}", flush=True)
        return
    spent = time.process_time() - begun, time.perf_counter() - clock
    record = compare(seed, result, simulation.truth, [], spent[1])
    printed = np.concatenate([result.group(b.sensor, b.name).std for b in record.blocks])
    scale = printed / np.sqrt(np.diag(record.covariance))
    whole.append(Sample(seed, record.error, scale[:, None] * record.covariance * scale))
    share = nees(whole[-1:]).mean
    for camera, found in rows.items():
        intrinsics = result.group(camera, "intrinsics")
        fx = abs(intrinsics.value[0] - simulation.truth.intrinsics[camera][0])
        found.append(np.append(errors(result, simulation.truth, camera), [fx, fx / intrinsics.std[0]]))
        end = f"{share:>8.2f}{spent[0]:>8.1f}{spent[1]:>7.1f}   {result.converged}"
        print(f"{f'{seed} {camera}':<14}{_line(found[-1])}{end}", flush=True)


def _summary(kind: str, rows: dict[str, list[np.ndarray]], whole: list[Sample]) -> None:
    for camera, found in rows.items():
        print(f"{f'RMS {camera}':<14}{_line(np.sqrt(np.mean(np.square(found), axis=0)))}{nees(whole).mean:>8.2f}")
    if kind in TARGETS:
        print(f"{'at most':<14}" + "".join(f"{target:>10.4g}{'':>9}" for target in TARGETS[kind]))


def _line(row: np.ndarray) -> str:
    return "".join(f"{value:>10.4f}{ratio:>9.2f}" for value, ratio in row.reshape(-1, 2))


FAULTS = {
    "people": ImageFaults(people=2),
    "gain": ImageFaults(gain_steps=((5.0, 0.5), (11.0, 1.4), (17.0, 0.8))),
    "frozen": ImageFaults(frozen=((6.0, 6.5), (13.0, 14.0))),
    "robot": ImageFaults(robot_part=0.15),
    "dirt": ImageFaults(dirt=5),
}


def _options() -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folder", type=Path, metavar="FOLDER", help="where the bags are kept")
    parser.add_argument("--kind", choices=KINDS, default="free", help="camera and IMU in free motion, and what else")
    parser.add_argument("--lens", choices=("none", "guess"), default="none", help="guess: focal lengths 3 %% off")
    parser.add_argument("--seeds", type=int, default=8, metavar="N", help="recordings (8)")
    parser.add_argument("--first", type=int, default=0, metavar="SEED", help="the first of the seeds (0)")
    parser.add_argument("--duration", type=float, default=40.0, metavar="S", help="length of each recording (40)")
    parser.add_argument("--rate", type=float, default=10.0, metavar="HZ", help="images a second of each camera (10)")
    parser.add_argument("--faults", choices=tuple(FAULTS), help="what goes wrong with the images")
    parser.add_argument("--tracks", action="store_true", help="errors of the tracks, without calibration")
    return parser.parse_args()


def scenario_of(kind: str, duration_s: float, rate_hz: float) -> Scenario:
    """One camera and the IMU of the paper in free motion; two such cameras, side by side; or one over ramps, with the
    LiDAR or the wheels of the paper's robot."""
    name = "table2-3d" if kind in ("free", "stereo") else "table2-ramp"
    base = load_scenario(PAPER / f"{name}.yaml")
    camera = dataclasses.replace(base.cameras[0], rate_hz=rate_hz)
    cameras = [camera]
    if kind == "stereo":
        aside = np.eye(4)
        aside[0, 3] = BASELINE_M
        other = dataclasses.replace(base.cameras[1], T_imu_cam=camera.T_imu_cam @ aside, rate_hz=rate_hz, phase_s=0.0)
        cameras.append(other)
    return dataclasses.replace(
        base,
        duration_s=duration_s,
        cameras=tuple(cameras),
        features=None,
        lidars=base.lidars if kind == "lidar" else (),
        wheels=base.wheels if kind == "wheels" else (),
    )


def rig_of(scenario: Scenario, lens: str) -> Rig:
    """As a user would write it who knows the models and the IMU's data sheet, and at most roughly the focal lengths."""
    rig = rig_for(scenario, settings=Settings(), intrinsics="free", distortion="free")
    if lens == "none":
        return rig
    cameras = []
    for camera, true in zip(rig.cameras, scenario.cameras, strict=True):
        middle = [0.5 * (side - 1) for side in camera.resolution]
        guess = Parameter("free", np.array([*(GUESSED * f for f in true.intrinsics[:2]), *middle]))
        cameras.append(dataclasses.replace(camera, intrinsics=guess))
    return dataclasses.replace(rig, cameras=tuple(cameras))


def _rendered(options: argparse.Namespace, simulation: Simulation, seed: int) -> Path:
    """The bag of a seed, rendered where it is not yet there."""
    faults = f"-{options.faults}" if options.faults else ""
    path = options.folder / f"{options.kind}-{options.duration:g}s-{options.rate:g}Hz{faults}-{seed}.bag"
    if not path.exists():
        write_sensors(simulation, seed, path)
    return path


if __name__ == "__main__":
    sys.exit(main())
