"""How bodies stand to each other, from single images of them that are ambiguous."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from icalib.geometry.cameras import camera_model
from icalib.sensors.camera.corner_factor import Views
from icalib.sensors.camera.initialize.target_scene import place_bodies, scene_poses, view_poses
from icalib.sensors.camera.model import choose_bodies, restrict
from icalib.tools.simulation import simulate, tag_map


@pytest.fixture(scope="module")
def far():
    """Small tags in noise of half a pixel: many look better from the wrong side."""
    scenario = tag_map(12.0)
    small = dataclasses.replace(scenario.target, size=0.08)
    cameras = tuple(dataclasses.replace(c, corner_noise_px=0.5) for c in scenario.cameras)
    simulation = simulate(dataclasses.replace(scenario, target=small, cameras=cameras), 0)
    bodies = choose_bodies(small, [simulation.measurements], bent=False)
    return simulation, bodies, restrict(bodies, simulation.measurements).cameras


def lens(simulation, name):
    model = next(c.model for c in simulation.scenario.cameras if c.name == name)
    return camera_model(model), np.concatenate(
        [simulation.truth.values[name]["intrinsics"], simulation.truth.values[name]["distortion"]]
    )


def in_camera(simulation, stream, body):
    """R_cam_body, (M, 3, 3), at each image."""
    camera = stream.name
    T = simulation.truth.T_world_bodies[body]
    R_wi, _, _ = simulation.truth.pose_at(simulation.truth.corners[camera].seconds)
    R_wc = R_wi @ simulation.truth.T_imu_sensor[camera][:3, :3]
    return R_wc.transpose(0, 2, 1) @ T[:3, :3]


def test_one_of_two_mirrored_poses_is_near_the_truth_where_one_alone_often_is_not(far):
    simulation, bodies, (stream, _) = far
    views = Views.of(stream, bodies.target.body)
    poses = view_poses(stream, views, bodies, *lens(simulation, "cam0"))
    true = np.stack([in_camera(simulation, stream, k) for k in range(12)], axis=1)[views.image, views.body]
    found = poses.rotation.transpose(0, 1, 3, 2)
    error = np.stack(
        [
            np.linalg.norm(Rotation.from_matrix(true.transpose(0, 2, 1) @ found[:, s]).as_rotvec(), axis=1)
            for s in (0, 1)
        ]
    )
    better = poses.rms_px.argmin(axis=1)
    wrong = np.mean(error[better, np.arange(len(better))] > 0.35)
    assert wrong > 0.05
    assert np.mean(error.min(axis=0) > 0.35) < 0.2 * wrong


def test_bodies_are_placed_by_what_most_images_agree_on(far):
    simulation, bodies, streams = far
    lenses = [lens(simulation, s.name) for s in streams]
    params = {s.name: p for s, (_, p) in zip(streams, lenses, strict=True)}
    scene = place_bodies(bodies, streams, [m for m, _ in lenses], params)
    reference = np.linalg.inv(simulation.truth.T_world_bodies[bodies.used[0]])
    for k in bodies.used[1:]:
        T = reference @ simulation.truth.T_world_bodies[k]
        name = bodies.target.bodies[k]
        turn = Rotation.from_matrix(T[:3, :3].T @ scene.values[name, "rotation"]).magnitude()
        assert np.rad2deg(turn) < 6.0
        assert np.linalg.norm(scene.values[name, "translation"] - T[:3, 3]) < 0.1
    for stream, (model, p) in zip(streams, lenses, strict=True):
        poses = scene_poses(stream, model, p, scene)
        assert poses.ok.mean() > 0.9
