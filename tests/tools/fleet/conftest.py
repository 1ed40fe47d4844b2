"""Two robots with two recordings each; one of them had a camera turned in between."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import pytest
import yaml
from scipy.spatial.transform import Rotation

from icalib.export.formats import output_files
from icalib.pipeline import calibrate
from icalib.result import Calibration
from icalib.rig.file import rig_to_dict
from icalib.tools.fleet import run as run_module
from icalib.tools.fleet.result import JobOutcome, JobRecord, JobTask
from icalib.tools.simulation import Scenario, handheld, rig_for, simulate, write_tables

# Of cam1 about its x axis: ten times the standard deviation of the difference of two calibrations from 6 s.
TURN = 10.0 * np.sqrt(2.0) * 1.03e-4
JOBS = """\
defaults: {rig: rig.yaml}
jobs:
  - {robot: anton, recording: r0, time: 2026-10-01}
  - {robot: anton, recording: turned, time: 2026-10-08}
  - {robot: berta, recording: r0, time: 2026-10-01}
  - {robot: berta, recording: r1, time: 2026-10-02T13:05:00+01:00}
"""
NAMES = ["anton-r0", "anton-turned", "berta-r0", "berta-r1"]


def _turned(scenario: Scenario) -> Scenario:
    cam0, cam1 = scenario.cameras
    T = cam1.T_imu_sensor.copy()
    T[:3, :3] = T[:3, :3] @ Rotation.from_rotvec([TURN, 0.0, 0.0]).as_matrix()
    return replace(scenario, cameras=(cam0, replace(cam1, T_imu_sensor=T)))


@pytest.fixture(scope="session")
def recorded(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """rig.yaml and the recordings r0, r1 and turned."""
    folder, scenario = tmp_path_factory.mktemp("recorded"), handheld(6.0)
    (folder / "rig.yaml").write_text(yaml.safe_dump(rig_to_dict(rig_for(scenario))))
    for seed, name, one in ((0, "r0", scenario), (1, "r1", scenario), (2, "turned", _turned(scenario))):
        write_tables(simulate(one, seed), seed, folder / name)
    return folder


@pytest.fixture(scope="session")
def results(recorded: Path) -> dict[str, Calibration]:
    """By the name of the recording."""
    return {name: calibrate(recorded / "rig.yaml", recorded / name) for name in ("r0", "r1", "turned")}


@pytest.fixture
def fleet_folder(recorded: Path, tmp_path: Path) -> Path:
    """A folder of one's own with JOBS.yaml, rig.yaml and the recordings."""
    for name in ("r0", "r1", "turned"):
        (tmp_path / name).symlink_to(recorded / name)
    (tmp_path / "rig.yaml").write_text((recorded / "rig.yaml").read_text())
    (tmp_path / "JOBS.yaml").write_text(JOBS)
    return tmp_path


_FILES: dict[int, dict[str, bytes]] = {}  # by the id of a result that lives as long as the session


@dataclass
class Workshop:
    """In place of workers: gives the results that are known, fails where there is none, and keeps the order's names.
    interrupt: Ctrl-C after that many jobs."""

    results: dict[str, Calibration]
    done: list[str]
    interrupt: int | None = None
    change: Callable[[str, Calibration], Calibration] = lambda job, c: c

    def run_all(self, work: object, tasks: list[JobTask], crew: object) -> Iterator[tuple[JobTask, object]]:
        for k, task in enumerate(tasks):
            if k == self.interrupt:
                raise KeyboardInterrupt
            self.done.append(task.job.name)
            yield task, self.outcome(task)

    def outcome(self, task: JobTask) -> JobOutcome:
        result = self.results.get(task.job.recordings[0].name)
        if result is None:
            sentence = f"{task.job.recordings[0].name} is cut off; record <again>."
            return JobOutcome(JobRecord(task.job.name, sentence, 0.1, task.inputs), {})
        changed = self.change(task.job.name, result)
        files = self._files(result) if changed is result else output_files(changed)
        return JobOutcome(JobRecord.of(task.job.name, changed, 1.0, task.inputs), files)

    def _files(self, result: Calibration) -> dict[str, bytes]:
        """Of one of `results`, made once: a report takes its time."""
        if id(result) not in _FILES:
            _FILES[id(result)] = output_files(result)
        return _FILES[id(result)]


@pytest.fixture
def workers_replaced(results: dict[str, Calibration], monkeypatch: pytest.MonkeyPatch) -> Callable[[], Workshop]:
    """From its call on there are no real workers."""

    def replaced() -> Workshop:
        found = Workshop(results, [])
        monkeypatch.setattr(run_module, "run_all", found.run_all)
        return found

    return replaced


@pytest.fixture
def workshop(workers_replaced: Callable[[], Workshop]) -> Workshop:
    return workers_replaced()
