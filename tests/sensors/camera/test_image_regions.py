"""Gradients of what is seen in one place, and what lenses that no model follows make of standard deviations."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from icalib.data.measurements import Measurements, TrackStream
from icalib.estimate.estimate import estimate
from icalib.estimate.problem import Problem, assemble, begun
from icalib.estimate.residual_statistics import _cluster_gradients, _count, cluster_covariances
from icalib.estimate.solver import Outcome, SolverOptions, minimise
from icalib.geometry.targets import AprilGrid, Checkerboard, Scene
from icalib.initialize.rig_guess import guess_of_rig
from icalib.model.bodies import Bodies
from icalib.motion.factor import FactorKey, of_type, output_at
from icalib.optim.arrowhead import restricted_inverse
from icalib.pipeline import calibrate_measurements
from icalib.rig import Rig
from icalib.sensors.camera.corner_factor import CornerFactor
from icalib.sensors.camera.model import MODEL
from icalib.sensors.camera.track_factor import FeatureFactor
from icalib.sensors.camera.track_selection import _tag_corners
from icalib.sensors.camera.track_selection import image_cells as cells_of
from icalib.tools.simulation import Scenario, load_scenario, rig_for, simulate, with_drawn_guess

pytestmark = pytest.mark.slow

LITTLE_PX = 1e-3
EXAMPLE = Path(__file__).parents[3] / "examples" / "paper" / "table2-3d.yaml"


def followers(seconds: float) -> Scenario:
    return replace(load_scenario(EXAMPLE), duration_s=seconds, sensors=())


@pytest.fixture(scope="module")
def solved() -> tuple[Problem, Outcome]:
    """Without noise, so that residuals are next to nothing."""
    exact = {"imu_noise_enabled": False, "robot_noise_enabled": False}
    scenario = replace(followers(3.0), **exact)
    rig = with_drawn_guess(rig_for(scenario, intrinsics="free", distortion="free"), scenario, 1)
    inputs, state, _ = guess_of_rig(rig, [simulate(scenario, 1).measurements])
    state = begun(inputs, state)
    problem = assemble(inputs, state, MODEL.first_noise(rig.cameras, rig, inputs.measurements))
    return problem, minimise(problem, state, SolverOptions(1e-6))


def gradient(problem: Problem, outcome: Outcome) -> np.ndarray:
    """(B,) of the calibration parameters, chain and points marginalised."""
    return problem.marginal(lambda a, b: problem.sums_of(outcome.state, a, b))[:-1, -1]


def moved(problem: Problem, by: list[np.ndarray]) -> Problem:
    """Observations of each camera elsewhere, by (N, 2) px."""
    (features,) = of_type(problem.factors, FeatureFactor)
    streams = tuple(replace(s, uv=s.uv + b) for s, b in zip(features.streams, by, strict=True))
    return problem.replacing([replace(features, streams=streams)])


def image_cells(problem: Problem) -> tuple[FeatureFactor, dict[FactorKey, Any]]:
    features = of_type(problem.factors, FeatureFactor)
    return features[0], cells_of(of_type(problem.factors, CornerFactor), features)


def test_the_gradient_of_a_cell_is_what_its_residuals_change(solved: tuple[Problem, Outcome]):
    """With residuals so small that nothing bends, those of one cell twice as large: the gradient of the whole, points
    being where they then want to be, changes by the cell's own."""
    exact, outcome = solved
    (features, cells), rng = image_cells(exact), np.random.default_rng(0)
    tracks = cells[features.key]
    problem = moved(exact, [LITTLE_PX * rng.normal(size=(len(own), 2)) for own in tracks])
    (found,) = _cluster_gradients(problem, outcome, [cells])
    assert found.shape == (_count(cells), problem.layout.size) and _count(cells) == 36
    residual = output_at(of_type(problem.factors, FeatureFactor)[0], outcome.state).residual
    before, size = gradient(problem, outcome), np.abs(found).max(axis=0)
    for cell in (1, 30):
        twice = moved(problem, [-r * (own == cell)[:, None] for r, own in zip(residual, tracks, strict=True)])
        change = gradient(twice, outcome) - before
        np.testing.assert_allclose(change / size, found[cell] / size, atol=1e-3)


def test_cells_together_are_all_that_cameras_say(solved: tuple[Problem, Outcome]):
    problem, outcome = solved
    features, cells = image_cells(problem)
    whole = cells | {features.key: [np.zeros(len(c), dtype=np.int32) for c in cells[features.key]]}
    parts, (one,) = _cluster_gradients(problem, outcome, [cells, whole])
    np.testing.assert_allclose(parts.sum(axis=0), one, rtol=1e-6, atol=1e-6 * np.abs(parts).max())


def bent(measurements: Measurements, scenario: Scenario) -> Measurements:
    """Through lenses with ripples of 1 px that no model here follows, the same in all images."""
    return measurements.with_streams(*(_bent(t, scenario) for t in measurements.tracks))


def _bent(stream: TrackStream, scenario: Scenario) -> TrackStream:
    width, height = next(c.resolution for c in scenario.cameras if c.name == stream.name)
    x, y = (stream.uv / [width, height]).T * 2.0 * np.pi
    ripple = np.stack([np.sin(2.0 * x + 1.0) * np.cos(y), np.cos(1.5 * x) * np.sin(2.0 * y + 0.5)], axis=1)
    return replace(stream, uv=stream.uv + ripple)


def errors(rig: Rig, scenario: Scenario, seed: int, seen) -> tuple[np.ndarray, np.ndarray]:
    """Of lever arms, in formal and in printed standard deviations."""
    simulation = simulate(scenario, seed)
    found = calibrate_measurements(rig, seen(simulation.measurements))
    assert found.converged
    formal, printed = [], []
    for camera in scenario.cameras:
        for name, true in (("translation", camera.T_imu_sensor[:3, 3]), ("intrinsics", np.array(camera.intrinsics))):
            g = found.group(camera.name, name)
            formal.append((g.value - true) / g.std_formal)
            printed.append((g.value - true) / g.std)
    return np.concatenate(formal), np.concatenate(printed)


@pytest.fixture(scope="module")
def long_drive() -> tuple[Rig, Scenario]:
    scenario = followers(12.0)
    rig = with_drawn_guess(rig_for(scenario, intrinsics="free", distortion="free"), scenario, 1)
    return replace(rig, settings=replace(rig.settings, segments=8)), scenario


def test_a_lens_that_no_model_follows_is_in_the_standard_deviations(long_drive: tuple[Rig, Scenario]):
    formal, printed = (np.sqrt(np.mean(z**2)) for z in errors(*long_drive, 1, lambda m: bent(m, long_drive[1])))
    assert formal > 5.0 and printed < 2.0


@pytest.mark.full
def test_a_lens_that_the_model_follows_leaves_standard_deviations_small(long_drive: tuple[Rig, Scenario]):
    formal, printed = (np.sqrt(np.mean(z**2)) for z in errors(*long_drive, 1, lambda m: m))
    assert formal < 1.5 and printed > 0.5 * formal


def drifting(stream: TrackStream, sigma: float, rng: np.random.Generator) -> TrackStream:
    """With errors of `sigma` [px] that correlate by 0.9 from one view of a track to the next."""
    order = np.argsort(stream.feature, kind="stable")
    error, new = rng.normal(0.0, sigma, (len(order), 2)), np.diff(stream.feature[order], prepend=-1) != 0
    for i in np.flatnonzero(~new):
        error[i] = 0.9 * error[i - 1] + np.sqrt(1.0 - 0.9**2) * error[i]
    uv = stream.uv.copy()
    uv[order] += error
    return replace(stream, uv=uv)


def track_spread(measurements: Measurements, rig: Rig) -> float:
    """Mean over the intrinsics of the standard deviations by feature tracks, over the formal ones."""
    inputs, state, _ = guess_of_rig(rig, [measurements])
    found = estimate(inputs, state)
    V = cluster_covariances(found.problem, found.outcome).tracks
    assert V is not None
    k = np.concatenate([b.columns for b in found.problem.layout.free if b.name == "intrinsics"])
    t = found.problem.tolerance
    formal = t**2 * np.diag(
        restricted_inverse(found.outcome.information * t[:, None] * t, found.problem.fixed_directions)
    )
    return float(np.sqrt(np.mean(np.diag(V)[k] / formal[k])))


def test_errors_that_stay_along_a_track_are_in_the_standard_deviations():
    scenario = replace(followers(6.0), robot_noise_enabled=False)
    scenario = replace(scenario, cameras=scenario.cameras[:1])
    rig = with_drawn_guess(rig_for(scenario, intrinsics="free", distortion="free"), scenario, 1)
    clean, rng = simulate(scenario, 1).measurements, np.random.default_rng(1)
    sigma = rig.cameras[0].track_noise_px
    assert sigma is not None
    white = tuple(replace(t, uv=t.uv + rng.normal(0.0, sigma, t.uv.shape)) for t in clean.tracks)
    alike = tuple(drifting(t, sigma, rng) for t in clean.tracks)
    of_white, of_alike = (track_spread(clean.with_streams(*tracks), rig) for tracks in (white, alike))
    print(of_white, of_alike)
    assert 0.7 < of_white < 1.3
    assert of_alike > 1.5 * of_white


def test_a_tags_corners_are_told_apart_beside_a_board_with_an_odd_number_of_corners(unlike, setup_of, factor_of):
    alone = factor_of(setup_of(unlike), 0)
    board, grid = Checkerboard(5, 7, 0.03), AprilGrid(6, 6, 0.088, 0.3)
    stream = replace(alone.stream, point=alone.stream.point + len(board.points))
    beside = replace(alone, stream=stream, bodies=Bodies(Scene(("board", "grid"), (board, grid)), (1,)))
    np.testing.assert_array_equal(_tag_corners(beside, 1), _tag_corners(alone, 1))
