"""Whether a result depends on what is not data: machine, threads, signs of eigenvectors, the guess.

    python benchmarks/reproducible.py                                  all cases of the golden record
    python benchmarks/reproducible.py --only wheel-mocap stills        some of them
    python benchmarks/reproducible.py --rig RIG --recording RECORDING  another calibration
    python benchmarks/reproducible.py --variants Nehalem signs         some of the variants

Each case runs as it is, then once for each variant, in a process of its own:

    Haswell, Nehalem, ...   with these kernels of BLAS (OPENBLAS_CORETYPE)
    one-core                on one core
    generic                 with kernels compiled for any processor: their sums round differently
    signs                   with other signs of all eigenvectors, and another basis of each degenerate eigenspace
    guess                   with the start values and the guess moved by GUESS_SHARE of their prior uncertainty

A line gives the largest change of a value over its standard deviation, and of a standard deviation, relative; then what
else differs. Values may move by VALUE_BOUND, standard deviations by STD_BOUND. With another guess, values along
unobservable directions must differ, so only standard deviations and verdicts are compared.
"""

from __future__ import annotations

import argparse
import json
import os
import subprocess
import sys
from collections.abc import Callable
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

import numpy as np
import scipy.linalg
from golden_cases import CASES, ROOT, Case, Inputs
from golden_record import Record, changed, record_case

GUESS_SHARE = 0.3
VALUE_BOUND, STD_BOUND = 0.01, 0.01
DEGENERATE = 1e-12  # relative difference of eigenvalues below which any basis of their space is right
BLAS = ("Haswell", "Nehalem", "Sandybridge", "SkylakeX")
VARIANTS = ("Nehalem", "one-core", "generic", "signs", "guess")


def main() -> int:
    options = _options()
    case = _given(options.rig, options.recording) if options.rig else None
    if options.child:
        print(json.dumps(asdict(_run(case or CASES[options.only[0]], options.child))))
        return 0
    failed = 0
    print(f"{'case':<22}{'variant':<12}{'value / std':>13}{'std':>11}{'visits':>12}", flush=True)
    for name in [str(options.rig)] if case else options.only or CASES:
        chosen = ["--rig", options.rig, "--recording", options.recording] if case else ["--only", name]
        plain = _in_subprocess(chosen, "Haswell", options.data)
        for variant in options.variants:
            new = _in_subprocess(chosen, variant, options.data)
            if plain is None or new is None:
                print(f"{name[-20:]:<22}{variant:<12}  {'failed' if plain is new else 'FAILED IN ONE'}", flush=True)
                failed += plain is not new
                continue
            change = changed(plain, new)
            is_moved = variant != "guess" and change.moved > VALUE_BOUND
            failed += bool(is_moved or change.scaled > STD_BOUND or change.words)
            visits = f"{plain.visits} -> {new.visits}"
            print(f"{name[-20:]:<22}{variant:<12}{change.moved:>13.2g}{change.scaled:>11.2g}{visits:>12}", flush=True)
            print("".join(f"    {words}\n" for words in change.words), end="", flush=True)
    return int(failed > 0)


def _given(rig_file: Path, recording: Path) -> Case:
    given = Inputs(rig_file.absolute(), [recording.absolute()])
    return lambda: given


def _run(case: Case, variant: str) -> Record:
    """Record of the case in this process, with `variant` as far as it is not of the environment."""
    if variant == "signs":
        _other_eigenvectors()
    if variant == "guess":
        _other_guess()
    data = Path(os.environ.get("ICALIB_DATA", ROOT.parent / "shared" / "data"))
    return record_case(case, data)


def _other_eigenvectors() -> None:
    """Replaces the eigensolvers of NumPy and SciPy by ones that return another basis, which is right, too."""
    rng = np.random.default_rng(1)

    def turned(solve: Callable[..., Any]) -> Callable[..., Any]:
        def solve_and_turn(*args: Any, **options: Any) -> Any:
            found = solve(*args, **options)
            if not isinstance(found, tuple):
                return found
            values, vectors = found[0], found[1]
            flipped = np.array(vectors) * rng.choice((-1.0, 1.0), np.shape(values)[-1])
            if np.ndim(values) == 1:
                limit = DEGENERATE * np.abs(values).max(initial=0.0)
                for space in np.split(np.arange(len(values)), np.flatnonzero(np.diff(values) > limit) + 1):
                    basis = np.linalg.qr(rng.standard_normal((len(space), len(space))))[0]
                    flipped[:, space] = flipped[:, space] @ basis
            return values, flipped

        return solve_and_turn

    np.linalg.eigh = turned(np.linalg.eigh)
    scipy.linalg.eigh = turned(scipy.linalg.eigh)


def _other_guess() -> None:
    """Moves the state and the guess from which the estimate starts."""
    from icalib.estimate.problem import guess_sigma
    from icalib.initialize import rig_guess

    determine = rig_guess.determine

    def moved(inputs: Any, start: Any, guess: Any = None, *rest: Any) -> Any:
        signs = np.random.default_rng(1).choice((-1.0, 1.0), inputs.layout.size)
        step = GUESS_SHARE * signs * guess_sigma(inputs, start)
        for block in inputs.layout.free:
            if not inputs.is_sensor(block.sensor) or block.start is None:
                step[block.columns] = 0.0
        still = np.zeros((len(start.seconds), 15))
        guessed = replace(start, values=start.values | (guess or {})).retract(inputs.layout, still, step)
        return determine(inputs, start.retract(inputs.layout, still, step), guessed.values, *rest)

    rig_guess.determine = moved


def _in_subprocess(chosen: list[Any], variant: str, data: Path) -> Record | None:
    """Record of a case in a process of its own; None if the calibration raises an error."""
    command = [sys.executable, __file__, *map(str, chosen), "--child", variant]
    kernels = variant if variant in BLAS else "Haswell"
    environment = os.environ | {"OPENBLAS_CORETYPE": kernels, "ICALIB_DATA": str(data)}
    if variant == "generic":
        environment |= {"NUMBA_CPU_NAME": "generic", "NUMBA_CPU_FEATURES": ""}
    one = variant == "one-core" and hasattr(os, "sched_setaffinity")
    limit = (lambda: os.sched_setaffinity(0, {min(os.sched_getaffinity(0))})) if one else None
    done = subprocess.run(command, capture_output=True, text=True, env=environment, preexec_fn=limit)
    if done.returncode:
        last = done.stderr.strip().splitlines()[-1:] or [f"ended by signal {-done.returncode}"]
        print(last[0][:200], file=sys.stderr)
        return None
    return Record(**json.loads(done.stdout.splitlines()[-1]))


def _options() -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--only", nargs="+", choices=tuple(CASES), metavar="CASE", help=f"some of: {', '.join(CASES)}")
    parser.add_argument("--rig", type=Path, metavar="FILE", help="rig file of another calibration")
    parser.add_argument("--recording", type=Path, metavar="PATH", help="its recording")
    every = (*BLAS, *VARIANTS)
    parser.add_argument("--variants", nargs="+", choices=every, default=VARIANTS, metavar="VARIANT")
    data = Path(os.environ.get("ICALIB_DATA", ROOT.parent / "shared" / "data"))
    parser.add_argument("--data", type=Path, default=data, metavar="DIR", help="folder of the recordings")
    parser.add_argument("--child", help=argparse.SUPPRESS)
    return parser.parse_args()


if __name__ == "__main__":
    sys.exit(main())
