"""Cameras that follow points beside a LiDAR, nothing known of where they are, nor which point lies on which plane.

From tracks alone such cameras are refused in the plane, and elsewhere now and then placed so badly that the answer is
100 standard deviations off. The LiDAR shows the motion.
"""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from icalib.montecarlo.one_run import Task, run
from icalib.montecarlo.statistics import Sample, nees
from icalib.simulation import load_scenario

PAPER = Path(__file__).parents[2] / "examples" / "paper"


@pytest.mark.parametrize(("example", "seed"), [("planar", 4000), ("ramp", 4000)])
def test_nothing_but_rough_lenses_is_needed(example, seed):
    scenario = load_scenario(PAPER / f"table2-{example}.yaml")
    lidars = tuple(replace(x, azimuth_steps=600) for x in scenario.lidars)
    scenario = replace(scenario, duration_s=20.0, cameras=scenario.cameras[:2], lidars=lidars, wheels=())
    record = run(Task(scenario, seed, planes="found"))
    assert not record.failure
    assert bool(record.undetermined) == (example == "planar")
    assert all("translation z" in words for words in record.undetermined)
    known = np.concatenate([np.array(b.verdict) != "undetermined" for b in record.blocks])
    found = nees([Sample(seed, record.error[known], record.covariance[np.ix_(known, known)])], 0.9999)
    assert found.consistent, found
