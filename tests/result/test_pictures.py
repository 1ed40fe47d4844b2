"""Points of a LiDAR and outlines of a target in images, by the obvious formulas; and which images are shown."""

from __future__ import annotations

from dataclasses import fields, replace

import cv2
import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from tests.calibrations import DISTORTION, INTRINSICS, pose_at
from tests.typed import not_none

from icalib.data.measurements import CornerStream, LidarStream, Measurements
from icalib.geometry.targets import target_from_plain
from icalib.result import Calibration, RecordingSpan
from icalib.result.path import CubicPath
from icalib.result.pictures import (
    MOST_EDGE_POINTS,
    MOST_POINTS,
    Mount,
    cloud_in_image,
    depth_edges,
    hidden,
    pictures,
    target_in_image,
)

ORIGIN_NS = 1_700_000_000_000_000_000
SPAN = RecordingSpan("run", 0.0, 14.95, ORIGIN_NS)
CAMERA_AT_S, LIDAR_AT_S = 4.0, 3.96  # of an image and a scan, on the clock of the result
CAMERA_OFFSET_S, LIDAR_OFFSET_S = -1.354e-4, -0.01


@pytest.fixture(scope="module")
def moving(robot: Calibration) -> Calibration:
    return replace(robot, recordings=(SPAN,))


def stamp_ns(seconds: float, offset_s: float) -> int:
    return ORIGIN_NS + round(1e9 * (seconds - offset_s))


def project(points: np.ndarray) -> np.ndarray:
    fx, fy, cx, cy = INTRINSICS["cam0"]
    K = np.array([[fx, 0.0, cx], [0.0, fy, cy], [0.0, 0.0, 1.0]])
    return cv2.projectPoints(points, np.zeros(3), np.zeros(3), K, np.array(DISTORTION["cam0"]))[0][:, 0]


def inverse(T: np.ndarray) -> np.ndarray:
    return np.linalg.inv(T)


def apply(T: np.ndarray, points: np.ndarray) -> np.ndarray:
    return points @ T[:3, :3].T + T[:3, 3]


def body_at(seconds: float) -> np.ndarray:
    (R,), (p,) = pose_at(np.array([seconds]))
    return np.vstack([np.column_stack([R, p]), [0.0, 0.0, 0.0, 1.0]])


def scanned(c: Calibration, count: int) -> tuple[LidarStream, np.ndarray, np.ndarray]:
    """A scan of 0.08 s while the rig moves, of points in the field of view of the image; their pixels and distances."""
    rng = np.random.default_rng(1)
    in_camera = rng.uniform([-0.5, -0.3, 1.0], [0.5, 0.3, 1.0], (count, 3)) * rng.uniform(2.0, 9.0, (count, 1))
    world = apply(body_at(CAMERA_AT_S) @ c.T_imu_sensor("cam0"), in_camera)
    after_s = np.linspace(0.0, 0.08, count)
    R, p = pose_at(LIDAR_AT_S + after_s)
    xyz = apply(inverse(c.T_imu_sensor("lidar0")), np.einsum("nji,nj->ni", R, world - p))
    stamps = np.array([stamp_ns(LIDAR_AT_S, LIDAR_OFFSET_S)], np.int64)
    start, plane = np.array([0, count], np.int64), np.full(count, -1, np.int32)
    stream = LidarStream("lidar0", stamps, start, after_s.astype(np.float32), xyz.astype(np.float32), plane)
    return stream, project(in_camera), np.linalg.norm(in_camera, axis=1)


def seen(c: Calibration, scan: LidarStream, T: np.ndarray, late_s: float) -> tuple[np.ndarray, np.ndarray]:
    """Pixels and distances of the points that are in the image, the farthest first, if the LiDAR were at T (4, 4) on
    the body, and its clock late."""
    R, p = pose_at(LIDAR_AT_S + scan.offset_s.astype(np.float64) + late_s)
    world = np.einsum("nij,nj->ni", R, apply(T, scan.xyz.astype(np.float64))) + p
    in_camera = apply(inverse(body_at(CAMERA_AT_S) @ c.T_imu_sensor("cam0")), world)
    uv, distance = project(in_camera), np.linalg.norm(in_camera, axis=1)
    inside = ((uv >= -0.5) & (uv <= [751.5, 479.5])).all(axis=1)
    order = np.argsort(-distance[inside])
    return uv[inside][order], distance[inside][order]


def mounts(c: Calibration, first: bool = False) -> tuple[Mount, Mount]:
    return Mount.of(c, SPAN, "cam0", first), Mount.of(c, SPAN, "lidar0", first)


def test_points_of_a_moving_lidar_are_where_the_camera_sees_them(moving):
    scan, uv, distance = scanned(moving, 900)
    at_ns = stamp_ns(CAMERA_AT_S, CAMERA_OFFSET_S)
    points = cloud_in_image(moving, CubicPath.of(moving), "cam0", mounts(moving), scan, at_ns)
    farthest = np.argsort(-distance)
    np.testing.assert_allclose(points.distance, distance[farthest], atol=1e-4)
    np.testing.assert_allclose(points.uv, uv[farthest], atol=0.05)


@pytest.mark.parametrize("name", ["rotation", "translation", "time_offset"])
def test_the_first_guess_shows_the_points_elsewhere(moving, name):
    """0.5 deg, 50 mm, or 30 ms, in which the rig turns by 1 deg and more."""
    T, late_s = moving.T_imu_sensor("lidar0"), 0.0
    if name == "rotation":
        T[:3, :3] = T[:3, :3] @ Rotation.from_euler("z", 0.5, degrees=True).as_matrix()
    elif name == "translation":
        T[:3, 3] += [0.0, 0.05, 0.0]
    else:
        late_s = 0.03
    value = {"rotation": T[:3, :3], "translation": T[:3, 3], "time_offset": np.array([LIDAR_OFFSET_S + late_s])}[name]
    scan, uv, _ = scanned(moving, 900)
    c, at_ns = replace(moving, first_guess={("lidar0", name): value}), stamp_ns(CAMERA_AT_S, CAMERA_OFFSET_S)
    points = cloud_in_image(c, CubicPath.of(c), "cam0", mounts(c, first=True), scan, at_ns)
    elsewhere, distance = seen(c, scan, T, late_s)
    np.testing.assert_allclose(points.uv, elsewhere, atol=0.05)
    np.testing.assert_allclose(points.distance, distance, atol=1e-4)
    assert np.median(np.linalg.norm(points.uv[:, None] - uv, axis=2).min(axis=1)) > 1.0


def test_points_are_thinned_without_steps(moving):
    """Even steps would show the same rings of a LiDAR only; of 16 in turn, all are shown alike."""
    scan, uv, _ = scanned(moving, 4 * MOST_POINTS)
    at_ns = stamp_ns(CAMERA_AT_S, CAMERA_OFFSET_S)
    points = cloud_in_image(moving, CubicPath.of(moving), "cam0", mounts(moving), scan, at_ns)
    assert MOST_POINTS < len(points.uv) <= MOST_POINTS + MOST_EDGE_POINTS  # at random distances, many are edges
    row = np.array([int(np.argmin(((uv - at) ** 2).sum(axis=1))) for at in points.uv[~points.edge][::4]])
    assert np.bincount(row % 16, minlength=16).min() > 0.5 * len(row) / 16


@pytest.mark.parametrize(("rings", "ring_deg"), [(16, 2.0), (150, 0.2)])
def test_depth_edges_are_the_sides_of_a_box_before_a_wall(rings, ring_deg):
    """A box of 20 x 12 deg, 2 m away, before a wall in 3 m, on a floor, which is no edge. Rings that are far apart do
    not show its top."""
    azimuth, elevation = np.meshgrid(np.deg2rad(0.2 * np.arange(-150, 151)), np.deg2rad(ring_deg * np.arange(rings)))
    elevation -= np.deg2rad(0.5 * ring_deg * rings + 0.05)
    beams = np.stack([np.cos(azimuth), np.sin(azimuth), np.tan(elevation)], axis=-1)
    beams[..., :2] /= np.cos(azimuth)[..., None]
    box = (abs(azimuth) < np.deg2rad(10.01)) & (abs(elevation) < np.deg2rad(6.0))
    floor = 3.0 * np.tan(elevation) < -0.6
    reach = np.where(box, 2.0, np.where(floor, -0.6 / np.minimum(np.tan(elevation), -1e-3), 3.0))
    points = beams * reach[..., None]
    shuffled = np.random.default_rng(3).permutation(points.size // 3)
    found = np.zeros(points.size // 3, bool)
    found[shuffled] = depth_edges(points.reshape(-1, 3)[shuffled])
    sides = box & (abs(azimuth) > np.deg2rad(9.99))
    if ring_deg < 1.0:
        sides |= box & (abs(elevation) > np.deg2rad(5.84))
    np.testing.assert_array_equal(found.reshape(box.shape), sides)


def test_points_behind_an_object_are_hidden_and_those_beside_it_are_not():
    u, v = (x.ravel() for x in np.meshgrid(np.arange(0.0, 200.0, 2.0), np.arange(0.0, 150.0, 12.0)))
    wall, box = (
        np.stack([u, v], axis=1),
        np.stack([u, v + 3.0], axis=1)[(abs(u - 100.0) < 40.0) & (abs(v - 70.0) < 40.0)],
    )
    uv, distance = np.concatenate([wall, box]), np.repeat([6.0, 2.0], [len(wall), len(box)])
    behind = (abs(wall - [100.0, 71.5]) < [36.0, 30.0]).all(axis=1)
    beside = (abs(wall - [100.0, 71.5]) > [50.0, 60.0]).any(axis=1)
    found = hidden(uv, distance)
    assert found[: len(wall)][behind].all() and not found[: len(wall)][beside].any() and not found[len(wall) :].any()


def test_the_outline_is_that_of_the_sheet_in_the_pose_that_the_camera_sees(moving):
    T_cam_board = np.eye(4)
    T_cam_board[:3, :3], T_cam_board[:3, 3] = Rotation.from_rotvec([0.3, -0.2, 0.1]).as_matrix(), [-0.3, -0.3, 1.2]
    T_world_board = np.eye(4)
    T_world_board[:3, :3] = moving.group("board0", "tilt").value
    T = T_world_board @ inverse(T_cam_board) @ inverse(moving.T_imu_sensor("cam0"))
    n = len(moving.trajectory.seconds)
    still = replace(moving.trajectory, rotation=np.tile(T[:3, :3], (n, 1, 1)), position=np.tile(T[:3, 3], (n, 1)))
    c = replace(moving, trajectory=still)
    outline = target_in_image(c, CubicPath.of(c), "cam0", mounts(c)[0], CAMERA_AT_S)
    low, high = not_none(target_from_plain(c.rig)).outlines[0]
    corners = np.array([[x, y, 0.0] for x, y in (low, (high[0], low[1]), high, (low[0], high[1]))])
    assert np.isnan(outline[-1]).all()
    np.testing.assert_allclose(outline[:-1:12][:4], project(apply(T_cam_board, corners)), atol=1e-3)
    np.testing.assert_array_equal(outline[0], outline[-2])


def test_the_median_and_the_worst_image_and_the_fastest_turn_are_shown(moving):
    r = moving.corner_residuals[0]
    growth = np.repeat(np.linspace(1.0, 3.0, len(r.seconds)), np.diff(r.start))[:, None]
    kept = np.arange(60, 100, 4)
    stamps = [stamp_ns(t, CAMERA_OFFSET_S) for t in r.seconds[kept]]
    corners = CornerStream(
        "cam0",
        np.array(stamps, np.int64),
        np.zeros(len(stamps) + 1, np.int64),
        np.zeros(0, np.int64),
        np.zeros((0, 2)),
        pictures={ns: ("", bytes([k])) for k, ns in enumerate(stamps)},
    )
    residuals = moving.residuals | {("cam0", "corners"): replace(r, residual=r.residual * growth)}
    c = replace(moving, residuals=residuals)
    scan, _, _ = scanned(c, 900)
    found = list(pictures(c, ["lidar0"], [Measurements.of_streams(corners, scan)]))
    rms = replace(r, residual=r.residual * growth).rms_of_images[kept]
    median, worst, points = found
    assert median.jpeg == bytes([int(np.argsort(rms)[4])])
    assert worst.jpeg == bytes([int(np.argmax(rms))])
    assert (median.after, worst.after) == (None, None)
    assert f"{rms.max():.2g} px" in worst.title
    assert points.sensor == "lidar0"
    assert abs(points.seconds - CAMERA_AT_S) < 0.2  # the only images that this scan shows anything in
    assert points.before is None
    assert list(pictures(c, ["lidar0"], [Measurements.of_streams(replace(corners, pictures={}), scan)])) == []


def test_one_keyframe_has_its_own_pose_only(moving):
    path = moving.trajectory
    one = replace(path, **{f.name: getattr(path, f.name)[80:81] for f in fields(path)})
    R, p, known = CubicPath.of(replace(moving, trajectory=one)).at(path.seconds[79:83])
    np.testing.assert_array_equal(known, [False, True, False, False])
    np.testing.assert_allclose(R, np.repeat(one.rotation, 4, axis=0), atol=1e-12)
    np.testing.assert_allclose(p, np.repeat(one.position, 4, axis=0))
