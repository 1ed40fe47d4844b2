"""The notebooks of the examples run as they stand, one cell after the other."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest

ROOT = Path(__file__).parents[2]
NOTEBOOKS = sorted((ROOT / "examples").rglob("*.ipynb"))
PRINTED = {
    "calibrate": ("same rig -> valid []", "cam1 turned -> changed [('cam1', 'rotation'"),
    "camera-imu": ("/cam0/image_raw', 'image', 40", "type: aprilgrid", "errors of the camera's place in sigma"),
    "gnss": ("type: position", "time offset [ms] [", "errors of the lever arm in sigma"),
    "lidar-camera": ("type: checkerboard", "('cam0', 'lidar0', 'the worst of", "errors of the LiDAR's place in sigma"),
}


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
    assert [words for words in PRINTED[file.stem] if words not in printed] == []


def test_notebooks_hold_no_outputs():
    assert NOTEBOOKS
    for file in NOTEBOOKS:
        for cell in json.loads(file.read_text(encoding="utf-8"))["cells"]:
            assert not cell.get("outputs") and cell.get("execution_count") is None, f"{file.name}: clear all outputs"
