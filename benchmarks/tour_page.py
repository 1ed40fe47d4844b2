"""The commands of docs/tour.md and what they print: checked by a test, and brought up to date here.

python benchmarks/tour_page.py      runs the commands of the page and puts the numbers that they print into it
"""

from __future__ import annotations

import os
import re
import shutil
import subprocess
import sys
import tempfile
from dataclasses import dataclass
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
PAGE = ROOT / "docs" / "tour.md"
BLOCK = re.compile(r"(?:<!-- exits (\d+) -->\n)?```bash\n(.*?)```\n(?:\n```text\n(.*?)```\n)?", re.DOTALL)
LEFT_OUT = re.compile(r"^\.\.\.$", flags=re.MULTILINE)
NUMBER = re.compile(r"(?<![\w.])[-+]?\d+(?:\.\d+)?(?:[eE][-+]?\d+)?")  # but not that of cam0
SHARE, UNITS = 0.03, 2.0  # that a number may be off by: of itself, and of its last digit on the page


@dataclass(frozen=True)
class Block:
    """A command of the page, its exit code, and what it prints: pieces with something left out between them."""

    command: str
    code: int
    text: str

    @property
    def pieces(self) -> tuple[str, ...]:
        return tuple(p for p in LEFT_OUT.split(self.text) if p.strip())


def blocks(page: str) -> list[Block]:
    return [Block(command, int(code or 0), text) for code, command, text in BLOCK.findall(page)]


def checkout(folder: Path) -> Path:
    """`folder` with the examples in it, and with the commands of the page as if they were installed there."""
    shutil.copytree(ROOT / "examples", folder / "examples")
    programs = folder / ".venv" / "bin"
    programs.mkdir(parents=True)
    main = '-c "import sys; from icalib.cli import main; sys.exit(main())"'
    for name, arguments in (("icalib", main), ("python", "")):
        (programs / name).write_text(f'#!/bin/sh\nexec "{sys.executable}" {arguments} "$@"\n')
        (programs / name).chmod(0o755)
    return folder


def run(block: Block, folder: Path) -> subprocess.CompletedProcess[str]:
    """The command of `block` in `folder`, with all that it prints in `stdout`."""
    return subprocess.run(
        ["bash", "-euo", "pipefail", "-c", block.command],
        cwd=folder,
        env=os.environ | {"COLUMNS": "120"},
        encoding="utf-8",
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        check=False,
    )


def says(output: str, pieces: tuple[str, ...]) -> str:
    """The first of `pieces` that `output` does not hold after those before it, or nothing. Where lines end is all the
    same; numbers may be off by a little, for machines round in different ways."""
    words, position = output.split(), 0
    for piece in pieces:
        sought = piece.split()
        found = _place(sought, words, position, near)
        if found is None:
            return piece
        position = found + len(sought)
    return ""


def refreshed(text: str, output: str) -> str:
    """`text` of a block with the numbers of `output`, lines as they are. Raises ValueError where words differ."""
    words, position, parts = output.split(), 0, LEFT_OUT.split(text)
    for k, piece in enumerate(parts):
        sought = piece.split()
        found = _place(sought, words, position, lambda *_: True)
        if found is None:
            raise ValueError(f"this is not printed any more:\n{piece}\n{output}")
        printed = iter(words[found : found + len(sought)])
        parts[k] = re.sub(r"\S+", lambda _, printed=printed: next(printed), piece)
        position = found + len(sought)
    return "...".join(parts)


def near(expected: str, number: str) -> bool:
    mantissa, _, power = expected.lower().partition("e")
    unit = 10.0 ** (int(power or 0) - len(mantissa.partition(".")[2]))
    return abs(float(expected) - float(number)) <= max(SHARE * abs(float(expected)), UNITS * unit) * 1.0001


def _place(sought: list[str], words: list[str], position: int, close) -> int | None:
    """Where the words `sought` stand in `words` from `position` on, with numbers for which `close` holds."""

    def alike(expected: str, word: str) -> bool:
        same = NUMBER.sub("#", expected) == NUMBER.sub("#", word)
        return same and all(map(close, NUMBER.findall(expected), NUMBER.findall(word)))

    starts = range(position, len(words) - len(sought) + 1)
    return next((i for i in starts if all(map(alike, sought, words[i : i + len(sought)]))), None)


def main() -> int:
    page = PAGE.read_text(encoding="utf-8")
    with tempfile.TemporaryDirectory(prefix="icalib-tour-") as folder:
        here = checkout(Path(folder))
        for block in blocks(page):
            ended = run(block, here)
            if ended.returncode != block.code:
                print(f"{block.command}\nends with {ended.returncode}, not {block.code}:\n{ended.stdout}")
                return 1
            try:
                page = page.replace(block.text, refreshed(block.text, ended.stdout)) if block.text else page
            except ValueError as error:
                print(f"{block.command}\n{error}")
    PAGE.write_text(page, encoding="utf-8")
    return 0


if __name__ == "__main__":
    sys.exit(main())
