"""Are standard deviations as large as errors? NEES of many short simulated recordings, by kind of sensor.

python benchmarks/nees.py [--first-seed N] [--rounds N] [--without-imu MINUTES] [--imus] [--boards N]

A round is what tests/consistency/test_sigmas.py runs, with other seeds. The mean normalised estimation error squared
(NEES) per degree of freedom is printed, and the bounds within which it is where standard deviations are honest.

With --without-imu, wheels beside motion capture and wheels beside a camera are calibrated for that long instead, five
seeds each. True scales are drawn from their priors. Nothing else shows a length, so that each estimated scale is 1. The
NEES is that of the wheels' radii and baseline.

With --imus, rigs of two and three IMUs, from nothing, 40 s each, 30 seeds: beside a camera and a board, and alone. The
root mean square of each error is printed, too.

With --boards, a camera and a LiDAR at rest and a board in ten places, N seeds for each number of rings; in three;
and in recordings that go on while the board is carried.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path

import numpy as np

from icalib.geometry import so3
from icalib.geometry.targets import AprilGrid
from icalib.pipeline import calibrate_measurements
from icalib.rig import PoseSensor, Rig
from icalib.sensors.imu.simulate import SimImu
from icalib.sensors.lidar.simulate import SimLidar
from icalib.sensors.pose.simulate import SimPoses
from icalib.sensors.wheels.simulate import SimWheels
from icalib.tools.montecarlo.record import RunRecord, compare
from icalib.tools.montecarlo.summary import Nees, Sample, nees
from icalib.tools.simulation import Drive, Room, Scenario, handheld, load_scenario, rig_for, simulate
from icalib.tools.simulation.motion import rotation_from_vector
from icalib.tools.simulation.stops import Pauses, Stops, simulate_stops

PAPER = Path(__file__).resolve().parent.parent / "examples" / "paper"
WALL_GRID = AprilGrid(4, 10, 0.6, 0.3)
ON_WALL = np.array([[0.0, 0.0, -1.0, 5.9], [-1.0, 0.0, 0.0, 3.9], [0.0, 1.0, 0.0, 0.1], [0.0, 0.0, 0.0, 1.0]])
FALSE_ALARMS = 1e-3  # in a round, where standard deviations are honest
TOGETHER = "all"
PARTS = slice(0, 3), slice(3, 6)  # rotation and translation in a vector of errors
LEAST_DOF = 400  # for sigmas 1.3 times too small or too large to be beyond chance


@dataclass(frozen=True, eq=False)
class Case:
    """Recordings that differ by their seed, and the rig that they are calibrated with. All sensors have at least
    LEAST_DOF together; of several, each of `kinds`, names without numbers, is judged alone, too, by what it has."""

    scenario: Scenario
    rig: Rig
    recordings: int
    kinds: tuple[str, ...] = ()


@dataclass(frozen=True)
class Judged:
    """NEES of one kind of sensor, by the covariance and by the printed standard deviations."""

    kind: str
    dof: int
    by_covariance: Nees
    by_printed: Nees
    bias: float  # largest mean error over the recordings, in standard deviations of such a mean

    @property
    def consistent(self) -> bool:
        return self.by_covariance.consistent and self.by_printed.consistent

    def __str__(self) -> str:
        covariance, printed = self.by_covariance, self.by_printed
        bounds = f"bounds {covariance.low:.3f} to {covariance.high:.3f}, {self.dof} dof, bias {self.bias:.1f}"
        return f"{self.kind:6s} NEES {covariance.mean:.3f}, printed {printed.mean:.3f}, {bounds}"


def _pose(turn: float, position: list[float]) -> np.ndarray:
    """Turned about the vertical by `turn` rad."""
    T = np.eye(4)
    T[:2, :2] = [[np.cos(turn), -np.sin(turn)], [np.sin(turn), np.cos(turn)]]
    T[:3, 3] = position
    return T


def _mocap() -> SimPoses:
    return SimPoses("mocap0", _pose(0.3, [0.1, -0.2, 0.15]), 0.0123, T_world_frame=_pose(2.0, [3.0, -1.0, 0.5]))


def _rig(scenario: Scenario) -> Rig:
    """All is estimated, from the truth on: whether a first guess is found is another question. The noise of IMU and
    encoders is stated, all other is found from residuals. Simulated wheels do not slip."""
    rig = rig_for(
        scenario,
        rotation="start",
        translation="start",
        time_offset="start",
        intrinsics="start",
        distortion="start",
        others="start",
    )
    return rig.with_(
        cameras=tuple(replace(c, corner_noise_px=None, track_noise_px=None) for c in rig.cameras),
        lidars=tuple(replace(x, range_noise_m=None) for x in rig.lidars),
        wheels=tuple(replace(w, lateral_slip=1e-4, vertical_slip=1e-4) for w in rig.wheels),
        poses=tuple(replace(p, rotation_noise=None, position_noise=None) for p in rig.poses),
    )


def _board() -> Case:
    """Two cameras in front of a target."""
    scenario = handheld(3.0)
    scenario = replace(scenario, cameras=tuple(replace(c, rate_hz=10.0) for c in scenario.cameras))
    return Case(scenario, _rig(scenario), 16)


def _tracks() -> Case:
    """A camera that follows points of a room."""
    scenario = load_scenario(PAPER / "table2-3d.yaml")
    assert scenario.features is not None
    features = replace(scenario.features, per_image=40, count=600, persistent=80)
    scenario = replace(scenario, duration_s=5.0, features=features, cameras=scenario.cameras[:1], sensors=())
    return Case(scenario, _rig(scenario), 30)


def _drive() -> Case:
    """A robot on hills with a LiDAR, wheels and motion capture."""
    scenario = load_scenario(PAPER / "table2-ramp.yaml")
    lidars = tuple(replace(x, azimuth_steps=200) for x in scenario.of(SimLidar))
    wheels = tuple(replace(w, noise=0.005) for w in scenario.of(SimWheels))
    sensors = (*lidars, *wheels, _mocap())
    scenario = replace(scenario, duration_s=6.0, cameras=(), features=None, sensors=sensors)
    return Case(scenario, _rig(scenario), 20, ("lidar", "wheel", "mocap"))


def _poses() -> Case:
    """Motion capture, and another program's odometry, which drifts."""
    odometry = replace(_mocap(), name="odom0", kind="relative", rotation_noise=5e-3, position_noise=1e-2)
    room, motion = Room((8.0, 6.0, 3.0)), Drive("free")
    scenario = Scenario((), duration_s=5.0, motion=motion, board=False, room=room, sensors=(_mocap(), odometry))
    return Case(scenario, _rig(scenario), 30, ("mocap", "odom"))


def _imu(rate_hz: float) -> Case:
    """Two known cameras in front of a target, moved by hand: lever arms and offsets depend on how readings between two
    stamps are integrated."""
    scenario = replace(handheld(20.0), imu_rate_hz=rate_hz)
    return Case(scenario, rig_for(scenario), 30)


def imus(number: int, seconds: float, camera: bool) -> Scenario:
    """IMUs of a data sheet moved by hand, 15 and 27 cm from the first one, with clocks of their own; with or without a
    camera in front of a target."""
    scenario = handheld(seconds)
    clock = scenario.imu_clock_origin_ns
    further = (
        SimImu("imu1", _turned([0.5, -1.2, 0.8], [0.12, -0.08, 0.05]), 0.0123, 400.0, 0.0007, clock),
        SimImu("imu2", _turned([-0.9, 0.4, 2.0], [-0.2, 0.1, 0.15]), -0.0051, 1000.0, 0.0003, clock),
    )
    cameras = scenario.cameras[:1] if camera else ()
    return replace(scenario, cameras=cameras).with_sensors(*further[: number - 1])


def _turned(vector: list[float], position: list[float]) -> np.ndarray:
    """(4, 4) pose with this rotation vector [rad] and position [m]."""
    T = np.eye(4)
    T[:3, :3], T[:3, 3] = rotation_from_vector(np.array(vector)), position
    return T


def _imus() -> Case:
    """A camera, a target and three IMUs."""
    scenario = imus(3, 3.0, camera=True)
    scenario = replace(scenario, cameras=tuple(replace(c, rate_hz=10.0) for c in scenario.cameras))
    return Case(scenario, rig_for(scenario), 20, ("imu",))


RATES_HZ = (100, 200, 400, 1000)
CASES: dict[str, Callable[[], Case]] = {
    "board": _board,
    "tracks": _tracks,
    "drive": _drive,
    "poses": _poses,
    "imus": _imus,
    **{f"imu at {rate} Hz": partial(_imu, float(rate)) for rate in RATES_HZ},
}
CHECKS = sum(len(make().kinds) + 1 for make in CASES.values())


def judge(case: Case, first_seed: int) -> list[Judged]:
    """Calibrates the case's recordings, with seeds from `first_seed` on."""
    seeds = range(first_seed, first_seed + case.recordings)
    runs = [_run(case, seed) for seed in seeds]
    return [_judged(kind, runs) for kind in (TOGETHER, *case.kinds)]


def _run(case: Case, seed: int) -> tuple[RunRecord, np.ndarray]:
    """Errors and covariance of one recording; and the standard deviations that are printed, of the same numbers."""
    simulation = simulate(case.scenario, seed)
    result = calibrate_measurements(case.rig, simulation.measurements)
    record = compare(seed, result, simulation.truth, [], 0.0)
    return record, np.concatenate([result.group(b.sensor, b.name).std for b in record.blocks])


def _judged(kind: str, runs: list[tuple[RunRecord, np.ndarray]]) -> Judged:
    by_covariance, by_printed = [], []
    for record, printed in runs:
        blocks = [b for b in record.blocks if kind in (TOGETHER, b.sensor.rstrip("0123456789"))]
        k = np.concatenate([record.columns(b.key) for b in blocks])
        covariance = record.covariance[np.ix_(k, k)]
        scale = printed[k] / np.sqrt(np.diag(covariance))
        by_covariance.append(Sample(record.seed, record.error[k], covariance))
        by_printed.append(Sample(record.seed, record.error[k], scale[:, None] * covariance * scale))
    probability = 1.0 - FALSE_ALARMS / CHECKS
    dof = sum(len(s.error) for s in by_covariance)
    normalised = [sample.error / np.sqrt(np.diag(sample.covariance)) for sample in by_printed]
    bias = float(np.abs(np.mean(normalised, axis=0)).max() * np.sqrt(len(runs)))
    return Judged(kind, dof, nees(by_covariance, probability), nees(by_printed, probability), bias)


def check_imus(seeds: range) -> int:
    """Prints NEES and errors of rigs with several IMUs. Returns the number of checks that failed."""
    failed = 0
    for number, camera in ((2, True), (3, True), (3, False)):
        scenario = imus(number, 40.0, camera)
        case = Case(scenario, rig_for(scenario), len(seeds))
        runs = [_run(case, seed) for seed in seeds]
        found = _judged(TOGETHER, runs)
        failed += not found.consistent
        print(f"{number} IMUs{', a camera' if camera else ' alone'}: {found}", flush=True)
        for block in runs[0][0].blocks:
            errors = np.array([record.error[record.columns(block.key)] for record, _ in runs])
            print(f"  {block.key}: RMS {np.sqrt((errors**2).sum(axis=1).mean()):.2g}", flush=True)
    return failed


def check_boards(seeds: range) -> int:
    """Prints NEES and errors of LiDARs at rest. Returns the number of checks that failed."""
    failed = 0
    carried = (Pauses(), Pauses(sway_m=0.002), Pauses(sway_m=0.005), Pauses(late_s=0.1))
    for stops in (Stops(10), Stops(10, rings=64), Stops(3), *(Stops(10, pauses=p) for p in carried)):
        samples, T = [], stops.T_cam_lidar
        for seed in seeds:
            result = calibrate_measurements(stops.rig(), simulate_stops(stops, seed)[0])
            rotation, translation = (result.group("lidar0", name) for name in ("rotation", "translation"))
            turn = so3.log(np.ascontiguousarray(T[:3, :3].T @ rotation.value))
            error = np.append(turn, translation.value - T[:3, 3])
            assert rotation.columns is not None and translation.columns is not None
            columns = np.append(rotation.columns, translation.columns)
            samples.append(Sample(seed, error, result.covariance[np.ix_(columns, columns)]))
        found = nees(samples, 0.99)
        turns, shifts = (np.sqrt((np.array([s.error[k] for s in samples]) ** 2).sum(axis=1).mean()) for k in PARTS)
        print(f"{stops.n_stops} places, {stops.rings} rings, {stops.pauses}")
        print(f"  RMS {np.rad2deg(turns):.3f} deg, {1e3 * shifts:.1f} mm")
        print(f"  NEES {found.mean:.2f}, bounds {found.low:.2f} to {found.high:.2f}", flush=True)
        failed += not found.consistent
    return failed


def scenarios_without_imu(seconds: float) -> dict[str, Scenario]:
    """A vehicle on ramps, its wheels beside motion capture or beside a camera that sees a wall of tags."""
    scenario = load_scenario(PAPER / "table2-ramp.yaml")
    wheels = tuple(replace(w, noise=0.005, allowed_slip=1e-4) for w in scenario.of(SimWheels))
    scenario = replace(scenario, duration_s=seconds, features=None, imu_noise_enabled=False)
    camera = replace(scenario.cameras[0], corner_noise_px=0.15)
    wall = {"board": True, "T_world_board": ON_WALL, "target": WALL_GRID}
    return {
        "mocap": replace(scenario, cameras=(), sensors=(*wheels, _mocap())),
        "camera": replace(scenario, cameras=(camera,), sensors=wheels, **wall),
    }


def lengths(scenario: Scenario, seed: int) -> tuple[float, float, Sample, str]:
    """Estimated scale and its standard deviation, errors of the wheels' sizes, and the verdict, without an IMU."""
    scale = np.random.default_rng(seed).normal()
    if scenario.board:
        scenario = replace(scenario, target_size=1.0 + scenario.target.size_sigma * scale)
    else:
        poses = (replace(p, scale=1.0 + PoseSensor.scale_sigma * scale) for p in scenario.of(SimPoses))
        scenario = scenario.with_sensors(*poses)
    simulation = simulate(scenario, seed)
    rig = rig_for(scenario).with_(imu=None)
    rig = rig.with_(poses=tuple(replace(p, scale_sigma=PoseSensor.scale_sigma) for p in rig.poses))
    rig = rig.with_(target=replace(rig.target, size_sigma=scenario.target.size_sigma))
    result = calibrate_measurements(rig, simulation.measurements.without("imu0"))
    groups = [result.group("wheel0", name) for name in ("radii", "baseline")]
    columns = np.concatenate([g.columns for g in groups if g.columns is not None])
    error = np.concatenate([g.value - simulation.truth.values["wheel0"][g.name] for g in groups])
    (own,) = (g for g in result.groups if g.name in ("scale", "size"))
    sample = Sample(seed, error, result.covariance[np.ix_(columns, columns)])
    return float(own.value[0]), float(own.std[0]), sample, result.verdict


def check_without_imu(minutes: float, seeds: range) -> int:
    """Prints each run and the NEES. Returns the number of checks that failed."""
    failed = 0
    for name, scenario in scenarios_without_imu(60.0 * minutes).items():
        runs = [lengths(scenario, seed) for seed in seeds]
        for scale, std, sample, verdict in runs:
            print(f"{name:8s} seed {sample.seed}: scale {scale:.6f} +- {std:.6f}, {verdict}", flush=True)
            failed += verdict == "not usable"
        together = nees([sample for _, _, sample, _ in runs], 1.0 - FALSE_ALARMS)
        mean = float(np.mean([(scale - 1.0) / std for scale, std, _, _ in runs]))
        print(f"{name:8s} scale {mean:+.2f} sigma, NEES {together.mean:.2f}, {together.low:.2f} to {together.high:.2f}")
        failed += abs(mean) > 0.5 or not together.consistent
    return failed


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--first-seed", type=int, default=1000)
    parser.add_argument("--rounds", type=int, default=1)
    parser.add_argument("--without-imu", type=float, metavar="MINUTES")
    parser.add_argument("--imus", action="store_true")
    parser.add_argument("--boards", type=int, metavar="N")
    options = parser.parse_args()
    if options.boards:
        return min(check_boards(range(options.first_seed, options.first_seed + options.boards)), 1)
    if options.imus:
        return min(check_imus(range(options.first_seed, options.first_seed + 30)), 1)
    if options.without_imu is not None:
        return min(check_without_imu(options.without_imu, range(options.first_seed, options.first_seed + 5)), 1)
    failed = 0
    for round_ in range(options.rounds):
        for name, make in CASES.items():
            case = make()
            for found in judge(case, options.first_seed + round_ * case.recordings):
                print(f"round {round_}  {name:14s} {found}{'' if found.consistent else '  FAILS'}", flush=True)
                failed += not found.consistent
    return min(failed, 1)


if __name__ == "__main__":
    sys.exit(main())
