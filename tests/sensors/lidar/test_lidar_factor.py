"""The LiDAR factor against its points one by one: each at its own instant, each a residual of its own."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import pytest
from tests.cases import each
from tests.setups import RINGS
from tests.typed import not_none

from icalib.errors import EstimationError
from icalib.geometry.planes import moved
from icalib.motion.factor import chi2 as weighted_squares
from icalib.motion.poses import Poses, assign_keyframes, poses_at
from icalib.optim.arrowhead import make_pieces
from icalib.optim.state import KEYFRAME_DIM
from icalib.sensors.lidar.binning import AssociatedPoints, LidarNoise, in_world, take_moments
from icalib.sensors.lidar.residual import RINGS_SEEN, rings_seen, true_rings
from icalib.tools.simulation import simulate


def moments_of(setup, noise=None, state=None, stream=None, plane=None, bin_s=1e-3):
    state = state or setup.state
    values = np.array([state.values[p] for p in setup.planes])
    own = setup.plane if plane is None else plane
    return take_moments(
        AssociatedPoints(stream or setup.stream, own, values), setup.motion(state), not_none(noise), bin_s
    )


def point_times(setup):
    stream = setup.stream
    return np.repeat(stream.seconds, np.diff(stream.start)) + stream.offset_s


def poses_of_points(setup, state, times, keyframes_at=None) -> tuple[Poses, np.ndarray]:
    """IMU poses at times on the LiDAR's clock, each from the keyframe next to `keyframes_at`, or to itself."""
    offset = state.values["lidar0", "time_offset"][0]
    keyframe = assign_keyframes("inertial", state.seconds, (times if keyframes_at is None else keyframes_at) + offset)
    return poses_at("inertial", times + offset, keyframe, state, setup.imu, 9.81, False), keyframe


def world_points(setup, state, poses, xyz):
    R_il, p_il = state.values["lidar0", "rotation"], state.values["lidar0", "translation"]
    in_imu = xyz @ R_il.T + p_il
    return poses.position + np.einsum("nij,nj->ni", poses.rotation, in_imu), in_imu


@dataclass
class Point:
    """Residual (N,), cosine of incidence (N,), and the Jacobians (N, chain + calib) of both, by obvious formulas, of
    all points on planes."""

    r: np.ndarray
    J: np.ndarray
    incidence: np.ndarray
    J_incidence: np.ndarray


def pointwise(setup, state, bin_s=1e-3) -> Point:
    """The points of a bin hang on one keyframe, though each has a pose of its own."""
    used = np.flatnonzero(setup.plane >= 0)
    xyz = setup.stream.xyz[used].astype(np.float64)
    scan = np.repeat(setup.stream.seconds, np.diff(setup.stream.start))
    centre = scan + (np.floor(setup.stream.offset_s.astype(np.float64) / bin_s) + 0.5) * bin_s
    poses, keyframe = poses_of_points(setup, state, point_times(setup)[used], centre[used])
    world, in_imu = world_points(setup, state, poses, xyz)
    value = np.array([state.values[p] for p in setup.planes])[setup.plane[used]]
    n, c = value[:, :3], value[:, 3:]
    R, R_il = poses.rotation, state.values["lidar0", "rotation"]
    r = np.einsum("ni,ni->n", n, world - c)
    in_body = np.einsum("nij,ni->nj", R, n)
    beam = xyz / np.linalg.norm(xyz, axis=1, keepdims=True)
    J_pose = np.concatenate([np.cross(in_imu, in_body), n], axis=1)
    turned = np.concatenate([np.cross(beam @ R_il.T, in_body), np.zeros_like(n)], axis=1)
    o = KEYFRAME_DIM * len(state.seconds)
    J, J_c = np.zeros((2, len(used), o + setup.layout.size))
    for i, k in enumerate(keyframe):
        J[i, KEYFRAME_DIM * k : KEYFRAME_DIM * (k + 1)] = J_pose[i] @ poses.J_keyframe[i]
        J_c[i, KEYFRAME_DIM * k : KEYFRAME_DIM * (k + 1)] = turned[i] @ poses.J_keyframe[i]
    columns = [o + setup.layout.columns("lidar0", name) for name in ("rotation", "translation", "time_offset")]
    J[:, columns[0]] = np.cross(xyz, in_body @ R_il)
    J[:, columns[1]] = in_body
    twist = np.concatenate([poses.rate, poses.velocity], axis=1)
    J[:, columns[2][0]] = (J_pose * twist).sum(axis=1)
    J_c[:, columns[0]] = np.cross(beam, in_body @ R_il)
    J_c[:, columns[2][0]] = (turned * twist).sum(axis=1)
    h = 1e-6
    for q, key in enumerate(setup.planes):
        own = setup.plane[used] == q
        for t in range(3):
            up, down = (moved(state.values[key], s * h * np.eye(3)[t]) for s in (1, -1))
            distances = [(world[own] - p[3:]) @ p[:3] for p in (up, down)]
            J[own, o + setup.layout.columns(*key)[t]] = (distances[0] - distances[1]) / (2 * h)
            in_world = np.einsum("nij,nj->ni", R[own] @ R_il, beam[own])
            J_c[own, o + setup.layout.columns(*key)[t]] = in_world @ (up[:3] - down[:3]) / (2 * h)
    return Point(r, J, np.einsum("ni,ni->n", in_body @ R_il, beam), J_c)


def sums(setup, factor, state, dense):
    pieces, out = make_pieces(factor.n_keyframes, setup.layout.size), factor.output()
    cost = sum(factor.accumulate(state, p, out) for p in pieces)
    return cost, *dense(pieces, factor.n_keyframes), out.residual


@each("bin_s", [1e-3, 1e-4, 2e-6])
@each("loss", ["none", "huber", "cauchy"])
@each("beam", [0.0, 0.03])
def test_sums_are_those_of_the_points(sparse_room, room_of, dense, bin_s, loss, beam):
    """But for the instants at which states act on them, wrong by half a bin at most: of 25 ms from the keyframe.
    Without the gyroscope's noise, of which test_factors.py knows."""
    setup = room_of(sparse_room, spacing=0.05)
    state = setup.perturbed(np.random.default_rng(0), 0.3)
    noise = LidarNoise(0.02, beam, loss, 1.2)
    factor = setup.factor(state, noise, bin_s=bin_s)
    factor = replace(factor, noise_angle=np.zeros_like(factor.noise_angle))
    cost, H, g, _ = sums(setup, factor, state, dense)
    point = pointwise(setup, state, bin_s)
    sigma = np.hypot(noise.sigma, beam * point.incidence)
    t = np.abs(point.r) / sigma
    root = {
        "none": np.ones_like(t),
        "huber": np.minimum(1.0, 1.2 / np.maximum(t, 1e-300)) ** 0.5,
        "cauchy": (1.0 + (t / 1.2) ** 2) ** -0.5,
    }[loss]
    assert 0.05 < (t > 1.2).mean() < 0.9
    J, r = point.J * (root / sigma)[:, None], point.r * root / sigma
    size = np.sqrt(np.maximum((J**2).sum(axis=0), 1e-6 * (J**2).sum(axis=0).max()))
    found, expected = (M / np.outer(size, size) for M in (H, J.T @ J))
    bound, o = 10.0 * bin_s, KEYFRAME_DIM * len(state.seconds)
    np.testing.assert_allclose(found, expected, rtol=0, atol=bound)
    np.testing.assert_allclose(found[o:, o:], expected[o:, o:], rtol=0, atol=0.1 * bound)
    # Half of r^2 / sigma^2 by the pose: sigma turns with the incidence.
    share = np.where(t < 4.0, t**2, 0.0) * root**2 * beam**2 * point.incidence / sigma**2
    slope = (J.T @ r - point.J_incidence.T @ share) / size
    np.testing.assert_allclose(g / size, slope, rtol=0, atol=bound * np.linalg.norm(r))
    np.testing.assert_allclose((g / size)[o:], slope[o:], rtol=0, atol=0.1 * bound * np.linalg.norm(r))
    assert cost == pytest.approx(0.5 * r @ r, rel=bound)


@each("beam", [0.0, 0.03])
def test_errors_of_rings_move_their_points(sparse_room, room_of, dense, beam):
    """Against points that are moved one by one, by 1 mrad up, down and sideways, and by 1 mm nearer and farther. The
    ring with most points has no offset of its own."""
    setup = room_of(sparse_room, spacing=0.05, rings=True)
    state, noise, bin_s, h = setup.perturbed(np.random.default_rng(0), 0.1), LidarNoise(0.1, beam), 1e-4, 1e-3
    factor = setup.factor(state, noise, bin_s=bin_s)
    factor = replace(factor, noise_angle=np.zeros_like(factor.noise_angle))
    _, H, g, _ = sums(setup, factor, state, dense)
    off, o = np.array([state.values["lidar0", name] for name in RINGS]), KEYFRAME_DIM * len(state.seconds)
    point = pointwise(corrected(setup, *off), state, bin_s)
    ring, sigma = rings_of_points(setup)[setup.plane >= 0], np.hypot(noise.sigma, beam * point.incidence)
    assert (np.abs(point.r) / sigma).max() < 4.0
    slope, columns = np.zeros(len(g)), o + setup.layout.columns("lidar0", *RINGS)
    for name, step in zip(RINGS, h * np.eye(3)[:, :, None], strict=True):
        up, down = (pointwise(corrected(setup, *(off + sign * step)), state, bin_s) for sign in (1.0, -1.0))
        own = o + setup.layout.columns("lidar0", name)
        point.J[:, own] = (ring[:, None] == np.arange(16)) * ((up.r - down.r) / (2.0 * h))[:, None]
        cost = [0.5 * (x.r / np.hypot(noise.sigma, beam * x.incidence)) ** 2 for x in (up, down)]
        slope[own] = np.bincount(ring, cost[0] - cost[1], minlength=16) / (2.0 * h)
    J = point.J / sigma[:, None]
    size = np.sqrt(np.maximum((J**2).sum(axis=0), 1e-6 * (J**2).sum(axis=0).max()))
    reference = columns[16 + np.bincount(rings_of_points(setup)).argmax()]
    assert not H[reference].any() and g[reference] == 0.0
    J[:, reference] = slope[reference] = 0.0
    np.testing.assert_allclose(
        (H / np.outer(size, size))[columns], (J.T @ J / np.outer(size, size))[columns], rtol=0, atol=2e-3
    )
    found, expected = g[columns] / size[columns], slope[columns] / size[columns]
    np.testing.assert_allclose(found, expected, rtol=0, atol=2e-3 * np.sqrt(len(ring)))


def test_corrected_rings_are_moved_one_by_one(sparse_room, room_of):
    """Of a part of the points, too, which does not have all rings."""
    setup = room_of(sparse_room)
    off = np.random.default_rng(1).normal(size=(3, 16)) * 0.01
    values = {("lidar0", RINGS_SEEN): rings_seen(setup.stream)} | {
        ("lidar0", x): v for x, v in zip(RINGS, off, strict=True)
    }
    state, expected = replace(setup.state, values=setup.state.values | values), corrected(setup, *off).stream
    np.testing.assert_allclose(true_rings(setup.stream, state).xyz, expected.xyz, rtol=0, atol=2e-6)
    high = np.flatnonzero(setup.stream.xyz[:, 2] > 0.0)
    np.testing.assert_allclose(
        true_rings(setup.stream.numbered(high), state).xyz, expected.xyz[high], rtol=0, atol=2e-6
    )


def test_a_point_on_the_axis_has_no_azimuth(sparse_room, room_of):
    """It was nan, and refused the recording."""
    setup = room_of(sparse_room, rings=True)
    xyz = setup.stream.xyz.copy()
    xyz[0] = [0.0, 0.0, 2.0]
    stream = replace(setup.stream, xyz=xyz)
    setup = replace(setup, sim=replace(setup.sim, measurements=setup.sim.measurements.with_streams(stream)))
    rings = setup.factor(setup.state, LidarNoise(0.1)).moments.rings
    assert rings.any() and np.isfinite(rings).all()
    values = {("lidar0", x): np.full(16, 1e-3) for x in RINGS}
    state = replace(setup.state, values=setup.state.values | values)
    np.testing.assert_allclose(true_rings(stream, state).xyz[0], [0.0, 0.0, 1.999], atol=1e-5)


def rings_of_points(setup):
    """(N,) band of each point, of 16: 8 rings are in the nearest one."""
    x, y, z = setup.stream.xyz.astype(np.float64).T
    _, ring = np.unique(np.round(np.rad2deg(np.arctan2(z, np.hypot(x, y)))), return_inverse=True)
    return np.array([0, 2, 4, 6, 9, 11, 13, 15])[ring]


def corrected(setup, turn, too_far, about):
    """The setup with points turned up by `turn` (16,) and about z by `about` (16,), and nearer by `too_far` (16,), the
    errors of their rings."""
    x, y, z = setup.stream.xyz.astype(np.float64).T
    ring = rings_of_points(setup)
    level, elevation = np.arctan2(y, x) + about[ring], np.arctan2(z, np.hypot(x, y)) + turn[ring]
    r = np.linalg.norm([x, y, z], axis=0) - too_far[ring]
    xyz = r * np.array([np.cos(elevation) * np.cos(level), np.cos(elevation) * np.sin(level), np.sin(elevation)])
    stream = replace(setup.stream, xyz=xyz.T.astype(np.float32))
    return replace(setup, sim=replace(setup.sim, measurements=setup.sim.measurements.with_streams(stream)))


def brisk(robot_scenario):
    """One point in each millisecond, anywhere in it; 2 rad/s and 8 m/s^2 at times."""
    scenario = robot_scenario(4.0, noiseless=True)
    simulation = simulate(scenario, seed=0)
    stream = simulation.measurements.lidars[0]
    rng = np.random.default_rng(1)
    at = np.floor(stream.offset_s.astype(np.float64) / 1e-3) + 1000 * np.repeat(
        np.arange(len(stream.stamps_ns)), np.diff(stream.start)
    )
    order = rng.permutation(len(at))
    keep = np.sort(order[np.unique(at[order], return_index=True)[1]])
    start = np.searchsorted(keep, stream.start)
    few = replace(stream, start=start, xyz=stream.xyz[keep], offset_s=stream.offset_s[keep], plane=stream.plane[keep])
    return replace(simulation, measurements=simulation.measurements.with_streams(few))


def test_points_move_to_the_centre_of_their_bin_as_the_sensor_moved(robot_scenario, room_of):
    setup = room_of(brisk(robot_scenario))
    moments = moments_of(setup, LidarNoise(1.0))
    assert (moments.count == 1).all()
    xyz = moments.root[:, [1, 3, 6]] / moments.root[:, :1]
    centre, _ = poses_of_points(setup, setup.state, moments.seconds)
    found, _ = world_points(setup, setup.state, centre, xyz)
    own, _ = poses_of_points(setup, setup.state, point_times(setup))
    exact = world_points(setup, setup.state, own, setup.stream.xyz.astype(np.float64))[0][setup.plane >= 0]
    still = world_points(setup, setup.state, centre, setup.stream.xyz[setup.plane >= 0].astype(np.float64))[0]
    assert np.linalg.norm(own.rate, axis=1).max() > np.deg2rad(60.0)
    assert np.linalg.norm(still - exact, axis=1).max() > 2e-3
    assert np.linalg.norm(found - exact, axis=1).max() < 1e-5


def test_points_of_a_bin_of_several_steps_move_to_its_centre(robot_scenario, room_of):
    """The mean of each bin's points on each plane is in the world where these were seen."""
    setup = room_of(brisk(robot_scenario))
    moments = moments_of(setup, LidarNoise(1.0), bin_s=5e-3)
    assert moments.count.max() > 3
    centre, _ = poses_of_points(setup, setup.state, np.repeat(moments.seconds, np.diff(moments.start)))
    mean = moments.root[:, [1, 3, 6]] / moments.root[:, :1]
    found, _ = world_points(setup, setup.state, centre, mean)
    used = np.flatnonzero(setup.plane >= 0)
    own, _ = poses_of_points(setup, setup.state, point_times(setup)[used])
    exact, _ = world_points(setup, setup.state, own, setup.stream.xyz[used].astype(np.float64))
    scan = np.repeat(np.arange(len(setup.stream.stamps_ns)), np.diff(setup.stream.start))[used]
    bin_of = np.floor(setup.stream.offset_s[used].astype(np.float64) / 5e-3)
    _, entry = np.unique(np.stack([scan, bin_of, setup.plane[used]]), axis=1, return_inverse=True)
    expected = np.stack([np.bincount(entry, x) for x in exact.T], axis=1) / np.bincount(entry)[:, None]
    np.testing.assert_allclose(found, expected, rtol=0, atol=1e-5)


def test_points_in_the_world_are_where_each_was_seen(robot_scenario, room_of):
    setup = room_of(brisk(robot_scenario))
    points, seen_from = in_world(setup.motion(setup.state), setup.stream)
    poses, _ = poses_of_points(setup, setup.state, point_times(setup))
    exact, _ = world_points(setup, setup.state, poses, setup.stream.xyz.astype(np.float64))
    sensor, _ = world_points(setup, setup.state, poses, np.zeros(setup.stream.xyz.shape))
    assert np.linalg.norm(points - exact, axis=1).max() < 2e-5
    assert np.linalg.norm(seen_from - sensor, axis=1).max() < 5e-6


def test_a_point_beyond_its_plane_has_a_positive_residual(sparse_room, room_of, dense):
    setup = room_of(sparse_room, spacing=0.05)
    before, after = setup.state, dict(setup.state.values)
    for key in setup.planes:
        after[key] = moved(after[key], np.array([0.0, 0.0, -0.1]))
    factor = setup.factor(before)
    _, _, g, _ = sums(setup, factor, replace(before, values=after), dense)
    distance = [KEYFRAME_DIM * factor.n_keyframes + setup.layout.columns(*key)[2] for key in setup.planes]
    # Predicted - measured is then +0.1 m, and moving the plane along its normal lowers it.
    count = np.bincount(factor.moments.plane, factor.moments.count)
    np.testing.assert_allclose(g[distance] / count * 0.03**2, -0.1, atol=0.01)


def test_points_without_a_plane_or_without_imu_are_left_out(sparse_room, room_of):
    setup = room_of(sparse_room)
    noise = LidarNoise(0.03)
    whole = moments_of(setup, noise)
    assert whole.count.sum() == (setup.plane >= 0).sum()
    some = np.where(np.arange(len(setup.plane)) % 3 == 0, np.int32(-1), setup.plane)
    assert moments_of(setup, noise, plane=some).count.sum() == (some >= 0).sum()
    late = setup.state.values | {("lidar0", "time_offset"): np.array([0.4])}
    beyond = moments_of(setup, noise, state=replace(setup.state, values=late))
    assert beyond.count.sum() < whole.count.sum()
    assert (beyond.seconds + 0.4).max() <= setup.imu.seconds[-1]
    never = setup.state.values | {("lidar0", "time_offset"): np.array([100.0])}
    with pytest.raises(EstimationError, match="lidar0.*time_offset"):
        moments_of(setup, noise, state=replace(setup.state, values=never))


def with_stream(setup, stream, plane=None):
    measurements = setup.sim.measurements.with_streams(stream)
    return replace(
        setup, sim=replace(setup.sim, measurements=measurements), plane=setup.plane if plane is None else plane
    )


def test_stamps_at_the_end_of_scans_and_points_in_any_order_change_nothing(sparse_room, room_of, dense):
    setup = room_of(sparse_room, spacing=0.05)
    stream, rng = setup.stream, np.random.default_rng(0)
    ends = zip(stream.start[:-1], stream.start[1:], strict=True)
    order = np.concatenate([rng.permutation(np.arange(a, b)) for a, b in ends])
    offset = (stream.offset_s.astype(np.float64) - 0.125).astype(np.float32)
    ended = with_stream(setup, replace(stream, xyz=stream.xyz[order], offset_s=offset[order]), setup.plane[order])
    later = setup.state.values | {("lidar0", "time_offset"): setup.state.values["lidar0", "time_offset"] + 0.125}
    state = replace(setup.state, values=later)
    found: Any = sums(ended, ended.factor(state), state, dense)
    expected: Any = sums(setup, setup.factor(), setup.state, dense)
    # Points at the edge of bins of 3 ms change theirs, and perhaps the keyframe; the calibration parameters are the
    # same.
    H, H_expected = (
        h[KEYFRAME_DIM * len(state.seconds) :, KEYFRAME_DIM * len(state.seconds) :] for h in (found[1], expected[1])
    )
    size = np.sqrt(np.diag(H_expected))
    np.testing.assert_allclose(H / np.outer(size, size), H_expected / np.outer(size, size), atol=3e-4)
    assert found[0] == pytest.approx(expected[0], rel=1e-4)


def test_scans_that_overlap_in_time_are_sorted(sparse_room, room_of, dense):
    setup = room_of(sparse_room, spacing=0.05)
    stream = setup.stream
    early = replace(stream, stamps_ns=stream.stamps_ns - np.arange(len(stream.stamps_ns)) * 60_000_000)
    factor = with_stream(setup, early).factor()
    assert (np.diff(factor.moments.seconds) >= 0.0).all()
    assert (np.diff(factor.keyframe) >= 0).all()
    assert factor.moments.count.sum() == (setup.plane >= 0).sum()
    _, H, _, _ = sums(setup, factor, setup.state, dense)
    assert np.isfinite(H).all()


def test_rows_count_and_weigh_as_their_points(sparse_room, room_of):
    setup = room_of(sparse_room, spacing=0.05)
    factor = setup.factor(noise=LidarNoise(0.03))
    out = factor.output()
    for piece in make_pieces(factor.n_keyframes, setup.layout.size):
        factor.accumulate(setup.state, piece, out, sums=False)
    r = pointwise(setup, setup.state).r
    assert factor.count(out, "points") == len(r) == (setup.plane >= 0).sum()
    assert weighted_squares(out, factor.kinds["points"]) == pytest.approx(((r / 0.03) ** 2).sum(), rel=1e-3)
    assert factor.rms(out, "points") == (pytest.approx(np.sqrt(np.mean(r**2)), rel=1e-3), "m")
