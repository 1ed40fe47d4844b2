"""What is measured: one function a group, each run in a fresh process by run.py. Times are medians of wall times;
`cpu` sums all cores, and other work on the machine hardly disturbs it."""

from __future__ import annotations

import dataclasses
import importlib.util
import os
import resource
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np

import icalib
from icalib.data.measurements import CornerStream, ImuStream, Measurements
from icalib.data.recordings import open_recording, read_measurements
from icalib.estimate.inputs import inputs_for
from icalib.estimate.problem import assemble
from icalib.pipeline import calibrate_measurements
from icalib.rig import Rig
from icalib.sensors.camera.initialize import initial_state
from icalib.sensors.camera.initialize.target_with_imu import initial_guess
from icalib.sensors.camera.model import MODEL

EXAMPLES = Path(__file__).resolve().parent.parent / "examples" / "euroc"
PLAIN_CORNER_NOISE_PX = 0.3
PAUSE_S = 1.0  # between repetitions: longer than `max_gap_s`, so that no IMU reading bridges the seam


@dataclasses.dataclass(frozen=True)
class Figure:
    """One measured number."""

    name: str
    value: float
    unit: str

    def as_dict(self) -> dict[str, str | float]:
        return dataclasses.asdict(self)


def measure(group: str, recording: Path) -> list[Figure]:
    """The figures of `group`; `recording` is the folder euroc_imu_april."""
    name, _, argument = group.partition(":")
    if name == "command":
        return command(recording)
    rig = icalib.load_rig(EXAMPLES / ("rig-from-nothing.yaml" if name == "from-nothing" else "rig.yaml"))
    measurements = read_measurements(open_recording(recording), rig)
    if name == "duration":
        return duration(plain(rig), measurements, int(argument))
    if name == "sums":
        return sums("sums.plain", plain(rig), measurements) + sums("sums.honest", rig, measurements)
    if name == "gtsam":
        return gtsam(plain(rig), measurements)
    return whole(name, plain(rig) if name == "plain" else rig, measurements)


def plain(rig: Rig) -> Rig:
    """`rig` with the plain model: every corner as good as any other, no bloom, a flat board, no splits."""
    settings = dataclasses.replace(
        rig.settings, bloom=False, board_shape=False, blur_noise=False, common_error=False, segments=0, loss="huber"
    )
    cameras = tuple(dataclasses.replace(c, corner_noise_px=PLAIN_CORNER_NOISE_PX) for c in rig.cameras)
    return rig.with_(cameras=cameras, settings=settings)


def median_time(run: Callable[[], object], repeats: int) -> float:
    """Seconds, after one run that is not counted."""
    run()
    laps = []
    for _ in range(repeats):
        started = time.perf_counter()
        run()
        laps.append(time.perf_counter() - started)
    return float(np.median(laps))


def peak_memory(who: int = resource.RUSAGE_SELF) -> float:
    """MB (1e6 bytes) that a process held at most so far."""
    unit = 1 if sys.platform == "darwin" else 1024
    return resource.getrusage(who).ru_maxrss * unit * 1e-6


def whole(name: str, rig: Rig, measurements: Measurements, repeats: int = 5) -> list[Figure]:
    """From corners in memory to covariance, warm."""
    results = []
    total = median_time(lambda: results.append(calibrate_measurements(rig, measurements)), repeats)
    fastest = min(sum(r.timings.values()) for r in results[1:])
    cpu = time.process_time()
    calibrate_measurements(rig, measurements)
    cpu = time.process_time() - cpu
    stages = {s: float(np.median([r.timings[s] for r in results[1:]])) for s in results[0].timings}
    return [
        Figure(f"{name}.all", total, "s"),
        Figure(f"{name}.fastest", fastest, "s"),
        Figure(f"{name}.cpu", cpu, "s"),
        *(Figure(f"{name}.{stage.replace(' ', '_')}", value, "s") for stage, value in stages.items()),
        Figure(f"{name}.iterations", len(results[0].iterations), "1"),
        Figure(f"{name}.peak_memory", peak_memory(), "MB"),
    ]


def sums(name: str, rig: Rig, measurements: Measurements) -> list[Figure]:
    """Residuals, Jacobians and sums of the normal equations at the first state."""
    inputs = inputs_for(rig, [measurements])
    state = initial_state(inputs, initial_guess(rig, measurements))
    problem = assemble(inputs, state, MODEL.first_noise(rig.cameras, rig, measurements))
    pieces, out = problem.pieces(), problem.residuals()
    seconds = median_time(lambda: problem.linearise(state, pieces, out), 9)
    corners = sum(len(s.uv) for s in measurements.cameras)
    return [Figure(f"{name}.linearise", seconds, "s"), Figure(f"{name}.corners_per_second", corners / seconds, "1/s")]


def command(recording: Path) -> list[Figure]:
    """The whole command in fresh processes; cold: no compiled kernel is kept from before."""
    with tempfile.TemporaryDirectory() as scratch:
        environment = os.environ | {"NUMBA_CACHE_DIR": str(Path(scratch) / "kernels")}

        def python(*arguments: str) -> None:
            subprocess.run([sys.executable, *arguments], env=environment, stdout=subprocess.DEVNULL, check=True)

        def calibrate() -> None:
            code = "import sys; from icalib.cli import main; sys.exit(main())"
            rig, output = str(EXAMPLES / "rig.yaml"), str(Path(scratch) / "out")
            python("-c", code, "calibrate", rig, str(recording), "--output", output)

        started = time.perf_counter()
        calibrate()
        cold = time.perf_counter() - started
        return [
            Figure("command.cold", cold, "s"),
            Figure("command.warm", median_time(calibrate, 3), "s"),
            Figure("command.peak_memory", peak_memory(resource.RUSAGE_CHILDREN), "MB"),
            Figure("command.import_icalib", median_time(lambda: python("-c", "import icalib"), 5), "s"),
            Figure("command.import_pipeline", median_time(lambda: python("-c", "import icalib.pipeline"), 5), "s"),
            Figure("command.python_alone", median_time(lambda: python("-c", "pass"), 5), "s"),
        ]


def repeated(measurements: Measurements, n: int) -> Measurements:
    """The recording `n` times end to end, with a pause in which nobody measures."""
    streams = (measurements.imu, *measurements.cameras)
    first, last = min(int(s.stamps_ns[0]) for s in streams), max(int(s.stamps_ns[-1]) for s in streams)
    shift = np.arange(n, dtype=np.int64)[:, None] * np.int64(last - first + round(PAUSE_S * 1e9))

    def stamps(s: ImuStream | CornerStream) -> np.ndarray:
        return (s.stamps_ns + shift).ravel()

    def camera(s: CornerStream) -> CornerStream:
        start = np.concatenate([[0], (s.start[1:] + np.arange(n)[:, None] * len(s.uv)).ravel()])
        return CornerStream(s.name, stamps(s), start, np.tile(s.point, n), np.tile(s.uv, (n, 1)))

    imu = measurements.imu
    assert imu is not None
    whole_imu = ImuStream(imu.name, stamps(imu), np.tile(imu.gyro, (n, 1)), np.tile(imu.accel, (n, 1)))
    return Measurements.of_streams(whole_imu, *(camera(s) for s in measurements.cameras))


def duration(rig: Rig, measurements: Measurements, n: int) -> list[Figure]:
    """The plain model on `n` repetitions. Iterations differ a little with length: hence the time of one, too."""
    before = peak_memory()
    long = repeated(measurements, n)
    results = []
    cpu = time.process_time()
    seconds = median_time(lambda: results.append(calibrate_measurements(rig, long)), 1)
    cpu = (time.process_time() - cpu) / len(results)
    minutes = float(np.ptp(long.imu.stamps_ns)) * 1e-9 / 60.0
    name, iterations = f"duration.{n}", len(results[0].iterations)
    return [
        Figure(f"{name}.minutes", minutes, "min"),
        Figure(f"{name}.iterations", iterations, "1"),
        Figure(f"{name}.time", seconds, "s"),
        Figure(f"{name}.time_per_minute", seconds / minutes, "s/min"),
        Figure(f"{name}.cpu_per_minute", cpu / minutes, "s/min"),
        Figure(f"{name}.iteration_per_minute", results[-1].timings["solving"] / iterations / minutes, "s/min"),
        Figure(f"{name}.first_guess_per_minute", results[-1].timings["first guess"] / minutes, "s/min"),
        Figure(f"{name}.memory", peak_memory() - before, "MB"),
        Figure(f"{name}.memory_per_minute", (peak_memory() - before) / minutes, "MB/min"),
    ]


def gtsam(rig: Rig, measurements: Measurements) -> list[Figure]:
    """The same data by GTSAM, where it is installed."""
    if importlib.util.find_spec("gtsam") is None:
        print(
            "run.py: GTSAM is not installed (pip install 'icalib[benchmark]'); its comparison is left out.",
            file=sys.stderr,
        )
        return []
    from gtsam_comparison import compare

    return [Figure(f"gtsam.{name}", value, unit) for name, value, unit in compare(rig, measurements)]
