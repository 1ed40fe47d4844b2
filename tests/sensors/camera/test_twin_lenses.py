"""A second set of parameters of the same lens is named, and only where it is the same lens."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from tests.remarks import names

from icalib.geometry.cameras import camera_model
from icalib.geometry.targets import NoTarget
from icalib.pipeline import calibrate_measurements
from icalib.sensors.camera.assess.lenses import twin_lens
from icalib.tools.simulation import load_scenario, rig_for, simulate

LENS = np.array([180.0, 181.0, 325.0, 238.0, -0.2, 0.55])


def image() -> np.ndarray:
    u, v = np.meshgrid(np.linspace(20.0, 620.0, 25), np.linspace(20.0, 460.0, 20))
    return np.stack([u.ravel(), v.ravel()], axis=1)


def test_double_sphere_has_two_sets_of_parameters_for_one_lens():
    model, uv = camera_model("double-sphere"), image()
    twin = twin_lens(model, LENS, uv, limit_px=0.1)
    assert twin is not None and twin[0] > 1.5 * LENS[0] and twin[4] > 0.2
    rays, valid = model.unproject(LENS, uv)
    there, seen = model.project(twin, rays)
    assert valid.all() and seen.all()
    assert 1e-4 < np.sqrt(((there - uv) ** 2).sum(axis=1).mean()) < 0.1
    back = twin_lens(model, twin, uv, limit_px=0.1)
    assert back is not None
    np.testing.assert_allclose(back, LENS, rtol=0.03, atol=0.03)


def test_observations_that_tell_them_apart_have_none():
    assert twin_lens(camera_model("double-sphere"), LENS, image(), limit_px=1e-4) is None


@pytest.mark.parametrize("name", ["pinhole-radtan", "pinhole-equidistant"])
def test_models_of_one_set_have_no_other(name: str):
    model = camera_model(name)
    lens = np.array([458.0, 457.0, 367.0, 248.0, *model.start_distortions[0]])
    assert twin_lens(model, lens, image(), limit_px=1.0) is None


@pytest.mark.slow
@pytest.mark.parametrize(("noise_px", "named"), [(2.0, True), (0.01, False)])
def test_a_note_names_it_where_the_noise_hides_the_difference(noise_px: float, named: bool):
    base = load_scenario("examples/paper/table2-3d.yaml")
    camera = replace(
        base.cameras[0],
        model="double-sphere",
        resolution=(640, 480),
        intrinsics=tuple(LENS[:4].tolist()),
        distortion=tuple(LENS[4:].tolist()),
        corner_noise_px=noise_px,
    )
    scenario = replace(base, duration_s=10.0, cameras=(camera,), sensors=())
    rig = replace(rig_for(scenario, intrinsics="free", distortion="free"), target=NoTarget())
    result = calibrate_measurements(rig, simulate(scenario, 1).measurements)
    assert ("second_lens_fits" in names(result.notes)) == named
