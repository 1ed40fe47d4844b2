"""Which points of the scene are taken to lie on planes of the LiDARs."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from icalib.motion.point_planes import PlaneAssociation
from icalib.optim.arrowhead import make_pieces
from icalib.sensors.camera.track_surfaces import CELL_M, MAX_PLANE_DISTANCE_M, PATCH_M, Surfaces, most_alike
from icalib.sensors.lidar.binning import points_on_planes
from icalib.tools.simulation import handheld, simulate

NOISE = 0.01
CERTAIN = np.eye(3) * 1e6  # information: to a millimetre


@pytest.fixture(scope="module")
def room(room_of, sparse_room):
    return room_of(sparse_room)


@pytest.fixture(scope="module")
def surfaces(room) -> Surfaces:
    recording = np.zeros(len(room.planes), dtype=np.int64)
    planes = np.array([room.state.values[key] for key in room.planes])
    clouds = [points_on_planes(room.motion(room.state), room.stream, room.plane)]
    return Surfaces.of_clouds(room.planes, recording, planes, clouds, NOISE, False)


@pytest.fixture(scope="module")
def seen(room) -> tuple[np.ndarray, np.ndarray]:
    """What the LiDAR saw of the planes, on them (n, 3), and of which (n,)."""
    own = np.flatnonzero(room.plane >= 0)
    _, on_plane = projected(room, own)
    return on_plane, room.plane[own]


def projected(room, own):
    """Points of the LiDAR in the world at the truth, and moved onto their planes."""
    stream = room.stream
    scan = np.searchsorted(stream.start, own, side="right") - 1
    offset = room.state.values[stream.name, "time_offset"][0]
    seconds = stream.seconds[scan] + stream.offset_s[own] + offset
    R, p, _ = room.sim.truth.pose_at(seconds + room.sim.truth.seconds[0])
    T = room.sim.truth.T_imu_sensor[stream.name]
    world = np.einsum("nij,nj->ni", R, stream.xyz[own] @ T[:3, :3].T + T[:3, 3]) + p
    plane = np.array([room.state.values[room.planes[k]] for k in room.plane[own]])
    off = np.einsum("na,na->n", plane[:, :3], world - plane[:, 3:])
    return world, world - off[:, None] * plane[:, :3]


def certain(n: int, information: np.ndarray = CERTAIN) -> tuple[np.ndarray, np.ndarray]:
    """The same of n points; all of the first recording."""
    return np.broadcast_to(information, (n, 3, 3)), np.zeros(n, dtype=np.int64)


def under(surfaces: Surfaces, points: np.ndarray, information: np.ndarray = CERTAIN) -> np.ndarray:
    return surfaces.under(points, *certain(len(points), information)).plane


def test_points_on_planes_are_found_but_for_those_at_edges(surfaces, seen):
    points, plane = seen
    found = under(surfaces, points)
    assert (found[found >= 0] == plane[found >= 0]).all()
    assert (found >= 0).mean() > 0.9


def test_points_that_are_all_off_by_as_much_are_found(surfaces, seen):
    """Cameras may stand that far from the LiDAR until the points tell."""
    points, plane = seen
    found = under(surfaces, points + [0.0, 0.0, 0.15])
    assert (found[found >= 0] == plane[found >= 0]).all()
    level = np.abs(surfaces.plane[plane, 2]) > 0.99
    assert (found[level] >= 0).mean() > 0.8


def test_points_that_are_anywhere_lie_on_nothing(surfaces, seen):
    rng, (points, _) = np.random.default_rng(2), seen
    scattered = points + rng.uniform(-MAX_PLANE_DISTANCE_M, MAX_PLANE_DISTANCE_M, points.shape)
    assert (under(surfaces, scattered) >= 0).mean() < 0.02


def test_points_beyond_what_the_lidar_saw_lie_on_nothing(surfaces, seen):
    points, plane = seen
    k = np.bincount(plane).argmax()
    along = np.linalg.svd(surfaces.plane[k, None, :3])[2][1]
    away = points[plane == k] + 60.0 * along
    assert np.abs((away - surfaces.plane[k, 3:]) @ surfaces.plane[k, :3]).max() < 1e-9
    assert (under(surfaces, away) == -1).all()
    beside = points[plane == k] + 0.5 * CELL_M * along
    assert (under(surfaces, beside) == k).mean() > 0.9


def test_vague_points_and_those_of_another_recording_lie_on_nothing(surfaces, seen):
    points, _ = seen
    assert (under(surfaces, points, np.eye(3) * 50.0) == -1).all()
    other = replace(surfaces, recording=np.ones(len(surfaces.keys), dtype=np.int64))
    assert (under(other, points) == -1).all()


def test_most_alike_is_where_most_are():
    rng = np.random.default_rng(0)
    off = np.concatenate([0.2 + 0.01 * rng.standard_normal(60), rng.uniform(-0.5, 0.5, 40)])
    alike = most_alike(off, np.full(100, 0.01))
    assert alike[:60].mean() > 0.95 and np.abs(off[alike] - 0.2).max() < 0.05
    assert not most_alike(off[::4], np.full(25, 0.01)).any()  # too few
    assert not most_alike(rng.uniform(-0.5, 0.5, 1000), np.full(1000, 0.01)).any()  # too small a share


def test_points_of_one_patch_together_weigh_as_one(surfaces, seen):
    """A bump is there however often it is looked at."""
    points, _ = seen
    once = surfaces.under(points, *certain(len(points)))
    thrice = surfaces.under(np.tile(points, (3, 1)), *certain(3 * len(points)))
    np.testing.assert_array_equal(np.tile(once.plane, 3), thrice.plane)
    on = once.plane >= 0
    np.testing.assert_allclose((thrice.sigma[: len(on)] / once.sigma)[on], np.sqrt(3.0))
    middle = np.floor(points[on].mean(axis=0))
    patches = len(np.unique(np.floor((points[on] - middle) / PATCH_M), axis=0))
    assert 0.3 * patches < NOISE**2 * (once.sigma[on] ** -2).sum() < 2.0 * patches


def test_planes_know_their_recording():
    assert PlaneAssociation(("plane 0", "plane 12"), ()).recording.tolist() == [0, 0]
    assert PlaneAssociation(("plane 1.3", "plane 2.0", "plane 12.4"), ()).recording.tolist() == [0, 1, 11]


def test_a_plane_pulls_its_points_towards_it(setup_of, features_on_planes):
    """The more, the less they may be off, and none that lie on none."""
    setup, factor = features_on_planes(setup_of(simulate(handheld(1.5), seed=4)), noise_px=0.5)

    def distance(sigma: float) -> np.ndarray:
        own = replace(factor, on=factor.on._replace(sigma=np.full(factor.tracks.count, sigma)))
        out = own.output()
        for piece in make_pieces(factor.n_keyframes, None):
            own.accumulate(setup.state, piece, out, sums=False)
        return np.where(factor.on.plane == 0, np.abs(out.off.residual), 0.0)

    near, far = distance(1e-4), distance(10.0)
    own = factor.on.plane == 0
    assert near[own].max() < 1e-3 < 2e-3 < np.median(far[own])
    assert not near[~own].any()
