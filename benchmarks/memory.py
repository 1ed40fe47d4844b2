"""Peak memory of the command line on a long recording with images: `python benchmarks/memory.py FOLDER --minutes 10`.

A camera at 20 Hz beside an IMU, filmed while being moved by hand; its images are half of EuRoC's in width and
height, so that rendering takes minutes, and memory hardly depends on them: only a few are held at a time. The bag is
kept in FOLDER (1.1 GB for 10 minutes). `icalib calibrate` then runs in a process of its own whose corners nobody has
kept, twice, because kernels may have to be compiled the first time. Needs icalib[bags,images], and Linux or macOS.
"""

from __future__ import annotations

import argparse
import dataclasses
import os
import sys
import tempfile
import time
from pathlib import Path

import yaml

from icalib.rig import Settings
from icalib.rig_file import rig_to_dict
from icalib.simulation import Scenario, film, handheld, rig_for, write_film

TARGET_MB = 500.0


def main() -> int:
    options = _options()
    options.folder.mkdir(parents=True, exist_ok=True)
    scenario = scenario_of(60.0 * options.minutes)
    rig, bag = options.folder / "memory-rig.yaml", options.folder / f"memory-{options.minutes:g}min.bag"
    if options.render:
        return _render(scenario, bag)
    if not bag.exists():
        # Not in this process: what a child starts with counts as its own peak.
        _, seconds, _ = _in_a_process([__file__, *sys.argv[1:], "--render"], {})
        print(f"rendered in {seconds:.0f} s", flush=True)
    written = rig_to_dict(rig_for(scenario, settings=Settings(), intrinsics="free", distortion="free"))
    rig.write_text(yaml.safe_dump(written, sort_keys=False))
    code = 0
    for kernels in ("perhaps compiling", "compiled"):
        peak, seconds, code = calibrated(rig, bag)
        print(f"{kernels:<18} {peak:6.0f} MB, {seconds:6.1f} s, exit code {code}", flush=True)
    print(f"{'at most':<18} {TARGET_MB:6.0f} MB for 10 minutes")
    return code


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
    half = dataclasses.replace(
        cam0,
        resolution=(cam0.resolution[0] // 2, cam0.resolution[1] // 2),
        intrinsics=(0.5 * fx, 0.5 * fy, 0.5 * (cx - 0.5), 0.5 * (cy - 0.5)),
    )
    return dataclasses.replace(base, cameras=(half,))


def _render(scenario: Scenario, bag: Path) -> int:
    part = bag.with_suffix(".part")
    part.unlink(missing_ok=True)  # of a run that was interrupted
    write_film(film(scenario, 0), {"ros1": part})
    part.rename(bag)
    return 0


def calibrated(rig: Path, bag: Path) -> tuple[float, float, int]:
    """Peak memory [MB], seconds and exit code of the command line."""
    run = "import sys; from icalib.cli import main; sys.exit(main())"
    with tempfile.TemporaryDirectory() as empty:
        options = ["calibrate", str(rig), str(bag), "--output", f"{empty}/out", "--quiet"]
        return _in_a_process(["-c", run, *options], {"ICALIB_CACHE": f"{empty}/corners"})


def _in_a_process(arguments: list[str], environment: dict[str, str]) -> tuple[float, float, int]:
    """Peak memory [MB], seconds and exit code of Python with `arguments`."""
    started = time.perf_counter()
    child = os.posix_spawn(sys.executable, [sys.executable, *arguments], os.environ | environment)
    _, status, used = os.wait4(child, 0)
    unit = 1 if sys.platform == "darwin" else 1024
    return used.ru_maxrss * unit * 1e-6, time.perf_counter() - started, os.waitstatus_to_exitcode(status)


if __name__ == "__main__":
    sys.exit(main())
