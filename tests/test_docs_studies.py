"""What the documentation says of studies is what their results say."""

from __future__ import annotations

import json
import re
from collections.abc import Callable
from pathlib import Path
from types import ModuleType

import pytest


@pytest.fixture(scope="module")
def tables(benchmark_program: Callable[[str], ModuleType]) -> ModuleType:
    """The program that writes them."""
    return benchmark_program("study_tables")


def test_tables_are_those_of_the_results(tables: ModuleType):
    page = tables.PAGE.read_text(encoding="utf-8")
    assert len(tables.MARKED.findall(page)) >= 5
    assert tables.rewritten(page) == page


def test_a_table_has_the_numbers_of_its_result(tables: ModuleType):
    found = tables.result("table2-3d-none")
    block = next(b for b in found["blocks"] if (b["sensor"], b["name"]) == ("lidar0", "rotation"))
    row = next(line for line in tables.block_table(found).splitlines() if line.startswith("| lidar0 rotation"))
    rms, sigma, mean, bounds = (cell.strip() for cell in row.strip("|").split("|")[1:])
    assert float(rms.removesuffix(" deg")) == pytest.approx(block["rmse"] * 57.29578, rel=1e-2)
    assert float(sigma.removesuffix(" deg")) == pytest.approx(block["mean_sigma"] * 57.29578, rel=1e-2)
    assert mean == f"{block['nees']['mean']:.3f}" and bounds.startswith(f"{block['nees']['low']:.3f} to")


def test_what_is_outside_its_bounds_is_marked(tables: ModuleType):
    found = tables.result("table2-3d-none")
    for block in found["blocks"]:
        block["nees"] |= {"mean": block["nees"]["high"] + 0.01}
    rows = tables.block_table(found).splitlines()[2:-1]
    assert len(rows) == len(found["blocks"]) and all("(outside)" in row for row in rows)


def test_every_result_is_named_on_some_page(tables: ModuleType):
    pages = "".join(p.read_text(encoding="utf-8") for p in tables.DOCS.glob("*.md"))
    for file in tables.STUDIES.iterdir():
        assert f"studies/{file.name}" in pages, file.name


def test_results_are_of_runs_that_can_be_made_again(tables: ModuleType):
    """Each says what it was made from, and no path of the machine that made it."""
    for name in re.findall(r"<!-- study (\S+) -->", tables.PAGE.read_text(encoding="utf-8")):
        study = json.loads((tables.STUDIES / f"{name}.json").read_text(encoding="utf-8"))["study"]
        assert not Path(study["scenario"]).is_absolute()
        assert study["guess"] in ("none", "drawn") and re.fullmatch("[0-9a-f]{16}", study["program"])
