"""Time of tracks in the estimator, beside what its matrix products alone take: `python benchmarks/tracks.py`.

IMU and three cameras of Table II in a room; the problem of the last pass, at the solution. Times are those of the
processor, all threads together, so that other work on the machine disturbs them less; ratios are of one run.
"""

from __future__ import annotations

import argparse
import os
import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
from threadpoolctl import threadpool_limits

from icalib.estimate.estimate import Estimate, estimate
from icalib.estimate.inputs import inputs_for
from icalib.geometry.blas import subtract_gram
from icalib.geometry.targets import NoTarget
from icalib.optim.arrowhead import Piece, solve
from icalib.pipeline import calibrate_measurements
from icalib.rig import Parameter, Rig
from icalib.sensors.camera.initialize import initial_guesses, initial_state
from icalib.tools.simulation import load_scenario, rig_for, simulate

SCENARIO = Path(__file__).parents[1] / "examples" / "paper" / "table2-3d.yaml"
REPEATS = 3


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seconds", type=float, default=60.0, help="of the recording (60)")
    seconds = parser.parse_args().seconds
    scenario = replace(load_scenario(SCENARIO), sensors=(), duration_s=seconds)
    simulation, rig = simulate(scenario, 1), _rig(rig_for(scenario, intrinsics="start", distortion="start"))
    calibrate_measurements(rig, simulation.measurements)  # compiles
    print(f"load before: {os.getloadavg()[0]:.1f}")
    spent, taken = _spent(lambda: calibrate_measurements(rig, simulation.measurements))
    print(f"measurements to covariance{taken:>8.2f} s on the clock, {spent:.2f} s of the processor")
    with threadpool_limits(limits=1, user_api="blas"):
        inputs = inputs_for(rig, [simulation.measurements])
        guesses, _ = _spent(lambda: initial_guesses(rig, inputs.bodies, [m.measurements for m in inputs.motions]))
        state = initial_state(inputs, *initial_guesses(rig, inputs.bodies, [m.measurements for m in inputs.motions]))
        print(f"first guess               {guesses:>8.2f} s of the processor")
        passes, _ = _spent(lambda: estimate(inputs, state))
        print(f"all passes                {passes:>8.2f} s")
        _step(estimate(inputs, state))
    print(f"load after: {os.getloadavg()[0]:.1f}")


def _rig(rig: Rig) -> Rig:
    """No target, focal lengths 2 % off, noise known."""
    off = np.array([1.02, 1.02, 1.0, 1.0])
    cameras = [
        replace(c, intrinsics=Parameter("free", c.intrinsics.value * off), track_noise_px=1.0) for c in rig.cameras
    ]
    return rig.with_(target=NoTarget(), cameras=tuple(cameras))


def _step(result: Estimate) -> None:
    """One step, and its products alone."""
    problem, state = result.problem, result.outcome.state
    pieces, residuals = problem.pieces(), problem.residuals()
    linearising, solving = [], []
    for _ in range(REPEATS):
        linearising.append(_spent(lambda: problem.linearise(state, pieces, residuals))[0])
        solving.append(_spent(lambda: solve(pieces, problem.n_keyframes, problem.tolerance))[0])
    products = sum(min(_spent(_products(p))[0] for _ in range(REPEATS)) for p in pieces)
    features = [p.features for p in pieces if p.features is not None]
    alive = max(int(f.plan.alive.max(initial=0)) for f in features)
    n = sum(len(f.sums.track) for f in features)
    print(f"{problem.n_keyframes} keyframes, {sum(len(f.sums.diagonal) for f in features)} tracks")
    print(f"{alive} alive, {n} observations")
    print(f"linearising               {min(linearising):>8.2f} s, {1e6 * min(linearising) / n:.2f} us an observation")
    print(f"solving                   {min(solving):>8.2f} s, {min(solving) / products:.1f} times its products alone")


def _products(piece: Piece) -> Callable[[], None]:
    """The updates of the front, of matrices of the same sizes."""
    features = piece.features
    assert features is not None
    plan, n_calib = features.plan, features.sums.side.shape[2]
    ranks = []
    for g in range(len(plan.after)):
        own = plan.keyframes.values[plan.keyframes.start[g] : plan.keyframes.start[g + 1]]
        ranks.append(int(plan.coupled[own].sum() + 3 * (plan.dying.start[g + 1] - plan.dying.start[g])))
    wide = n_calib + 3 * plan.alive
    rows, front = np.random.default_rng(0).standard_normal((max(ranks), wide.max())), np.zeros((wide.max(),) * 2)

    def run() -> None:
        for rank, width in zip(ranks, wide.tolist(), strict=True):
            subtract_gram(rows[:rank, :width], front[:width, :width])

    return run


def _spent(work: Callable[[], object]) -> tuple[float, float]:
    """Seconds of the processor, and on the clock."""
    processor, clock = time.process_time(), time.perf_counter()
    work()
    return time.process_time() - processor, time.perf_counter() - clock


if __name__ == "__main__":
    main()
