"""Simulated corners: projection, time offsets, and the sign and size of every disturbance."""

import math
from dataclasses import replace

import numpy as np
import pytest
from tests.cases import each

from icalib.errors import RigError
from icalib.tools.simulation import SimCamera, handheld, simulate
from icalib.tools.simulation.projection import image_velocity, project, visible

FISHEYE = SimCamera(
    "cam0", "pinhole-equidistant", (752, 480), (190.0, 191.0, 375.0, 240.0), (0.03, -0.01, 0.004, -0.001), np.eye(4)
)
EUCM = replace(FISHEYE, model="eucm", intrinsics=(210.0, 211.0, 375.0, 240.0), distortion=(0.62, 1.1))
SPHERES = replace(EUCM, model="double-sphere", distortion=(-0.2, 0.59))
MIRROR = replace(EUCM, model="omni-radtan", distortion=(1.2, -0.1, 0.03, 3e-4, -2e-4))
RATIONAL = replace(
    EUCM,
    model="pinhole-rational",
    intrinsics=(330.0, 331.0, 375.0, 240.0),
    distortion=(3.1, 0.9, 2e-4, 1e-4, 0.02, 3.4, 1.9, 0.15),
)
WIDE = (FISHEYE, EUCM, SPHERES, MIRROR)


def with_camera(scenario, index=0, **changes):
    cameras = list(scenario.cameras)
    cameras[index] = replace(cameras[index], **changes)
    return replace(scenario, cameras=tuple(cameras))


def project_one(camera, P):
    """One point with the standard library only."""
    d, length = camera.distortion, math.hypot(*P[:3])
    if camera.model == "omni-radtan":
        d, P = d[1:], (P[0] / length, P[1] / length, P[2] / length + d[0])
    x, y = P[0] / P[2], P[1] / P[2]
    r = math.sqrt(x * x + y * y)
    if camera.model == "eucm":
        depth = d[0] * math.hypot(math.sqrt(d[1]) * P[0], math.sqrt(d[1]) * P[1], P[2]) + (1.0 - d[0]) * P[2]
        xd, yd = P[0] / depth, P[1] / depth
    elif camera.model == "double-sphere":
        z = P[2] + d[0] * length
        depth = d[1] * math.hypot(P[0], P[1], z) + (1.0 - d[1]) * z
        xd, yd = P[0] / depth, P[1] / depth
    elif "radtan" in camera.model:
        L = 1.0 + d[0] * r**2 + d[1] * r**4
        xd = x * L + 2.0 * d[2] * x * y + d[3] * (r * r + 2.0 * x * x)
        yd = y * L + d[2] * (r * r + 2.0 * y * y) + 2.0 * d[3] * x * y
    elif camera.model == "pinhole-rational":
        above = 1.0 + d[0] * r**2 + d[1] * r**4 + d[4] * r**6
        L = above / (1.0 + d[5] * r**2 + d[6] * r**4 + d[7] * r**6)
        xd = x * L + 2.0 * d[2] * x * y + d[3] * (r * r + 2.0 * x * x)
        yd = y * L + d[2] * (r * r + 2.0 * y * y) + 2.0 * d[3] * x * y
    else:
        theta = math.atan2(math.hypot(P[0], P[1]), P[2])
        bent = theta + d[0] * theta**3 + d[1] * theta**5 + d[2] * theta**7 + d[3] * theta**9
        xd, yd = (bent * c / math.hypot(P[0], P[1]) for c in P[:2])
    fx, fy, cx, cy = camera.intrinsics
    return fx * xd + cx, fy * yd + cy


def expected_corners(sim, index, time_offset):
    """The camera's corners from its raw stamps, with the given offset, one at a time."""
    camera, stream, truth = sim.scenario.cameras[index], sim.measurements.cameras[index], sim.truth
    since_origin = (stream.stamps_ns - truth.imu_clock_origin_ns).astype(np.float64) * 1e-9
    R, p, _ = truth.pose_at(since_origin + time_offset)
    T_world_board, T_imu_cam = truth.T_world_board, truth.T_imu_sensor[camera.name]
    uv = []
    for image, point in zip(stream.image, stream.point, strict=True):
        T_world_imu = np.eye(4)
        T_world_imu[:3, :3], T_world_imu[:3, 3] = R[image], p[image]
        P = np.append(sim.scenario.target.points[point], 1.0)
        uv.append(project_one(camera, np.linalg.solve(T_world_imu @ T_imu_cam, T_world_board @ P)))
    return np.array(uv)


@pytest.mark.parametrize("index", [0, 1])
def test_corners_are_projections_at_sensor_time_plus_offset(index):
    scenario = handheld(duration_s=1.0, asynchronous=True, noiseless=True)
    scenario = with_camera(scenario, index, clock_origin_ns=scenario.imu_clock_origin_ns - 3_000_037_000)
    sim = simulate(scenario, seed=1)
    camera = sim.scenario.cameras[index]
    assert math.isclose(sim.truth.time_offset[camera.name], camera.time_offset_s + 3.000037, abs_tol=1e-12)
    measured = sim.measurements.cameras[index].uv
    np.testing.assert_allclose(measured, expected_corners(sim, index, sim.truth.time_offset[camera.name]), atol=1e-8)
    wrong_sign = expected_corners(sim, index, 3.000037 - camera.time_offset_s)
    assert np.abs(measured - wrong_sign).max() > 1.0


@each("lens", [*WIDE, RATIONAL])
def test_recordings_of_wide_lenses_are_exact_too(lens):
    scenario = with_camera(
        handheld(duration_s=1.0, noiseless=True),
        model=lens.model,
        intrinsics=lens.intrinsics,
        distortion=lens.distortion,
    )
    sim = simulate(scenario, seed=2)
    expected = expected_corners(sim, 0, sim.truth.time_offset["cam0"])
    np.testing.assert_allclose(sim.measurements.cameras[0].uv, expected, atol=1e-9)


@each("camera", [handheld().cameras[0], RATIONAL, *WIDE])
def test_projection_and_its_directional_derivative(camera):
    rng = np.random.default_rng(3)
    points = np.concatenate([rng.uniform(-1.0, 1.0, (50, 2)), rng.uniform(0.4, 2.0, (50, 1))], axis=1)
    if camera in WIDE:
        points = np.concatenate([points, [[1.0, 0.3, -0.2], [1.0, 1.0, 1e-9], [1e-9, -1e-9, 1.0]]])
    uv = np.array([project_one(camera, P) for P in points])
    np.testing.assert_allclose(project(camera, points), uv, rtol=1e-13)
    direction = rng.standard_normal(points.shape)
    h = 1e-6
    forward, back = project(camera, points + h * direction), project(camera, points - h * direction)
    np.testing.assert_allclose(
        image_velocity(camera, points, direction), (forward - back) / (2.0 * h), rtol=1e-6, atol=1e-5
    )


def test_points_behind_outside_or_beyond_the_fold_are_not_seen():
    radtan = replace(handheld().cameras[0], distortion=(-0.3, 0.0, 0.0, 0.0), resolution=(4000, 4000))
    radtan = replace(radtan, intrinsics=(450.0, 450.0, 2000.0, 2000.0))
    fold = 1.0 / math.sqrt(0.9)  # 1 + 3 k1 r^2 = 0
    points = np.array([[fold - 0.01, 0.0, 1.0], [fold + 0.01, 0.0, 1.0], [0.1, 0.1, -1.0], [0.0, 0.0, 1.0]])
    np.testing.assert_array_equal(visible(radtan, points, project(radtan, points)), [True, False, False, True])
    small = replace(radtan, resolution=(2100, 2100))
    np.testing.assert_array_equal(visible(small, points, project(small, points)), [False, False, False, True])
    fisheye = replace(FISHEYE, distortion=(-0.1, 0.0, 0.0, 0.0), resolution=(4000, 4000))
    fisheye = replace(fisheye, intrinsics=(300.0, 300.0, 2000.0, 2000.0))
    theta = np.sqrt(1.0 / 0.3) + np.array([-0.01, 0.01])
    points = np.stack([np.sin(theta), 0.0 * theta, np.cos(theta)], axis=1)
    np.testing.assert_array_equal(visible(fisheye, points, project(fisheye, points)), [True, False])


@each("camera", [EUCM, SPHERES, MIRROR])
def test_wide_lenses_see_just_as_far_as_their_image_moves_outwards(camera):
    camera = replace(camera, resolution=(100_000, 100_000), intrinsics=(*camera.intrinsics[:2], 5e4, 5e4))
    angles = np.linspace(1e-3, math.pi - 1e-3, 5000)
    points = np.stack([np.sin(angles), 0.0 * angles, np.cos(angles)], axis=1)
    uv = project(camera, points)
    seen = visible(camera, points, uv)
    limit = int(seen.argmin())
    assert not seen[limit:].any() and angles[limit] > 0.55 * math.pi
    assert (np.diff(uv[:limit, 0]) > 0.0).all() and not np.diff(uv[limit - 1 : limit + 2, 0]).min() > 0.0


def test_unknown_model_is_refused():
    with pytest.raises(RigError, match="omni"):
        replace(FISHEYE, model="omni")


def test_bloom_pulls_corners_towards_their_tag():
    scenario = handheld(duration_s=1.0, noiseless=True)
    plain, bloomed = simulate(scenario, seed=4), simulate(with_camera(scenario, bloom_px=0.3), seed=4)
    before, after = plain.measurements.cameras[0], bloomed.measurements.cameras[0]
    moved = after.uv - before.uv
    np.testing.assert_allclose(np.linalg.norm(moved, axis=1), 0.3, rtol=1e-9)
    opposite = before.point ^ 2  # corner 0 <-> 2, 1 <-> 3 of the same tag
    key = before.image * 1000 + before.point
    partner = np.searchsorted(key, before.image * 1000 + opposite)
    both = (partner < len(key)) & (key[np.minimum(partner, len(key) - 1)] == before.image * 1000 + opposite)
    across = before.uv[partner[both]] - before.uv[both]
    cosine = np.sum(across * moved[both], axis=1) / (0.3 * np.linalg.norm(across, axis=1))
    assert both.sum() > 1000 and cosine.min() > 0.99
    np.testing.assert_array_equal(plain.measurements.cameras[1].uv, bloomed.measurements.cameras[1].uv)


@each("bow", [(2e-3, 0.0, 0.0), (0.0, 2e-3, 0.0), (0.0, 0.0, 2e-3)])
def test_bow_moves_the_board_towards_the_camera_where_positive(bow):
    scenario = handheld(duration_s=0.5, noiseless=True)
    scenario = replace(scenario, motion=replace(scenario.motion, kind="motionless"))
    scenario = with_camera(scenario, distortion=(0.0, 0.0, 0.0, 0.0))
    flat, bent = simulate(scenario, seed=5), simulate(replace(scenario, bow=bow), seed=5)
    camera = scenario.cameras[0]
    a, b = flat.measurements.cameras[0], bent.measurements.cameras[0]
    assert len(a.uv) == len(b.uv) == 144 * len(a.stamps_ns)
    first = slice(0, 144)
    half = 0.5 * (5 * 0.1144 + 0.088)
    for point, uv, moved in zip(a.point[first], a.uv[first], b.uv[first] - a.uv[first], strict=True):
        x, y, _ = scenario.target.points[point] / half - 1.0
        z = bow[0] * x * x + bow[1] * x * y + bow[2] * y * y
        # The camera looks straight at the board's centre from 0.8 m, and depth falls by z.
        outwards = uv - np.array(camera.intrinsics[2:])
        np.testing.assert_allclose(moved, outwards * z / (0.8 - z), atol=1e-9)


def test_corner_noise_blur_shift_and_outliers():
    scenario = replace(handheld(duration_s=20.0), blur_s=1e-3, shift_px=0.15, outlier_fraction=0.02, outlier_px=30.0)
    sim = simulate(scenario, seed=6)
    stream, truth = sim.measurements.cameras[0], sim.truth.corners["cam0"]
    error = stream.uv - truth.uv
    inlier = ~truth.outlier
    assert abs(truth.outlier.mean() - 0.02) < 0.003
    assert 5.0 < error[truth.outlier].std() < 30.0 and np.abs(error[truth.outlier]).max() < 35.0
    assert truth.sigma.min() >= 0.2 and truth.sigma.max() > 0.5
    mean = np.array(
        [error[stream.image == i][inlier[stream.image == i]].mean(axis=0) for i in range(len(stream.stamps_ns))]
    )
    assert abs(mean.std() / 0.15 - 1.0) < 0.15  # 798 numbers: known to 2.5 %; white noise adds 5 %
    white = ((error - mean[stream.image]) / truth.sigma[:, None])[inlier]
    assert abs(white.std() - 1.0) < 0.02


def test_blur_grows_with_the_rms_image_speed():
    scenario = replace(handheld(duration_s=2.0, noiseless=False), blur_s=2e-3)
    sim = simulate(scenario, seed=7)
    stream, truth, h = sim.measurements.cameras[0], sim.truth.corners["cam0"], 1e-3
    later = expected_corners(sim, 0, sim.truth.time_offset["cam0"] + h)
    earlier = expected_corners(sim, 0, sim.truth.time_offset["cam0"] - h)
    speed = np.linalg.norm(later - earlier, axis=1) / (2.0 * h)
    for i in range(len(stream.stamps_ns)):
        mine = stream.image == i
        expected = math.sqrt(0.2**2 + (2e-3) ** 2 * (speed[mine] ** 2).mean())
        np.testing.assert_allclose(truth.sigma[mine], expected, rtol=1e-3)


def test_dropouts_rates_phases_and_small_views():
    scenario = handheld(duration_s=4.0, asynchronous=True, noiseless=True)
    scenario = with_camera(scenario, 0, dropouts=((1.0, 2.0),), rate_hz=10.0, jitter_s=0.02)
    sim = simulate(scenario, seed=8)
    t0, t1 = sim.truth.corners["cam0"].seconds, sim.truth.corners["cam1"].seconds
    assert not ((t0 > 1.0) & (t0 < 2.0)).any() and np.diff(t0).max() > 0.9
    assert len(t0) in (29, 30) and np.ptp(np.diff(t0[t0 < 1.0])) > 1e-3
    periods = (t1 - 0.075) / 0.05  # half a period of phase after the lead of 0.05 s
    np.testing.assert_allclose(periods, np.round(periods), atol=1e-6)
    for camera in sim.measurements.cameras:
        assert (np.diff(camera.stamps_ns) > 0).all()
    tiny = simulate(with_camera(scenario, 0, resolution=(40, 40)), seed=8).measurements.cameras[0]
    assert (np.diff(tiny.start) >= 6).all() and len(tiny.stamps_ns) < len(t0)


@pytest.mark.parametrize("rolling", ["rows", "columns"])
def test_a_rolling_shutter_shows_each_corner_at_the_time_of_its_row(rolling):
    """As a camera with a global shutter does that takes its image then."""
    readout, scenario = 0.03, handheld(2.0, noiseless=True)
    rolled = simulate(with_camera(scenario, readout_s=readout, rolling=rolling), 0)
    axis, truth = ("columns", "rows").index(rolling), rolled.truth.corners["cam0"]
    stream = rolled.measurements.cameras[0]
    for n in (5, 700, 2500):
        row = (truth.uv[n, axis] + 0.5) / (752, 480)[axis] - 0.5
        then = truth.seconds[stream.image[n]] + readout * row
        moved = with_camera(scenario, phase_s=then - 0.05, rate_hz=0.1, clock_origin_ns=scenario.imu_clock_origin_ns)
        one = simulate(moved, 0)
        corner = one.truth.corners["cam0"].uv[one.measurements.cameras[0].point == stream.point[n]]
        np.testing.assert_allclose(corner, truth.uv[n : n + 1], rtol=0, atol=1e-5)  # stamps are rounded to ns
