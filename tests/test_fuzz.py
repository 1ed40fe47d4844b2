"""A few cases of `benchmarks/fuzz.py`: whatever is changed, commands end in one sentence and leave the user's files."""

from __future__ import annotations

import json
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from types import ModuleType

import numpy as np
import pytest
import yaml
from tests.cases import each

from icalib import cli

pytestmark = pytest.mark.slow

BENCHMARKS = Path(__file__).parents[1] / "benchmarks"


@pytest.fixture
def mutators(benchmark_program: Callable[[str], ModuleType]) -> ModuleType:
    return benchmark_program("fuzz_mutators")


@pytest.mark.skipif(sys.platform == "win32", reason="processes are forked")
@pytest.mark.parametrize("count", [60, pytest.param(300, marks=pytest.mark.full)])
def test_some_cases(count: int):
    """Those that have every kind of change of the first `count`."""
    command = [sys.executable, str(BENCHMARKS / "fuzz.py"), "--count", str(count), "--seed", "1", "--covering"]
    ended = subprocess.run(command, capture_output=True, text=True, timeout=600, check=False)
    assert ended.returncode == 0, ended.stdout[-5000:] + ended.stderr[-2000:]
    assert ": 0 failed" in ended.stdout and "; 0 good inputs refused" in ended.stdout


@pytest.mark.skipif(sys.platform == "win32", reason="processes are forked")
@each(
    ("said", "content", "fault"),
    [
        ("icalib: a.yaml:1: must be a mapping, but is 'nan nan nan ...'.\n", b"nan\nnan\nnan\nnan\n", False),
        ("icalib: a.csv:3: wx [rad/s] is '-inf', which is not a number.\n", b"1,-inf,3\n", False),
        ("icalib: cam0's offset is '.nan', imu0's is 1.\n", b"offset: .nan\n", False),
        ("icalib: cam.yaml:10: sensors.imu0.noise.nan: there is no such field.\n", b"nan: 1", False),
        ("icalib: cam.yaml:10: sensors.imu0.noise: is nan, but must be above 0.\n", b"noise: nan", True),
        ("icalib: cam0 is nan px off.\n", b"offset: nan\n", True),
        ("icalib: cam0 is 'nan' px off.\n", b"offset: 1\n", True),
        ("icalib: cam0's shift is 0 to inf, imu0's 1.\n", b"inf", True),
        ("icalib: inference and nanoseconds are words.\n", b"", False),
    ],
)
def test_numbers_that_are_none_may_only_be_quoted(said: str, content: bytes, fault: bool, benchmark_program):
    assert benchmark_program("fuzz_run").says_no_number(said, content) == fault


@pytest.mark.skipif(sys.platform == "win32", reason="processes are forked")
@each("value", [float("nan"), float("inf"), 1.0])
@each("suffix", [".json", ".yaml"])
def test_results_may_quote_nan_but_hold_none(value: float, suffix: str, benchmark_program, tmp_path: Path):
    path = tmp_path / f"made{suffix}"
    plain = {"notes": ["a.csv:3: wx is '.nan', which is not a number"], "sensors": {"cam0": {"std": [1.0, value]}}}
    path.write_text(json.dumps(plain) if suffix == ".json" else yaml.safe_dump(plain))
    assert benchmark_program("fuzz_run").holds_no_number(path) == (value != 1.0)


@pytest.mark.skipif(sys.platform == "win32", reason="processes are forked")
def test_good_input_that_is_refused_is_told(benchmark_program, capsys, tmp_path: Path):
    run, cases = benchmark_program("fuzz_run"), benchmark_program("fuzz_cases")
    (tmp_path / "good").mkdir()
    (tmp_path / "good" / "rig.yaml").write_text("sensors: {}\n")
    case = cases.Case(0, -1, "rig", "", ("inspect", "nothing", "-q"))
    assert run.refused_inputs([case], tmp_path / "good", tmp_path / "cases", 60.0) == [case]
    assert "good input: rig : icalib inspect nothing" in capsys.readouterr().out


@pytest.mark.skipif(sys.platform == "win32", reason="processes are forked")
def test_few_cases_cover_all_kinds(benchmark_program, tmp_path: Path):
    cases, mutators = benchmark_program("fuzz_cases"), benchmark_program("fuzz_mutators")
    names = {name for kind in cases._KINDS for name in kind.files}
    for name in names:
        path = tmp_path / name.replace("*", "a.csv" if "run" not in name else "a")
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text("a: [1, 2.5]\nb: text\n" * 20)
    np.savez(tmp_path / "rec" / "lidar0" / "scans.npz", xyz=np.ones((4, 3)), stamps_ns=np.arange(4))
    chosen = cases.covering(3, 2000, tmp_path)
    kinds = {step.kind for c in chosen for step in mutators.mutated(tmp_path / c.file, c.rng())[0]}
    assert len(chosen) < 40
    assert {
        "bytes flip",
        "bytes count",
        "text alias",
        "text token",
        "text laughs",
        "text whole",
        "arrays drop",
        "arrays rows",
    } <= kinds
    assert {c.kind for c in chosen} == {kind.name for kind in cases._KINDS} - {"jobs", "study"}


def test_a_seed_gives_the_same_case_again(mutators: ModuleType, tmp_path: Path):
    content = b"a: [1, 2.5]\nb: text\n" * 20
    seen = set()
    for seed in range(30):
        found = []
        for name in ("one.yaml", "two.yaml"):
            (tmp_path / name).write_bytes(content)
            how = mutators.mutate(tmp_path / name, np.random.default_rng(seed))
            found.append((how, (tmp_path / name).read_bytes() if (tmp_path / name).is_file() else b""))
            (tmp_path / name).unlink()
        assert found[0] == found[1]
        seen.add(found[0][1])
    assert len(seen) > 20


@pytest.mark.parametrize(
    ("error", "words"),
    [
        (PermissionError(13, "Permission denied", "/secret"), "/secret cannot be used: Permission denied; check"),
        (MemoryError(), "the memory of this machine is not enough"),
    ],
)
def test_what_fails_outside_is_one_sentence(error: Exception, words: str, monkeypatch, capsys, tmp_path: Path):
    def failing(path: Path) -> None:
        raise error

    monkeypatch.setattr("icalib.rig.file.load_rig", failing)
    assert cli.main(["calibrate", "rig.yaml", "rec", "-o", str(tmp_path)]) == 1
    said = capsys.readouterr().err
    assert words in said and said.count("\n") == 1
