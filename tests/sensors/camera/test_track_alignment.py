"""Cameras that follow points of the scene, on a robot that turns about one axis: what that leaves open stays."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from icalib.geometry import so3
from icalib.initialize.rig_guess import guess_of_rig
from icalib.sensors.camera.initialize import from_tracks
from icalib.tools.simulation import load_scenario, rig_for, simulate, with_drawn_guess

EXAMPLES = Path(__file__).parents[3] / "examples" / "paper"


@pytest.fixture(scope="module", params=[1, 2])
def planar(request):
    """A planar drive with cameras alone, their lenses guessed roughly; and what `align_jointly` made of its start."""
    scenario = replace(load_scenario(EXAMPLES / "table2-planar.yaml"), duration_s=20.0, sensors=())
    simulation = simulate(scenario, request.param)
    rig = with_drawn_guess(rig_for(scenario, intrinsics="free", distortion="free"), scenario, request.param)
    kept = {}

    def watched(gyro, pairs, begin, fixed):
        kept["begin"], kept["end"] = begin, aligned(gyro, pairs, begin, fixed)
        return kept["end"]

    aligned = from_tracks.align_jointly
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(from_tracks, "align_jointly", watched)
        _, state, _ = guess_of_rig(rig, [simulation.measurements])
    return simulation.truth, state, kept["begin"], kept["end"]


def test_a_turn_about_the_only_axis_stays_as_guessed(planar):
    truth, _, begin, end = planar
    up = truth.R_world_imu[0][2]  # in the axes of the IMU
    for a, b in zip(begin, end, strict=True):
        turned = so3.log(np.ascontiguousarray(b.rotation @ a.rotation.T))
        assert np.linalg.norm(turned) < 0.5
        # Second order: tilts one way and another make a turn of their own.
        assert abs(turned @ up) < 0.5 * np.sum(turned**2) + 1e-3


def test_biases_stay_as_small_as_they_are(planar):
    """Gravity and the accelerometer's bias along it are one thing on a level floor, and rough lenses bend all rays
    alike: many of them must not outvote how long gravity is."""
    truth, state, _, _ = planar
    found = state.bias.mean(axis=0)
    np.testing.assert_allclose(found[:3], truth.gyro_bias.mean(axis=0), atol=5e-3)
    np.testing.assert_allclose(found[3:], truth.accel_bias.mean(axis=0), atol=0.5)
