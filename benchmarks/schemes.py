"""What each pose scheme makes of the same simulated recordings: consistency and time-offset error.

python benchmarks/schemes.py [--seeds N]      the table of docs/schemes.md
"""

from __future__ import annotations

import argparse
import dataclasses
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation

from icalib.pipeline import calibrate_measurements
from icalib.result import Calibration
from icalib.tools.simulation import Scenario, Truth, handheld, rig_for, simulate

BLOCKS = ("rotation", "translation", "time_offset")
PLACES = {"every-image": "every image", "first-camera": "cam0's images"}


@dataclass(frozen=True)
class Case:
    """One row: what is simulated, and with which settings it is solved."""

    title: str
    scenario: Scenario
    keyframes: str
    scheme: str
    spacing_s: float = 0.05  # between keyframes, at most


def cases() -> list[Case]:
    together, apart = (handheld(12.0, asynchronous=a) for a in (False, True))
    slow = dataclasses.replace(
        apart, motion=dataclasses.replace(apart.motion, rotation_scale=0.2, translation_scale=0.2)
    )
    scenarios = {"together": together, "half a period apart": apart, "half a period apart, slow": slow}
    return [
        Case(title, scenario, keyframes, scheme)
        for title, scenario in scenarios.items()
        for keyframes in PLACES
        for scheme in ("inertial", "kinematic", "pose")
    ]


def run(case: Case, seed: int) -> tuple[dict[str, float], float, float]:
    """Squared error by its covariance of each block, over dof; RMS offset and position errors [s, m]."""
    simulated = simulate(case.scenario, seed)
    rig = rig_for(case.scenario, intrinsics="fixed", distortion="fixed")
    settings = dataclasses.replace(
        rig.settings, keyframes=case.keyframes, scheme=case.scheme, segments=0, keyframe_spacing_s=case.spacing_s
    )
    calibration = calibrate_measurements(dataclasses.replace(rig, settings=settings), simulated.measurements)
    errors = {b: _errors(calibration, simulated.truth, b) for b in BLOCKS}
    rms = {b: float(np.sqrt(np.mean(e**2))) for b, (e, _) in errors.items()}
    nees = {b: float(e @ np.linalg.solve(P, e)) / len(e) for b, (e, P) in errors.items()}
    return nees, rms["time_offset"], rms["translation"]


def _errors(calibration: Calibration, truth: Truth, block: str) -> tuple[np.ndarray, np.ndarray]:
    groups = [
        g for g in calibration.groups if g.name == block and g.columns is not None and g.sensor in truth.T_imu_sensor
    ]
    errors = []
    for g in groups:
        T = truth.T_imu_sensor[g.sensor]
        if block == "rotation":
            errors.append(Rotation.from_matrix(T[:3, :3].T @ g.value).as_rotvec())
        else:
            errors.append(g.value - (T[:3, 3] if block == "translation" else truth.time_offset[g.sensor]))
    columns = np.concatenate([np.array(g.columns) for g in groups])
    return np.concatenate(errors), calibration.covariance[np.ix_(columns, columns)]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seeds", type=int, default=20)
    n = parser.parse_args().seeds
    print("| cameras | keyframes at | scheme | rotation | position | time offset | offset error | position error |")
    print("|---|---|---|---|---|---|---|---|")
    with ProcessPoolExecutor(2) as pool:
        for case in cases():
            nees, offsets, positions = zip(*pool.map(run, [case] * n, range(n)), strict=True)
            mean = [np.mean([k[b] for k in nees]) for b in BLOCKS]
            offset, position = (float(np.sqrt(np.mean(np.square(x)))) for x in (offsets, positions))
            print(
                f"| {case.title} | {PLACES[case.keyframes]} | {case.scheme} | "
                + " | ".join(f"{m:.3g}" for m in mean)
                + f" | {1e6 * offset:.0f} us | {1e3 * position:.2f} mm |",
                flush=True,
            )


if __name__ == "__main__":
    main()
