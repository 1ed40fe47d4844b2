"""Time of a robot with a LiDAR and wheels beside cameras: `python benchmarks/robot.py`.

The sensors of Table II in a room, everything guessed, points associated with planes. Times are those of the processor,
all threads together, so that other work on the machine disturbs them less; the stages are those of one run, after one
that compiles.
"""

from __future__ import annotations

import argparse
import os
import resource
import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import TypeVar

import numpy as np
from threadpoolctl import threadpool_limits

from icalib.data.measurements import Measurements
from icalib.estimate.estimate import Estimate
from icalib.estimate.inputs import Inputs
from icalib.estimate.problem import motion_of
from icalib.initialize.rig_guess import guess_of_rig
from icalib.observability.determination import Determined, determine
from icalib.rig import Rig
from icalib.sensors.lidar.binning import AssociatedPoints, take_moments
from icalib.sensors.lidar.residual import LidarFactor
from icalib.tools.simulation import load_scenario, rig_for, simulate, with_drawn_guess
from icalib.validation import assess

PAPER = Path(__file__).parents[1] / "examples" / "paper"
REPEATS = 3
T = TypeVar("T")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seconds", type=float, default=60.0, help="of the recording (60)")
    parser.add_argument("--motion", choices=("3d", "ramp", "planar"), default="3d")
    given = parser.parse_args()
    scenario = replace(load_scenario(PAPER / f"table2-{given.motion}.yaml"), duration_s=given.seconds)
    simulation = simulate(scenario, 1)
    rig = with_drawn_guess(rig_for(scenario, intrinsics="free", distortion="free"), scenario, 1)
    with threadpool_limits(limits=1, user_api="blas"):
        _run(rig, simulation.measurements)  # compiles
        print(f"load before: {os.getloadavg()[0]:.1f}")
        inputs, solution = _run(rig, simulation.measurements, show=True)
        _parts(inputs, solution.estimate)
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1e3
    print(f"load after: {os.getloadavg()[0]:.1f}; peak memory {peak:.0f} MB, the simulation included")


def _run(rig: Rig, measurements: Measurements, show: bool = False) -> tuple[Inputs, Determined]:
    """Measurements to covariance, stage by stage."""
    begun, clock = time.process_time(), time.perf_counter()
    (inputs, state, guess), starting = _spent(lambda: guess_of_rig(rig, [measurements]))
    solution, solving = _spent(lambda: determine(inputs, state, guess=guess))
    _, judging = _spent(lambda: assess(inputs, solution))
    if show:
        print(f"measurements to covariance{time.process_time() - begun:>8.2f} s of the processor, ", end="")
        print(f"{time.perf_counter() - clock:.2f} s on the clock, {len(solution.estimate.steps)} steps")
        print(f"  start                   {starting:>8.2f} s")
        print(f"  solving, determination  {solving:>8.2f} s")
        print(f"  judging                 {judging:>8.2f} s")
    return inputs, solution


def _parts(inputs: Inputs, estimate: Estimate) -> None:
    """Accumulation of points to moments, and one linearisation by sensor."""
    problem, state = estimate.problem, estimate.outcome.state
    motion, planes = motion_of(inputs, state), np.array([state.values[k] for k in inputs.association.keys])
    noises = [estimate.measurement_model.noise[s.name] for s in inputs.measurements.lidars]
    for stream, plane, noise in zip(inputs.measurements.lidars, inputs.association.plane, noises, strict=True):
        cloud = AssociatedPoints(stream, plane, planes)
        spent = min(_spent(lambda c=cloud, n=noise: take_moments(c, motion, n))[1] for _ in range(REPEATS))
        rate = 1e-6 * len(stream.xyz) / spent
        print(f"{stream.name}: {1e-6 * len(stream.xyz):.1f} M points to moments {spent:.2f} s, ", end="")
        print(f"{rate:.0f} M points/s and core, {2.0 * rate:.0f} on two")
    pieces, residuals = problem.pieces(), problem.residuals()
    total = min(_spent(lambda: problem.linearise(state, pieces, residuals))[1] for _ in range(REPEATS))
    print(f"{problem.n_keyframes} keyframes, {problem.layout.size} calibration parameters")
    print(f"linearising {total:.3f} s, of which")
    for factor in problem.factors.values():
        out = factor.output()
        own = min(
            _spent(lambda f=factor, o=out: [f.accumulate(state, p, o) for p in pieces])[1] for _ in range(REPEATS)
        )
        what = f", {len(factor.moments.plane)} planes in bins" if isinstance(factor, LidarFactor) else ""
        print(f"  {factor.name:<24}{own:>8.3f} s{what}")


def _spent(work: Callable[[], T]) -> tuple[T, float]:
    """What work gives, and seconds of the processor."""
    begun = time.process_time()
    given = work()
    return given, time.process_time() - begun


if __name__ == "__main__":
    main()
