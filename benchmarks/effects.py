"""Imperfect sensors and targets: is what is called determined right, on each kind of rig?

python benchmarks/effects.py [--rig R ...] [--seeds N] [--first-seed N]

Each effect has the size of one and of two standard deviations of its default prior, with random signs. Recordings are
short and simulated at the level of measurements; calibrations start from nothing. A row says how often the solver
converged, and the largest error in printed standard deviations of what is called determined, and of what is weak. The
program fails where an error of what is determined is beyond 4.
"""

from __future__ import annotations

import argparse
import sys
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Literal

import numpy as np

from icalib.errors import CalibrationError
from icalib.geometry.targets import AprilGrid
from icalib.geometry.targets.base import SIZE_SIGMA
from icalib.pipeline import calibrate_measurements
from icalib.result import Calibration
from icalib.rig import Parameter, PoseSensor, Rig
from icalib.sensors.imu.spec import class_imperfections
from icalib.sensors.lidar.simulate import SimLidar
from icalib.sensors.lidar.spec import RANGE_SCALE
from icalib.sensors.pose.simulate import SimPoses
from icalib.sensors.wheels.simulate import SimWheels
from icalib.tools.montecarlo.record import error, true_value
from icalib.tools.simulation import Drive, Room, Scenario, Simulation, handheld, load_scenario, rig_for, simulate

PAPER = Path(__file__).resolve().parent.parent / "examples" / "paper"
FAR = 4.0  # standard deviations
TIMES = (1.0, 2.0)  # the standard deviation of the prior
CLASS = "consumer"
# Where the 24 numbers of `Scenario.imu_intrinsics` stand.
IMU_EFFECTS = {
    "accelerometer scale": [0, 2, 5],
    "accelerometer misalignment": [1, 3, 4],
    "gyroscope scale": [6, 8, 11],
    "gyroscope misalignment": [7, 9, 10],
    "accelerometer rotation": [12, 13, 14],
    "g-sensitivity": list(range(15, 24)),
}
SIZE, SCALE, RANGES, NONE = "target size", "scale of poses", "scale of ranges", "none"
ENCODER = 0.005  # rad/sqrt(s): with the paper's 0.03 it is chance whether hills show how wheels roll
ON_WALL = np.array([[0.0, 0.0, -1.0, 5.9], [-1.0, 0.0, 0.0, 3.9], [0.0, 1.0, 0.0, 0.1], [0.0, 0.0, 0.0, 1.0]])
MOUNT = ("rotation", "translation", "time_offset")


def _pose(vector_z: float, position: Sequence[float]) -> np.ndarray:
    """Turned about the vertical by `vector_z` rad."""
    T = np.eye(4)
    T[:2, :2] = [[np.cos(vector_z), -np.sin(vector_z)], [np.sin(vector_z), np.cos(vector_z)]]
    T[:3, 3] = position
    return T


def _mocap() -> SimPoses:
    return SimPoses("mocap0", _pose(0.3, [0.1, -0.2, 0.15]), 0.0123, T_world_frame=_pose(2.0, [3.0, -1.0, 0.5]))


def camera_imu() -> Scenario:
    """Two cameras before a target, 10 s."""
    scenario = handheld(10.0)
    return replace(scenario, cameras=tuple(replace(c, rate_hz=10.0) for c in scenario.cameras))


def tracks_imu() -> Scenario:
    """A camera that follows points of a room, 8 s."""
    scenario = load_scenario(PAPER / "table2-3d.yaml")
    assert scenario.features is not None
    features = replace(scenario.features, per_image=60, count=900, persistent=120)
    return replace(scenario, duration_s=8.0, features=features, cameras=scenario.cameras[:1], sensors=())


def lidar_imu() -> Scenario:
    """A LiDAR that moves freely in a room, 10 s."""
    scenario = load_scenario(PAPER / "table2-3d.yaml")
    lidars = tuple(replace(x, azimuth_steps=450) for x in scenario.of(SimLidar))
    return replace(scenario, duration_s=10.0, cameras=(), features=None, sensors=lidars)


def lidar_poses_imu() -> Scenario:
    """That LiDAR, with motion capture."""
    scenario = lidar_imu()
    return replace(scenario, sensors=(*scenario.sensors, _mocap()))


def poses_imu() -> Scenario:
    """Motion capture of a body that moves freely, 10 s."""
    room, motion = Room((8.0, 6.0, 3.0)), Drive("free")
    return Scenario((), duration_s=10.0, motion=motion, board=False, room=room, sensors=(_mocap(),))


def wheels_poses_imu() -> Scenario:
    """Wheels on hills before motion capture, 20 s."""
    scenario = load_scenario(PAPER / "table2-ramp.yaml")
    wheels = tuple(replace(w, noise=ENCODER) for w in scenario.of(SimWheels))
    return replace(scenario, duration_s=20.0, cameras=(), features=None, sensors=(*wheels, _mocap()))


def camera_wheels() -> Scenario:
    """Wheels on hills, a camera that sees a large target on a wall now and then, 20 s."""
    scenario = load_scenario(PAPER / "table2-ramp.yaml")
    cameras = tuple(replace(c, corner_noise_px=0.15) for c in scenario.cameras[:1])
    board = {"board": True, "T_world_board": ON_WALL, "target": AprilGrid(4, 10, 0.6, 0.3)}
    wheels = tuple(replace(w, noise=ENCODER) for w in scenario.of(SimWheels))
    return replace(scenario, duration_s=20.0, cameras=cameras, features=None, sensors=wheels, **board)


@dataclass(frozen=True)
class Kind:
    """A kind of rig: its scenario, whether the IMU is in the rig, the effects on it, and how its lenses are treated."""

    scenario: Callable[[], Scenario]
    imu: bool
    effects: tuple[str, ...]
    lens: Literal["free", "fixed"] = "free"


KINDS = {
    "camera + IMU": Kind(camera_imu, True, (*IMU_EFFECTS, SIZE)),
    "tracks + IMU": Kind(tracks_imu, True, tuple(IMU_EFFECTS)),
    "LiDAR + IMU": Kind(lidar_imu, True, (*IMU_EFFECTS, RANGES)),
    "LiDAR + poses + IMU": Kind(lidar_poses_imu, True, (SCALE, RANGES)),
    "poses + IMU": Kind(poses_imu, True, (*IMU_EFFECTS, SCALE)),
    "wheels + poses + IMU": Kind(wheels_poses_imu, True, (*IMU_EFFECTS, SCALE)),
    "wheels + poses": Kind(wheels_poses_imu, False, (SCALE,)),
    "camera + wheels": Kind(camera_wheels, False, (SIZE,), "fixed"),
}


def with_effect(scenario: Scenario, effect: str, times: float, seed: int) -> Scenario:
    """The scenario with an effect of so many standard deviations of its default prior, signs drawn by the seed."""
    signs = np.random.default_rng([seed, 77]).choice((-1.0, 1.0), 24)
    if effect in IMU_EFFECTS:
        own = IMU_EFFECTS[effect]
        intrinsics = np.zeros(24)
        intrinsics[own] = times * (signs * class_imperfections(CLASS).sigma)[own]
        return replace(scenario, imu_intrinsics=intrinsics)
    if effect == SIZE:
        return replace(scenario, target_size=float(1.0 + times * signs[0] * SIZE_SIGMA))
    if effect == SCALE:
        scale = float(1.0 + times * signs[0] * PoseSensor.scale_sigma)
        return scenario.with_sensors(*(replace(p, scale=scale) for p in scenario.of(SimPoses)))
    if effect == RANGES:
        scale = float(1.0 + times * signs[0] * RANGE_SCALE.prior_sigma)
        return scenario.with_sensors(*(replace(x, scale=scale) for x in scenario.of(SimLidar)))
    return scenario


def rig_of(scenario: Scenario, kind: Kind) -> Rig:
    """The rig as a user writes it, who knows the noise and nothing else: with the default priors."""
    rig = rig_for(scenario, intrinsics=kind.lens, distortion=kind.lens)
    target = replace(rig.target, size_sigma=SIZE_SIGMA) if rig.has_target else rig.target
    prior = Parameter("prior", np.zeros(24), class_imperfections(CLASS).sigma)
    assert rig.imu is not None
    return rig.with_(
        imu=replace(rig.imu, intrinsics=prior) if kind.imu else None,
        target=target,
        poses=tuple(replace(p, scale_sigma=PoseSensor.scale_sigma) for p in rig.poses),
        lidars=tuple(replace(x, range_scale=Parameter("fixed")) for x in rig.lidars),
        settings=replace(rig.settings, segments=8),
    )


def true_beside(simulation: Simulation, body: str, sensor: str, name: str) -> np.ndarray | None:
    """The truth of a group of `sensor`, as seen from the body where that is not the IMU."""
    if body == "imu0" or name not in MOUNT:
        return true_value(simulation.truth, sensor, name)
    (R, p, t), (Q, q, u) = ([true_value(simulation.truth, s, n) for n in MOUNT] for s in (body, sensor))
    assert R is not None and p is not None and t is not None and Q is not None and q is not None and u is not None
    return {"rotation": R.T @ Q, "translation": R.T @ (q - p), "time_offset": u - t}[name]


def errors(result: Calibration, simulation: Simulation) -> Iterator[tuple[str, str, float]]:
    """Name, verdict, and error in printed standard deviations of each number that was estimated."""
    for g in result.groups:
        true = None if g.columns is None else true_beside(simulation, result.body, g.sensor, g.name)
        if true is not None:
            off = np.abs(error(g.name, g.value, true)) / g.std
            for label, verdict, x in zip(g.labels, g.verdict, off.tolist(), strict=True):
                yield f"{g.sensor} {g.name} {label}", verdict, x


@dataclass
class Row:
    """Of one effect of one size on one kind of rig: the worst over its recordings."""

    converged: int = 0
    failures: tuple[str, ...] = ()
    worst: dict[str, tuple[float, str]] | None = None

    def add(self, found: Iterator[tuple[str, str, float]]) -> None:
        self.converged += 1
        worst = dict(self.worst or {})
        for name, verdict, off in found:
            worst[verdict] = max(worst.get(verdict, (0.0, "")), (off, name))
        self.worst = worst

    @property
    def far(self) -> bool:
        return (self.worst or {}).get("determined", (0.0, ""))[0] > FAR

    def cells(self, seeds: int) -> str:
        found = [(self.worst or {}).get(v) for v in ("determined", "weak")]
        shown = ["" if w is None else f"{w[0]:.1f} {w[1]}" for w in found]
        return f"{self.converged} of {seeds} | {' | '.join(shown)} |"


def row_of(kind: Kind, effect: str, times: float, seeds: Sequence[int]) -> Row:
    """Calibrates recordings with the effect."""
    row, base = Row(), kind.scenario()
    rig = rig_of(base, kind)
    for seed in seeds:
        simulation = simulate(with_effect(base, effect, times, seed), seed)
        measured = simulation.measurements if kind.imu else simulation.measurements.without("imu0")
        try:
            result = calibrate_measurements(rig, measured)
        except CalibrationError as failure:
            row.failures = (*row.failures, str(failure))
            continue
        if result.converged:
            row.add(errors(result, simulation))
    return row


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--rig", nargs="+", choices=tuple(KINDS), default=tuple(KINDS))
    parser.add_argument("--seeds", type=int, default=2)
    parser.add_argument("--first-seed", type=int, default=0)
    options = parser.parse_args()
    seeds, far, began = range(options.first_seed, options.first_seed + options.seeds), 0, time.process_time()
    print("| rig | effect | sigma | converged | determined: worst | weak: worst |\n|---|---|---|---|---|---|")
    for name in options.rig:
        kind = KINDS[name]
        for effect, times in [(NONE, 0.0), *((e, t) for e in kind.effects for t in TIMES)]:
            row = row_of(kind, effect, times, seeds)
            print(f"| {name} | {effect} | {times:g} | {row.cells(len(seeds))}{' FAR' if row.far else ''}", flush=True)
            for failure in row.failures:
                print(f"  {failure}", file=sys.stderr)
            far += row.far
    print(f"{time.process_time() - began:.0f} CPU s", file=sys.stderr)
    return min(far, 1)


if __name__ == "__main__":
    sys.exit(main())
