"""Mutated input: `python benchmarks/fuzz.py --count 3000 --seed 0`.

Each case changes one file of a good workspace (rig files, tables, bags, pictures, scenarios, results, jobs, files of
Kalibr), seeded by its number, and runs one command on it in a forked process. A command must end within a time limit,
below 2 GB, with exit code 0, or with 1 or 2 and one sentence; it must write nothing but its output, no user file may
change, and no result may hold numbers that are not finite. Before that every command runs on the workspace as it is,
and must end with exit code 0. Failures are listed by case; `--only N` runs one again, `--covering` the fewest cases
that have every kind of change and of input. Needs icalib[bags,images,view] and Linux.
"""

from __future__ import annotations

import argparse
import os
import sys
import tempfile
import time
from collections import Counter
from collections.abc import Iterable
from pathlib import Path

for variable in ("NUMBA_NUM_THREADS", "OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS"):
    os.environ.setdefault(variable, "1")  # threads do not live on in forked processes
os.environ.setdefault("NUMBA_THREADING_LAYER", "workqueue")

sys.path.insert(0, str(Path(__file__).parent))

from fuzz_cases import Case, case_of, covering, unchanged_cases  # noqa: E402
from fuzz_inputs import good_workspace  # noqa: E402
from fuzz_run import Found, refused_inputs, run_case, warm  # noqa: E402


def main() -> int:
    options = _options()
    started = time.perf_counter()
    with tempfile.TemporaryDirectory(prefix="icalib-fuzz-") as folder:
        good, place = good_workspace(Path(folder) / "good"), Path(folder) / "cases"
        warm(good, Path(folder) / "warm")
        cases, unchanged = _cases(options, good)
        refused = refused_inputs(unchanged, good, place, options.seconds)
        failed, codes = list[Case](), Counter[int]()
        for case in cases:
            found = run_case(case, good, place, options.seconds)
            codes[found.code] += 1
            _tell(case, found, options.verbose)
            if found.faults:
                failed.append(case)
            if options.minutes and time.perf_counter() - started > 60.0 * options.minutes:
                break
    lasted = time.perf_counter() - started
    print(
        f"{codes.total()} cases, seed {options.seed}, {lasted:.0f} s: {len(failed)} failed; exit codes {dict(codes)}; "
        f"{len(refused)} good inputs refused."
    )
    return 1 if failed or refused else 0


def _cases(options: argparse.Namespace, good: Path) -> tuple[Iterable[Case], list[Case]]:
    """The cases to run, and those without a change to run before them."""
    if options.only:
        return (case_of(options.seed, number, good) for number in options.only), []
    if options.covering:
        cases = covering(options.seed, options.count, good)
        return cases, list({case.command: case.unchanged() for case in cases}.values())
    return (case_of(options.seed, number, good) for number in range(options.count)), unchanged_cases(good)


def _tell(case: Case, found: Found, verbose: bool) -> None:
    if found.faults:
        print(f"{case.number}: {case.described()}\n    {found.described()}", flush=True)
    elif verbose:
        print(f"{case.number}: {case.described()}\n    {found.how}\n    {found.code} {found.said.strip()}", flush=True)


def _options() -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--count", type=int, default=3000, help="how many cases")
    parser.add_argument("--seed", type=int, default=0, help="of all cases together")
    parser.add_argument("--only", type=int, nargs="*", help="numbers of cases to run alone")
    parser.add_argument(
        "--covering", action="store_true", help="of these cases the fewest of all kinds, without workers"
    )
    parser.add_argument("--seconds", type=float, default=60.0, help="of CPU time; a command that takes longer hangs")
    parser.add_argument("--minutes", type=float, default=0.0, help="stop after so long; 0: never")
    parser.add_argument("--verbose", action="store_true", help="say what each case ended with")
    return parser.parse_args()


if __name__ == "__main__":
    sys.exit(main())
