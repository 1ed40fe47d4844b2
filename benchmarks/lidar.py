"""Time of an IMU and a LiDAR alone, from raw clouds in memory to the result: `python benchmarks/lidar.py`.

The clouds of a spinning LiDAR of 16 rings and 300 000 beams a second in the room of Table II, with nothing known: no
guess, and not which point lies on which plane. All points are used. Kernels are compiled by a short run beforehand.
With `--kiss-icp`, the odometry of kiss-icp in its default configuration goes over the same clouds in the same process
(`pip install kiss-icp`), and the ratio of the processor times is shown. Other work on the machine hardly changes it.
"""

from __future__ import annotations

import argparse
import os
import resource
import time
from dataclasses import replace
from itertools import pairwise
from pathlib import Path

import numpy as np

from icalib.data.measurements import LidarStream, Measurements
from icalib.pipeline import calibrate_measurements
from icalib.rig import Rig
from icalib.sensors.lidar.simulate import SimLidar
from icalib.tools.simulation import Simulation, load_scenario, rig_for, simulate

PAPER = Path(__file__).parents[1] / "examples" / "paper"
RATE_HZ, AZIMUTH_STEPS = 10.0, 1875  # times 16 rings: 300 000 beams a second
COMPILING_S = 10.0


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seconds", type=float, default=60.0, help="of the recording (60)")
    parser.add_argument("--motion", choices=("3d", "ramp", "planar"), default="3d")
    parser.add_argument("--kiss-icp", action="store_true", help="measure the odometry of kiss-icp, too")
    given = parser.parse_args()
    calibrate_measurements(*_recording(_simulated(given.motion, COMPILING_S, AZIMUTH_STEPS // 4)))
    simulation = _simulated(given.motion, given.seconds, AZIMUTH_STEPS)
    rig, recording = _recording(simulation)
    (stream,) = recording.lidars
    size = sum(x.nbytes for x in (stream.xyz, stream.offset_s, stream.plane)) / 1e6
    before = _peak_mb()
    print(f"{len(stream.xyz) / 1e6:.1f} M points of {given.seconds:g} s, {size:.0f} MB; load {os.getloadavg()[0]:.1f}")
    wall, cpu = time.perf_counter(), time.process_time()
    result = calibrate_measurements(rig, recording)
    wall, cpu = time.perf_counter() - wall, time.process_time() - cpu
    print(f"clouds to result {wall:.1f} s on the clock, {cpu:.1f} s of the processor; converged: {result.converged}")
    for stage, spent in result.timings.items():
        print(f"  {stage:<16}{spent:>8.1f} s")
    used = result.lidar_residuals[0]
    print(f"{used.points_used} of {used.points_read} points on {len(result.planes)} planes")
    print(f"{used.points_read / wall * 1e-6:.2f} M points/s, all in all")
    print(f"peak memory {_peak_mb():.0f} MB, before the calibration {before:.0f} MB; load {os.getloadavg()[0]:.1f}")
    _errors(simulation, result)
    if given.kiss_icp:
        theirs = _kiss_icp_seconds(stream)
        print(f"kiss-icp's odometry alone {theirs:.1f} s of the processor; ratio {cpu / theirs:.2f}")


def _kiss_icp_seconds(stream: LidarStream) -> float:
    """Processor time of the odometry of kiss-icp over all scans."""
    from kiss_icp.config import load_config
    from kiss_icp.kiss_icp import KissICP

    odometry, started = KissICP(load_config(None)), time.process_time()
    for first, last in pairwise(stream.start):
        odometry.register_frame(stream.xyz[first:last].astype(float), stream.offset_s[first:last].astype(float))
    return time.process_time() - started


def _simulated(motion: str, seconds: float, steps: int) -> Simulation:
    scenario = load_scenario(PAPER / f"table2-{motion}.yaml")
    lidar = replace(scenario.of(SimLidar)[0], rate_hz=RATE_HZ, azimuth_steps=steps)
    alone = replace(scenario, duration_s=seconds, cameras=(), features=None, board=False, sensors=(lidar,))
    return simulate(alone, 1)


def _recording(simulation: Simulation) -> tuple[Rig, Measurements]:
    """The rig without guesses, and the clouds without the planes that the simulator knows."""
    (stream,) = simulation.measurements.lidars
    stream.plane[:] = -1
    return rig_for(simulation.scenario), simulation.measurements


def _errors(simulation: Simulation, result) -> None:
    name = result.lidar_residuals[0].sensor
    T, truth = result.T_imu_sensor(name), simulation.truth.T_imu_sensor[name]
    cosine = 0.5 * (np.trace(truth[:3, :3].T @ T[:3, :3]) - 1.0)
    off_us = 1e6 * (result.group(name, "time_offset").value[0] - simulation.truth.time_offset[name])
    error_mm = 1e3 * np.linalg.norm(T[:3, 3] - truth[:3, 3])
    print(f"off by {np.rad2deg(np.arccos(min(cosine, 1.0))):.4f} deg, {error_mm:.2f} mm, {off_us:.1f} us")


def _peak_mb() -> float:
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1e3


if __name__ == "__main__":
    main()
