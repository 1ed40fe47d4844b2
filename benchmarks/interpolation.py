"""Error and consistency of the three pose schemes against the rate of states and the speed of the motion.

python benchmarks/interpolation.py [--seeds N]      docs/studies/interpolation.json and its figures
"""

from __future__ import annotations

import argparse
import dataclasses
import json
from concurrent.futures import ProcessPoolExecutor
from pathlib import Path

import matplotlib
import numpy as np
from schemes import BLOCKS, Case, run

from icalib.tools.simulation import Scenario, handheld

STUDIES = Path(__file__).resolve().parent.parent / "docs" / "studies"
SCHEMES = ("inertial", "kinematic", "pose")
RATES_HZ = (10.0, 20.0, 40.0, 80.0, 160.0)
SPEEDS = (0.05, 0.1, 0.2, 0.5, 1.0, 2.0)
CAMERA_HZ = 10.0
USUAL_HZ = 20.0
SECONDS = 12.0


def scenario(states_hz: float, speed: float) -> Scenario:
    """Two cameras, the second half way between two states; 1.1 rad/s and 4.7 m/s^2 RMS at speed 1."""
    whole = handheld(SECONDS)
    cameras = tuple(
        dataclasses.replace(c, rate_hz=CAMERA_HZ, phase_s=k * 0.5 / states_hz) for k, c in enumerate(whole.cameras)
    )
    motion = dataclasses.replace(whole.motion, rotation_scale=speed, translation_scale=speed)
    return dataclasses.replace(whole, cameras=cameras, motion=motion)


def cases() -> list[tuple[str, float, Case]]:
    """(axis, where on it, what is run), with states at the first camera's images and in between at the rate."""
    points = [("state_rate", hz, hz, 1.0) for hz in RATES_HZ] + [("speed", s, USUAL_HZ, s) for s in SPEEDS]
    return [
        (axis, x, Case(axis, scenario(hz, speed), "first-camera", scheme, spacing_s=1.0 / hz))
        for axis, x, hz, speed in points
        for scheme in SCHEMES
    ]


def study(seeds: int) -> list[dict]:
    rows = []
    with ProcessPoolExecutor(2) as pool:
        for axis, x, case in cases():
            nees, offsets, positions = zip(*pool.map(run, [case] * seeds, range(seeds)), strict=True)
            row = {"axis": axis, "at": x, "scheme": case.scheme, "runs": seeds}
            row |= {f"nees_{b}": float(np.mean([k[b] for k in nees])) for b in BLOCKS}
            row["time_offset_rmse_s"], row["translation_rmse_m"] = (
                float(np.sqrt(np.mean(np.square(e)))) for e in (offsets, positions)
            )
            rows.append(row)
            print(row, flush=True)
    return rows


def draw(rows: list[dict]) -> None:
    """NEES and errors against either axis."""
    matplotlib.use("svg")
    from matplotlib import pyplot

    matplotlib.rcParams |= {"font.size": 9, "svg.hashsalt": "icalib"}
    shown = (
        ("nees_time_offset", "NEES of the time offsets", 1.0),
        ("time_offset_rmse_s", "error of the time offsets [us]", 1e6),
        ("translation_rmse_m", "error of the positions [mm]", 1e3),
    )
    titles = {"state_rate": "states per second", "speed": "speed of the motion (1: 1.1 rad/s, 4.7 m/s² RMS)"}
    figure, axes = pyplot.subplots(2, 3, figsize=(10.5, 5.6), layout="constrained")
    for line, (axis, title) in zip(axes, titles.items(), strict=True):
        for panel, (key, label, unit) in zip(line, shown, strict=True):
            for scheme, mark in zip(SCHEMES, "os^", strict=True):
                selected = [r for r in rows if r["axis"] == axis and r["scheme"] == scheme]
                panel.loglog([r["at"] for r in selected], [unit * r[key] for r in selected], marker=mark, label=scheme)
            panel.set(xlabel=title, ylabel=label)
            panel.grid(alpha=0.3)
            if key.startswith("nees"):
                panel.axhline(1.0, color="0.4", lw=0.8)
    axes[0, 0].legend()
    figure.savefig(STUDIES / "interpolation.svg", metadata={"Date": None})


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seeds", type=int, default=20)
    rows = study(parser.parse_args().seeds)
    STUDIES.mkdir(exist_ok=True)
    (STUDIES / "interpolation.json").write_text(json.dumps(rows, indent=1) + "\n")
    draw(rows)


if __name__ == "__main__":
    main()
