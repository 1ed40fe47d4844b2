"""What each motion leaves open for a robot with cameras, a LiDAR and wheels, and whether the rest is right.

python benchmarks/degeneracy.py [--seconds S] [--seeds N] [MOTION ...]      docs/studies/degeneracy.json
"""

from __future__ import annotations

import argparse
import dataclasses
import json
from pathlib import Path

import numpy as np

from icalib.errors import CalibrationError
from icalib.montecarlo.truth import error, true_value
from icalib.pipeline import calibrate_measurements
from icalib.simulation import load_scenario, rig_for, simulate, with_drawn_guess

ROOT = Path(__file__).resolve().parent.parent
FOUND = ROOT / "docs" / "studies" / "degeneracy.json"
MOTIONS = ("table2-planar", "single-axis", "arc", "spin", "straight-line", "constant-velocity", "standing")


def judged(motion: str, seconds: float, seed: int) -> dict:
    """Verdicts by entry, and the largest error in formal standard deviations among entries of each verdict."""
    scenario = load_scenario(ROOT / "examples" / "paper" / f"{motion}.yaml")
    scenario = dataclasses.replace(scenario, duration_s=seconds)
    simulation = simulate(scenario, seed)
    rig = with_drawn_guess(rig_for(scenario, intrinsics="fixed", distortion="fixed"), scenario, seed)
    found = {"motion": motion, "seed": seed, "seconds": seconds}
    try:
        result = calibrate_measurements(rig, simulation.measurements)
    except CalibrationError as refused:
        return found | {"refused": str(refused)}
    verdicts, worst = {}, {}
    for g in result.groups:
        true = true_value(simulation.truth, g.sensor, g.name)
        if g.columns is None or true is None:
            continue
        off = np.abs(error(g.name, g.value, true) / g.std_formal)
        for label, verdict, z in zip(g.labels, g.verdict, off, strict=True):
            verdicts[f"{g.sensor} {g.name} {label}"] = verdict
            worst[verdict] = max(worst.get(verdict, 0.0), round(float(z), 2))
    return found | {"converged": result.converged, "worst": worst, "verdicts": verdicts}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seconds", type=float, default=15.0)
    parser.add_argument("--seeds", type=int, default=1)
    parser.add_argument("motion", nargs="*", default=MOTIONS)
    a = parser.parse_args()
    rows = []
    for motion in a.motion:
        for seed in range(1, a.seeds + 1):
            rows.append(judged(motion, a.seconds, seed))
            print({k: v for k, v in rows[-1].items() if k != "verdicts"}, flush=True)
    FOUND.write_text(json.dumps(rows, indent=1) + "\n")


if __name__ == "__main__":
    main()
