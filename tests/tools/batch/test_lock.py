"""Two commands and one folder."""

from __future__ import annotations

import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest

from icalib.cli import main
from icalib.errors import CalibrationError
from icalib.tools.batch import exclusive_lock

HOLD = "import sys, time; from pathlib import Path; from icalib.tools.batch import exclusive_lock\n" + (
    "with exclusive_lock(Path(sys.argv[1])):\n    print('held', flush=True)\n    time.sleep(60)\n"
)


@pytest.fixture
def held(tmp_path: Path) -> Iterator[subprocess.Popen[str]]:
    """Another process at work in tmp_path."""
    with subprocess.Popen([sys.executable, "-c", HOLD, tmp_path], stdout=subprocess.PIPE, text=True) as other:
        assert other.stdout is not None and other.stdout.readline() == "held\n"
        yield other
        other.kill()


def test_a_folder_that_another_process_is_at_work_in_is_refused(tmp_path: Path, held):
    with pytest.raises(CalibrationError, match=f"another icalib uses {tmp_path}; wait"), exclusive_lock(tmp_path):
        pass


def test_the_lock_ends_with_its_process_however_it_ends(tmp_path: Path, held):
    held.kill()
    held.wait()
    for _ in range(2):
        with exclusive_lock(tmp_path):
            pass


def test_the_lock_ends_with_the_work_though_that_fails(tmp_path: Path):
    with pytest.raises(ZeroDivisionError), exclusive_lock(tmp_path):
        raise ZeroDivisionError
    with exclusive_lock(tmp_path):
        pass


def test_a_folder_that_cannot_be_written_is_a_sentence(tmp_path: Path):
    (tmp_path / "file").touch()
    with (
        pytest.raises(CalibrationError, match=r"file cannot be written .*; choose another"),
        exclusive_lock(tmp_path / "file"),
    ):
        pass


@pytest.mark.parametrize("command", ["montecarlo", "fleet"])
def test_commands_refuse_in_a_sentence(tmp_path: Path, held, capsys, command: str):
    scenario = Path(__file__).parents[3] / "examples" / "paper" / "standing.yaml"
    jobs = tmp_path / "JOBS.yaml"
    (tmp_path / "rig.yaml").touch()
    jobs.write_text("jobs:\n  - {robot: anton, rig: rig.yaml, recording: monday}\n")
    words = [str(scenario), "--runs", "1"] if command == "montecarlo" else [str(jobs)]
    assert main([command, *words, "--output", str(tmp_path), "--quiet"]) == 1
    assert f"another icalib uses {tmp_path}" in capsys.readouterr().err
