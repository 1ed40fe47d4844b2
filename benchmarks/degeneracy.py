"""What each motion leaves open for a robot with cameras, a LiDAR and wheels, and whether what is called known is right.

python benchmarks/degeneracy.py OUTPUT [--runs N] [--workers N] [--motion M ...]     docs/studies/degeneracy.json

Short recordings with few points, so that many can be made; extrinsics, time offsets and lenses estimated from a guess
drawn about the truth, with the IMU of the data sheet and one ten times noisier. Runs are kept in OUTPUT, and the same
command goes on from there; each motion's rows are written as soon as they are known, the others' stay as they were. The
table of docs/studies/degeneracy.md is printed at the end.
"""

from __future__ import annotations

import argparse
import json
from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import replace
from itertools import product
from pathlib import Path

import numpy as np

from icalib.base.files import write_texts
from icalib.sensors.lidar.simulate import SimLidar
from icalib.tools.montecarlo import RunRecord, StudyPlan, run_study
from icalib.tools.montecarlo.study import scenario_digest
from icalib.tools.simulation import Scenario, load_scenario

ROOT = Path(__file__).resolve().parent.parent
FOUND = ROOT / "docs" / "studies" / "degeneracy.json"
MOTIONS = {
    "table2-3d": "free",
    "table2-ramp": "ramps",
    "table2-planar": "planar",
    "single-axis": "about one axis",
    "arc": "constant arc",
    "spin": "spin in place",
    "straight-line": "straight line, speed varying",
    "constant-velocity": "constant velocity",
    "standing": "standing",
}
IMUS = {"data sheet": 1.0, "ten times noisier": 10.0}
SECONDS, AZIMUTH_STEPS, PER_IMAGE = 8.0, 300, 30
FAR = 4.0  # standard deviations
KNOWN = ("determined", "weak")
HEADING = "| motion | IMU | converged | determined, largest error | weak, largest error |\n|---|---|---|---|---|"


def variant(motion: str, noise: float) -> Scenario:
    """The example's motion and sensors, in a recording that is short and thin."""
    scenario = load_scenario(ROOT / "examples" / "paper" / f"{motion}.yaml")
    features = scenario.features
    assert features is not None
    share = PER_IMAGE / features.per_image
    return replace(
        scenario.with_sensors(*(replace(x, azimuth_steps=AZIMUTH_STEPS) for x in scenario.of(SimLidar))),
        duration_s=SECONDS,
        imu_noise=scenario.imu_noise.scaled(noise),
        features=replace(
            features,
            per_image=PER_IMAGE,
            count=round(share * features.count),
            persistent=round(share * features.persistent),
        ),
    )


def entries(record: RunRecord) -> Iterator[tuple[str, str, float]]:
    """Name, verdict, and error in standard deviations of every number that was estimated."""
    for block, label, verdict, z in record.errors():
        yield f"{block.key} {label}", verdict, z


def combinations(record: RunRecord, verdicts: Sequence[str]) -> np.ndarray:
    """(n,) errors in standard deviations along the principal axes of the correlations among entries so judged."""
    k = np.array([v in verdicts for _, v, _ in entries(record)], dtype=bool)
    sigma = np.sqrt(np.diag(record.covariance)[k])
    values, vectors = np.linalg.eigh(record.covariance[np.ix_(k, k)] / np.outer(sigma, sigma))
    return vectors.T @ (record.error[k] / sigma) / np.sqrt(np.maximum(values, 1e-12))


def summary(motion: str, imu: str, records: Sequence[RunRecord]) -> dict:
    """What was found over all runs of one motion and one IMU."""
    good = [r for r in records if not r.failure]
    verdicts: dict[str, Counter[str]] = {}
    by_verdict: dict[str, list[tuple[float, int, str]]] = {}
    for r in good:
        for name, verdict, z in entries(r):
            verdicts.setdefault(name, Counter())[verdict] += 1
            by_verdict.setdefault(verdict, []).append((abs(z), r.seed, name))
    along = {v: np.abs(np.concatenate([np.empty(0), *(combinations(r, v) for r in good)])) for v in (KNOWN[:1], KNOWN)}
    return {
        "motion": motion,
        "imu": imu,
        "runs": len(records),
        "failures": {str(r.seed): r.failure for r in records if r.failure},
        "errors": {
            v: {
                "count": len(found),
                "largest": round(max(found)[0], 2),
                "beyond": [f"{name} in seed {seed}: {z:.1f} sigma" for z, seed, name in sorted(found) if z > FAR],
            }
            for v, found in sorted(by_verdict.items())
        },
        "combinations": {
            " or ".join(v): {
                "count": len(z),
                "largest": round(float(z.max(initial=0.0)), 2),
                "beyond": int((z > FAR).sum()),
            }
            for v, z in along.items()
        },
        "verdicts": {name: dict(counts.most_common()) for name, counts in verdicts.items()},
    }


def stored() -> dict[tuple[str, str], dict]:
    """The rows of the docs, by motion and IMU."""
    return {(r["motion"], r["imu"]): r for r in json.loads(FOUND.read_text())} if FOUND.exists() else {}


def store(row: dict) -> None:
    """The row into the docs, in place of the earlier one of its motion and IMU, if there is one."""
    rows = stored() | {(row["motion"], row["imu"]): row}
    in_order = [rows[k] for k in product(MOTIONS, IMUS) if k in rows]
    write_texts(FOUND.parent, {FOUND.name: json.dumps(in_order, indent=1) + "\n"})


def in_words(row: dict) -> str:
    """The row as one of a Markdown table: how many converged, and the largest error among the numbers of a verdict."""

    def worst(verdict: str) -> str:
        found = row["errors"].get(verdict)
        return f"{found['largest']:.1f} of {found['count']}" if found else "none"

    converged = f"{row['runs'] - len(row['failures'])} of {row['runs']}"
    return f"| {MOTIONS[row['motion']]} | {row['imu']} | {converged} | {worst('determined')} | {worst('weak')} |"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("output", type=Path)
    parser.add_argument("--runs", type=int, default=100)
    parser.add_argument("--workers", type=int)
    parser.add_argument("--motion", choices=MOTIONS, action="append", help="of these alone; all where none is named")
    given = parser.parse_args()
    for motion in given.motion or MOTIONS:
        for imu, noise in IMUS.items():
            plan = StudyPlan(given.runs, 1, "drawn", workers=given.workers)
            name = f"{motion}, {imu}"
            size = f"{SECONDS} {AZIMUTH_STEPS} {PER_IMAGE}"
            scenario = variant(motion, noise)
            digest = scenario_digest(ROOT / "examples" / "paper" / f"{motion}.yaml", scenario) + f" {noise} {size}"
            study = run_study(scenario, name, digest, given.output / name.replace(", ", "-"), plan)
            store(summary(motion, imu, study.records))
    print(HEADING, *(in_words(row) for row in stored().values()), sep="\n")


if __name__ == "__main__":
    main()
