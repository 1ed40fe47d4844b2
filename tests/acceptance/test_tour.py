"""docs/tour.md is true: its commands are run in order, and must end and print as it says."""

from __future__ import annotations

import re
import sys
from collections.abc import Callable
from pathlib import Path
from types import ModuleType

import pytest


@pytest.fixture(scope="module")
def tour_page(benchmark_program: Callable[[str], ModuleType]) -> ModuleType:
    """The program that runs the commands of the page."""
    return benchmark_program("tour_page")


IN_CI = ("icalib inspect", "rig-equidistant.yaml", "icalib export")


@pytest.mark.skipif(sys.platform == "win32", reason="the page is for a Unix shell")
@pytest.mark.parametrize("chosen", [IN_CI, pytest.param(("",), marks=pytest.mark.full)], ids=["first", "all"])
def test_the_commands_of_the_page_do_what_it_says(tour_page: ModuleType, tmp_path: Path, chosen: tuple[str, ...]):
    """In continuous integration those that need no other result than the first."""
    page = tour_page.PAGE.read_text(encoding="utf-8")
    found, folder = tour_page.blocks(page), tour_page.checkout(tmp_path)
    assert len(found) == page.count("```bash")
    wanted = [block for block in found if any(word in block.command for word in chosen)]
    assert len(wanted) >= len(chosen)
    for block in wanted:
        run = tour_page.run(block, folder)
        assert run.returncode == block.code, f"{block.command}\n{run.stdout}"
        missing = tour_page.says(run.stdout, block.pieces)
        assert not missing, f"{block.command}\ndid not print\n{missing}\nin its place in\n{run.stdout}"


OUTPUT = "cam0 turned by 0.21 deg, 1.8 sigma\nWarning: residuals 3.3 times\n  as large (929)"


@pytest.mark.parametrize(
    ("pieces", "missing"),
    [
        (("cam0 turned by 0.21 deg, 1.8 sigma Warning:",), ""),
        (("turned by 0.23 deg,", "as large (950)"), ""),
        (("turned by 0.24 deg,",), "turned by 0.24 deg,"),
        (("turned by -0.21 deg,",), "turned by -0.21 deg,"),
        (("as large (960)",), "as large (960)"),
        (("cam1 turned",), "cam1 turned"),
        (("Warning:", "cam0"), "cam0"),
        (("residuals 3.3 as",), "residuals 3.3 as"),
    ],
)
def test_the_check_finds_what_is_not_so(tour_page: ModuleType, pieces: tuple[str, ...], missing: str):
    assert tour_page.says(OUTPUT, pieces) == missing


def test_blocks_are_read_with_their_exit_codes_and_output(tour_page: ModuleType):
    page = "<!-- exits 1 -->\n```bash\nfalse\n```\n\n```text\na\n...\nb\n```\n\n```bash\ntrue\n```\n\ntext\n"
    Block = tour_page.Block
    assert tour_page.blocks(page) == [Block("false\n", 1, "a\n...\nb\n"), Block("true\n", 0, "")]
    assert tour_page.blocks(page)[0].pieces == ("a\n", "\nb\n")


def test_every_figure_is_there_and_small(tour_page: ModuleType):
    figures = re.findall(r"!\[.*?\]\((tour/.*?)\)", tour_page.PAGE.read_text(encoding="utf-8"))
    assert sorted(figures) == sorted(f"tour/{p.name}" for p in (tour_page.PAGE.parent / "tour").iterdir())
    assert all((tour_page.PAGE.parent / figure).stat().st_size < 150_000 for figure in figures)


def test_numbers_of_the_page_are_brought_up_to_date(tour_page: ModuleType):
    text = "cam0 turned by  0.25 deg,\n1.9 sigma\n...\nresiduals 3 times as\nlarge (7)\n"
    expected = "cam0 turned by  0.21 deg,\n1.8 sigma\n...\nresiduals 3.3 times as\nlarge (929)\n"
    assert tour_page.refreshed(text, OUTPUT) == expected
    with pytest.raises(ValueError, match="is not printed"):
        tour_page.refreshed("cam1 turned", OUTPUT)
