"""The whole way, from a bag of rendered images to a calibration, from nothing and against the truth."""

from __future__ import annotations

import dataclasses
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

import icalib
from icalib.geometry.targets import Charuco, Checkerboard, Target
from icalib.result import Calibration
from icalib.rig import Rig, Settings
from icalib.tools.simulation import Film, Scenario, Truth, film, handheld, rig_for, tag_map, write_film
from icalib.tools.simulation.projection import project
from icalib.tools.simulation.writing import FORMS, Form

pytest.importorskip("cv2")
pytest.importorskip("rosbags")

BLOCKS = ("rotation", "translation", "time_offset", "intrinsics")


@pytest.fixture(scope="module")
def scenario() -> Scenario:
    """Six seconds of EuRoC's cam0 at half its resolution."""
    base = handheld(6.0)
    fx, fy, cx, cy = 0.5 * np.array(base.cameras[0].intrinsics)
    # The centre of the top left pixel stays (0, 0).
    intrinsics = (fx, fy, cx - 0.25, cy - 0.25)
    camera = dataclasses.replace(base.cameras[0], resolution=(376, 240), intrinsics=intrinsics)
    return dataclasses.replace(base, cameras=(camera,))


@pytest.fixture(scope="module")
def filmed(scenario: Scenario) -> Film:
    return film(scenario, seed=0)


@pytest.fixture(scope="module")
def recordings(filmed: Film, tmp_path_factory: pytest.TempPathFactory) -> dict[Form, Path]:
    folder = tmp_path_factory.mktemp("filmed")
    paths: dict[Form, Path] = {form: folder / form for form in FORMS}
    write_film(filmed, paths)
    return paths


def rig_from_nothing(scenario: Scenario) -> Rig:
    """As a user would write it: nothing known of the camera but its model and resolution."""
    settings = Settings(cache_corners=False)
    rig = rig_for(scenario, intrinsics="free", distortion="free", settings=settings)
    return rig.with_(cameras=(dataclasses.replace(rig.cameras[0], corner_noise_px=None),))


@pytest.fixture(scope="module")
def rig(scenario: Scenario) -> Rig:
    return rig_from_nothing(scenario)


@pytest.fixture(scope="module")
def result(rig: Rig, recordings: dict[Form, Path]) -> Calibration:
    return icalib.calibrate(rig, recordings["ros1"])


def standardised(result: Calibration, truth: Truth, block: str) -> np.ndarray:
    """Errors of one block of cam0 in formal standard deviations."""
    group = result.group("cam0", block)
    if block == "rotation":
        error = Rotation.from_matrix(truth.T_imu_sensor["cam0"][:3, :3].T @ group.value).as_rotvec()
        return error / group.std_formal
    true = {
        "translation": truth.T_imu_sensor["cam0"][:3, 3],
        "time_offset": [truth.time_offset["cam0"]],
        "intrinsics": truth.values["cam0"]["intrinsics"],
    }
    return (group.value - true[block]) / group.std_formal


def test_a_bag_of_images_gives_the_truth(result: Calibration, filmed: Film):
    assert result.converged
    for block in BLOCKS:
        assert np.abs(standardised(result, filmed.truth, block)).max() < 3.0, block
        assert set(result.group("cam0", block).verdict) == {"determined"}, block


def test_what_the_lens_bends_within_a_window_is_all_that_distortion_is_off(
    result: Calibration, filmed: Film, scenario: Scenario
):
    """Edges are taken for straight as far as a corner's window reaches: some thousandths of a pixel, several formal
    standard deviations of the distortion's coefficients."""
    camera = scenario.cameras[0]
    found = dataclasses.replace(
        camera,
        intrinsics=tuple(result.group("cam0", "intrinsics").value),
        distortion=tuple(result.group("cam0", "distortion").value),
    )
    x, y = np.meshgrid(np.linspace(-0.75, 0.75, 31), np.linspace(-0.5, 0.5, 21))
    points = np.stack([x, y, np.ones_like(x)], axis=-1)
    moved = project(found, points) - project(camera, points)
    turn = result.group("cam0", "intrinsics").value[:2] / 1e3  # a turn of 1 mrad moves a point by so much
    assert np.abs(moved - moved.mean(axis=(0, 1))).max() < 0.02 < 0.1 * turn.min()
    assert abs(result.group("cam0", "bloom").value[0]) < 0.005


@pytest.mark.parametrize("form", [pytest.param(f, marks=pytest.mark.full) for f in FORMS if f != "ros1"])
def test_every_format_gives_the_same(form: Form, rig: Rig, recordings: dict[Form, Path], result: Calibration):
    other = icalib.calibrate(rig, recordings[form])
    for ours, theirs in zip(result.groups, other.groups, strict=True):
        # Of the board's attitude, which way is up: the heading of the world is the first guess's, and no result.
        a, b = (g.value[2] if g.name == "tilt" else g.value for g in (theirs, ours))
        np.testing.assert_allclose(a, b, rtol=0.0, atol=1e-9, err_msg=f"{ours.sensor} {ours.name}")
    for ours, theirs in zip(result.corner_residuals, other.corner_residuals, strict=True):
        # Corners lie on edges as bent as the estimate says, which is equal to rounding.
        np.testing.assert_allclose(theirs.uv, ours.uv, rtol=0.0, atol=1e-11)
        np.testing.assert_array_equal(theirs.point, ours.point)


@pytest.mark.parametrize(
    "target",
    [
        pytest.param(Charuco(8, 6, 0.08, 0.06, "4x4_50"), id="charuco", marks=pytest.mark.full),
        pytest.param(Checkerboard(6, 9, 0.06), id="checkerboard", marks=pytest.mark.full),
    ],
)
def test_other_targets_and_an_exposure(target: Target, scenario: Scenario, tmp_path: Path):
    """Their points are numbered as the target's, or nothing would fit; some images show a board in part."""
    motion = dataclasses.replace(scenario.motion, distance_m=0.9, rotation_scale=0.7, translation_scale=0.8)
    camera = dataclasses.replace(scenario.cameras[0], rate_hz=6.0)
    scenario = dataclasses.replace(scenario, target=target, motion=motion, cameras=(camera,))
    filmed = film(scenario, seed=1, exposure_s=0.002)
    write_film(filmed, {"mcap": tmp_path / "run"})
    result = icalib.calibrate(rig_from_nothing(scenario), tmp_path / "run")
    for block in BLOCKS:
        assert np.abs(standardised(result, filmed.truth, block)).max() < 3.0, block
    fit = next(f for f in result.fits if f.kind == "corners")
    assert fit.rms is not None and fit.rms < 0.05


@pytest.mark.full
def test_a_room_with_tags_and_a_grid(tmp_path: Path):
    """From images to the calibration and where everything stands; only the lens is given."""
    room = tag_map(8.0, with_grid=True)
    camera = dataclasses.replace(room.cameras[0], rate_hz=10.0)
    room = dataclasses.replace(room, cameras=(camera,))
    filmed = film(room, seed=0)
    write_film(filmed, {"mcap": tmp_path / "room"})
    rig = rig_for(room, settings=Settings(cache_corners=False))
    result = icalib.calibrate(rig, tmp_path / "room")
    assert result.converged
    assert set(result.bodies) == set(room.target.bodies)
    for block in ("rotation", "translation", "time_offset"):
        assert np.abs(standardised(result, filmed.truth, block)).max() < 4.0
    true = dict(zip(room.target.bodies, filmed.truth.T_world_bodies, strict=True))
    for body in result.bodies[1:]:
        T = np.linalg.inv(true[result.bodies[0]]) @ true[body]
        found = result.T_scene_body(body)
        assert np.linalg.norm(found[:3, 3] - T[:3, 3]) < 4.0 * np.linalg.norm(result.group(body, "translation").std)
        assert np.linalg.norm(found[:3, 3] - T[:3, 3]) < 2e-3
