"""Peak memory of the command line on a long recording with images: `python benchmarks/memory.py FOLDER --minutes 10`.

A camera at 20 Hz beside an IMU. Its motion repeats every 20 s, so that only 400 pictures are rendered, of half EuRoC's
width and height; the IMU goes on measuring that motion with noise of its own. The bag is kept in FOLDER (1.1 GB for 10
minutes). `icalib calibrate` then runs in a process of its own whose corners nobody has kept, twice, because kernels may
have to be compiled the first time. Needs icalib[bags,images], and Linux or macOS.
"""

from __future__ import annotations

import argparse
import os
import sys
import tempfile
import time
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import yaml

from icalib.data.measurements import ImuStream
from icalib.rig import Settings
from icalib.rig.file import rig_to_dict
from icalib.tools.simulation import Scenario, handheld, rig_for, simulate, write_film
from icalib.tools.simulation.corners import image_stamps
from icalib.tools.simulation.filming import Film, Shot
from icalib.tools.simulation.motion import Waves, imu_stamps, read_imu, reference_motion
from icalib.tools.simulation.rendering import Imaging

PERIOD_S = 20.0
TARGET_MB = 500.0


@dataclass(frozen=True)
class Ended:
    """A process that has ended: peak memory [MB], seconds on the clock and of the processor, exit code."""

    peak_mb: float
    seconds: float
    cpu_seconds: float
    code: int


def main() -> int:
    options = _options()
    options.folder.mkdir(parents=True, exist_ok=True)
    scenario = scenario_of(60.0 * options.minutes)
    rig, bag = options.folder / "memory-rig.yaml", options.folder / f"memory-{options.minutes:g}min.bag"
    if options.render:
        return _render(scenario, bag)
    if not bag.exists():
        # Not in this process: what a child starts with counts as its own peak.
        rendered = in_a_process([__file__, *sys.argv[1:], "--render"], {})
        print(f"rendered in {rendered.seconds:.0f} s", flush=True)
    written = rig_to_dict(rig_for(scenario, settings=Settings(), intrinsics="free", distortion="free"))
    rig.write_text(yaml.safe_dump(written, sort_keys=False))
    for kernels in ("perhaps compiling", "compiled"):
        done = calibrated(rig, bag)
        print(f"{kernels:<18} {done.peak_mb:6.0f} MB, {done.seconds:6.1f} s, exit code {done.code}", flush=True)
    print(f"{'at most':<18} {TARGET_MB:6.0f} MB for 10 minutes")
    return done.code


def _options() -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folder", type=Path, metavar="FOLDER", help="where the bag is kept")
    parser.add_argument("--minutes", type=float, default=10.0, metavar="MIN", help="length of the recording (10)")
    parser.add_argument("--render", action="store_true", help=argparse.SUPPRESS)
    return parser.parse_args()


def scenario_of(duration_s: float) -> Scenario:
    """EuRoC's cam0 with half its pixels along each axis; the centre of the first two was at 0.5."""
    base = handheld(duration_s)
    cam0 = base.cameras[0]
    fx, fy, cx, cy = cam0.intrinsics
    half = replace(
        cam0,
        jitter_s=0.0,
        resolution=(cam0.resolution[0] // 2, cam0.resolution[1] // 2),
        intrinsics=(0.5 * fx, 0.5 * fy, 0.5 * (cx - 0.5), 0.5 * (cy - 0.5)),
    )
    return replace(base, cameras=(half,))


def _render(scenario: Scenario, bag: Path) -> int:
    part = bag.with_suffix(".part")
    part.unlink(missing_ok=True)  # of a run that was interrupted
    write_film(repeating_film(scenario), {"ros1": part})
    part.rename(bag)
    return 0


class RepeatingFilm(Film):
    """A film of a motion that repeats, whose pictures of the first period are shown again in each."""

    def shots(self, workers: int | None = None) -> Iterator[Shot]:
        first = replace(self.scenario, duration_s=PERIOD_S + 1.0)
        pictures = list(Film(first, self.seed, self.imaging, 0.0, self.imu, self.truth).shots(workers))
        camera = self.scenario.cameras[0]
        period = round(PERIOD_S * camera.rate_hz)
        stamps, seconds = image_stamps(self.scenario, camera, np.random.default_rng(0))
        for k, (stamp, t) in enumerate(zip(stamps.tolist(), seconds.tolist(), strict=True)):
            yield replace(pictures[k % period], stamp_ns=stamp, seconds=t)


def repeating_film(scenario: Scenario) -> Film:
    """Readings over the whole of `scenario`, of its motion with the nearest frequencies that fit into the period."""
    rng = np.random.default_rng(0)
    motion = reference_motion(scenario, rng)
    motion = replace(motion, angles=_repeating(motion.angles), shifts=_repeating(motion.shifts))
    stamps = imu_stamps(scenario, rng)
    seconds = 1e-9 * stamps
    readings = read_imu(scenario, seconds, motion.readings_at(seconds), rng)
    imu = ImuStream("imu0", stamps + np.int64(scenario.imu_clock_origin_ns), readings.gyro, readings.accel)
    short = simulate(replace(scenario, duration_s=2.0), 0).truth
    return RepeatingFilm(scenario, 0, Imaging(blur_px=0.8, noise=2.0), 0.0, imu, replace(short, trajectory=motion))


def _repeating(waves: Waves) -> Waves:
    return replace(waves, frequency=np.round(waves.frequency * PERIOD_S) / PERIOD_S)


def calibrated(rig: Path, bag: Path) -> Ended:
    """What the command line needed."""
    run = "import sys; from icalib.cli import main; sys.exit(main())"
    with tempfile.TemporaryDirectory() as empty:
        options = ["calibrate", str(rig), str(bag), "--output", f"{empty}/out", "--quiet"]
        return in_a_process(["-c", run, *options], {"ICALIB_CACHE": f"{empty}/corners"})


def in_a_process(arguments: list[str], environment: dict[str, str]) -> Ended:
    """Python with `arguments`, its peak memory that of this process at least."""
    started = time.perf_counter()
    child = os.posix_spawn(sys.executable, [sys.executable, *arguments], os.environ | environment)
    _, status, used = os.wait4(child, 0)
    unit = 1 if sys.platform == "darwin" else 1024
    seconds, cpu = time.perf_counter() - started, used.ru_utime + used.ru_stime
    return Ended(used.ru_maxrss * unit * 1e-6, seconds, cpu, os.waitstatus_to_exitcode(status))


if __name__ == "__main__":
    sys.exit(main())
