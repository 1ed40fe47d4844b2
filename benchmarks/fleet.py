"""A fleet under fire: ten robots with ten simulated recordings each, on two workers. A worker is killed, then the
command with its scheduler, then a cluster with its scheduler; no finished job may be lost or done twice. In one robot a
camera was turned half-way, which must be found.

python benchmarks/fleet.py FOLDER [--seconds 6]      FOLDER is new; about 3 MB a job
"""

from __future__ import annotations

import argparse
import os
import signal
import sqlite3
import subprocess
import sys
import time
from contextlib import closing
from dataclasses import replace
from pathlib import Path

import numpy as np
import psutil
import yaml

from icalib.rig.file import rig_to_dict
from icalib.tools.simulation import Scenario, handheld, rig_for, simulate, write_tables

ROBOTS, TIMES = 10, 10
TURNED = "robot3"
COMMAND = "import sys; from icalib.cli import main; sys.exit(main())"
CLUSTER = """
import sys, time
from pathlib import Path
from distributed import LocalCluster
if __name__ == "__main__":
    with LocalCluster(n_workers=2, threads_per_worker=1, dashboard_address=":0") as cluster:
        Path(sys.argv[1]).write_text(cluster.scheduler_address + "\\n")
        time.sleep(3600)
"""


def turned(scenario: Scenario, angle: float) -> Scenario:
    """cam1 turned about its x axis [rad]."""
    cam0, cam1 = scenario.cameras
    T, c, s = cam1.T_imu_sensor.copy(), np.cos(angle), np.sin(angle)
    T[:3, :3] = T[:3, :3] @ [[1.0, 0.0, 0.0], [0.0, c, -s], [0.0, s, c]]
    return replace(scenario, cameras=(cam0, replace(cam1, T_imu_sensor=T)))


def record(folder: Path, seconds: float) -> None:
    """Recordings, rig.yaml and JOBS.yaml."""
    folder.mkdir(parents=True)
    scenario, jobs = handheld(seconds), []
    (folder / "rig.yaml").write_text(yaml.safe_dump(rig_to_dict(rig_for(scenario))))
    for k in range(ROBOTS * TIMES):
        robot, day = f"robot{k // TIMES}", k % TIMES
        angle = np.deg2rad(0.15) if robot == TURNED and day >= TIMES // 2 else 0.0
        name = f"{robot}-{day}"
        write_tables(simulate(turned(scenario, angle), k), k, folder / name)
        jobs.append({"name": name, "robot": robot, "recording": name, "time": f"2026-10-{day + 1:02}"})
    (folder / "JOBS.yaml").write_text(yaml.safe_dump({"defaults": {"rig": "rig.yaml"}, "jobs": jobs}))


def started(folder: Path, *command: str) -> subprocess.Popen:
    with (folder / "log").open("a") as log:
        return subprocess.Popen([sys.executable, *command], stdout=log, stderr=log, start_new_session=True)


def fleet(folder: Path, *who: str) -> subprocess.Popen:
    return started(folder, "-c", COMMAND, "fleet", str(folder / "JOBS.yaml"), "-o", str(folder / "out"), *who)


def finished(folder: Path) -> dict[str, int]:
    """When each job's record was written, by name."""
    return {f.parent.name: f.stat().st_mtime_ns for f in (folder / "out" / "jobs").glob("*/fleet-job.json")}


def wait_for(process: subprocess.Popen, folder: Path, count: int) -> None:
    while len(finished(folder)) < count:
        assert process.poll() is None, (folder / "log").read_text()
        time.sleep(0.02)


def kill_worker(process: subprocess.Popen) -> None:
    children = psutil.Process(process.pid).children(recursive=True)
    next(p for p in children if any("spawn_main" in a for a in p.cmdline())).kill()


def kill_all(process: subprocess.Popen) -> None:
    os.killpg(process.pid, signal.SIGKILL)
    process.wait()


def check(folder: Path, before: dict[str, int], what: str) -> dict[str, int]:
    now = finished(folder)
    kept = sum(now.get(name) == stamp for name, stamp in before.items())
    print(f"{what}: {len(now)} jobs finished; of the {len(before)} before, {kept} are there and untouched", flush=True)
    assert kept == len(before)
    return now


def under_fire(folder: Path) -> None:
    """The three kills, then to the end."""
    jobs = ROBOTS * TIMES
    process = fleet(folder, "--workers", "2")
    wait_for(process, folder, jobs // 5)
    before = finished(folder)
    kill_worker(process)
    wait_for(process, folder, 2 * jobs // 5)
    before = check(folder, before, "a killed worker")
    kill_all(process)
    (folder / "cluster.py").write_text(CLUSTER)
    cluster = started(folder, str(folder / "cluster.py"), str(folder / "address"))
    while not (folder / "address").exists() or not (folder / "address").read_text().endswith("\n"):
        time.sleep(0.1)
    process = fleet(folder, "--scheduler", (folder / "address").read_text().strip())
    wait_for(process, folder, 7 * jobs // 10)
    before = check(folder, before, "the command and its scheduler killed, gone on with a cluster")
    kill_all(cluster)
    code, said = process.wait(), (folder / "log").read_text().splitlines()[-1]
    print(f"the cluster killed: exit code {code}, {said}")
    assert code == 1 and said.startswith("icalib: the Dask scheduler went away")
    before = check(folder, before, "the cluster killed")
    process = fleet(folder, "--workers", "2")
    print(f"to the end: exit code {process.wait()}")
    assert len(check(folder, before, "to the end")) == jobs


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folder", type=Path)
    parser.add_argument("--seconds", type=float, default=6.0, help="of a recording")
    options = parser.parse_args()
    record(options.folder, options.seconds)
    begun = time.perf_counter()
    under_fire(options.folder)
    print(f"{time.perf_counter() - begun:.0f} s")
    with closing(sqlite3.connect(options.folder / "out" / "fleet.sqlite")) as base:
        print(base.execute("SELECT count(DISTINCT job), count(*), count(DISTINCT status) FROM results").fetchone())
    begun = time.perf_counter()
    fleet(options.folder).wait()
    print(f"nothing to do: {time.perf_counter() - begun:.1f} s")


if __name__ == "__main__":
    main()
