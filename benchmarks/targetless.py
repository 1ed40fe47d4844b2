"""From bags of a textured room without a target to calibrations: `python benchmarks/targetless.py FOLDER --seeds 8`.

Bags are kept in FOLDER (145 MB for each camera of 40 s at 10 Hz), so that only the first run renders. Each is
calibrated from nothing by `icalib.calibrate`, the lens free and unknown, or with `--lens guess` given 3 % off.
`--tracks` compares what the tracker finds with where the tracked points of the surfaces truly are; `--command` measures
time and memory of the whole command, in a process of its own. Needs icalib[bags,images].
"""

from __future__ import annotations

import argparse
import dataclasses
import sys
import tempfile
import time
from pathlib import Path

import numpy as np
import yaml
from memory import calibrated, in_a_process
from rendered import errors
from track_errors import print_track_errors

import icalib
from icalib.errors import CalibrationError
from icalib.rig import Parameter, Rig, Settings
from icalib.rig.file import rig_to_dict
from icalib.tools.montecarlo.record import compare
from icalib.tools.montecarlo.summary import Sample, nees
from icalib.tools.simulation import ImageFaults, Scenario, Simulation, load_scenario, rig_for, simulate, write_sensors

PAPER = Path(__file__).parents[1] / "examples" / "paper"
KINDS = ("free", "lidar", "wheels", "stereo", "robot")
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
    rig, seeds = rig_of(scenario, options.lens), range(options.first, options.first + options.seeds)
    if options.command and not options.render:
        return max(_command(rig, options, seed) for seed in seeds)
    rows: dict[str, list[np.ndarray]] = {camera.name: [] for camera in scenario.cameras}
    whole: list[Sample] = []
    head = "".join(f"{unit:>10}{'/ sigma':>9}" for unit in UNITS)
    if not options.tracks and not options.render:
        print(f"{'seed camera':<14}{head}{'NEES':>8}{'cpu s':>8}{'s':>7}   converged", flush=True)
    for seed in seeds:
        simulation, path = simulate(scenario, seed), _path(options, seed)
        if not path.exists():
            write_sensors(simulation, seed, path)
        if options.tracks:
            print_track_errors(simulation, rig, path)
        elif not options.render:
            _calibrated(rig, simulation, path, seed, rows, whole)
    if whole:
        _summary(options.kind, rows, whole)
    return 0


def _command(rig: Rig, options: argparse.Namespace, seed: int) -> int:
    """`icalib calibrate` on one bag, which another process renders: a process starts with the peak memory of the one
    that starts it."""
    path = _path(options, seed)
    if not path.exists():
        in_a_process([__file__, *sys.argv[1:], "--render", "--first", str(seed), "--seeds", "1"], {})
    with tempfile.TemporaryDirectory() as folder:
        file = Path(folder) / "rig.yaml"
        file.write_text(yaml.safe_dump(rig_to_dict(rig), sort_keys=False), encoding="utf-8")
        done = calibrated(file, path)
    used = f"{done.cpu_seconds:.1f} s of the processor, {done.seconds:.1f} s on the clock, {done.peak_mb:.0f} MB"
    print(f"{path.name}: {used}, exit code {done.code}", flush=True)
    return done.code


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
        fx = abs(intrinsics.value[0] - simulation.truth.values[camera]["intrinsics"][0])
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
    only = parser.add_mutually_exclusive_group()
    only.add_argument("--tracks", action="store_true", help="errors of the tracks, without calibration")
    only.add_argument("--command", action="store_true", help="time and memory of the command `icalib calibrate`")
    parser.add_argument("--render", action="store_true", help=argparse.SUPPRESS)
    return parser.parse_args()


def scenario_of(kind: str, duration_s: float, rate_hz: float) -> Scenario:
    """One camera and the IMU of the paper in free motion; two such cameras, side by side; one over ramps, with the
    LiDAR or the wheels of the paper's robot; or all of that robot, its cameras at their rates (20, 10 and 10 Hz)."""
    name = "table2-3d" if kind in ("free", "stereo") else "table2-ramp"
    base = load_scenario(PAPER / f"{name}.yaml")
    camera = dataclasses.replace(base.cameras[0], rate_hz=rate_hz)
    cameras = [camera]
    if kind == "stereo":
        aside = np.eye(4)
        aside[0, 3] = BASELINE_M
        other = dataclasses.replace(
            base.cameras[1], T_imu_sensor=camera.T_imu_sensor @ aside, rate_hz=rate_hz, phase_s=0.0
        )
        cameras.append(other)
    if kind == "robot":
        cameras = list(base.cameras)
    return dataclasses.replace(
        base,
        duration_s=duration_s,
        cameras=tuple(cameras),
        features=None,
        sensors=tuple(s for s in base.sensors if kind in (s.sensor_type, "robot")),
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
    return rig.with_(cameras=tuple(cameras))


def _path(options: argparse.Namespace, seed: int) -> Path:
    faults = f"-{options.faults}" if options.faults else ""
    return options.folder / f"{options.kind}-{options.duration:g}s-{options.rate:g}Hz{faults}-{seed}.bag"


if __name__ == "__main__":
    sys.exit(main())
