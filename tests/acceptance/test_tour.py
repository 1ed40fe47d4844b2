"""docs/tour.md is true: its commands are run in order, and must end and print as it says."""

from __future__ import annotations

import os
import re
import shutil
import subprocess
import sys
from dataclasses import dataclass
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
PAGE = ROOT / "docs" / "tour.md"
BLOCK = re.compile(r"(?:<!-- exits (\d+) -->\n)?```bash\n(.*?)```\n(?:\n```text\n(.*?)```\n)?", re.DOTALL)
NUMBER = re.compile(r"(?<![\w.])[-+]?\d+(?:\.\d+)?(?:[eE][-+]?\d+)?")  # but not that of cam0
SHARE, UNITS = 0.03, 2.0  # that a number may be off by: of itself, and of its last digit on the page


@dataclass(frozen=True)
class Block:
    """A command of the page, its exit code, and what it prints: pieces with something left out between them."""

    command: str
    code: int
    pieces: tuple[str, ...]


def blocks(page: str) -> list[Block]:
    return [
        Block(command, int(code or 0), tuple(p for p in re.split(r"^\.\.\.$", text, flags=re.M) if p.strip()))
        for code, command, text in BLOCK.findall(page)
    ]


def says(output: str, pieces: tuple[str, ...]) -> str:
    """The first of `pieces` that `output` does not hold after those before it, or nothing. Where lines end is all the
    same; numbers may be off by a little, for machines round in different ways."""
    words, position = output.split(), 0
    for piece in pieces:
        sought = piece.split()
        starts = range(position, len(words) - len(sought) + 1)
        found = next((i for i in starts if all(map(alike, sought, words[i : i + len(sought)]))), None)
        if found is None:
            return piece
        position = found + len(sought)
    return ""


def alike(expected: str, word: str) -> bool:
    if NUMBER.sub("#", expected) != NUMBER.sub("#", word):
        return False
    return all(map(near, NUMBER.findall(expected), NUMBER.findall(word)))


def near(expected: str, number: str) -> bool:
    mantissa, _, power = expected.lower().partition("e")
    unit = 10.0 ** (int(power or 0) - len(mantissa.partition(".")[2]))
    return abs(float(expected) - float(number)) <= max(SHARE * abs(float(expected)), UNITS * unit) * 1.0001


@pytest.fixture
def checkout(tmp_path: Path) -> Path:
    """A folder with the examples, and with the commands of the page as if they were installed in it."""
    shutil.copytree(ROOT / "examples", tmp_path / "examples")
    programs = tmp_path / ".venv" / "bin"
    programs.mkdir(parents=True)
    main = '-c "import sys; from icalib.cli import main; sys.exit(main())"'
    for name, arguments in (("icalib", main), ("python", "")):
        (programs / name).write_text(f'#!/bin/sh\nexec "{sys.executable}" {arguments} "$@"\n')
        (programs / name).chmod(0o755)
    return tmp_path


@pytest.mark.skipif(sys.platform == "win32", reason="the page is for a Unix shell")
def test_the_commands_of_the_page_do_what_it_says(checkout: Path):
    environment = os.environ | {"COLUMNS": "120"}
    found = blocks(PAGE.read_text(encoding="utf-8"))
    assert len(found) == PAGE.read_text(encoding="utf-8").count("```bash")
    for block in found:
        command = ["bash", "-euo", "pipefail", "-c", block.command]
        run = subprocess.run(
            command, cwd=checkout, env=environment, encoding="utf-8", stdout=subprocess.PIPE, stderr=subprocess.STDOUT
        )
        assert run.returncode == block.code, f"{block.command}\n{run.stdout}"
        missing = says(run.stdout, block.pieces)
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
def test_the_check_finds_what_is_not_so(pieces: tuple[str, ...], missing: str):
    assert says(OUTPUT, pieces) == missing


def test_blocks_are_read_with_their_exit_codes_and_output():
    page = "<!-- exits 1 -->\n```bash\nfalse\n```\n\n```text\na\n...\nb\n```\n\n```bash\ntrue\n```\n\ntext\n"
    assert blocks(page) == [Block("false\n", 1, ("a\n", "\nb\n")), Block("true\n", 0, ())]


def test_every_figure_is_there_and_small():
    figures = re.findall(r"!\[.*?\]\((tour/.*?)\)", PAGE.read_text(encoding="utf-8"))
    assert sorted(figures) == sorted(f"tour/{p.name}" for p in (PAGE.parent / "tour").iterdir())
    assert all((PAGE.parent / figure).stat().st_size < 150_000 for figure in figures)
