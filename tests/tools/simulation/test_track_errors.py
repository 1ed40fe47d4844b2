"""Errors of tracks as benchmarks/track_errors.py measures them, on tracks whose errors are known."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from icalib.tools.simulation import simulate


def test_errors_of_tracks_are_those_that_they_were_given(robot, benchmark_program):
    program = benchmark_program("track_errors")
    scenario = replace(robot, sensors=(), cameras=robot.cameras[:1], robot_noise_enabled=False)
    simulation = simulate(scenario, 2)
    (stream,) = simulation.measurements.tracks
    views = program.views_of(simulation, stream)
    points = program.begun_on(scenario.room, views)
    number = np.unique(stream.feature)
    np.testing.assert_allclose(points, simulation.truth.points[number], atol=1e-6)
    np.testing.assert_allclose(views.projected(points[views.track]), views.uv, atol=1e-6)
    later = np.where(views.age[:, None] > 0, [0.1, -0.2], 0.0)
    moved = replace(views, uv=views.uv + later)
    np.testing.assert_allclose(moved.uv - moved.projected(points[views.track]), later, atol=1e-6)
    away = points + 0.02 * np.random.default_rng(0).standard_normal(points.shape)
    found = program.fitted(views, away)
    long = np.bincount(views.track) > 20
    before, after = (np.linalg.norm(p - points, axis=1)[long] for p in (away, found))
    assert np.median(after) < 1e-4 < 0.02 < np.median(before)
