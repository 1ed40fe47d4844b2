"""Lenses from small tags all over a room, of which each by itself says next to nothing of the lens."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from tests.cases import each
from tests.typed import instance, not_none

from icalib.data.measurements import CornerStream, Measurements
from icalib.errors import EstimationError
from icalib.geometry.cameras import camera_model
from icalib.geometry.targets import Markers
from icalib.pipeline import calibrate_measurements
from icalib.rig import Parameter
from icalib.sensors.camera.initialize.scene_intrinsics import find_scene, is_plausible_lens, scene_intrinsics
from icalib.sensors.camera.model import choose_bodies
from icalib.sensors.wheels.simulate import SimWheels
from icalib.tools.simulation import load_scenario, rig_for, simulate, tag_map

pytestmark = pytest.mark.slow

PAPER = Path(__file__).parents[3] / "examples" / "paper"
EDGE_M, PER_WALL = 0.25, 12
RADTAN = camera_model("pinhole-radtan")
EUROC = np.array([458.654, 457.296, 367.215, 248.375, -0.28340811, 0.07395907, 0.00019359, 1.76187e-05])


@pytest.fixture(scope="module")
def robot(tags_on_walls):
    """A ground robot of the paper among tags, with the first and the third of its cameras and its wheels."""
    base = load_scenario(PAPER / "table2-ramp.yaml")
    return replace(
        base,
        duration_s=10.0,
        features=None,
        cameras=tuple(replace(base.cameras[k], corner_noise_px=0.2, rate_hz=10.0) for k in (0, 2)),
        sensors=tuple(replace(w, noise=0.005, allowed_slip=1e-4) for w in base.of(SimWheels)),
        target=Markers("tag36h11", EDGE_M, tuple(range(4 * PER_WALL))),
        board=True,
        T_world_bodies=tags_on_walls(not_none(base.room).size, PER_WALL),
    )


def test_lenses_are_found_from_tags_alone(robot):
    simulation = simulate(robot, 1)
    rig = rig_for(robot, intrinsics="free", distortion="free")
    for camera, stream in zip(rig.cameras, simulation.measurements.cameras, strict=True):
        params = scene_intrinsics(rig.target, camera, stream)
        np.testing.assert_allclose(params[:2], simulation.truth.values[camera.name]["intrinsics"][:2], rtol=0.01)
        np.testing.assert_allclose(params[2:4], simulation.truth.values[camera.name]["intrinsics"][2:], atol=5.0)


def test_camera_wheels_and_tags_are_calibrated_from_nothing(robot):
    simulation = simulate(robot, 1)
    rig = rig_for(robot, intrinsics="free", distortion="free")
    result = calibrate_measurements(rig, simulation.measurements)
    assert result.converged
    for sensor, true in simulation.truth.T_imu_sensor.items():
        np.testing.assert_allclose(result.T_imu_sensor(sensor), true, atol=0.03)
    np.testing.assert_allclose(
        result.group("wheel0", "radii").value, simulation.truth.values["wheel0"]["radii"], rtol=5e-3
    )


def test_a_rough_focal_length_is_a_start_only(robot):
    simulation = simulate(robot, 1)
    rig = rig_for(robot, intrinsics="free", distortion="free")
    guess = Parameter("free", np.array([600.0, 600.0, 375.5, 239.5]))
    stream = simulation.measurements.cameras[0]
    params = scene_intrinsics(rig.target, replace(rig.cameras[0], intrinsics=guess), stream)
    np.testing.assert_allclose(params[:2], simulation.truth.values["cam0"]["intrinsics"][:2], rtol=0.01)


@each(
    "changed",
    [{0: 9e4}, {1: 5e3}, {2: 8298.0}, {3: -43115.0}, {4: -85.0}, {0: np.nan}, {0: -458.0}],
)
def test_what_is_no_lens(changed):
    corners = np.stack(np.meshgrid(np.linspace(20, 730, 20), np.linspace(20, 460, 15)), axis=-1).reshape(-1, 2)
    assert is_plausible_lens(RADTAN, EUROC, (752, 480), corners)
    params = EUROC.copy()
    for place, value in changed.items():
        params[place] = value
    assert not is_plausible_lens(RADTAN, params, (752, 480), corners)


def scrambled(stream: CornerStream, target: Markers, body: int) -> CornerStream:
    """The stream, the corners of one body anywhere."""
    uv, rng = stream.uv.copy(), np.random.default_rng(3)
    own = target.body[stream.point] == body
    uv[own] = rng.uniform([0.0, 0.0], [752.0, 480.0], (int(own.sum()), 2))
    return replace(stream, uv=uv)


def test_a_tag_that_nothing_ties_to_the_others_is_left_out():
    scenario = tag_map(6.0)
    simulation = simulate(scenario, 0)
    cameras = tuple(scrambled(c, instance(scenario.target, Markers), 7) for c in simulation.measurements.cameras)
    result = calibrate_measurements(rig_for(scenario), simulation.measurements.with_streams(*cameras))
    name = scenario.target.bodies[7]
    assert result.converged
    assert name not in result.bodies
    assert any(name in note for note in result.notes if note.name == "bodies_unconnected")
    for camera, true in simulation.truth.T_imu_sensor.items():
        np.testing.assert_allclose(result.T_imu_sensor(camera), true, atol=0.02)


def test_corners_that_no_lens_explains_are_named():
    scenario = tag_map(1.5)
    simulation = simulate(scenario, 0)
    rng = np.random.default_rng(0)
    cameras = tuple(replace(c, uv=c.uv + rng.normal(0.0, 25.0, c.uv.shape)) for c in simulation.measurements.cameras)
    rig = rig_for(scenario, intrinsics="free", distortion="free")
    with pytest.raises(EstimationError, match="cam0: no lens of model pinhole-radtan explains the bodies"):
        calibrate_measurements(rig, simulation.measurements.with_streams(*cameras))


def test_a_scene_of_one_body_has_no_poses():
    scenario = tag_map(4.0)
    recording = simulate(scenario, 0).measurements
    own = scenario.target.body

    def first_tag_only(s: CornerStream) -> CornerStream:
        keep = own[s.point] == 0
        count = np.bincount(s.image[keep], minlength=len(s.stamps_ns))
        start = np.concatenate([[0], np.cumsum(count[count > 0])])
        return CornerStream(s.name, s.stamps_ns[count > 0], start, s.point[keep], s.uv[keep])

    recording = Measurements.of_streams(*(first_tag_only(c) for c in recording.cameras))
    bodies = choose_bodies(scenario.target, [recording], bent=False)
    assert find_scene(rig_for(scenario), bodies, [recording]).values == {}


def test_growth_needs_no_image_that_shows_all(robot):
    """The scene is tied together along images of which none shows more than a few tags."""
    simulation = simulate(robot, 2)
    stream = simulation.measurements.cameras[0]
    bodies = choose_bodies(robot.target, [Measurements.of_streams(stream)], bent=False)
    assert np.bincount(np.unique(stream.image * 100 + robot.target.body[stream.point]) // 100).max() < len(bodies.used)
    rig = rig_for(robot)
    scene = find_scene(rig.with_(cameras=rig.cameras[:1]), bodies, [Measurements.of_streams(stream)])
    true = simulation.truth.T_world_bodies
    reference = np.linalg.inv(true[bodies.used[0]])
    for k in bodies.used[1:]:
        near = np.linalg.norm((reference @ true[k])[:3, 3])
        found = scene.values[robot.target.bodies[k], "translation"]
        assert np.linalg.norm(found - (reference @ true[k])[:3, 3]) < 0.05 + 0.05 * near


def test_images_that_show_no_body_are_an_error():
    """Corners are anywhere: that is not said of single tags."""
    scenario = tag_map(1.5)
    simulation = simulate(scenario, 0)
    rng = np.random.default_rng(0)
    cameras = tuple(replace(c, uv=rng.uniform(0.0, 480.0, c.uv.shape)) for c in simulation.measurements.cameras)
    with pytest.raises(EstimationError, match=r"of the 12 bodies of the target"):
        calibrate_measurements(rig_for(scenario), simulation.measurements.with_streams(*cameras))
