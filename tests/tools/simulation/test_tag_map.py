"""Several bodies in the world: each at its own pose, tags seen whole and from the front, in corners and in images."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from tests.cases import each

from icalib.errors import RigError
from icalib.geometry.targets import AprilGrid, Markers, Scene
from icalib.tools.simulation import Imaging, film, handheld, simulate, tag_map
from icalib.tools.simulation.projection import project


def tags_seen(sim, camera: int) -> np.ndarray:
    """(M,) number of free tags in each image."""
    stream, body = sim.measurements.cameras[camera], sim.scenario.target.body
    pairs = np.unique(np.stack([stream.image, body[stream.point]]), axis=1)
    return np.bincount(pairs[0][pairs[1] < 12], minlength=len(stream.stamps_ns))


@each("seed", range(3))
@each("with_grid", [False, True])
def test_every_image_shows_three_tags_and_every_tag_is_seen_often(seed: int, with_grid: bool):
    sim = simulate(tag_map(20.0, with_grid=with_grid), seed)
    for k, stream in enumerate(sim.measurements.cameras):
        assert len(stream.stamps_ns) == 399 and tags_seen(sim, k).min() >= 3
        seen = np.bincount(sim.scenario.target.body[stream.point], minlength=12 + with_grid)
        assert seen.min() >= 4 * 100


@pytest.mark.parametrize("with_grid", [False, True])
def test_every_corner_is_the_projection_of_its_own_body(with_grid: bool):
    sim = simulate(tag_map(1.0, with_grid=with_grid, noiseless=True), 1)
    camera, stream, truth, target = sim.scenario.cameras[1], sim.measurements.cameras[1], sim.truth, sim.scenario.target
    R, p, _ = truth.pose_at(truth.corners["cam1"].seconds)
    in_camera = []
    for image, point in zip(stream.image, stream.point, strict=True):
        T_world_imu = np.eye(4)
        T_world_imu[:3, :3], T_world_imu[:3, 3] = R[image], p[image]
        P = truth.T_world_bodies[target.body[point]] @ np.append(target.points[point], 1.0)
        in_camera.append(np.linalg.solve(T_world_imu @ camera.T_imu_sensor, P)[:3])
    np.testing.assert_allclose(stream.uv, project(camera, np.array(in_camera)), atol=1e-8)
    assert len(truth.T_world_bodies) == len(target.bodies) == 12 + with_grid


def test_tags_lie_on_two_walls_and_the_floor_of_one_room():
    scenario = tag_map(with_grid=True)
    T, target = scenario.body_poses[scenario.target.body], scenario.target
    world = np.einsum("nij,nj->ni", T[:, :3, :3], target.points) + T[:, :3, 3]
    assert world.min() > -1e-12
    for axis, bodies in enumerate(([0, 1, 2, 3, 12], [4, 5, 6, 7], [8, 9, 10, 11])):
        on_it = np.isin(target.body, bodies)
        np.testing.assert_allclose(world[on_it, axis], 0.0, atol=1e-12)
        np.testing.assert_allclose(T[on_it, :3, 2], np.tile(np.eye(3)[axis], (on_it.sum(), 1)), atol=1e-12)
    np.testing.assert_allclose(np.linalg.det(T[:, :3, :3]), 1.0)


def test_a_tag_is_seen_from_the_front_only_and_whole_only():
    scenario = tag_map(2.0, noiseless=True)
    target = scenario.target
    turned = scenario.body_poses.copy()
    turned[2, :3, :3] = turned[2, :3, :3] @ np.diag([1.0, -1.0, -1.0])
    stream = simulate(replace(scenario, T_world_bodies=turned), 0).measurements.cameras[0]
    assert (target.body[stream.point] != 2).all() and (target.body[stream.point] == 3).any()
    sim = simulate(replace(scenario, motion=replace(scenario.motion, rotation_scale=1.5)), 0)
    stream = sim.measurements.cameras[0]
    _, corners = np.unique(stream.image * 100 + target.body[stream.point], return_counts=True)
    assert set(corners.tolist()) == {4} and tags_seen(sim, 0).min() < 12


def test_a_grid_may_be_cut_and_is_the_only_body_that_bends():
    scenario = tag_map(3.0, noiseless=True, with_grid=True)
    flat, bent = (simulate(s, 0).measurements.cameras[0] for s in (scenario, replace(scenario, bow=(2e-3, 0.0, 0.0))))
    np.testing.assert_array_equal(flat.point, bent.point)
    moved, on_grid = np.linalg.norm(bent.uv - flat.uv, axis=1), scenario.target.body[flat.point] == 12
    assert moved[~on_grid].max() == 0.0 and 0.1 < moved[on_grid].max() < 2.0
    corners = np.bincount(flat.image[on_grid])
    assert ((corners > 0) & (corners < 36)).any()


def test_a_film_shows_every_body_where_the_corners_are():
    pytest.importorskip("cv2")
    scenario = tag_map(0.3, noiseless=True, with_grid=True)
    stream = simulate(scenario, 3).measurements.cameras[0]
    shots = [s for s in film(scenario, 3, Imaging(blur_px=0.5)).shots() if s.camera == "cam0"]
    assert [s.stamp_ns for s in shots] == stream.stamps_ns.tolist()
    for i, shot in enumerate(shots):
        rows = slice(stream.start[i], stream.start[i + 1])
        points = stream.point[rows]
        assert shot.target.seen[points].all()
        np.testing.assert_allclose(shot.target.uv[points], stream.uv[rows], atol=1e-8)
    middle = np.rint(shots[0].target.uv[:48].reshape(12, 4, 2)).astype(int)
    inside = [
        shots[0].pixels[quad[:, 1].min() : quad[:, 1].max(), quad[:, 0].min() : quad[:, 0].max()] for quad in middle
    ]
    assert all(np.ptp(box) > 120 for box, quad in zip(inside, middle, strict=True) if box.size)


def test_bodies_without_a_pose_are_refused():
    base = handheld(1.0)
    tags = Markers("tag36h11", 0.1, (1, 2, 3))
    with pytest.raises(RigError, match="T_world_bodies"):
        replace(base, target=tags)
    with pytest.raises(RigError, match=r"\(4, 4, 4\)"):
        replace(
            base,
            target=Scene(("a", "b"), (tags, AprilGrid(2, 2, 0.1, 0.3))),
            T_world_bodies=np.tile(np.eye(4), (3, 1, 1)),
        )
