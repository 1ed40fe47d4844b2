"""A few cases of `benchmarks/fuzz.py`: whatever is changed, commands end in one sentence and leave the user's files."""

from __future__ import annotations

import importlib.util
import subprocess
import sys
from pathlib import Path
from types import ModuleType

import numpy as np
import pytest

from icalib import cli

BENCHMARKS = Path(__file__).parents[1] / "benchmarks"


@pytest.fixture
def mutators() -> ModuleType:
    spec = importlib.util.spec_from_file_location("fuzz_mutators", BENCHMARKS / "fuzz_mutators.py")
    assert spec is not None and spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


@pytest.mark.skipif(sys.platform == "win32", reason="processes are forked")
def test_some_cases():
    command = [sys.executable, str(BENCHMARKS / "fuzz.py"), "--count", "60", "--seed", "1", "--minutes", "0.5"]
    ended = subprocess.run(command, capture_output=True, text=True, timeout=600, check=False)
    assert ended.returncode == 0, ended.stdout[-5000:] + ended.stderr[-2000:]
    assert ": 0 failed" in ended.stdout


def test_a_seed_gives_the_same_case_again(mutators: ModuleType, tmp_path: Path):
    content = b"a: [1, 2.5]\nb: text\n" * 20
    seen = set()
    for seed in range(30):
        found = []
        for name in ("one.yaml", "two.yaml"):
            (tmp_path / name).write_bytes(content)
            how = mutators.mutate(tmp_path / name, np.random.default_rng(seed))
            found.append((how, (tmp_path / name).read_bytes()))
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

    monkeypatch.setattr("icalib.rig_file.load_rig", failing)
    assert cli.main(["calibrate", "rig.yaml", "rec", "-o", str(tmp_path)]) == 1
    said = capsys.readouterr().err
    assert words in said and said.count("\n") == 1
