"""A step that turns the whole world turns it exactly, where no board says how it stands."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from icalib.geometry.planes import moved_and_turned, tangents
from icalib.optim.state import make_layout
from icalib.tools.simulation import simulate

TURN = np.array([0.2, -0.15, 0.1])  # rad, in world axes


@pytest.fixture(scope="module")
def setup(robot_scenario, room_of):
    return room_of(simulate(robot_scenario(3.0), seed=1))


def turning(setup, turn: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Chain and calibration steps of a turn of all there is about the world's origin, to first order."""
    state, calib = setup.state, np.zeros(setup.layout.size)
    chain = np.zeros((len(state.seconds), 15))
    chain[:, 0:3] = np.einsum("kji,j->ki", state.rotation, turn)
    chain[:, 3:6], chain[:, 6:9] = np.cross(turn, state.position), np.cross(turn, state.velocity)
    for b in (b for b in setup.layout.free if b.kind == "plane"):
        normal, point = np.split(state.values[b.key], 2)
        calib[b.columns] = np.append(tangents(normal) @ np.cross(turn, normal), normal @ np.cross(turn, point))
    return chain, calib


def test_trajectory_and_planes_turn_exactly(setup):
    state, Q = setup.state, Rotation.from_rotvec(TURN).as_matrix()
    turned = state.retract(setup.layout, *turning(setup, TURN))
    np.testing.assert_allclose(turned.rotation, Q @ state.rotation, atol=1e-12)
    np.testing.assert_allclose(turned.position, state.position @ Q.T, atol=1e-12)
    np.testing.assert_allclose(turned.velocity, state.velocity @ Q.T, atol=1e-12)
    planes = [b.key for b in setup.layout.free if b.kind == "plane"]
    assert planes
    for key in planes:
        np.testing.assert_allclose(turned.values[key][:3], Q @ state.values[key][:3], atol=1e-12)
        np.testing.assert_allclose(turned.values[key][3:], Q @ state.values[key][3:], atol=1e-12)


def test_what_a_lidar_sees_does_not_change(setup):
    factor, pieces = setup.factor(), setup.problem(setup.state).pieces(sums=False)

    def cost(state) -> float:
        return sum(factor.accumulate(state, p, factor.output(), sums=False) for p in pieces)

    before, after = cost(setup.state), cost(setup.state.retract(setup.layout, *turning(setup, TURN)))
    # Between keyframes the IMU leads, and gravity has not turned.
    assert after == pytest.approx(before, rel=1e-5)


def test_on_a_flat_floor_map_and_path_turn_while_no_keyframe_does(robot_scenario, room_of):
    """All sensors turn against the IMU: on a flat floor the LiDAR sees the same."""
    setup = room_of(simulate(robot_scenario(3.0, example="table2-planar"), seed=1))
    turn, state = np.array([0.0, 0.0, 0.14]), setup.state
    chain, calib = turning(setup, turn)
    chain[:, 0:3] = 0.0
    rotation, translation = (state.values["lidar0", name] for name in ("rotation", "translation"))
    up = state.rotation[0].T @ turn
    calib[setup.layout.columns("lidar0", "rotation")] = rotation.T @ up
    calib[setup.layout.columns("lidar0", "translation")] = np.cross(up, translation)
    turned, Q = state.retract(setup.layout, chain, calib), Rotation.from_rotvec(turn).as_matrix()
    np.testing.assert_allclose(turned.rotation, state.rotation, atol=1e-12)
    np.testing.assert_allclose(turned.position, state.position @ Q.T, atol=1e-12)
    factor, pieces = setup.factor(), setup.problem(state).pieces(sums=False)
    before, after = (sum(factor.accumulate(s, p, factor.output(), sums=False) for p in pieces) for s in (state, turned))
    # But for the lever arm, which moves along the tangent, and what the IMU says between keyframes.
    assert after == pytest.approx(before, rel=1e-2)


def test_any_other_step_is_the_same_to_first_order(setup):
    rng = np.random.default_rng(2)
    chain = 1e-2 * rng.normal(size=(len(setup.state.seconds), 15))
    calib = 1e-2 * rng.normal(size=setup.layout.size)

    def off(s: float) -> float:
        moved = setup.state.retract(setup.layout, s * chain, s * calib)
        return np.abs(moved.position - setup.state.position - s * chain[:, 3:6]).max()

    assert off(1.0) > 1e-6
    assert off(0.1) == pytest.approx(1e-2 * off(1.0), rel=0.1)


@pytest.mark.parametrize("size", [1.0, 0.1])
def test_a_plane_that_turns_is_moved_the_same_to_first_order(size: float):
    plane, d = np.array([0.6, 0.0, 0.8, 2.0, -1.0, 3.0]), size * 1e-3 * np.array([1.0, -2.0, 0.5])
    from_moved = moved_and_turned(plane, d, np.zeros(3))
    off = moved_and_turned(plane, d, size * 1e-2 * TURN) - from_moved
    across = tangents(plane[:3]) @ off[:3]
    assert max(abs(across).max(), abs(plane[:3] @ off[3:])) < size**2 * 2e-5


def test_a_layout_without_planes_turns_its_trajectory(setup):
    chain, _ = turning(setup, TURN)
    turned = setup.state.retract(make_layout([]), chain, np.zeros(0))
    Q = Rotation.from_rotvec(TURN).as_matrix()
    np.testing.assert_allclose(turned.position, setup.state.position @ Q.T, atol=1e-12)
