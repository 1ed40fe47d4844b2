"""The golden record: results that a change of the code must not move.

    python benchmarks/golden.py store                   runs all cases, and writes benchmarks/golden/CASE.json
    python benchmarks/golden.py compare                 runs them, and compares with what is stored
    python benchmarks/golden.py compare --only tags     runs some of them
    python benchmarks/golden.py compare --sigma 0.05    for a change of the solver: values may move by that share of
                                                        their standard deviation, standard deviations by that share,
                                                        and files and numbers in sentences may differ

Without --sigma, values and standard deviations are to be equal to 1e-9, and sentences and files to the letter. Each
case runs in a process of its own, twice: the first run loads or compiles kernels, the second is recorded. Needs the
recordings in $ICALIB_DATA or ../shared/data, and icalib[bags,images].
"""

from __future__ import annotations

import argparse
import json
import os
import subprocess
import sys
import tempfile
from collections.abc import Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import asdict
from pathlib import Path

from golden_cases import CASES, ROOT
from golden_record import Change, Record, changed, is_equal, record_case

FOLDER = Path(__file__).resolve().parent / "golden"
ROUNDS = 2


def main() -> int:
    options = _options()
    if options.child:
        print(json.dumps(asdict(record_case(CASES[options.child], options.data, ROUNDS))))
        return 0
    names, failed = options.only or tuple(CASES), 0
    if options.what == "compare":
        if missing := [name for name in names if not _file(name).exists()]:
            sys.exit(f"not stored yet: {', '.join(missing)}; run store --only with these.")
        print(f"{'case':<26}{'value / std':>13}{'std':>11}{'relative':>11}{'visits':>12}{'cpu s':>15}{'times':>7}")
    for name, new in _records(names, options.data, options.jobs):
        if options.what == "store":
            FOLDER.mkdir(exist_ok=True)
            _file(name).write_text(json.dumps(asdict(new), indent=1) + "\n", encoding="utf-8")
            print(f"{name}: {new.visits} visits, {new.cpu_s:.1f} s, {new.overall or new.refusal}", flush=True)
            continue
        old = Record(**json.loads(_file(name).read_text(encoding="utf-8")))
        change = changed(old, new)
        failed += not is_equal(change, options.sigma)
        print(_line(name, old, new, change), flush=True)
    return int(failed > 0)


def _file(name: str) -> Path:
    return FOLDER / f"{name}.json"


def _line(name: str, old: Record, new: Record, change: Change) -> str:
    numbers = f"{change.moved:>13.2g}{change.scaled:>11.2g}{change.relative:>11.2g}"
    visits, spent = f"{old.visits} -> {new.visits}", f"{old.cpu_s:.1f} -> {new.cpu_s:.1f}"
    line = f"{name:<26}{numbers}{visits:>12}{spent:>15}{new.cpu_s / old.cpu_s:>7.2f}"
    return "\n".join([line, *(f"    {words}" for words in (*change.words, *change.sentences, *change.texts))])


def _records(names: Sequence[str], data: Path, jobs: int) -> Iterator[tuple[str, Record]]:
    """Records of the cases, `jobs` at a time."""
    with tempfile.TemporaryDirectory() as cache, ThreadPoolExecutor(jobs) as pool:
        yield from zip(names, pool.map(lambda name: _in_subprocess(name, data, cache), names), strict=True)


def _in_subprocess(name: str, data: Path, cache: str) -> Record:
    """Runs a case in a process of its own."""
    command = [sys.executable, __file__, "store", "--child", name, "--data", str(data)]
    environment = os.environ | {"NUMBA_CACHE_DIR": cache}
    done = subprocess.run(command, stdout=subprocess.PIPE, text=True, check=True, env=environment)
    return Record(**json.loads(done.stdout.splitlines()[-1]))


def _options() -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("what", choices=("store", "compare"))
    parser.add_argument("--only", nargs="+", choices=tuple(CASES), metavar="CASE", help=f"some of: {', '.join(CASES)}")
    parser.add_argument("--sigma", type=float, metavar="SHARE", help="of a standard deviation that may change")
    parser.add_argument("--jobs", type=int, default=1, metavar="N", help="cases that run at the same time")
    data = Path(os.environ.get("ICALIB_DATA", ROOT.parent / "shared" / "data"))
    parser.add_argument("--data", type=Path, default=data, metavar="DIR", help="folder of the recordings")
    parser.add_argument("--child", help=argparse.SUPPRESS)
    return parser.parse_args()


if __name__ == "__main__":
    sys.exit(main())
