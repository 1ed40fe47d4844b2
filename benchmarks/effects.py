"""Imperfect sensors and targets: is what is called determined right, on each kind of rig?

python benchmarks/effects.py [--table] [--rig R ...] [--seeds N] [--first-seed N]

Each effect has the size of one and of two standard deviations of its default prior, with random signs. Recordings are
short and simulated at the level of measurements; calibrations start from nothing. A row says how often the solver
converged, and the largest error in printed standard deviations of what is called determined, and of what is weak. The
program fails where an error of what is determined is beyond 4.

With --table the effects are those outside of the model, at sizes that move the result by 3, 10 and 30 standard
deviations, or as large as plausible. A cell is silently wrong where what is determined is off by more than 4 printed
standard deviations, the result may be used, and no reason names a cause.
"""

from __future__ import annotations

import argparse
import re
import sys
import time
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Literal

import numpy as np

from icalib.data.measurements import Measurements, TrackStream, WheelStream
from icalib.errors import CalibrationError
from icalib.geometry import so3
from icalib.geometry.targets import AprilGrid
from icalib.geometry.targets.base import SIZE_SIGMA
from icalib.pipeline import calibrate_measurements
from icalib.result import Calibration
from icalib.result.verdict import AUXILIARY
from icalib.rig import Parameter, PoseSensor, Rig
from icalib.sensors.imu.spec import class_imperfections
from icalib.sensors.lidar.simulate import SimLidar
from icalib.sensors.lidar.spec import RANGE_SCALE
from icalib.sensors.pose.simulate import SimPoses
from icalib.sensors.position.simulate import SimPositions
from icalib.sensors.stream import Stream
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


def positions_imu() -> Scenario:
    """A prism on that body, tracked at 20 Hz to 2 mm, 20 s."""
    prism = SimPositions("prism0", _pose(0.0, [0.12, -0.25, 0.3]), 0.0123, rate_hz=20.0, position_noise=2e-3)
    return replace(poses_imu(), duration_s=20.0, sensors=(prism,))


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
    """A kind of rig: its scenario, whether the IMU is in the rig, the effects on it, how its lenses are treated, and
    when effects begin [s]."""

    scenario: Callable[[], Scenario]
    imu: bool
    effects: tuple[str, ...]
    lens: Literal["free", "fixed"] = "free"
    instant_s: float | None = 5.3


KINDS = {
    "camera + IMU": Kind(camera_imu, True, (*IMU_EFFECTS, SIZE)),
    "tracks + IMU": Kind(tracks_imu, True, tuple(IMU_EFFECTS)),
    "LiDAR + IMU": Kind(lidar_imu, True, (*IMU_EFFECTS, RANGES)),
    "LiDAR + poses + IMU": Kind(lidar_poses_imu, True, (SCALE, RANGES)),
    "poses + IMU": Kind(poses_imu, True, (*IMU_EFFECTS, SCALE)),
    "positions + IMU": Kind(positions_imu, True, ()),
    "wheels + poses + IMU": Kind(wheels_poses_imu, True, (*IMU_EFFECTS, SCALE)),
    "wheels + poses": Kind(wheels_poses_imu, False, (SCALE,)),
    "camera + wheels": Kind(camera_wheels, False, (SIZE,), "fixed", None),
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
    prior = Parameter("prior", np.zeros(24), class_imperfections(CLASS).sigma, of_class=True)
    assert rig.imu is not None
    return rig.with_(
        imu=replace(rig.imu, intrinsics=prior, low_pass=Parameter("fixed")) if kind.imu else None,
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


# The table: what an effect costs that is outside of the model, and whether it is named.

LEVELS = (3.0, 10.0, 30.0)  # standard deviations by which an effect moves the result
AT_INSTANT, FOR_A_WHILE = np.inf, 0.5  # s
UNSHOWN = 3.0  # standard deviations of the prior of a length that nothing else shows: the largest plausible size
# Identifiers of sentences that name a cause; all others say that numbers are uncertain, or describe residuals.
CAUSES = re.compile(
    r"clock_(drifts|rate_estimated|jumps)|imu_not_ideal|imu_noise_(under|over)stated|ranges_contradict|range_\w+_estimated"
    r"|ring_errors_\w+|rolling_\w+|cameras_\w+|mount_moves|lens_\w+|wheel_sizes_\w+|disturbance_at_one_time|target_size_wrong"
    r"|(fixed_value|prior|guess|lengths|rotations)_contradict\w*|fixed_intrinsics_wrong|resolution_wrong|second_lens_fits"
    r"|accelerometer_\w+|imu_\w+_estimated|target_moves|ground_not_even|poses_filtered_or_drifting|scan_\w+|many_outliers\w*"
)


@dataclass(frozen=True)
class Outside:
    """An effect outside of the model. unit: a small size, from which sizes are scaled; 0: it is there or not; most: the
    largest plausible one, both in units of `words`. changed: the scenario with an effect of a size; lasts: None: it is
    there all the time, else how long from an instant on [s]. named: pattern of
    `identifier: sentence` that names it. power: of the size, with which the result moves. streams, rig: what else is
    changed."""

    name: str
    unit: float
    most: float
    words: str
    named: str
    changed: Callable[[Scenario, float], Scenario] = lambda scenario, _: scenario
    lasts: float | None = None
    power: int = 1
    streams: Callable[[Measurements], Measurements] = lambda measured: measured
    rig: Callable[[Rig], Rig] = lambda rig: rig


NOTHING = Outside("none", 0.0, 0.0, "", "^$")


def _with(sensor: str, **fields: Any) -> Callable[[Scenario, float], Scenario]:
    """Changes fields of a sensor to what functions of their value and of the size of an effect give."""

    def changed(s: Any, size: float) -> Any:
        return replace(s, **{k: f(getattr(s, k), size) for k, f in fields.items()}) if s.name == sensor else s

    return lambda scenario, size: replace(
        scenario,
        cameras=tuple(changed(c, size) for c in scenario.cameras),
        sensors=tuple(changed(s, size) for s in scenario.sensors),
    )


def _bumped(T: np.ndarray, angle: float) -> np.ndarray:
    """A mount turned by an angle [rad] about its axis (2, -1, 2), and moved by 0.1 m per rad."""
    moved, axis = T.copy(), np.array([2.0, -1.0, 2.0]) / 3.0
    moved[:3, :3] = T[:3, :3] @ so3.exp(angle * axis)
    moved[:3, 3] += 0.1 * angle * axis
    return moved


def _rings(lidar: SimLidar, size: float) -> tuple[float, ...]:
    """Errors of rings, the same in each recording, of that RMS size."""
    off = np.random.default_rng(5).standard_normal(lidar.rings)
    off -= off.mean()
    return tuple(size * off / np.sqrt(np.mean(off**2)))


def outside(scenario: Scenario, kind: Kind) -> Iterator[Outside]:
    """All effects on a rig; of several cameras one has them. The motion is such that the first looks at the target."""
    for sensor in (*scenario.cameras[-1:], *scenario.sensors):
        seen = sensor.name if kind.imu else ""  # else it may be any: motion is relative to one of them
        yield from _of_clock(sensor.name, seen)
        if not isinstance(sensor, SimWheels):  # a robot moves as its wheels do, wherever these are
            bump = _with(sensor.name, T_imu_sensor=_bumped)
            yield Outside(f"{sensor.name} bumped", 1e-3, 0.3, "rad", f"mount_moves.*{seen}", bump, AT_INSTANT)
    for camera in scenario.cameras[:1]:
        yield from _of_camera(camera.name)
    if len(scenario.cameras) > 1:
        yield Outside("swapped cameras", 0.0, 1.0, "", "cameras_swapped", streams=_swapped_cameras, rig=_lenses_stated)
    if scenario.board:
        size, moved = (
            (lambda s, x: replace(s, target_size=1.0 + x)),
            (lambda s, x: replace(s, T_world_board=_bumped(s.T_world_board, x))),
        )
        yield Outside("target size", 1e-3, UNSHOWN * SIZE_SIGMA, "", "target_size_wrong|lengths_contradict", size)
        yield Outside("target moved", 1e-3, 0.3, "rad", "(target|board)\\w* mov|moves.*board", moved, AT_INSTANT)
    for lidar in scenario.of(SimLidar):
        yield from _of_lidar(lidar)
    for poses in scenario.of(SimPoses):
        scale = _with(poses.name, scale=lambda s, x: s + x)
        yield Outside("scale of poses", 1e-3, UNSHOWN * PoseSensor.scale_sigma, "", "scale|lengths_", scale)
    for wheels in scenario.of(SimWheels):
        turned = _with(wheels.name, radii=lambda r, x: (r[0] * (1.0 + x), r[1]))
        yield Outside("left radius changes", 1e-3, 0.1, "", "wheel_sizes_change", turned, AT_INSTANT)
        yield Outside("swapped wheels", 0.0, 1.0, "", "wheels are swapped|sizes_implausible", streams=_swapped_wheels)
    if kind.imu:
        yield from _of_imu()


def _of_clock(name: str, seen: str) -> Iterator[Outside]:
    rate, step = _with(name, clock_rate_ppm=lambda _, x: x), _with(name, time_offset_s=lambda t, x: t - abs(x))
    yield Outside(f"clock rate of {name}", 10.0, 500.0, "ppm", f"clock_(drifts|rate).*{seen}", rate)
    yield Outside(f"clock of {name} jumps", 2e-4, 0.1, "s", f"clock_jumps.*{seen}", step, AT_INSTANT)


def _of_camera(name: str) -> Iterator[Outside]:
    readout = _with(name, readout_s=lambda _, x: abs(x))
    yield Outside("rolling shutter", 5e-4, 0.03, "s", f"rolling_shutter.*{name}", readout)
    focal = _with(name, intrinsics=lambda k, x: (k[0] * (1.0 + x), k[1] * (1.0 + x), *k[2:]))
    yield Outside(
        "focal length changes", 1e-3, 0.05, "", f"lens_changes.*{name}|{name}.*lens_changes", focal, AT_INSTANT
    )
    bad = _with(name, corner_noise_px=lambda s, x: s * (1.0 + abs(x)))
    yield Outside(
        "bad images for 0.5 s", 20.0, 100.0, "x noise", f"(disturbance|many_outliers).*{name}", bad, FOR_A_WHILE
    )


def _of_lidar(lidar: SimLidar) -> Iterator[Outside]:
    offset = _with(lidar.name, range_offset_m=lambda _, x: x)
    yield Outside("range offset", 0.01, 0.1, "m", "range_offset|ranges_offset", offset)
    scale = _with(lidar.name, scale=lambda _, x: 1.0 + x)
    yield Outside(
        "range scale", 1e-3, 0.03, "", "range_scale_estimated|ranges_contradict|lengths_contradict: the ranges", scale
    )
    rings = _with(lidar.name, elevation_errors_deg=lambda _, x: _rings(lidar, x))
    yield Outside("elevations of rings", 0.1, 0.5, "deg", "ring_elevations", rings)
    azimuths = _with(lidar.name, azimuth_errors_deg=lambda _, x: _rings(lidar, x))
    yield Outside("azimuths of rings", 0.1, 0.5, "deg", "ring_azimuths", azimuths)
    offsets = _with(lidar.name, ring_offsets_m=lambda _, x: _rings(lidar, x))
    yield Outside("offsets of rings", 0.01, 0.04, "m", "ring_offsets", offsets)


def _of_imu() -> Iterator[Outside]:
    yield Outside(
        "late accelerometer", 1e-3, 0.02, "s", "accelerometer.*(late|delay)",
        lambda s, x: replace(s, imu_accel_delay_s=abs(x)),
    )  # fmt: skip
    low = lambda s, x: replace(s, imu_cutoff_hz=1.0 / max(abs(x), 1e-6))  # noqa: E731
    yield Outside("low-pass in the IMU", 0.02, 0.2, "s (1 / cutoff)", "imu.*(low-pass|filter)", low, power=2)
    for part, axes in (("gyroscope", (6, 8)), ("accelerometer", (0, 5))):
        off = np.isin(np.arange(24), axes) * np.where(np.arange(24) == axes[0], 1.0, -1.0)
        scale = lambda s, x, off=off: replace(s, imu_intrinsics=x * off)  # noqa: E731
        yield Outside(f"{part} scale, fixed", 2e-3, 0.05, "", "imu_not_ideal", scale, rig=_ideal_imu)


def _ideal_imu(rig: Rig) -> Rig:
    return rig if rig.imu is None else rig.with_(imu=replace(rig.imu, intrinsics=Parameter("fixed")))


def _lenses_stated(rig: Rig) -> Rig:
    """The rig with lenses fixed at those of EuRoC."""
    true = rig_for(camera_imu(), intrinsics="fixed", distortion="fixed").cameras
    return rig.with_(cameras=true)


def _swapped_cameras(measured: Measurements) -> Measurements:
    a, b = measured.cameras[:2]
    return measured.with_streams(replace(a, name=b.name), replace(b, name=a.name))


def _swapped_wheels(measured: Measurements) -> Measurements:
    return measured.with_streams(*(replace(w, rate=w.rate[:, ::-1].copy()) for w in measured.of(WheelStream)))


def recorded(kind: Kind, effect: Outside, size: float, seed: int) -> tuple[Measurements, list[Simulation]]:
    """Measurements with an effect, and the simulations whose truths they have: both sides of one that begins."""
    base = kind.scenario()
    after = simulate(effect.changed(base, size), seed)
    if effect.lasts is None:
        return effect.streams(after.measurements), [after]
    before = simulate(base, seed)
    begin = _middle_of_images(before) if kind.instant_s is None else kind.instant_s
    end = begin + effect.lasts
    sides = [
        (before, -np.inf, begin),
        (after, begin, end),
        (before, end, np.inf),
    ]
    streams = []
    for key, stream in before.measurements.streams.items():
        parts: list[Any] = [_part(simulation, key, low, high) for simulation, low, high in sides]
        first, second = parts[:2]
        if isinstance(first, TrackStream) and isinstance(second, TrackStream):
            parts[1] = _renumbered(second, after.truth.points, first, before.truth.points)
        joined = type(stream).joined([part for part in parts if len(part.stamps_ns)])
        streams.append(replace(joined, joins_ns=()))
    return Measurements.of_streams(*streams), [before, after] if effect.lasts == AT_INSTANT else [before]


def _middle_of_images(simulation: Simulation) -> float:
    """The median instant of the images of the first camera, s on the IMU's clock."""
    stamps, origin = simulation.measurements.cameras[0].stamps_ns, np.int64(simulation.truth.imu_clock_origin_ns)
    return float(np.median((stamps - origin) * 1e-9))


def _part(simulation: Simulation, key: str, low: float, high: float) -> Stream:
    """The rows of a stream from `low` to `high`, s on the IMU's clock."""
    stream, truth = simulation.measurements.streams[key], simulation.truth
    seconds = (stream.stamps_ns - np.int64(truth.imu_clock_origin_ns)) * 1e-9 + truth.time_offset.get(stream.name, 0.0)
    kept, start = (seconds >= low) & (seconds < high), getattr(stream, "start", None)
    rows = kept if start is None else np.repeat(kept, np.diff(start))
    changed = {name: column[rows] for name, column in stream.columns().items() if len(column) == stream.rows}
    if start is not None:
        changed["start"] = np.concatenate([[0], np.cumsum(np.diff(start)[kept])])
    return replace(stream, stamps_ns=stream.stamps_ns[kept], **changed)


def _renumbered(
    stream: TrackStream, points: np.ndarray, earlier: TrackStream, earlier_points: np.ndarray
) -> TrackStream:
    """The tracks of `stream` with the numbers that their points had in `earlier`, or with new ones. points (F, 3): of
    each feature number."""
    if np.array_equal(points, earlier_points):
        return stream
    of_point = {earlier_points[number].tobytes(): number for number in np.unique(earlier.feature)}
    new = len(earlier_points) + np.arange(len(points))
    number = np.array([of_point.get(point.tobytes(), n) for point, n in zip(points, new, strict=True)])
    return replace(stream, feature=number[stream.feature])


@dataclass(frozen=True)
class Cell:
    """One recording with an effect. sigmas: largest error of what is determined, by printed standard deviations; named:
    the first sentence that names a cause."""

    verdict: str
    sigmas: float = 0.0
    worst: str = ""
    named: str = ""
    right: bool = False
    at_once: bool = False  # whether the effect begins at an instant, so that a disturbance there is no wrong cause

    @property
    def marks(self) -> tuple[str, ...]:
        silent = self.sigmas > FAR and self.verdict != "not usable" and not self.named
        wrong = self.named and not self.right and not (self.at_once and self.named.startswith("disturbance"))
        return (*(["SILENT"] if silent else []), *(["WRONG CAUSE"] if wrong else []))

    @property
    def row(self) -> str:
        cause = "" if not self.named else f"{'' if self.right else 'not '}named: {self.named}"
        return " | ".join([f"{self.sigmas:.1f} {self.worst}", self.verdict, cause, *self.marks])


def cell(kind: Kind, base: Scenario, effect: Outside, size: float, seed: int) -> Cell:
    """Calibrates a recording with an effect of this size."""
    measured, sides = recorded(kind, effect, size, seed)
    try:
        result = calibrate_measurements(effect.rig(rig_of(base, kind)), _of_kind(measured, kind))
    except CalibrationError as failure:
        return Cell("refused", worst=str(failure), right=bool(re.search(effect.named, str(failure))))
    off = [found for side in sides for found in errors(result, side) if found[1] == "determined"]
    name, _, sigmas = max(off, key=lambda found: found[2], default=("", "", 0.0))
    estimated = [note for note in result.notes if note.name.endswith("_estimated")]
    for remark in dict.fromkeys((*result.reasons, *result.warnings, *estimated)):
        words = f"{remark.name}: {remark}"
        if (right := bool(re.search(effect.named, words))) or CAUSES.match(remark.name):
            return Cell(result.verdict, sigmas, name, words, right, effect.lasts is not None)
    return Cell(result.verdict, sigmas, name)


def _of_kind(measured: Measurements, kind: Kind) -> Measurements:
    return measured if kind.imu else measured.without("imu0")


def shift(kind: Kind, base: Scenario, effect: Outside, plain: dict[str, Calibration]) -> float:
    """Standard deviations by which an effect of its unit moves the result, at most, beside the same noise. plain:
    results without effects, by the name of `effect.rig`."""
    rig = effect.rig(rig_of(base, kind))
    rig = rig.with_(settings=replace(rig.settings, segments=0))  # nothing is named and estimated
    own = effect.rig.__name__
    if own not in plain:
        plain[own] = calibrate_measurements(rig, _of_kind(recorded(kind, NOTHING, 0.0, 0)[0], kind))
    result = calibrate_measurements(rig, _of_kind(recorded(kind, effect, effect.unit, 0)[0], kind))
    moved = [0.0]
    for g in plain[own].groups:
        other = result.group_or_none(g.sensor, g.name)
        if g.columns is not None and other is not None and g.name not in AUXILIARY:
            off = np.abs(error(g.name, other.value, g.value)) / g.std
            moved += [x for x, v in zip(off.tolist(), g.verdict, strict=True) if v == "determined"]
    return max(moved)


def sizes_of(
    kind: Kind, base: Scenario, effect: Outside, plain: dict[str, Calibration]
) -> Iterator[tuple[float, float]]:
    """Sizes, and standard deviations by which they move the result, at most the largest plausible one."""
    if not effect.unit:
        yield 1.0, np.inf
        return
    per_unit = shift(kind, base, effect, plain)
    largest = per_unit * (effect.most / effect.unit) ** effect.power
    for sigmas in sorted({min(level, largest) for level in LEVELS}):
        yield effect.unit * (sigmas / max(per_unit, 1e-9)) ** (1.0 / effect.power), sigmas


def table(rigs: Sequence[str], seeds: Sequence[int]) -> int:
    """Prints the table, and how many cells are silently wrong or have a wrong cause. Returns that number."""
    wrong, at_ten = Counter[str](), Counter[bool]()
    print("| rig | effect | size | moves by | seed | worst determined, sigma | verdict | cause | |\n|" + "---|" * 9)
    for name in rigs:
        kind, plain = KINDS[name], dict[str, Calibration]()
        base = kind.scenario()
        for effect in outside(base, kind):
            for size, sigmas in sizes_of(kind, base, effect, plain):
                for seed in seeds:
                    found = cell(kind, base, effect, size * (-1.0) ** seed, seed)
                    print(
                        f"| {name} | {effect.name} | {size:.2g} {effect.words} | {sigmas:.3g} | {seed} | {found.row} |",
                        flush=True,
                    )
                    wrong.update(found.marks)
                    at_ten.update([found.right] if sigmas in (LEVELS[1], np.inf) else [])
    print(f"{wrong['SILENT']} silent, {wrong['WRONG CAUSE']} wrong causes; at 10 sigma {at_ten[True]} of "
          f"{at_ten.total()} named first")  # fmt: skip
    return wrong.total()


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--rig", nargs="+", choices=tuple(KINDS), default=tuple(KINDS))
    parser.add_argument("--seeds", type=int, default=2)
    parser.add_argument("--first-seed", type=int, default=0)
    parser.add_argument("--table", action="store_true")
    options = parser.parse_args()
    seeds, far, began = range(options.first_seed, options.first_seed + options.seeds), 0, time.process_time()
    if options.table:
        return min(table(options.rig, seeds), 1)
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
