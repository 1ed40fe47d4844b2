"""The tables of docs/montecarlo.md, from the results of the studies in docs/studies.

python benchmarks/study_tables.py [NAME=STUDY ...]

With NAME=STUDY the result of the study in the folder STUDY, made anew from its runs, becomes docs/studies/NAME.json.
Then the tables between `<!-- study NAME -->` or `<!-- studies NAME ... -->` and `<!-- end -->` are written anew.
`tests/test_docs_studies.py` compares the page with the results.
"""

from __future__ import annotations

import argparse
import json
import re
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from icalib.base.files import write_texts
from icalib.result.quantities import format_number
from icalib.sensors.parameter import display_unit
from icalib.tools.montecarlo.record import from_json
from icalib.tools.montecarlo.summary import Nees, consistency_json, summarise

DOCS = Path(__file__).resolve().parent.parent / "docs"
PAGE, STUDIES = DOCS / "montecarlo.md", DOCS / "studies"
MARKED = re.compile(r"<!-- (study|studies) (.+?) -->\n(.*?)<!-- end -->", re.DOTALL)
BLOCKS = "| block | RMS error | mean sigma | NEES per degree of freedom | 95 % bounds |\n|---|---|---|---|---|"
OVERVIEW = (
    "| study | guess | seeds | failed | NEES, all together | 95 % bounds | blocks inside | largest error |\n"
    "|---|---|---|---|---|---|---|---|"
)


def block_table(found: dict[str, Any]) -> str:
    """One row for each block, and one for all together."""
    rows = [BLOCKS]
    for block in found["blocks"]:
        if block["nees"] is None:
            continue
        unit, scale = display_unit(block["unit"])
        sizes = [f"{format_number(scale * block[name], 3)} {unit}".strip() for name in ("rmse", "mean_sigma")]
        name = f"{block['sensor']} {block['name'].replace('_', ' ')}"
        rows.append(f"| {name} | {' | '.join(sizes)} | {_nees(Nees(**block['nees']))} |")
    return "\n".join([*rows, f"| all together | | | {_nees(Nees(**found['whole']))} |"]) + "\n"


def overview(names: Sequence[str]) -> str:
    """One row for each study."""
    rows = [OVERVIEW]
    for name in names:
        found = result(name)
        study, largest = found["study"], found["largest"]
        counted = [Nees(**b["nees"]) for b in found["blocks"] if b["nees"] is not None]
        inside = sum(n.consistent for n in counted)
        first, runs, failed = study["first_seed"], found["runs"], len(found["failures"])
        cells = (
            f"[{name}](studies/{name}.json)",
            study["guess"],
            f"{first} to {first + runs - 1}",
            f"{failed} of {runs}",
            _nees(Nees(**found["whole"])),
            f"{inside} of {len(counted)}",
            f"{largest['sigmas']:.1f} sigma of {largest['numbers']}",
        )
        rows.append(f"| {' | '.join(cells)} |")
    return "\n".join(rows) + "\n"


def result(name: str) -> dict[str, Any]:
    return json.loads((STUDIES / f"{name}.json").read_text(encoding="utf-8"))


def rewritten(page: str) -> str:
    """The page with every marked table as the results have it."""

    def anew(match: re.Match[str]) -> str:
        kind, names = match[1], match[2]
        table = block_table(result(names)) if kind == "study" else overview(names.split())
        return f"<!-- {kind} {names} -->\n{table}<!-- end -->"

    return MARKED.sub(anew, page)


def take(name: str, folder: Path) -> None:
    """The result of a study's runs into the docs."""
    records = [from_json(file.read_bytes()) for file in sorted((folder / "runs").glob("*.json"))]
    made_from = json.loads((folder / "study.json").read_text(encoding="utf-8"))
    made_from["first_seed"] = min(r.seed for r in records)
    if {r.program for r in records} != {made_from["program"]}:
        raise SystemExit(f"{folder}: not all runs are of the program {made_from['program']}.")
    write_texts(STUDIES, {f"{name}.json": consistency_json(summarise(records), made_from).decode() + "\n"})


def _nees(nees: Nees) -> str:
    outside = "" if nees.consistent else " (outside)"
    return f"{nees.mean:.3f}{outside} | {nees.low:.3f} to {nees.high:.3f}"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("studies", nargs="*", metavar="NAME=STUDY", help="results to take into the docs first")
    for given in parser.parse_args().studies:
        name, _, folder = given.partition("=")
        take(name, Path(folder))
    write_texts(DOCS, {PAGE.name: rewritten(PAGE.read_text(encoding="utf-8"))})


if __name__ == "__main__":
    main()
