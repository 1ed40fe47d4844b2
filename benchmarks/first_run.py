"""Time of a first run, which compiles the kernels, beside that of a later one: `python benchmarks/first_run.py`.

Four commands `icalib calibrate`, each in processes of their own. The first has no compiled kernels, the second has
those of the first; neither has corners of an earlier run. Times are those of the processor (user and system, all
threads), so that other work on the machine disturbs them less. Needs icalib[bags,images], the recordings
`euroc_imu_april` and `wheel_mocap` in $ICALIB_DATA or ../shared/data, and Linux or macOS.
"""

from __future__ import annotations

import argparse
import os
import sys
import tempfile
from dataclasses import replace
from pathlib import Path

import numpy as np
import yaml
from golden_cases import WHEEL_MOCAP, write_wheel_tables
from memory import in_a_process
from rendered import rig_of, scenario_of

from icalib.rig.file import rig_to_dict
from icalib.sensors.lidar.simulate import SimLidar
from icalib.tools.simulation import Scenario, film, load_scenario, simulate, write_film, write_sensors

ROOT = Path(__file__).resolve().parent.parent
DATA = Path(os.environ.get("ICALIB_DATA", ROOT.parent / "shared" / "data"))
SECONDS = 10.0  # of the two simulated recordings
RUN = "import sys; from icalib.cli import main; sys.exit(main())"


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("cases", nargs="*", metavar="CASE", help=f"some of: {', '.join(CASES)} (all)")
    names = parser.parse_args().cases or list(CASES)
    print(f"{'case':<14}{'first cpu s':>12}{'s':>7}{'later cpu s':>12}{'s':>7}{'compilation cpu s':>19}", flush=True)
    worst = 0
    for name in names:
        with tempfile.TemporaryDirectory() as folder:
            rig, recording = CASES[name](Path(folder))
            first, later = (_calibrated(Path(folder), rig, recording, k) for k in ("first", "later"))
        row = f"{first[0]:>12.1f}{first[1]:>7.1f}{later[0]:>12.1f}{later[1]:>7.1f}{first[0] - later[0]:>19.1f}"
        print(f"{name:<14}{row}", flush=True)
        worst = max(worst, first[2], later[2])
    return worst


def _calibrated(folder: Path, rig: Path, recording: Path, run: str) -> tuple[float, float, int]:
    """Seconds of the processor, seconds, and exit code."""
    places = {"NUMBA_CACHE_DIR": str(folder / "kernels"), "ICALIB_CACHE": str(folder / f"corners-{run}")}
    options = ["calibrate", str(rig), str(recording), "--output", str(folder / f"out-{run}"), "--quiet"]
    done = in_a_process(["-c", RUN, *options], places)
    return done.cpu_seconds, done.seconds, done.code


def _euroc(folder: Path) -> tuple[Path, Path]:
    return ROOT / "examples" / "euroc" / "rig.yaml", DATA / "euroc_imu_april"


def _rendered(folder: Path) -> tuple[Path, Path]:
    """A camera in front of a target."""
    scenario, bag = scenario_of("pinhole", SECONDS), folder / "recording.bag"
    write_film(film(scenario, 0), {"ros1": bag})
    return _rig_file(scenario, folder), bag


def _lidar(folder: Path) -> tuple[Path, Path]:
    """A LiDAR in a room, in free motion."""
    scenario = load_scenario(ROOT / "examples" / "paper" / "table2-3d.yaml")
    scenario = replace(scenario, duration_s=SECONDS, cameras=(), sensors=scenario.of(SimLidar), features=None)
    bag = folder / "recording.bag"
    write_sensors(simulate(scenario, 0), 0, bag)
    return _rig_file(scenario, folder), bag


def _rig_file(scenario: Scenario, folder: Path) -> Path:
    """Without guesses."""
    rig = folder / "rig.yaml"
    rig.write_text(yaml.safe_dump(rig_to_dict(rig_of(scenario)), sort_keys=False), encoding="utf-8")
    return rig


def _wheel_mocap(folder: Path) -> tuple[Path, Path]:
    rig, tables = folder / "rig.yaml", folder / "tables"
    rig.write_text(WHEEL_MOCAP, encoding="utf-8")
    (path,) = (DATA / "wheel_mocap").glob("diff/square/*/*_run-01.csv")
    write_wheel_tables(tables, np.loadtxt(path, delimiter=","))
    return rig, tables


CASES = {"euroc": _euroc, "rendered": _rendered, "lidar": _lidar, "wheel-mocap": _wheel_mocap}


if __name__ == "__main__":
    sys.exit(main())
