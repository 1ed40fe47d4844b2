"""The golden record: results that a change of the code must not move.

    python benchmarks/golden.py store                   runs all cases, and writes benchmarks/golden/CASE.json
    python benchmarks/golden.py compare                 runs them, and compares with what is stored
    python benchmarks/golden.py compare --sigma 0.05    for a change of the solver: values may move by that share of
                                                        their standard deviation, standard deviations by that share

Without --sigma, values and standard deviations are to be equal to 1e-9. Each case runs twice, in a process of its own
with an empty cache of kernels: the first run compiles, the second is timed. Needs the recordings in $ICALIB_DATA or
../shared/data.
"""

from __future__ import annotations

import argparse
import json
import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path

import numpy as np
from golden_cases import CASES, ROOT

from icalib.data.measurements import Measurements
from icalib.pipeline import calibrate_measurements
from icalib.rig import Rig

FOLDER = Path(__file__).resolve().parent / "golden"
EQUAL = 1e-9


@dataclass(frozen=True)
class Record:
    """One calibration. values, std, verdict: by "sensor.parameter"; chi2: of all residuals; visits: states at which the
    solver looked for a step; cpu_s: processor time of a run that compiles nothing."""

    values: dict[str, list[float]]
    std: dict[str, list[float]]
    verdict: dict[str, list[str]]
    converged: bool
    chi2: float
    visits: int
    cpu_s: float


@dataclass(frozen=True)
class Change:
    """Between two records. moved: the largest change of a value over its standard deviation; scaled: the largest change
    of a standard deviation, relative; relative: the largest of a value or a standard deviation, relative to it or, of a
    value, to its standard deviation if that is larger; words: what else differs."""

    moved: float
    scaled: float
    relative: float
    words: tuple[str, ...]


def run(name: str, data: Path) -> Record:
    """The second of two runs of a case."""
    rig, measurements = CASES[name](data)
    calibrate_measurements(rig, measurements)
    return record_of(rig, measurements)


def record_of(rig: Rig, measurements: Sequence[Measurements]) -> Record:
    """Calibrates, and records the result."""
    visits: list[object] = []
    begun = time.process_time()
    result = calibrate_measurements(rig, measurements, on_visit=visits.append)
    spent = time.process_time() - begun
    groups = {f"{g.sensor}.{g.name}": g for g in result.groups}
    return Record(
        {key: np.ravel(g.value).tolist() for key, g in groups.items()},
        {key: np.ravel(g.std).tolist() for key, g in groups.items()},
        {key: list(g.verdict) for key, g in groups.items()},
        result.converged,
        float(sum(f.chi2 for f in result.fits)),
        len(visits),
        spent,
    )


def changed(old: Record, new: Record) -> Change:
    """What differs between two records of the same case."""
    words = [f"{key} is only in one of both" for key in sorted(old.values.keys() ^ new.values.keys())]
    words += ["convergence differs"] if old.converged != new.converged else []
    moved, scaled, relative = [0.0], [0.0], [0.0]
    for key in sorted(old.values.keys() & new.values.keys()):
        if old.verdict[key] != new.verdict[key]:
            words.append(f"{key}: {' '.join(old.verdict[key])} became {' '.join(new.verdict[key])}")
        a, b, s, t = (np.array(x[key]) for x in (old.values, new.values, old.std, new.std))
        if a.shape != b.shape or s.shape != t.shape:
            words.append(f"{key} has another size")
            continue
        spread = np.resize(s, a.shape) if s.size == a.size else np.full(a.shape, s.max(initial=0.0))
        apart, size = np.abs(b - a), np.maximum(np.abs(a), spread)
        relative.append(float((apart / np.maximum(size, 1e-300)).max(initial=0.0)))
        moved.append(float((apart[spread > 0.0] / spread[spread > 0.0]).max(initial=0.0)))
        scaled.append(float((np.abs(t - s)[s > 0.0] / s[s > 0.0]).max(initial=0.0)))
        words += [f"{key} is fixed in only one of both"] if ((s > 0.0) != (t > 0.0)).any() else []
    return Change(max(moved), max(scaled), max(*relative, *scaled), tuple(words))


def is_equal(change: Change, sigma: float | None) -> bool:
    """Whether nothing differs by more than EQUAL, or than the share `sigma` of standard deviations."""
    if change.words:
        return False
    return change.relative <= EQUAL if sigma is None else max(change.moved, change.scaled) <= sigma


def main() -> int:
    options = _options()
    if options.child:
        print(json.dumps(asdict(run(options.child, options.data))))
        return 0
    failed = 0
    if options.what == "compare":
        print(f"{'case':<20}{'value / std':>13}{'std':>11}{'relative':>11}{'visits':>12}{'cpu s':>15}{'times':>7}")
    for name in options.only or CASES:
        new = _in_subprocess(name, options.data)
        file = FOLDER / f"{name}.json"
        if options.what == "store":
            FOLDER.mkdir(exist_ok=True)
            file.write_text(json.dumps(asdict(new), indent=1) + "\n", encoding="utf-8")
            print(f"{name}: {new.visits} visits, {new.cpu_s:.1f} s", flush=True)
            continue
        old = Record(**json.loads(file.read_text(encoding="utf-8")))
        change = changed(old, new)
        failed += not is_equal(change, options.sigma)
        print(_line(name, old, new, change), flush=True)
    return int(failed > 0)


def _line(name: str, old: Record, new: Record, change: Change) -> str:
    numbers = f"{change.moved:>13.2g}{change.scaled:>11.2g}{change.relative:>11.2g}"
    visits, spent = f"{old.visits} -> {new.visits}", f"{old.cpu_s:.1f} -> {new.cpu_s:.1f}"
    line = f"{name:<20}{numbers}{visits:>12}{spent:>15}{new.cpu_s / old.cpu_s:>7.2f}"
    return "\n".join([line, *(f"    {words}" for words in change.words)])


def _in_subprocess(name: str, data: Path) -> Record:
    """Runs a case in a process with an empty cache of kernels. With kernels that other cases compiled, sums may round
    differently."""
    command = [sys.executable, __file__, "store", "--child", name, "--data", str(data)]
    with tempfile.TemporaryDirectory() as cache:
        environment = os.environ | {"NUMBA_CACHE_DIR": cache}
        done = subprocess.run(command, stdout=subprocess.PIPE, text=True, check=True, env=environment)
    return Record(**json.loads(done.stdout.splitlines()[-1]))


def _options() -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("what", choices=("store", "compare"))
    parser.add_argument("--only", nargs="+", choices=tuple(CASES), metavar="CASE", help=f"some of: {', '.join(CASES)}")
    parser.add_argument("--sigma", type=float, metavar="SHARE", help="of a standard deviation that may change")
    data = Path(os.environ.get("ICALIB_DATA", ROOT.parent / "shared" / "data"))
    parser.add_argument("--data", type=Path, default=data, metavar="DIR", help="folder of the recordings")
    parser.add_argument("--child", help=argparse.SUPPRESS)
    return parser.parse_args()


if __name__ == "__main__":
    sys.exit(main())
