"""Studies with real runs on real workers: the same whatever their number, resumed after being killed."""

from __future__ import annotations

import json
import signal
import socket
import subprocess
import sys
import time
from contextlib import ExitStack, suppress
from pathlib import Path

import psutil
import pytest

from icalib.base.extras import load_distributed
from icalib.errors import CalibrationError
from icalib.tools.montecarlo import RunRecord, RunTask, Study, StudyPlan, run_study
from icalib.tools.montecarlo import study as study_module
from icalib.tools.montecarlo.record import Identity, RunStore
from icalib.tools.montecarlo.study import run_all
from icalib.tools.simulation import Scenario, handheld

pytestmark = pytest.mark.slow

RUNS = 3
_SCRIPT = """
import sys
from pathlib import Path
from icalib.tools.montecarlo import StudyPlan, run_study
from icalib.tools.simulation import handheld

if __name__ == "__main__":
    run_study(handheld(6.0), "handheld", "digest", Path(sys.argv[1]), StudyPlan(int(sys.argv[2]), workers=1))
"""


def study(folder: Path, runs: int = RUNS, digest: str = "digest", **plan) -> Study:
    return run_study(handheld(6.0), "handheld", digest, folder, StudyPlan(runs, **plan))


@pytest.fixture(scope="module")
def alone(tmp_path_factory) -> Path:
    """By one worker."""
    folder = tmp_path_factory.mktemp("alone") / "new" / "study"
    study(folder, workers=1)
    return folder


def written(folder: Path) -> dict[str, tuple[int, bytes]]:
    return {f.name: (f.stat().st_mtime_ns, f.read_bytes()) for f in (folder / "runs").iterdir()}


def test_two_workers_find_what_one_finds(alone: Path, tmp_path: Path):
    study(tmp_path, workers=2)
    assert (tmp_path / "consistency.json").read_bytes() == (alone / "consistency.json").read_bytes()
    for name, (_, content) in written(alone).items():
        one, two = json.loads(content), json.loads((tmp_path / "runs" / name).read_bytes())
        assert one | {"seconds": 0.0} == two | {"seconds": 0.0}


def test_what_is_written(alone: Path):
    assert sorted(f.name for f in alone.iterdir()) == [
        ".lock",
        "consistency.html",
        "consistency.json",
        "runs",
        "study.json",
    ]
    assert sorted(written(alone)) == [f"{seed:06d}.json" for seed in range(RUNS)]
    found = json.loads((alone / "consistency.json").read_bytes())
    assert (found["runs"], found["failures"], found["study"]["first_seed"]) == (RUNS, [], 0)
    rotation = found["blocks"][0]
    assert (rotation["sensor"], rotation["name"], rotation["dimension"]) == ("cam0", "rotation", 3)
    assert rotation["nees"]["low"] < 1.0 < rotation["nees"]["high"]
    assert 0.3 < rotation["rmse"] / rotation["mean_sigma"] < 3.0
    assert "cam0 rotation" in (alone / "consistency.html").read_text()


def test_a_study_that_was_killed_goes_on_and_repeats_nothing(alone: Path, tmp_path: Path):
    script, folder = tmp_path / "study.py", tmp_path / "out"
    script.write_text(_SCRIPT)
    with (tmp_path / "log").open("w") as log:
        process = subprocess.Popen([sys.executable, str(script), str(folder), str(RUNS)], stdout=log, stderr=log)
        deadline = time.monotonic() + 300.0
        while not (folder / "runs").is_dir() or len(list((folder / "runs").glob("0*.json"))) < 1:
            assert process.poll() is None and time.monotonic() < deadline, (tmp_path / "log").read_text()
            time.sleep(0.05)
        process.send_signal(signal.SIGKILL)
        process.wait()
    before = written(folder)
    assert not (folder / "consistency.json").exists()
    study(folder, workers=1)
    after = written(folder)
    assert len(before) < len(after) and {name: after[name] for name in before} == before
    assert (folder / "consistency.json").read_bytes() == (alone / "consistency.json").read_bytes()


@pytest.mark.full
def test_the_run_of_a_killed_worker_is_made_again():
    records = run_all([RunTask(handheld(6.0), seed) for seed in range(4)], workers=2)
    found = [next(records)]
    workers = [p for p in psutil.Process().children(recursive=True) if any("spawn_main" in a for a in p.cmdline())]
    assert len(workers) == 2
    workers[0].kill()
    found += records
    assert sorted(r.seed for r in found) == [0, 1, 2, 3] and not any(r.failure for r in found)


@pytest.mark.full
def test_studies_run_side_by_side():
    """Dask takes the port of its dashboard even without one, and warns where another study has it."""
    with ExitStack() as stack:
        with suppress(OSError):  # somebody else has it: all the better
            stack.enter_context(socket.create_server(("127.0.0.1", 8787)))
        assert list(run_all([], workers=1)) == []


def test_a_finished_study_starts_no_worker(alone: Path, monkeypatch):
    monkeypatch.setattr(study_module, "run_all", lambda *_: pytest.fail("a run was repeated"))
    before = written(alone)
    assert [r.seed for r in study(alone).records] == list(range(RUNS))
    assert study(alone, 2, seed=1).consistency.runs == 2
    study(alone)
    assert written(alone) == before


@pytest.mark.full
def test_more_runs_are_added_by_a_cluster(alone: Path, tmp_path: Path):
    distributed = load_distributed()
    study(tmp_path, 1, workers=1)
    before = written(tmp_path)
    local = {"n_workers": 1, "threads_per_worker": 1, "dashboard_address": ":0"}
    with distributed.LocalCluster(**local, silence_logs=60) as cluster:
        study(tmp_path, RUNS, scheduler=cluster.scheduler_address)
    assert {name: written(tmp_path)[name] for name in before} == before
    assert (tmp_path / "consistency.json").read_bytes() == (alone / "consistency.json").read_bytes()


@pytest.mark.parametrize(
    ("changed", "why"),
    [
        ({"digest": "another"}, "the scenario changed"),
        ({"guess": "drawn"}, "their initial guess differs"),
        ({"planes": "found"}, "planes are known in one study and found in the other"),
    ],
)
def test_runs_of_another_study_are_never_mixed_in(alone: Path, changed: dict, why: str):
    before = (alone / "consistency.json").read_bytes()
    with pytest.raises(CalibrationError, match=f"holds runs of another study \\({why}\\); choose another folder"):
        study(alone, **changed)
    assert (alone / "consistency.json").read_bytes() == before


def test_another_icalib_is_another_study(alone: Path, tmp_path: Path, monkeypatch):
    monkeypatch.setattr("icalib.tools.montecarlo.record.program", lambda: "another")
    with pytest.raises(CalibrationError, match="icalib changed"):
        study(alone)
    store = RunStore(tmp_path, Identity.of("handheld", "digest", "none", "known"))
    with pytest.raises(CalibrationError, match="a worker of the cluster runs another version of icalib"):
        store.add(RunRecord(0, "", 1.0, "yet another"))


def fill(folder: Path, records: list[RunRecord], monkeypatch, interrupt: bool = False) -> Study:
    """A study whose runs come from `records`; Ctrl-C after them."""

    def give(*_):
        yield from records
        if interrupt:
            raise KeyboardInterrupt

    monkeypatch.setattr(study_module, "run_all", give)
    return study(folder, len(records) + interrupt)


def test_failed_runs_are_kept_and_reported(tmp_path: Path, monkeypatch):
    good = RunRecord(0, "", 1.0, Identity.of("", "", "none", "known").program)
    bad = RunRecord(1, "no camera saw the <target>.", 1.0, good.program)
    found = fill(tmp_path, [bad, good], monkeypatch)
    assert [f.sentence for f in found.consistency.failures] == [bad.failure]
    assert len(written(tmp_path)) == 2
    assert "no camera saw the &lt;target&gt;." in (tmp_path / "consistency.html").read_text()


def test_a_run_that_killed_its_workers_is_reported_and_tried_again_the_next_time(tmp_path: Path, monkeypatch):
    good = RunRecord(0, "", 1.0, Identity.of("", "", "none", "known").program)
    lost = RunRecord(1, "its worker died again and again.", 0.0, "")
    assert fill(tmp_path, [good, lost], monkeypatch).consistency.failures[0].seed == 1
    assert list(written(tmp_path)) == ["000000.json"]
    assert fill(tmp_path, [RunRecord(1, "", 1.0, good.program), good], monkeypatch).consistency.failures == ()


def test_an_interrupted_study_says_what_is_there(tmp_path: Path, monkeypatch):
    good = RunRecord(0, "", 1.0, Identity.of("", "", "none", "known").program)
    with pytest.raises(KeyboardInterrupt, match="1 of 2 runs are in .*; the same command resumes"):
        fill(tmp_path, [good], monkeypatch, interrupt=True)
    assert list(written(tmp_path)) == ["000000.json"]


def test_damaged_files_are_named(alone: Path, tmp_path: Path):
    (tmp_path / "runs").mkdir()
    (tmp_path / "study.json").write_bytes((alone / "study.json").read_bytes())
    for content in (b"", b"{}", b'{"format": 1}', b"[]"):
        (tmp_path / "runs" / "000000.json").write_bytes(content)
        with pytest.raises(CalibrationError, match=r"000000\.json is damaged; delete it"):
            study(tmp_path, 1)
    (tmp_path / "study.json").write_text("{")
    with pytest.raises(CalibrationError, match=r"study\.json is damaged"):
        study(tmp_path, 1)


@pytest.mark.parametrize(
    ("plan", "sentence"),
    [
        ({"runs": 0}, "0 runs were asked for, but a study needs at least 1"),
        ({"runs": 1, "workers": 0}, "0 workers were asked for, but at least 1 is needed"),
        ({"runs": 1, "workers": 1, "scheduler": "tcp://here:1"}, "not both"),
    ],
)
def test_plans_that_make_no_sense(plan: dict, sentence: str):
    with pytest.raises(CalibrationError, match=sentence):
        StudyPlan(**plan)


def test_a_recorded_motion_is_part_of_the_scenario(tmp_path: Path):
    paper = Path(__file__).parents[3] / "examples" / "paper"
    for name in ("recorded.yaml", "trajectory.tum"):
        (tmp_path / name).write_bytes((paper / name).read_bytes())
    from icalib.tools.montecarlo.study import scenario_digest
    from icalib.tools.simulation import load_scenario

    def digest() -> str:
        scenario: Scenario = load_scenario(tmp_path / "recorded.yaml")
        return scenario_digest(tmp_path / "recorded.yaml", scenario)

    first = digest()
    assert digest() == first
    with (tmp_path / "trajectory.tum").open("a") as file:
        file.write("\n")
    second = digest()
    with (tmp_path / "recorded.yaml").open("a") as file:
        file.write("\n")
    assert len({first, second, digest()}) == 3
