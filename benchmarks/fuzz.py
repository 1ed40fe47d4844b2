"""Mutated input: `python benchmarks/fuzz.py --count 3000 --seed 0`.

Each case changes one file of a good workspace (rig files, tables, bags, pictures, scenarios, results, jobs, files of
Kalibr), seeded by its number, and runs one command on it in a forked process. A command must end within a time limit,
below 2 GB, with exit code 0, or with 1 or 2 and one sentence; it must write nothing but its output, no user file may
change, and no result may hold numbers that are not finite. Failures are listed by case; `--only N` runs one again.
Needs icalib[bags,images,view] and Linux.
"""

from __future__ import annotations

import argparse
import os
import sys
import tempfile
import time
from pathlib import Path

for variable in ("NUMBA_NUM_THREADS", "OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS"):
    os.environ.setdefault(variable, "1")  # threads do not live on in forked processes
os.environ.setdefault("NUMBA_THREADING_LAYER", "workqueue")

sys.path.insert(0, str(Path(__file__).parent))

from fuzz_cases import Case, case_of, good_workspace  # noqa: E402
from fuzz_run import Found, run_case, warm  # noqa: E402


def main() -> int:
    options = _options()
    started = time.perf_counter()
    with tempfile.TemporaryDirectory(prefix="icalib-fuzz-") as folder:
        good = good_workspace(Path(folder) / "good")
        warm(good, Path(folder) / "warm")
        numbers = options.only or range(options.count)
        failed, codes = list[tuple[Case, Found]](), dict[int, int]()
        for number in numbers:
            case = case_of(options.seed, number, good)
            found = run_case(case, good, Path(folder) / "cases", options.seconds)
            codes[found.code] = codes.get(found.code, 0) + 1
            if found.faults:
                failed.append((case, found))
                print(f"{case.number}: {case.described()}\n    {found.described()}", flush=True)
            elif options.verbose:
                print(f"{case.number}: {case.described()}\n    {found.code} {found.said.strip()}", flush=True)
            if options.minutes and time.perf_counter() - started > 60.0 * options.minutes:
                break
    lasted = time.perf_counter() - started
    print(
        f"{sum(codes.values())} cases, seed {options.seed}, {lasted:.0f} s: {len(failed)} failed; exit codes {codes}."
    )
    return 1 if failed else 0


def _options() -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--count", type=int, default=3000, help="how many cases")
    parser.add_argument("--seed", type=int, default=0, help="of all cases together")
    parser.add_argument("--only", type=int, nargs="*", help="numbers of cases to run alone")
    parser.add_argument("--seconds", type=float, default=60.0, help="a command that takes longer hangs")
    parser.add_argument("--minutes", type=float, default=0.0, help="stop after so long; 0: never")
    parser.add_argument("--verbose", action="store_true", help="say what each case ended with")
    return parser.parse_args()


if __name__ == "__main__":
    sys.exit(main())
