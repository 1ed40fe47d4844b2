"""`icalib montecarlo` and `icalib reproduce`: what they print, and one sentence where something is wrong."""

from __future__ import annotations

import sys
from dataclasses import replace
from io import StringIO
from pathlib import Path

import pytest
from rich.console import Console

from icalib.cli import main
from icalib.sensors.lidar.simulate import SimLidar
from icalib.sensors.wheels.simulate import SimWheels
from icalib.tools.batch import program
from icalib.tools.montecarlo import study as study_module
from icalib.tools.montecarlo.record import RunRecord
from icalib.tools.montecarlo.reproduce import FOLDER, MOTIONS
from icalib.tools.montecarlo.study import table
from icalib.tools.montecarlo.summary import block_row, summarise
from icalib.tools.simulation import load_scenario

PAPER = Path(__file__).parents[3] / "examples" / "paper"
SCENARIO = PAPER / "table2-3d.yaml"


@pytest.fixture
def runs(monkeypatch, record):
    """Runs are made up: every third fails."""

    def make(tasks, workers, scheduler):
        for task in tasks:
            one = replace(record(task.seed), program=program())
            yield one if task.seed % 3 != 2 else RunRecord(task.seed, "no camera saw the target.", 1.0, program())

    monkeypatch.setattr(study_module, "run_all", make)


def test_montecarlo_prints_the_table_and_the_failed_runs(runs, tmp_path: Path, capsys):
    assert main(["montecarlo", str(SCENARIO), "--runs", "30", "-o", str(tmp_path), "--seed", "6"]) == 0
    out = capsys.readouterr().out
    assert "cam0 rotation" in out and "wheel0 radii" in out and "all together" in out
    assert "10 of 30 runs failed" in out and "seed 8: no camera saw the target." in out
    assert sorted(f.stem for f in (tmp_path / "runs").iterdir())[::29] == ["000006", "000035"]
    assert main(["montecarlo", str(SCENARIO), "--runs", "30", "-o", str(tmp_path), "--seed", "6", "--quiet"]) == 0
    assert capsys.readouterr().out == ""


def test_the_table_is_whole_in_80_columns(record):
    def as_wide_as_table_2(found: RunRecord) -> RunRecord:
        """The longest names, and distortions known to 1e-5."""
        blocks = tuple(replace(b, sensor=b.sensor.replace("cam0", "wheel0")) for b in found.blocks)
        return replace(found, blocks=blocks, error=found.error / 30.0, covariance=found.covariance / 900.0)

    found = summarise([as_wide_as_table_2(record(seed)) for seed in range(30)])
    console = Console(width=80, file=StringIO())
    console.print(table(found))
    rows = console.file.getvalue().splitlines()  # type: ignore[attr-defined]
    row = next(r for r in rows if "wheel0 distortion" in r)
    block = next(b for b in found.blocks if b.key == "wheel0.distortion")
    assert row.split() == " ".join(block_row(block)).split()
    assert sum("wheel0 " in r for r in rows) == 4 and len(rows) < 17


def test_reproduce_leaves_figures_and_tables(runs, tmp_path: Path, capsys, assert_drawn):
    assert main(["reproduce", "--runs", "8", "--output", str(tmp_path)]) == 0
    page = (tmp_path / "reproduce.html").read_text()
    for motion, title in MOTIONS.items():
        assert (tmp_path / f"convergence-{motion}.png").read_bytes().startswith(b"\x89PNG")
        assert f"<h2>{title}</h2>" in page and f'id="{motion}-cam0.rotation"' in page
        assert (tmp_path / motion / "consistency.json").exists()
    assert "reproduce.html" in capsys.readouterr().out
    assert_drawn(page, {f"{motion}-cam0.rotation" for motion in MOTIONS})


def test_reproduce_without_any_good_run_still_reports(tmp_path: Path, monkeypatch, capsys):
    failed = [RunRecord(0, "no camera saw the target.", 1.0, program())]
    monkeypatch.setattr(study_module, "run_all", lambda *_: (r for r in failed))
    assert main(["reproduce", "--runs", "1", "--output", str(tmp_path)]) == 0
    assert "no camera saw the target." in (tmp_path / "reproduce.html").read_text()
    assert not list(tmp_path.glob("*.png"))


@pytest.mark.parametrize("motion", MOTIONS)
def test_the_scenarios_are_those_of_the_examples(motion: str):
    name = f"table2-{motion}.yaml"
    assert (FOLDER / name).read_bytes() == (PAPER / name).read_bytes()
    scenario = load_scenario(FOLDER / name)
    assert scenario.features and scenario.of(SimLidar) and scenario.of(SimWheels)


def sentence(capsys, *arguments: str) -> str:
    """What the command says on standard error; exit code 1."""
    assert main(list(arguments)) == 1
    text = capsys.readouterr().err
    assert text.startswith("icalib: ") and text.count("\n") == 1 and text.endswith(".\n")
    return text


def test_a_bad_scenario_is_one_sentence_and_leaves_nothing(tmp_path: Path, capsys):
    out = tmp_path / "out"
    assert "absent.yaml does not exist" in sentence(
        capsys, "montecarlo", str(tmp_path / "absent.yaml"), "--runs", "1", "-o", str(out)
    )
    (tmp_path / "bad.yaml").write_text(SCENARIO.read_text().replace("duration: 60", "duration: -1"))
    text = sentence(capsys, "montecarlo", str(tmp_path / "bad.yaml"), "--runs", "1", "-o", str(out))
    assert "bad.yaml:" in text and "duration" in text
    assert not out.exists()


def test_a_folder_that_cannot_be_written(tmp_path: Path, capsys):
    (tmp_path / "file").write_text("")
    text = sentence(capsys, "montecarlo", str(SCENARIO), "--runs", "1", "-o", str(tmp_path / "file" / "out"))
    assert "cannot be written" in text and "choose another folder" in text


@pytest.mark.parametrize("address", ["tcp://127.0.0.1:9", "nonsense://1"])
def test_no_scheduler_answers(tmp_path: Path, capsys, monkeypatch, address: str):
    monkeypatch.setattr("icalib.tools.batch.ANSWER_WITHIN_S", 1)
    arguments = ("montecarlo", str(SCENARIO), "--runs", "1", "-o", str(tmp_path), "--scheduler", address)
    assert f"no Dask scheduler answers at {address}; start one" in sentence(capsys, *arguments)


@pytest.mark.parametrize("module", ["distributed", "matplotlib.figure"])
def test_missing_packages_are_named(runs, tmp_path: Path, capsys, monkeypatch, module: str):
    if module == "distributed":
        monkeypatch.undo()
    monkeypatch.setitem(sys.modules, module, None)
    text = sentence(capsys, "reproduce", "--runs", "3", "-o", str(tmp_path))
    assert 'pip install ".[montecarlo]"' in text


@pytest.mark.parametrize(
    "arguments",
    [
        ["montecarlo", "x.yaml", "-o", "out"],
        ["montecarlo", "x.yaml", "-o", "out", "--runs", "0"],
        ["montecarlo", "x.yaml", "-o", "out", "--runs", "many"],
        ["montecarlo", "x.yaml", "-o", "out", "--runs", "2", "--workers", "0"],
        ["montecarlo", "x.yaml", "-o", "out", "--runs", "2", "--workers", "2", "--scheduler", "tcp://a:1"],
        ["montecarlo", "x.yaml", "-o", "out", "--runs", "2", "--guess", "truth"],
        ["montecarlo", "x.yaml", "-o", "out", "--runs", "2", "--planes", "guessed"],
        ["reproduce"],
    ],
)
def test_wrong_usage(arguments: list[str], capsys):
    with pytest.raises(SystemExit) as stopped:
        main(arguments)
    assert stopped.value.code == 2
    assert "error:" in capsys.readouterr().err


def test_an_interrupted_command_says_how_to_go_on(tmp_path: Path, monkeypatch, capsys, record):
    def make(tasks, workers, scheduler):
        yield replace(record(0), program=program())
        raise KeyboardInterrupt

    monkeypatch.setattr(study_module, "run_all", make)
    assert main(["montecarlo", str(SCENARIO), "--runs", "5", "-o", str(tmp_path)]) == 130
    assert capsys.readouterr().err.startswith(f"icalib: interrupted; 1 of 5 runs are in {tmp_path};")
