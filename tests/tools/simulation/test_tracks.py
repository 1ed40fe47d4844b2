"""Tracks: projections of points of the room, hidden ones left out, numbered as a front end would."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
from tests.cases import each
from tests.typed import instance, not_none

from icalib.data.measurements import WheelPoses
from icalib.errors import RigError
from icalib.sensors.lidar.simulate import SimLidar
from icalib.sensors.wheels.simulate import SimWheels
from icalib.tools.simulation import Features, simulate

from .conftest import alone
from .test_room import met


def eye(sim, camera, image):
    """T_world_cam of one image, from its raw stamp."""
    truth, stream = sim.truth, sim.measurements.tracks[camera]
    since = (stream.stamps_ns[image : image + 1] - truth.imu_clock_origin_ns) * 1e-9
    R, p, _ = truth.pose_at(since + truth.time_offset[stream.name])
    T = np.eye(4)
    T[:3, :3], T[:3, 3] = R[0], p[0]
    return T @ truth.T_imu_sensor[stream.name]


def projected(camera, T_world_cam, point):
    """The pinhole-radtan projection of one point, with scalars."""
    x, y, z, _ = np.linalg.solve(T_world_cam, np.append(point, 1.0))
    x, y = x / z, y / z
    k1, k2, p1, p2 = camera.distortion
    r2 = x * x + y * y
    stretch = 1.0 + k1 * r2 + k2 * r2 * r2
    u = x * stretch + 2.0 * p1 * x * y + p2 * (r2 + 2.0 * x * x)
    v = y * stretch + p1 * (r2 + 2.0 * y * y) + 2.0 * p2 * x * y
    fx, fy, cx, cy = camera.intrinsics
    return fx * u + cx, fy * v + cy


@pytest.fixture(scope="module")
def quiet(robot):
    return simulate(replace(alone(robot), duration_s=8.0, features=robot.features, robot_noise_enabled=False), 2)


@each("camera", [0, 1, 2])
def test_tracks_are_projections_of_points_that_are_not_hidden(quiet, camera):
    stream, lens, room = quiet.measurements.tracks[camera], quiet.scenario.cameras[camera], quiet.scenario.room
    for image in range(0, len(stream.stamps_ns), 20):
        T = eye(quiet, camera, image)
        for row in range(stream.start[image], stream.start[image + 1], 3):
            point = quiet.truth.points[stream.feature[row]]
            assert math.dist(projected(lens, T, point), stream.uv[row]) < 1e-8
            ray = point - T[:3, 3]
            assert met(room, T[:3, 3], ray) == pytest.approx(1.0, abs=1e-6)
    assert 40 < len(stream.uv) / len(stream.stamps_ns) <= 100
    assert (np.diff(stream.start) <= 100).all()
    rows = [stream.feature[a:b] for a, b in zip(stream.start[:-1], stream.start[1:], strict=True)]
    assert all(len(np.unique(row)) == len(row) for row in rows)


def test_noise_is_one_pixel_of_the_same_tracks(quiet):
    noisy = simulate(replace(quiet.scenario, robot_noise_enabled=True), 2)
    for a, b in zip(noisy.measurements.tracks, quiet.measurements.tracks, strict=True):
        np.testing.assert_array_equal(a.feature, b.feature)
        np.testing.assert_array_equal(a.stamps_ns, b.stamps_ns)
        error = a.uv - b.uv
        assert error.std() == pytest.approx(1.0, abs=4.0 / np.sqrt(2.0 * error.size))
        np.testing.assert_array_equal(b.uv, noisy.truth.tracks[a.name].uv)


def sightings(sim):
    """Instants at which each feature was seen, by any camera."""
    seen: dict[int, list[float]] = {}
    for stream in sim.measurements.tracks:
        seconds = sim.truth.tracks[stream.name].seconds
        for image, feature in zip(stream.image, stream.feature.tolist(), strict=True):
            seen.setdefault(feature, []).append(seconds[image])
    return {feature: np.unique(times) for feature, times in seen.items()}


def test_a_lost_track_has_a_new_number_and_landmarks_keep_theirs(robot):
    features = Features(count=800, persistent=100, longest_track_s=2.0)
    sim = simulate(replace(alone(robot), duration_s=30.0, features=features), 3)
    seen = sightings(sim)
    gaps = {feature: np.diff(times).max(initial=0.0) for feature, times in seen.items()}
    for feature, times in seen.items():
        if feature >= 100:
            assert gaps[feature] <= 0.15 + 1e-9 and times[-1] - times[0] <= 2.0
    assert max(gap for feature, gap in gaps.items() if feature < 100) > 1.0
    # The same point comes back under another number.
    _, count = np.unique(np.round(sim.truth.points[100:], 9), axis=0, return_counts=True)
    assert count.max() > 1
    assert max(seen) == len(sim.truth.points) - 1


def test_overlapping_cameras_share_numbers(quiet):
    features = [set(stream.feature.tolist()) for stream in quiet.measurements.tracks]
    assert len(features[0] & features[1]) > 20 and len(features[0] & features[2]) > 20


def test_none_lasts_and_all_last(robot):
    for lasting, longest in ((0, 1.0), (800, 1.0)):
        chosen = Features(count=800, persistent=lasting, longest_track_s=longest)
        sim = simulate(replace(alone(robot), features=chosen), 3)
        spans = [times[-1] - times[0] for times in sightings(sim).values()]
        assert (max(spans) <= 1.0) == (lasting == 0)
        assert (len(sim.truth.points) == 800) == (lasting == 800)


def test_the_same_seed_gives_the_same_recording(robot):
    def arrays(m):
        return m.tracks[1].uv, m.lidars[0].xyz, instance(m.wheels[0], WheelPoses).pose

    one, two, other = (simulate(robot, seed).measurements for seed in (1, 1, 2))
    for a, b, c in zip(arrays(one), arrays(two), arrays(other), strict=True):
        np.testing.assert_array_equal(a, b)
        assert a.shape != c.shape or (a != c).any()
    without = simulate(replace(robot, sensors=robot.of(SimWheels), features=None), 1).measurements
    np.testing.assert_array_equal(
        instance(without.wheels[0], WheelPoses).pose, instance(one.wheels[0], WheelPoses).pose
    )
    np.testing.assert_array_equal(not_none(without.imu).gyro, not_none(one.imu).gyro)


def test_a_sensor_without_time_to_measure_is_named(robot):
    for change, name in (
        ({"cameras": (replace(robot.cameras[1], rate_hz=0.1),), "sensors": ()}, "cam1"),
        ({"sensors": (replace(robot.of(SimLidar)[0], rate_hz=0.5),)}, "lidar0"),
        ({"sensors": (replace(robot.of(SimWheels)[0], rate_hz=0.2),)}, "wheel0"),
        ({"sensors": (replace(robot.of(SimWheels)[0], poses_every=300),)}, "wheel0"),
    ):
        with pytest.raises(RigError, match=f"{name} has fewer than two measurements"):
            simulate(replace(robot, **change), 1)
    assert simulate(replace(robot, cameras=(), sensors=robot.of(SimWheels)), 1).measurements.tracks == ()
