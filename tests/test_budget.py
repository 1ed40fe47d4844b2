"""Lines of each top folder of the source. A commit that raises a number says what it buys, and what it removed."""

from __future__ import annotations

import tomllib
from pathlib import Path

import icalib

SOURCE = Path(icalib.__file__).parent
BUDGET = Path(__file__).with_name("budget.toml")


def lines() -> dict[str, int]:
    """Lines of the Python files by top folder; `.` for those beside them."""
    found: dict[str, int] = {}
    for file in SOURCE.rglob("*.py"):
        parts = file.relative_to(SOURCE).parts
        top = parts[0] if len(parts) > 1 else "."
        found[top] = found.get(top, 0) + len(file.read_text(encoding="utf-8").splitlines())
    return found


def test_no_top_folder_exceeds_its_budget():
    budget = tomllib.loads(BUDGET.read_text(encoding="utf-8"))
    found = lines()
    assert budget["lines"].keys() == found.keys()
    assert {folder: n for folder, n in found.items() if n > budget["lines"][folder]} == {}
    assert len(list(SOURCE.rglob("*.py"))) <= budget["files"]


if __name__ == "__main__":
    print("\n".join(f'"{folder}" = {n}' for folder, n in sorted(lines().items())), f"# {sum(lines().values())}")
