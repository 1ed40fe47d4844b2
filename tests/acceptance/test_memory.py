"""Peak memory grows with a recording by what its corners and keyframes need, not by copies of them."""

from __future__ import annotations

import dataclasses
import pickle
import subprocess
import sys
from pathlib import Path

import pytest

from icalib.rig import Rig, Settings
from icalib.tools.simulation import handheld, rig_for, simulate

CHILD = """
import pickle, sys
from icalib.pipeline import calibrate_measurements
rig, measurements = pickle.load(open(sys.argv[1], "rb"))
assert calibrate_measurements(rig, measurements).converged
print(next(line.split()[1] for line in open("/proc/self/status") if line.startswith("VmHWM")))
"""
SHORT_S, LONG_S = 60.0, 360.0
# Of a corner: where it is, its point, standard deviation, residual, weight, bloom, and whether it is kept.
# The score test of effects has a second factor for a moment: residual, weight, standard deviation, bloom, and whether
# it is kept.
CORNER_BYTES = 16 + 8 + 8 + 8 + 4 + 8 + 1 + 37
# Of a keyframe: two blocks of 15 x 15, 15 x 25 with the calibration, preintegration, ten readings, states and steps.
# The score test has 34 columns more, of effects, and a preintegration of its own with derivatives by 38 parameters.
KEYFRAME_BYTES = 8 * (2 * 225 + 15 * (25 + 34) + 225 + (225 + 9 * 38 + 15) + (225 + 54 + 15) + 150 + 200)
LEAST, MOST = 0.75, 1.2  # of what is needed: work space and what the allocator holds are much the same in both


@pytest.mark.full
@pytest.mark.skipif(sys.platform != "linux", reason="peak memory in kilobytes, and an allocator that gives back")
def test_memory_grows_with_what_corners_and_keyframes_need(tmp_path: Path) -> None:
    _peak(tmp_path, 10.0)  # compiles what is not yet compiled
    (short, corners0, nodes0), (long, corners1, nodes1) = (_peak(tmp_path, s) for s in (SHORT_S, LONG_S))
    needed = CORNER_BYTES * (corners1 - corners0) + KEYFRAME_BYTES * (nodes1 - nodes0)
    assert LEAST * needed < long - short < MOST * needed


def _peak(folder: Path, duration_s: float) -> tuple[int, int, int]:
    """Peak memory [bytes] of a process that calibrates one camera, its corners and its images."""
    scenario = handheld(duration_s)
    scenario = dataclasses.replace(scenario, cameras=scenario.cameras[:1])
    measurements = simulate(scenario, 0).measurements
    rig: Rig = rig_for(scenario, settings=Settings(), intrinsics="free", distortion="free")
    path = folder / "measured.pickle"
    path.write_bytes(pickle.dumps((rig, measurements)))
    done = subprocess.run([sys.executable, "-c", CHILD, str(path)], stdout=subprocess.PIPE, text=True, check=True)
    stream = measurements.cameras[0]
    return 1024 * int(done.stdout), len(stream.uv), len(stream.stamps_ns)
