"""Rig files in the documentation can be loaded as they stand."""

from __future__ import annotations

import re
from pathlib import Path

from tests.cases import each

from icalib.rig.file import load_rig

DOCS = Path(__file__).parents[1] / "docs"
WHOLE = re.compile(r"```yaml\n(sensors:\n.*?)```", re.DOTALL)
PAGES = ("record.md", "faq.md")


def rig_files() -> list[tuple[str, str]]:
    """(page and number, text) of each."""
    texts = {page: (DOCS / page).read_text(encoding="utf-8") for page in PAGES}
    return [(f"{page} {k}", found) for page, text in texts.items() for k, found in enumerate(WHOLE.findall(text), 1)]


@each(("name", "text"), rig_files())
def test_a_rig_file_of_the_documentation_can_be_loaded(name: str, text: str, tmp_path: Path):
    (tmp_path / "rig.yaml").write_text(text)
    rig = load_rig(tmp_path / "rig.yaml")
    assert rig.cameras or rig.lidars or rig.poses, name


def test_every_block_of_these_pages_is_a_whole_rig_file():
    for page in PAGES:
        text = (DOCS / page).read_text(encoding="utf-8")
        assert text.count("```yaml\n") == len(WHOLE.findall(text)) > 0
