"""Rounds of association look at some of the points, and the last at all."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from tests.cases import each

from icalib.data.measurements import LidarStream, Measurements
from icalib.motion.point_planes import PlaneAssociation
from icalib.pipeline import calibrate_measurements
from icalib.sensors.lidar.initialize import association
from icalib.sensors.lidar.initialize.association import AssociatedPlanes, _first_points, _unthinned, odd_step
from icalib.tools.simulation import rig_for

pytestmark = pytest.mark.slow


def empty(n: int) -> LidarStream:
    return LidarStream(
        "lidar0",
        np.zeros(1, np.int64),
        np.array([0, n]),
        np.zeros(n, np.float32),
        np.zeros((n, 3), np.float32),
        np.full(n, -1, np.int32),
    )


@each("step", [1, 3, 5, 13])
def test_what_was_found_of_some_points_is_put_where_they_were(step):
    """Of two recordings, of which the second does not begin with a point that was looked at."""
    number = np.arange(23, dtype=np.int32)
    recordings = [(empty(10),), (empty(13),)]
    firsts = _first_points(recordings)
    assert firsts.tolist() == [[0], [10]]
    for own, streams, first in zip((number[:10], number[10:]), recordings, firsts, strict=True):
        looked_at = own[own % step == 0]
        found = AssociatedPlanes(PlaneAssociation(("plane 0",), (looked_at,)), np.zeros((1, 6)))
        placed = _unthinned(found, streams, first, step)
        assert placed is not None
        (plane,) = placed.association.plane
        np.testing.assert_array_equal(plane, np.where(own % step == 0, own, -1))
    assert _unthinned(None, recordings[0], firsts[0], step) is None


def test_steps_are_odd_and_long_enough():
    for points in (0, 1, association.MOST_POINTS, association.MOST_POINTS + 1, 10 * association.MOST_POINTS):
        step = odd_step(points)
        assert step % 2 == 1 and points <= step * association.MOST_POINTS


@pytest.mark.full
def test_the_result_is_that_of_all_points(robot, monkeypatch):
    """Of two recordings, of which a seventh is looked at beforehand."""
    sims = [robot(10.0, seed, {"azimuth_steps": 600}).sim for seed in (1, 2)]

    def raw(m: Measurements) -> Measurements:
        return m.with_streams(*(replace(x, plane=np.full(len(x.xyz), -1, np.int32)) for x in m.lidars))

    recordings, rig = [raw(s.measurements) for s in sims], rig_for(sims[0].scenario)
    whole = calibrate_measurements(rig, recordings)
    # The step of a round, and not that of the clouds that it thins again.
    monkeypatch.setattr(association, "odd_step", lambda points, *most: 7 if most else odd_step(points))
    thinned = calibrate_measurements(rig, recordings)
    assert whole.converged and thinned.converged
    counts = [c.lidar_residuals[0].points_used for c in (whole, thinned)]
    assert counts[1] == pytest.approx(counts[0], rel=0.02)
    for name in ("translation", "time_offset"):
        a, b = (c.group("lidar0", name) for c in (whole, thinned))
        assert (np.abs(a.value - b.value) < 0.5 * a.std).all(), name
    assert {"plane 1.0", "plane 2.0"} <= {p.name for p in thinned.planes}  # names of the first round, kept
