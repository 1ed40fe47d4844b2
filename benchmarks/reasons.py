"""Are reasons true? Recordings without a fault, and recordings with one known fault, on all kinds of rigs.

python benchmarks/reasons.py [NAME ...] [--seeds N] [--first-seed N]

Ten recordings of each of six rigs have no fault; five recordings have each of twelve faults. They are simulated at the
level of measurements, last 10 to 20 s, and are calibrated from nothing with the default priors. A row says in how many
the first reason names the true cause, how many say that none is known, and how many name a wrong one, anywhere in the
reasons or in a refusal. The program fails where a wrong cause is named, or where the true one is named first in less
than four of five. About 15 processor seconds a recording.
"""

from __future__ import annotations

import argparse
import re
import sys
from collections.abc import Callable
from dataclasses import dataclass, replace

import effects
import numpy as np
from scipy.signal import lfilter

from icalib.base.remark import Remark
from icalib.data.measurements import CornerStream, ImuStream, Measurements, PoseStream, WheelStream
from icalib.errors import CalibrationError
from icalib.pipeline import calibrate_measurements
from icalib.rig import Rig, Settings
from icalib.sensors.camera.read.detected_corners import with_even_stamps
from icalib.sensors.stream import S, Stream
from icalib.tools.simulation import Simulation, simulate

RIGS = tuple(effects.KINDS)[:5] + ("camera + wheels",)
CAMERA, POSES, WHEELS = "camera + IMU", "poses + IMU", "wheels + poses + IMU"

# Identifiers of the sentences that name a cause.
CAUSES: dict[str, frozenset[str]] = {
    "drift": frozenset({"clock_drifts"}),
    "step": frozenset({"clock_jumps"}),
    "mount": frozenset({"mount_moves"}),
    "lens": frozenset({"lens_changes", "lens_model_wrong", "fixed_intrinsics_wrong", "resolution_wrong"}),
    "rows": frozenset({"rolling_shutter", "cameras_not_simultaneous"}),
    "jitter": frozenset({"image_stamps_jitter", "stamps_jitter"}),
    "noise too small": frozenset({"imu_noise_understated"}),
    "noise too large": frozenset({"imu_noise_overstated", "imu_residuals_small"}),
    "other noise": frozenset(f"{kind}_noise_understated" for kind in ("corner", "range", "pose", "position", "wheel")),
    "one time": frozenset({"disturbance_at_one_time"}),
    "wheel": frozenset({"wheel_sizes_change", "wheel_reading_constant", "wheel_sizes_implausible"}),
    "target": frozenset({"target_size_wrong"}),
    "swapped": frozenset({"cameras_swapped"}),
    "stated": frozenset({"fixed_value_contradicted", "prior_contradicted", "lengths_contradict"}),
}
# What a refusal names, by the words it is known by: errors have no identifiers.
REFUSED_FOR = {
    "convention": r"invert|w first|Euler|rotations:",
    "unit": r"deg/s|unit|millimet| mm, not",
    "vehicle": r"same vehicle|same recording",
}


@dataclass(frozen=True)
class Case:
    """A recording, and the rig file of a user who knows the noise and nothing else."""

    rig: Rig
    measured: Measurements
    simulation: Simulation
    seed: int

    @property
    def first(self) -> CornerStream | PoseStream:
        """The stream of the first camera, or of the poses."""
        return self.measured.cameras[0] if self.measured.cameras else self.measured.of(PoseStream)[0]

    @property
    def imu(self) -> ImuStream:
        assert self.measured.imu is not None
        return self.measured.imu

    def with_streams(self, *streams: Stream) -> Case:
        return replace(self, measured=self.measured.with_streams(*streams))


@dataclass(frozen=True)
class Fault:
    """A change of a clean recording. rigs: those that have it in turn; causes: those of CAUSES that are true."""

    make: Callable[[Case], Case]
    causes: tuple[str, ...]
    rigs: tuple[str, ...] = (CAMERA,)


def late(stream: S, seconds: np.ndarray) -> S:
    """The stream with its stamps moved by `seconds` (N,)."""
    return replace(stream, stamps_ns=stream.stamps_ns + np.round(1e9 * seconds).astype(np.int64))


def larger(case: Case) -> float:
    """Size of a fault of the clock: poses show it less than images."""
    return 1.0 if case.measured.cameras else 5.0


def drift(case: Case) -> Case:
    """300 ppm, and 1500 ppm of poses."""
    return case.with_streams(late(case.first, larger(case) * 3e-4 * case.first.seconds))


def shared_drift(case: Case) -> Case:
    """All cameras by 300 ppm."""
    return case.with_streams(*(late(c, 3e-4 * c.seconds) for c in case.measured.cameras))


def step(case: Case) -> Case:
    """By 5 ms at 60 % of the recording, and by 25 ms of poses."""
    t = case.first.seconds
    return case.with_streams(late(case.first, np.where(t > 0.6 * t[-1], larger(case) * 0.005, 0.0)))


def jitter(case: Case) -> Case:
    """Images stamped by a host, up to 6 ms late, and made even as where images are read."""
    rng = np.random.default_rng([case.seed, 5])
    cameras = [late(c, rng.uniform(0.0, 0.006, len(c.stamps_ns))) for c in case.measured.cameras]
    read = with_even_stamps([(c, ()) for c in cameras], {c.name: "the images" for c in cameras})
    measured = case.measured.with_streams(*(stream for stream, _ in read))
    return replace(case, measured=replace(measured, notes=tuple(note for _, notes in read for note in notes)))


def bump(case: Case) -> Case:
    """The first camera moves by 4 mm on its mount at two thirds of the recording."""
    scenario, own = case.simulation.scenario, case.measured.cameras[0]
    T = scenario.cameras[0].T_imu_sensor.copy()
    T[:3, 3] += [0.0, 0.004, 0.0]
    cameras = (replace(scenario.cameras[0], T_imu_sensor=T), *scenario.cameras[1:])
    other = simulate(replace(scenario, cameras=cameras), case.seed).measurements.cameras[0]
    k = 2 * len(own.stamps_ns) // 3
    start = np.concatenate([[0], np.cumsum([*np.diff(own.start)[:k], *np.diff(other.start)[k:]])])
    point, uv = (
        np.concatenate([a[own.image < k], b[other.image >= k]])
        for a, b in ((own.point, other.point), (own.uv, other.uv))
    )
    return case.with_streams(replace(own, start=start, point=point, uv=uv))


def noise(times: float) -> Callable[[Case], Case]:
    """The stated noise of the IMU is so many times the true one."""

    def make(case: Case) -> Case:
        assert case.rig.imu is not None
        return replace(case, rig=case.rig.with_(imu=replace(case.rig.imu, noise=case.rig.imu.noise.scaled(times))))

    return make


def low_pass(case: Case) -> Case:
    """The IMU's readings by a filter of first order, 8 Hz: 20 ms late, and weaker where motion is quick."""
    a = np.exp(-2.0 * np.pi * 8.0 * np.median(np.diff(case.imu.seconds)))
    gyro, accel = (
        np.asarray(lfilter([1.0 - a], [1.0, -a], x - x[0], axis=0)) + x[0] for x in (case.imu.gyro, case.imu.accel)
    )
    return case.with_streams(replace(case.imu, gyro=gyro, accel=accel))


def stuck(case: Case) -> Case:
    """The left wheel's encoder repeats a reading for 2 s."""
    wheels = case.measured.of(WheelStream)[0]
    t, rate = wheels.seconds, wheels.rate.copy()
    held = (t > 0.4 * t[-1]) & (t < 0.4 * t[-1] + 2.0)
    rate[held, 0] = rate[held, 0][0]
    return case.with_streams(replace(wheels, rate=rate))


def radius(case: Case) -> Case:
    """The right wheel loses air: its radius is 3 % smaller from half of the recording on."""
    wheels = case.measured.of(WheelStream)[0]
    factor = 1.0 + 0.03 * (wheels.seconds > 0.5 * wheels.seconds[-1])
    return case.with_streams(replace(wheels, rate=wheels.rate * np.stack([np.ones(len(factor)), factor], axis=1)))


def inverted(case: Case) -> Case:
    """Poses of the reference frame in the sensor's."""
    p = case.measured.of(PoseStream)[0]
    R = np.swapaxes(p.rotation, 1, 2)
    return case.with_streams(replace(p, rotation=R, position=-np.einsum("nij,nj->ni", R, p.position)))


def degrees(case: Case) -> Case:
    return case.with_streams(replace(case.imu, gyro=np.rad2deg(case.imu.gyro)))


FAULTS = {
    "clock drifts": Fault(drift, ("drift",), (CAMERA, POSES)),
    "clock of two cameras drifts": Fault(shared_drift, ("drift",)),
    "clock jumps": Fault(step, ("step",), (CAMERA, POSES)),
    "camera is bumped": Fault(bump, ("mount",)),
    "stamps by the host": Fault(jitter, ("jitter",)),
    "IMU noise ten times too small": Fault(noise(0.1), ("noise too small",), (CAMERA, "LiDAR + IMU", POSES)),
    "IMU noise ten times too large": Fault(noise(10.0), ("noise too large",), (CAMERA, "LiDAR + IMU", POSES)),
    "IMU behind a low-pass": Fault(low_pass, ("low-pass",), (CAMERA, POSES)),
    "wheel sticks": Fault(stuck, ("wheel", "one time"), (WHEELS,)),
    "radius changes": Fault(radius, ("wheel",), (WHEELS,)),
    "poses inverted": Fault(inverted, ("convention",), (POSES, WHEELS)),
    "gyroscope in deg/s": Fault(degrees, ("unit",), (CAMERA, "LiDAR + IMU", POSES)),
}


def recorded(rig: str, seed: int) -> Case:
    """A clean recording of a kind of rig."""
    kind = effects.KINDS[rig]
    scenario = kind.scenario()
    simulation = simulate(scenario, seed)
    measured = simulation.measurements if kind.imu else simulation.measurements.without("imu0")
    return Case(replace(effects.rig_of(scenario, kind), settings=Settings()), measured, simulation, seed)


def reasons(case: Case) -> tuple[str, tuple[str, ...]]:
    """The verdict and the reasons, after notes on what was mended; of a refusal its sentence."""
    try:
        result = calibrate_measurements(case.rig, case.measured)
    except CalibrationError as refusal:
        return "refused", (str(refusal),)
    return result.verdict, (*case.measured.notes, *result.reasons)


def named(sentence: str) -> set[str]:
    """The causes that a sentence names: a `Remark` by its identifier, a refusal by its words."""
    if isinstance(sentence, Remark):
        return {cause for cause, names in CAUSES.items() if sentence.name in names}
    return {cause for cause, words in REFUSED_FOR.items() if re.search(words, sentence)}


def row(name: str, seed: int, fault: Fault | None, rig: str) -> str:
    """Prints what was said of one recording; whether it is "true", "none known" or "WRONG"."""
    case = recorded(rig, seed)
    verdict, sentences = reasons(fault.make(case) if fault else case)
    true = set(fault.causes) if fault else set()
    wrong = [s for s in sentences if named(s) and not named(s) & true]
    first_is_true = bool(sentences and named(sentences[0]) & true)
    said = "WRONG" if wrong else "true" if first_is_true or fault is None else "none known"
    print(f"  {said:10s} {name}, {rig}, seed {seed}: {verdict}", flush=True)
    for sentence in sentences:
        print(f"      {sentence}", flush=True)
    return said


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("names", nargs="*", help="parts of the names of faults or, for clean recordings, of rigs")
    parser.add_argument("--seeds", type=int, help="recordings a row; by default 10 without a fault, and 5 with one")
    parser.add_argument("--first-seed", type=int, default=0)
    given = parser.parse_args()
    rows = {f"no fault: {rig}": (None, (rig,)) for rig in RIGS} | {n: (f, f.rigs) for n, f in FAULTS.items()}
    table, failed = [], False
    for name, (fault, rigs) in rows.items():
        if given.names and not any(part in name for part in given.names):
            continue
        seeds = range(given.first_seed, given.first_seed + (given.seeds or (5 if fault else 10)))
        said = [row(name, seed, fault, rigs[k % len(rigs)]) for k, seed in enumerate(seeds)]
        true, unknown, wrong = (said.count(s) for s in ("true", "none known", "WRONG"))
        failed |= wrong > 0 or (fault is not None and true < 0.8 * len(said))
        table.append(f"| {name} | {true} | {unknown} | {wrong} |")
    print("\n| recordings | true cause first, or no fault named | none known | wrong cause |\n|---|---|---|---|")
    print("\n".join(table))
    return int(failed)


if __name__ == "__main__":
    sys.exit(main())
