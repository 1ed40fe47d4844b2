"""The notebooks of the examples and the code of the page on Python run as they stand, one cell after the other."""

from __future__ import annotations

import json
import re
from pathlib import Path
from typing import Any

import pytest
import yaml

from icalib.rig_file import rig_to_dict
from icalib.simulation import handheld, rig_for, simulate, write_tables

ROOT = Path(__file__).parents[2]
NOTEBOOKS = sorted((ROOT / "examples").rglob("*.ipynb"))
PAGE = ROOT / "docs" / "api.md"


def run(sources: list[str], where: str) -> dict[str, Any]:
    """Executes them in one namespace, which it returns."""
    names: dict[str, Any] = {"__name__": "__main__"}
    for k, source in enumerate(sources, 1):
        exec(compile(source, f"{where}, cell {k}", "exec"), names)  # noqa: S102
    return names


@pytest.mark.slow
@pytest.mark.parametrize("file", NOTEBOOKS, ids=lambda file: file.stem)
def test_a_notebook_runs(
    file: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch, tmp_path: Path
):
    monkeypatch.chdir(tmp_path)
    cells = json.loads(file.read_text(encoding="utf-8"))["cells"]
    run(["".join(c["source"]) for c in cells if c["cell_type"] == "code"], file.name)
    printed = capsys.readouterr().out
    assert "same rig -> valid []" in printed and "cam1 turned -> changed [('cam1', 'rotation'" in printed


def test_notebooks_hold_no_outputs():
    assert NOTEBOOKS
    for file in NOTEBOOKS:
        for cell in json.loads(file.read_text(encoding="utf-8"))["cells"]:
            assert not cell.get("outputs") and cell.get("execution_count") is None, f"{file.name}: clear all outputs"


@pytest.mark.slow
def test_the_code_of_the_page_runs(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]):
    monkeypatch.chdir(tmp_path)
    scenario = handheld(8.0)
    for seed, name in enumerate(("run", "new_run"), 1):
        write_tables(simulate(scenario, seed), seed, tmp_path / name)
    rig = rig_for(scenario, intrinsics="start", distortion="start")
    Path("rig.yaml").write_text(yaml.safe_dump(rig_to_dict(rig)))
    Path("scenario.yaml").write_text((ROOT / "examples" / "paper" / "table2-3d.yaml").read_text())
    blocks = re.findall(r"```python\n(.*?)```", PAGE.read_text(encoding="utf-8"), re.DOTALL)
    assert len(blocks) > 6
    names = run(blocks, PAGE.name)
    assert names["found"].validity == "valid" and names["calibration"].verdict == "usable"
    assert Path("out/calibration.yaml").exists() and Path("orb_slam3.yaml").exists()
    capsys.readouterr()
