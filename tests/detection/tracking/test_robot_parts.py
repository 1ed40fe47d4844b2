"""Points in place against a scene that moves through the image."""

from __future__ import annotations

import numpy as np

from icalib.sensors.camera.read.image_tracks import stay_in_place

IMAGES = 12


def _tracks(flow: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """start, feature and uv of tracks that move by flow (F, 2) px from image to image."""
    n = len(flow)
    begin = np.random.default_rng(0).uniform(100, 400, (n, 2))
    uv = begin + np.arange(IMAGES)[:, None, None] * flow
    return np.arange(IMAGES + 1) * n, np.tile(np.arange(n), IMAGES), uv.reshape(-1, 2)


def test_points_in_place_while_the_camera_turns_are_the_robots():
    flow = np.tile([4.0, -1.0], (30, 1))
    flow[:8] = 0.0
    assert stay_in_place(*_tracks(flow)).tolist() == [True] * 8 + [False] * 22


def test_points_straight_ahead_of_a_moving_camera_are_not():
    """Motion away from the centre, as of a camera that moves forwards: the points near the centre hardly move."""
    angle = np.linspace(0.0, 2.0 * np.pi, 30, endpoint=False)
    flow = 4.0 * np.column_stack([np.cos(angle), np.sin(angle)])
    flow[:8] = 0.01 * flow[:8]
    assert not stay_in_place(*_tracks(flow)).any()


def test_a_still_camera_tells_nothing():
    assert not stay_in_place(*_tracks(np.zeros((30, 2)))).any()


def test_numbers_without_observations_are_no_points_in_place():
    start, feature, uv = _tracks(np.tile([4.0, 0.0], (5, 1)))
    found = stay_in_place(start, 2 * feature, uv)
    assert len(found) == 9 and not found.any()
