"""Rotations of a pose sensor against its positions: the derivative by the effect, recovery, and what is covered."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from tests.consistency.test_pose_sensors import BLOCKS, alone, errors, sensor, without_noise

from icalib.data.measurements import PoseStream
from icalib.estimate.estimate import DEFAULT_OPTIONS, estimate
from icalib.estimate.residual_statistics import Segments
from icalib.estimate.score_test import score_test
from icalib.initialize.rig_guess import guess_of_rig
from icalib.motion.factor import of_type
from icalib.pipeline import calibrate_measurements
from icalib.sensors.pose.residual import PoseFactor
from icalib.tools.simulation import rig_for, simulate

TURN = np.deg2rad([1.0, -0.5, 0.8])


def turned(stream: PoseStream, turn: np.ndarray, kind: str) -> PoseStream:
    """Positions of absolute poses turned about the origin of their frame, displacements of relative ones in the axes of
    the sensor."""
    T, R = Rotation.from_rotvec(turn).as_matrix(), stream.rotation
    if kind == "absolute":
        return replace(stream, position=stream.position @ T.T)
    steps = np.einsum("nji,nj->ni", R[:-1], np.diff(stream.position, axis=0)) @ T.T
    path = np.cumsum(np.einsum("nij,nj->ni", R[:-1], steps), axis=0)
    return replace(stream, position=np.vstack([stream.position[:1], stream.position[0] + path]))


def scene(kind, seed, turn, position_noise):
    """Rig with eight segments, measurements with turned positions, and truth."""
    scenario = alone(kind)
    scenario = scenario.with_sensors(replace(sensor(kind), position_noise=position_noise))
    sim = simulate(scenario, seed)
    rig = without_noise(rig_for(scenario)).with_("settings", segments=8)
    (stream,) = sim.measurements.poses
    return rig, sim.measurements.with_streams(turned(stream, turn, kind)), sim.truth


@pytest.mark.parametrize("kind", ["absolute", "relative"])
def test_the_step_is_that_of_an_estimate_with_turned_positions(kind):
    """Turning the positions back by the step of the effect moves the estimate by the step of all parameters."""
    rig, measured, _ = scene(kind, 1, 3.0 * TURN, 2e-3)
    inputs, state, _ = guess_of_rig(rig, [replace(measured, name="only")], lambda _: None)
    before = estimate(inputs, state)
    outcome, problem = before.outcome, before.problem
    (factor,) = of_type(problem.factors, PoseFactor)
    segments = Segments.of(problem, outcome, 8)
    assert segments is not None
    effect = score_test(segments, outcome, factor.with_turned_positions, 3, 0.0)
    assert effect is not None
    np.testing.assert_allclose(effect.value, -3.0 * TURN, atol=0.03)
    back = replace(measured.poses[0], position=turned(measured.poses[0], effect.value, kind).position)
    again = replace(inputs, measurements=inputs.measurements.with_streams(back))
    options = replace(DEFAULT_OPTIONS, measurement_model=before.measurement_model)
    after = estimate(again, outcome.state, options).outcome.state
    columns = inputs.layout.columns("mocap0", "translation")
    moved = after.values["mocap0", "translation"] - outcome.state.values["mocap0", "translation"]
    turn = Rotation.from_matrix(outcome.state.values["mocap0", "rotation"].T @ after.values["mocap0", "rotation"])
    np.testing.assert_allclose(moved, effect.change[columns], atol=1e-3)
    expected = effect.change[inputs.layout.columns("mocap0", "rotation")]
    np.testing.assert_allclose(turn.as_rotvec(), expected, atol=0.15 * float(np.linalg.norm(expected)) + 1e-4)


def test_a_contradiction_is_said_and_covered():
    """Displacements of a visual odometry that are turned by 1.4 deg: without the difference, three standard deviations
    were 0.3 deg and the error 0.6 deg."""
    rig, measured, truth = scene("relative", 2, TURN, 2e-3)
    result = calibrate_measurements(rig, measured)
    said = [w for w in result.warnings if w.name == "rotations_contradict_positions"]
    assert len(said) == 1 and "turned by 1." in said[0]
    error = errors(result, truth, "mocap0")[0]
    std = result.group("mocap0", "rotation").std
    assert np.linalg.norm(error) > np.deg2rad(0.5)  # what the poses contradict by
    assert (np.abs(error) < 2.0 * std).all() and std.max() < np.deg2rad(1.5)


@pytest.mark.parametrize("kind", ["absolute", "relative"])
def test_nothing_is_said_of_poses_that_agree(kind):
    rig, measured, truth = scene(kind, 3, np.zeros(3), 2e-3)
    result = calibrate_measurements(rig, measured)
    assert not any("contradict" in w.name for w in result.warnings)
    for block, e in zip(BLOCKS, errors(result, truth, "mocap0"), strict=True):
        assert (np.abs(e) < 4.0 * result.group("mocap0", block).std).all(), block
