"""Points of a LiDAR on its own robot: found, and told from a floor and walls that also stay where they are."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from tests.cases import each
from tests.consistency.test_sheets import OPEN, scene
from tests.remarks import remark

from icalib.data.measurements import LidarStream, Measurements
from icalib.sensors.lidar.initialize import self_returns
from icalib.sensors.lidar.initialize.self_returns import _NearPoints, self_returns_of, without_self_returns
from icalib.tools.simulation import simulate

pytestmark = pytest.mark.slow

NOISE_M = 0.03


def raw(stream: LidarStream) -> LidarStream:
    return replace(stream, plane=np.full(len(stream.xyz), -1, np.int32))


def with_panel(stream: LidarStream, axis: int, at: float, low: list[float], high: list[float]):
    """The scans of a LiDAR behind a rectangle that goes along with it, at x (axis 0) or z (axis 2) = `at` from `low` to
    `high` on the other axes; and which points lie on it."""
    xyz = stream.xyz.astype(np.float64)
    beam = xyz / np.linalg.norm(xyz, axis=1)[:, None]
    distance = at / np.where(beam[:, axis] == 0.0, 1e-9, beam[:, axis])
    others = [i for i in range(3) if i != axis]
    across = (distance[:, None] * beam)[:, others]
    hit = (distance > 0.0) & (distance < np.linalg.norm(xyz, axis=1))
    hit &= (across > low).all(axis=1) & (across < high).all(axis=1)
    measured = distance + NOISE_M * np.random.default_rng(0).standard_normal(len(xyz))
    xyz[hit] = (measured[:, None] * beam)[hit]
    return replace(raw(stream), xyz=xyz.astype(np.float32)), hit


PANELS = {
    "small panel ahead": (0, 0.5, [-0.2, -0.2], [0.2, 0.1]),
    "panel ahead": (0, 0.9, [-1.0, -0.6], [1.0, 0.3]),
    "deck below": (2, -0.2, [-0.8, -0.7], [0.8, 0.7]),
}


PANEL_CASES = [(e, p) for e in ("table2-3d", "table2-planar", "table2-ramp") for p in PANELS]
IN_CI = [PANEL_CASES[k] for k in (0, 4, 8)]  # each panel on one motion


@each(("example", "panel"), IN_CI, full=[case for case in PANEL_CASES if case not in IN_CI])
def test_points_on_the_robot_are_found(robot, example, panel):
    stream, hit = with_panel(robot(16.0, 1, {"azimuth_steps": 300}, example=example).streams[0], *PANELS[panel])
    own = self_returns_of(stream)
    assert own is not None and hit.mean() > 0.03
    assert own[hit].mean() > 0.99 and own[~hit].mean() < 0.01


@each(
    ("example", "changes"),
    [("table2-planar", {"range_m": (0.5, 5.0)}), ("straight-line", {}), ("standing", {}), ("table2-planar", {})],
)
def test_what_stays_in_place_but_is_not_the_robot_s(robot, example, changes):
    """The floor that a robot drives on, and everything while it stands."""
    stream = raw(robot(16.0, 1, {"azimuth_steps": 300} | changes, example=example).streams[0])
    near = _NearPoints.of(stream)
    assert near.occupied(np.arange(near.groups))[near.voxel].sum() > 0.02 * len(stream.xyz)
    assert self_returns_of(stream) is None


def test_that_no_beams_pass_through_the_floor_is_what_saves_it(robot, monkeypatch):
    stream = raw(robot(16.0, 1, {"azimuth_steps": 300}, example="table2-planar").streams[0])
    monkeypatch.setattr(self_returns, "MIN_SHARE_THROUGH", -1.0)
    assert self_returns_of(stream) is not None


@each(("place", "turning", "seed"), [({}, 0.4, 3), ({}, 0.4, 5), (OPEN, 0.4, 2), (OPEN, 0.4, 4)])
def test_a_board_before_a_lidar_in_the_hand_is_not_the_robot_s(place, turning, seed):
    """It stays in front. In an open place floor and board do not fix the position of the LiDAR, and nothing is said."""
    scenario = scene(8.0, azimuth_steps=900, **place)
    scenario = replace(scenario, motion=replace(scenario.motion, rotation_scale=turning))
    stream = raw(simulate(scenario, seed).measurements.lidars[0])
    near = _NearPoints.of(stream)
    assert near.occupied(np.arange(near.groups))[near.voxel].any()
    assert self_returns_of(stream) is None


def test_of_a_long_recording_its_middle_tells(robot, monkeypatch):
    """And the robot is found in all of it."""
    monkeypatch.setattr(self_returns, "MAX_SEARCHED_SCANS", 70)
    whole = robot(16.0, 1, {"azimuth_steps": 300}, example="table2-planar").streams[0]
    assert len(whole.stamps_ns) > 1.5 * self_returns.MAX_SEARCHED_SCANS
    stream, hit = with_panel(whole, *PANELS["panel ahead"])
    own = self_returns_of(stream)
    assert own is not None and own[hit].mean() > 0.99 and own[~hit].mean() < 0.01
    assert self_returns_of(raw(whole)) is None


def test_what_is_said_and_what_stays(robot):
    r = robot(16.0, 1, {"azimuth_steps": 300}, example="table2-planar")
    stream, hit = with_panel(r.streams[0], *PANELS["panel ahead"])
    recording = replace(Measurements.of_streams(r.sim.measurements.imu, stream), warnings=(remark("before."),))
    found = without_self_returns(recording)
    before, (said,) = found.warnings[0], found.warnings[1:]
    assert before == "before." and said.name == "self_returns_removed" and said.startswith("lidar0 ")
    assert "% of its points" in said and "0.86 to 1.3" in said
    assert (
        any(f"azimuth {deg} deg" in said for deg in (-1, 0, 1))
        and "set min_range of lidar0 to 1.5 in the rig file" in said
    )
    (kept,) = found.lidars
    assert len(kept.stamps_ns) == len(stream.stamps_ns)
    assert len(kept.xyz) == pytest.approx((~hit).sum(), rel=0.01)
    all_round = without_self_returns(recording.with_streams(with_panel(r.streams[0], *PANELS["deck below"])[0]))
    assert "on all sides" in all_round.warnings[-1]


def test_points_of_known_planes_are_left_alone(robot):
    """Whoever knows what lies on which plane knows what is the robot's."""
    stream, _ = with_panel(robot(16.0, 1, {"azimuth_steps": 300}).streams[0], *PANELS["panel ahead"])
    known = Measurements.of_streams(replace(stream, plane=np.where(stream.xyz[:, 0] < 0.0, 1, -1).astype(np.int32)))
    assert without_self_returns(known).lidars[0] is known.lidars[0]
