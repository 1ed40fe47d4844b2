"""The examples of the pages about the Python API run as they stand, in order."""

from __future__ import annotations

import re
import shutil
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
PAGES = "api.md", "api-tools.md"
BLOCK = re.compile(r"(<!-- not run -->\n)?```python\n(.*?)```", re.DOTALL)


@pytest.mark.slow
def test_the_examples_run(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]):
    shutil.copytree(ROOT / "examples", tmp_path / "examples")
    monkeypatch.chdir(tmp_path)
    text = "".join((ROOT / "docs" / page).read_text("utf-8") for page in PAGES)
    found = [code for not_run, code in BLOCK.findall(text) if not not_run]
    assert len(found) > 10
    names: dict[str, object] = {"__name__": "example"}  # what starts workers is for a program of its own
    for code in found:
        exec(compile(code, "docs", "exec"), names)
    assert "cam0" in capsys.readouterr().out
    assert (tmp_path / "out" / "calibration.yaml").is_file()
