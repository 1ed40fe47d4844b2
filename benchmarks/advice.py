"""Whether advice helps: `python benchmarks/advice.py [NAME ...] [--seeds N]`.

A fault is simulated, and the recording calibrated. The advice of the first reason that can be applied is applied: a
line of the rig file is changed, or a part of the recording is used. Then it is calibrated again. Afterwards no
component that is called determined may be off by more than 4 printed standard deviations (mount, clock and sizes of
every sensor). The table shows the worst one before and after; the exit code is 1 where advice fails. Faults without
applicable advice are listed: their verdict must not be `usable`. About 10 processor seconds a row.
"""

from __future__ import annotations

import argparse
import re
import sys
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import ten_runs
from scipy.signal import lfilter

from icalib.data.measurements import Measurements
from icalib.data.stamps import Window, cut
from icalib.errors import CalibrationError
from icalib.geometry.targets import AprilGrid, NoTarget
from icalib.pipeline import calibrate_measurements
from icalib.result import Calibration
from icalib.rig import Parameter, Rig
from icalib.sensors.lidar.simulate import SimLidar
from icalib.tools.montecarlo.record import compare
from icalib.tools.simulation import Scenario, Simulation, handheld, load_scenario, rig_for, simulate, with_drawn_guess

SIGMAS = 4.0
SECONDS = 15.0
PAPER = Path(__file__).parents[1] / "examples" / "paper"
Case = tuple[Simulation, Rig, Measurements]


@dataclass(frozen=True)
class Advice:
    """pattern: of the sentence that gives it; apply: the rig and the measurements after it."""

    pattern: str
    apply: Callable[[re.Match[str], Case], tuple[Rig, Measurements]]


def camera_rig(seed: int, scenario: Scenario | None = None) -> Case:
    simulation = simulate(handheld(SECONDS) if scenario is None else scenario, seed)
    return simulation, rig_for(simulation.scenario, settings=ten_runs.SETTINGS), simulation.measurements


def with_imu(case: Case, change: Callable[[np.ndarray, np.ndarray, np.ndarray], tuple[np.ndarray, np.ndarray]]) -> Case:
    """Readings changed by a function of seconds, rates and accelerations."""
    simulation, rig, m = case
    assert m.imu is not None
    gyro, accel = change(m.imu.seconds, m.imu.gyro, m.imu.accel)
    return simulation, rig, m.with_streams(replace(m.imu, gyro=gyro, accel=accel))


def noise(times: float) -> Callable[[int], Case]:
    def make(seed: int) -> Case:
        simulation, rig, m = camera_rig(seed)
        assert rig.imu is not None
        return simulation, rig.with_(imu=replace(rig.imu, noise=rig.imu.noise.scaled(times))), m

    return make


def coloured(pole: float, accel: float, gyro: float) -> Callable[[int], Case]:
    """Vibration: first-order noise with the given pole per reading, of so many m/s^2 and rad/s."""

    def make(seed: int) -> Case:
        rng = np.random.default_rng([seed, 7])

        def shake(t: np.ndarray, w: np.ndarray, a: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
            e = [np.asarray(lfilter([np.sqrt(1.0 - pole**2)], [1.0, -pole], rng.normal(size=w.shape), 0)) for _ in "wa"]
            return w + gyro * e[0], a + accel * e[1]

        return with_imu(camera_rig(seed), shake)

    return make


def half_rate(seed: int) -> Case:
    """The accelerometer reports every fourth reading of the gyroscope, and is interpolated."""

    def thin(t: np.ndarray, w: np.ndarray, a: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        return w, np.stack([np.interp(t, t[::4], a[::4, i]) for i in range(3)], axis=1)

    return with_imu(camera_rig(seed), thin)


def clipped(seed: int) -> Case:
    """Rates beyond 1.5 rad/s are cut off."""
    return with_imu(camera_rig(seed), lambda t, w, a: (np.clip(w, -1.5, 1.5), a))


def shock(seed: int) -> Case:
    def hit(t: np.ndarray, w: np.ndarray, a: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        k = t.searchsorted(9.0)
        return w, np.concatenate([a[:k], a[k : k + 5] + [40.0, -25.0, 10.0], a[k + 5 :]])

    return with_imu(camera_rig(seed), hit)


def jump(seed: int) -> Case:
    """The clock of cam0 jumps by 4 ms after 9.4 s."""
    simulation, rig, m = camera_rig(seed)
    cam0, cam1 = m.cameras
    late = np.where(cam0.seconds > 9.4, 4_000_000, 0)
    return simulation, rig, m.with_streams(replace(cam0, stamps_ns=cam0.stamps_ns + late), cam1)


def size(times: float) -> Callable[[int], Case]:
    def make(seed: int) -> Case:
        simulation, rig, m = camera_rig(seed)
        return simulation, replace(rig, target=AprilGrid(6, 6, 0.088 * times, 0.3)), m

    return make


def stated(mode: str, off_m: float, sigma: float | None = None) -> Callable[[int], Case]:
    """The position of cam0, stated wrongly."""

    def make(seed: int) -> Case:
        simulation, rig, m = camera_rig(seed)
        value = simulation.truth.T_imu_sensor["cam0"][:3, 3] + [off_m, 0.0, 0.0]
        given = Parameter(mode, value, None if sigma is None else np.full(3, sigma))  # pyright: ignore[reportArgumentType]
        return simulation, rig.with_(cameras=(replace(rig.cameras[0], translation=given), *rig.cameras[1:])), m

    return make


def swapped(seed: int) -> Case:
    simulation, _, m = camera_rig(seed)
    given = {"rotation": "start", "translation": "start", "intrinsics": "start", "distortion": "start"}
    rig = rig_for(simulation.scenario, settings=ten_runs.SETTINGS, **given)  # pyright: ignore[reportArgumentType]
    a, b = m.cameras
    return simulation, rig, m.with_streams(replace(b, name=a.name), replace(a, name=b.name))


def corner_noise(seed: int) -> Case:
    """Stated as a third of what it is."""
    simulation, rig, m = camera_rig(seed)
    return simulation, rig.with_(cameras=tuple(replace(c, corner_noise_px=0.07) for c in rig.cameras)), m


def robot(**stated_noise: float) -> Callable[[int], Case]:
    """LiDAR and wheels on hills; fields of the rig file stated wrongly."""

    def make(seed: int) -> Case:
        scenario = load_scenario(PAPER / "table2-ramp.yaml")
        scenario = scenario.with_sensors(*(replace(x, azimuth_steps=150) for x in scenario.of(SimLidar)))
        none: dict[str, Any] = {
            "cameras": (),
            "features": None,
            "board": False,
            "target": NoTarget(),
            "T_world_bodies": np.zeros((0, 4, 4)),
        }
        simulation = simulate(replace(scenario, duration_s=20.0, **none), seed)
        rig = with_drawn_guess(rig_for(simulation.scenario, settings=ten_runs.SETTINGS), simulation.scenario, seed)
        own = {k: v for k, v in stated_noise.items() if k != "range_noise_m"}
        wheels = tuple(replace(w, **{k: v * getattr(w, k) for k, v in own.items()}) for w in rig.wheels)
        by = stated_noise.get("range_noise_m", 1.0)
        lidars = tuple(replace(x, range_noise_m=by * (x.range_noise_m or 0.0)) for x in rig.lidars)
        return simulation, rig.with_(wheels=wheels, lidars=lidars), simulation.measurements

    return make


FAULTS: dict[str, Callable[[int], Case]] = {
    "IMU noise stated 20x too small": noise(0.05),
    "IMU noise stated 10x too small": noise(0.1),
    "IMU noise stated 3x too small": noise(0.3),
    "IMU noise stated 10x too large": noise(10.0),
    "vibration, white": coloured(0.0, 0.5, 0.02),
    "vibration, slow": coloured(0.95, 0.3, 0.01),
    "vibration, fast": coloured(0.6, 0.3, 0.01),
    "accelerometer at a quarter of the rate": half_rate,
    "gyroscope clipped": clipped,
    "shock": shock,
    "clock jumps": jump,
    "clock drifts": lambda seed: (c := camera_rig(seed), (c[0], c[1], drifting(c[2])))[1],
    "target 10 % too large": size(1.1),
    "target 5 % too small": size(0.95),
    "prior 60 mm off": stated("prior", 0.06, 0.005),
    "fixed value 20 mm off": stated("fixed", 0.02),
    "cameras swapped": swapped,
    "corner noise stated 3x too small": corner_noise,
    "range noise stated 3x too small": robot(range_noise_m=0.33),
    "wheel noise stated 5x too small": robot(wheel_noise=0.2),
}


def drifting(m: Measurements) -> Measurements:
    return m.with_streams(ten_runs.with_drift(m.cameras[0], 3e-4), *m.cameras[1:])


def densities(match: re.Match[str], case: Case) -> tuple[Rig, Measurements]:
    _, rig, m = case
    assert rig.imu is not None
    found = {name: float(value) for name, value in re.findall(r"(\w+): ([\d.e-]+)", match[1])}
    return rig.with_(imu=replace(rig.imu, noise=replace(rig.imu.noise, **found))), m


def part(match: re.Match[str], case: Case) -> tuple[Rig, Measurements]:
    """The part before, if it is the longer one, or that after."""
    _, rig, m = case
    end, begin = float(match[1]), float(match[2])
    return rig, within(m, Window(0.0, end) if end > SECONDS - begin else Window(begin))


def well_off(match: re.Match[str], case: Case) -> tuple[Rig, Measurements]:
    _, rig, m = case
    second = float(match[1])
    return rig, within(m, Window(0.0, second - 2.0) if second > 0.5 * SECONDS else Window(second + 2.0))


def within(m: Measurements, window: Window) -> Measurements:
    streams = [s for s in (m.imu, *m.cameras) if s is not None]
    spans = [(int(s.stamps_ns[0]), int(s.stamps_ns[-1])) for s in streams]
    return m.with_streams(*(cut(window, s, s.name, spans) for s in streams))


def resized(match: re.Match[str], case: Case) -> tuple[Rig, Measurements]:
    """The target measured again: its true size."""
    simulation, rig, m = case
    return replace(rig, target=simulation.scenario.target), m


def freed(match: re.Match[str], case: Case) -> tuple[Rig, Measurements]:
    name, sensor = match[1].replace(" ", "_"), match[2]
    _, rig, m = case
    cameras = tuple(replace(c, **{name: Parameter()}) if c.name == sensor else c for c in rig.cameras)
    return rig.with_(cameras=cameras), m


def topics(match: re.Match[str], case: Case) -> tuple[Rig, Measurements]:
    return case[1], case[0].measurements


def one_clock(match: re.Match[str], case: Case) -> tuple[Rig, Measurements]:
    return case[1], case[0].measurements


def left_out(match: re.Match[str], case: Case) -> tuple[Rig, Measurements]:
    _, rig, m = case
    cameras = tuple(replace(c, corner_noise_px=None) for c in rig.cameras)
    return rig.with_(cameras=cameras, lidars=tuple(replace(x, range_noise_m=None) for x in rig.lidars)), m


def of_wheels(match: re.Match[str], case: Case) -> tuple[Rig, Measurements]:
    _, rig, m = case
    return rig.with_(wheels=tuple(replace(w, **{match[1]: float(match[2])}) for w in rig.wheels)), m


ADVICE = (
    Advice(r"Write noise: \{(.*?)\}", densities),
    Advice(r"--to (\d+\.\d), or --from (\d+\.\d)", part),
    Advice(r"\(--to or --from, well off (\d+\.\d)\)", well_off),
    Advice(r"Stamp all sensors by one clock", one_clock),
    Advice(r"by the accelerometer the target is .* times the size", resized),
    Advice(r"the (?:prior|fixed value) of (\w+) \w of (\w+)", freed),
    Advice(r"seem to be swapped", topics),
    Advice(r"leave (?:corner_noise|it) out", left_out),
    Advice(r"write (\w+): ([\d.e-]+) \(", of_wheels),
)


def worst(simulation: Simulation, result: Calibration) -> float:
    """The largest error in printed standard deviations among components that are called determined."""
    record, off = compare(0, result, simulation.truth, [], 0.0), 0.0
    for block in record.blocks:
        group = result.group(block.sensor, block.name)
        error = np.abs(record.error[record.columns(block.key)]) / np.maximum(group.std, 1e-300)
        off = max([off, *(e for e, v in zip(error.tolist(), group.verdict, strict=True) if v == "determined")])
    return off


def row(name: str, seed: int) -> tuple[str, bool]:
    """A line of the table, and whether it is as it should be."""
    case = FAULTS[name](seed)
    simulation, rig, measured = case
    try:
        result = calibrate_measurements(rig, measured)
    except CalibrationError as error:
        return f"refused: {str(error)[:90]}", True
    before = f"{result.verdict}, {worst(simulation, result):.1f} sigma"
    for sentence in result.reasons:
        for advice in ADVICE:
            if match := re.search(advice.pattern, sentence):
                after = calibrate_measurements(*advice.apply(match, case))
                off = worst(simulation, after)
                done = f"{match[0][:60]} -> {after.verdict}, {off:.1f} sigma"
                return f"{before}; {done}", off <= SIGMAS or after.verdict == "not usable"
    first = result.reasons[0][:90] if result.reasons else "no reason"
    return f"{before}; no advice to apply: {first}", result.verdict != "usable" or worst(simulation, result) <= SIGMAS


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("names", nargs="*", help="parts of the names of faults; by default all")
    parser.add_argument("--seeds", type=int, default=1)
    given = parser.parse_args()
    failed = 0
    for name in FAULTS:
        for seed in range(1, given.seeds + 1) if not given.names or any(n in name for n in given.names) else ():
            line, good = row(name, seed)
            failed += not good
            print(f"{'ok  ' if good else 'FAIL'} {name}, seed {seed}: {line}", flush=True)
    return 1 if failed else 0


if __name__ == "__main__":
    sys.exit(main())
