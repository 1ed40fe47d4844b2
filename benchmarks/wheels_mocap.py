"""Time and memory of wheels beside motion capture, without an IMU: `python benchmarks/wheels_mocap.py --minutes 10`.

A vehicle on a plane, poses at 100 Hz (2 mrad, 1 mm), wheels at 50 Hz. `calibrate` runs on the measurements in memory,
in a process of its own after one that compiles, so that the peak memory is that of the calibration.
"""

from __future__ import annotations

import argparse
import resource
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import icalib
from icalib.tools.simulation import load_scenario, simulate, write_tables

SCENARIO = """
duration: {seconds}
seed: 3
motion: {{kind: planar}}
sensors:
  imu0:
    type: imu
    rate: 200
    noise: {{gyro: 1.7e-4, gyro_walk: 1.9e-5, accel: 2.0e-3, accel_walk: 3.0e-3}}
  mocap0:
    type: pose
    rate: 100
    rotation_noise: 0.002
    position_noise: 0.001
    T_imu_sensor: [[1, 0, 0, 0.1], [0, 1, 0, 0.05], [0, 0, 1, 0.2], [0, 0, 0, 1]]
    T_world_frame: [[1, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]]
  wheel0:
    type: wheels
    rate: 50
    time_offset: 0.005
    radii: [0.1, 0.102]
    baseline: 0.42
    noise: 0.03
    reports: rates
    T_imu_sensor: [
      [0.998021197, 0.051405712, 0.036209721, -0.15],
      [-0.052304075, 0.998335142, 0.024315201, 0.04],
      [-0.034899497, -0.026161002, 0.999048361, -0.33],
      [0, 0, 0, 1],
    ]
room:
  size: [12, 10, 3.2]
"""
SEED = 3
RIG = """
sensors:
  mocap0: {type: pose}
  wheel0: {type: wheels, wheel_noise: 0.03}
"""


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--minutes", type=float, default=10.0, help="of the recording (10)")
    parser.add_argument("--folder", type=Path, help=argparse.SUPPRESS)  # of a recording: what the processes are told
    given = parser.parse_args()
    if given.folder is not None:
        _calibrate(given.folder)
        return
    with tempfile.TemporaryDirectory() as folder:
        for name, seconds in (("warm", 30.0), ("recording", 60.0 * given.minutes)):
            path = Path(folder) / name
            _record(path, seconds)
            done = subprocess.run(
                [sys.executable, __file__, "--folder", path], check=True, capture_output=True, text=True
            )
        print(f"{given.minutes:g} minutes: {done.stdout}", end="")


def _record(folder: Path, seconds: float) -> None:
    """Writes a recording and its rig file."""
    scenario = folder.with_suffix(".yaml")
    scenario.write_text(SCENARIO.format(seconds=seconds))
    write_tables(simulate(load_scenario(scenario), SEED), SEED, folder)
    folder.with_suffix(".rig").write_text(RIG)


def _calibrate(folder: Path) -> None:
    """Calibrates, and prints what it took."""
    wall, cpu = time.perf_counter(), time.process_time()
    result = icalib.calibrate(folder.with_suffix(".rig"), folder)
    wall, cpu = time.perf_counter() - wall, time.process_time() - cpu
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1e3  # kB on Linux
    print(f"{wall:.1f} s on the clock, {cpu:.1f} s of the processor, {peak:.0f} MB; converged: {result.converged}")


if __name__ == "__main__":
    main()
