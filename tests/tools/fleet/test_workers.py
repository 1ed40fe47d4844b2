"""Fleets with real calibrations on real workers: resumed after being killed, none lost and none done twice."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import psutil
import pytest

from icalib.errors import CalibrationError
from icalib.result import load_calibration
from icalib.tools.fleet import Crew, run_fleet
from icalib.tools.fleet.result import load_jobs

pytestmark = pytest.mark.slow

NAMES = ["anton-r0", "anton-turned", "berta-r0", "berta-r1"]
_FLEET = """
import sys
from icalib.tools.fleet import Crew, run_fleet

if __name__ == "__main__":
    run_fleet(sys.argv[1], sys.argv[2], Crew(workers=1))
"""
_CLUSTER = """
import sys, time
from pathlib import Path
from distributed import LocalCluster

if __name__ == "__main__":
    with LocalCluster(n_workers=1, threads_per_worker=1, dashboard_address=":0") as cluster:
        Path(sys.argv[1]).with_suffix(".part").write_text(cluster.scheduler_address)
        Path(sys.argv[1]).with_suffix(".part").rename(sys.argv[1])
        time.sleep(300)
"""


def started(folder: Path, text: str, *arguments: Path) -> subprocess.Popen:
    """A Python process that is the first of its own group."""
    (folder / "script.py").write_text(text)
    with (folder / "log").open("w") as log:
        command = [sys.executable, str(folder / "script.py"), *map(str, arguments)]
        return subprocess.Popen(command, stdout=log, stderr=log, start_new_session=True)


def wait_for(process: subprocess.Popen, folder: Path, pattern: str) -> None:
    deadline = time.monotonic() + 300.0
    while not list(folder.glob(pattern)):
        assert process.poll() is None and time.monotonic() < deadline, (folder / "log").read_text()
        time.sleep(0.02)


def records(folder: Path) -> dict[str, int]:
    return {f.parent.name: f.stat().st_mtime_ns for f in (folder / "out" / "jobs").glob("*/fleet-job.json")}


@pytest.mark.full
def test_a_killed_fleet_goes_on_and_repeats_nothing(fleet_folder: Path, workers_replaced):
    process = started(fleet_folder, _FLEET, fleet_folder / "JOBS.yaml", fleet_folder / "out")
    wait_for(process, fleet_folder, "out/jobs/*/fleet-job.json")
    os.killpg(process.pid, signal.SIGKILL)
    process.wait()
    before = records(fleet_folder)
    assert 1 <= len(before) < 4 and not (fleet_folder / "out" / "fleet.html").exists()
    workshop = workers_replaced()
    found = run_fleet(fleet_folder / "JOBS.yaml", fleet_folder / "out")
    assert sorted([*before, *workshop.done]) == NAMES and found.failed == ()
    assert {name: records(fleet_folder)[name] for name in before} == before


def test_the_job_of_a_killed_worker_is_done_again(fleet_folder: Path, results, same):
    with (fleet_folder / "JOBS.yaml").open("a") as file:
        file.write("  - {robot: berta, recording: absent}\n  - {robot: both, recording: [r0, r1]}\n")
    killed: list[int] = []

    def kill(words: str, done: float) -> None:
        children = psutil.Process().children(recursive=True)
        workers = [p for p in children if any("spawn_main" in a for a in p.cmdline())]
        if done > 0.0 and not killed:
            assert len(workers) == 2
            workers[0].kill()
            killed.append(workers[0].pid)

    found = run_fleet(fleet_folder / "JOBS.yaml", fleet_folder / "out", Crew(workers=2), progress=kill)
    assert len(killed) == 1 and len(records(fleet_folder)) == 6
    assert [(r.job.name, "absent does not exist" in r.sentence) for r in found.failed] == [("berta-absent", True)]
    assert [(d.robot, d.sensors) for d in found.drifted] == [("anton", ("cam1",))]
    one = load_calibration(fleet_folder / "out" / "jobs" / "anton-r0")
    assert same(one.groups, results["r0"].groups)
    joint = load_calibration(fleet_folder / "out" / "jobs" / "both-r0")
    assert [r.name for r in joint.recordings] == ["r0", "r1"]
    assert set(one.inputs) >= {str(load_jobs(fleet_folder / "JOBS.yaml")[0].rig)}


@pytest.mark.full
def test_a_killed_scheduler_is_one_sentence_and_loses_nothing(fleet_folder: Path, workers_replaced):
    process = started(fleet_folder, _CLUSTER, fleet_folder / "address")
    try:
        wait_for(process, fleet_folder, "address")
        crew = Crew(scheduler=(fleet_folder / "address").read_text())

        def kill(words: str, done: float) -> None:
            if done > 0.0:
                os.killpg(process.pid, signal.SIGKILL)

        with pytest.raises(
            CalibrationError, match="the connection to the Dask scheduler was lost; finished tasks are kept"
        ):
            run_fleet(fleet_folder / "JOBS.yaml", fleet_folder / "out", crew, progress=kill)
    finally:
        if process.poll() is None:
            os.killpg(process.pid, signal.SIGKILL)
        process.wait()
    before = records(fleet_folder)
    assert len(before) == 1
    workshop = workers_replaced()
    run_fleet(fleet_folder / "JOBS.yaml", fleet_folder / "out")
    assert sorted([*before, *workshop.done]) == NAMES
    assert {name: records(fleet_folder)[name] for name in before} == before
