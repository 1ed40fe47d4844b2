"""Images of a room: surfaces where they truly are, what hides what, no aliasing, and what goes wrong with images."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from tests.cases import each

from icalib.errors import RigError
from icalib.tools.simulation import (
    Drive,
    ImageFaults,
    Imaging,
    Obstacle,
    Room,
    Scenario,
    SimCamera,
    Texture,
    film,
    hills_of_slope,
)
from icalib.tools.simulation.filming import Interior, RoomRenderer
from icalib.tools.simulation.projection import project
from icalib.tools.simulation.rendering import pixel_kernel, shrink, unproject
from icalib.tools.simulation.room import atlas_of, dead_leaves, distances
from icalib.tools.simulation.scenario import faults_of

from .conftest import DISTORTED

TEXEL_M = 0.004
SIZE = (4.0, 3.0, 2.5)
BLOCKS = (Obstacle((0.9, 0.6), (0.5, 0.4, 1.2), 0.4), Obstacle((0.6, -0.4), (0.8, 0.6, 0.7), -0.3, ramp=True))
WHITE = Imaging(white=1.0, black=0.0, background=0.5, blur_px=0.8)


def looking(eye: np.ndarray, at: np.ndarray, roll: float) -> np.ndarray:
    """T_world_cam (4, 4), its z axis towards a point."""
    z = (at - eye) / np.linalg.norm(at - eye)
    x = np.cross(z, [np.sin(roll), 0.3, np.cos(roll)])
    x /= np.linalg.norm(x)
    T = np.eye(4)
    T[:3, :3], T[:3, 3] = np.stack([x, np.cross(z, x), z], axis=1), eye
    return T


def sides(room: Room) -> list[tuple[int, int]]:
    """Texels (along, across) of each face."""
    lengths = np.linalg.norm(room.faces[:, 1:3], axis=2)
    return [tuple(np.ceil(length / TEXEL_M).astype(int)) for length in lengths]


def spot_centre(room: Room, face: int, st: np.ndarray, camera: SimCamera, T: np.ndarray, sigma: float) -> np.ndarray:
    """(2,) px: centroid of the image of a Gaussian spot on a face, summed over the surface."""
    origin, u, v, _ = room.faces[face]
    step = np.linspace(-4.0 * sigma, 4.0 * sigma, 161)
    a, b = np.meshgrid(step, step, indexing="ij")
    points = (
        origin + st[0] * u + st[1] * v + a[..., None] * u / np.linalg.norm(u) + b[..., None] * v / np.linalg.norm(v)
    )
    uv = project(camera, (points - T[:3, 3]) @ T[:3, :3])
    by_a, by_b = np.gradient(uv, axis=0), np.gradient(uv, axis=1)
    area = np.abs(by_a[..., 0] * by_b[..., 1] - by_a[..., 1] * by_b[..., 0])
    weight = area * np.exp(-0.5 * (a**2 + b**2) / sigma**2)
    return np.einsum("ij,ijk->k", weight, uv) / weight.sum()


def seen_by_brute_force(room: Room, rays: np.ndarray, eye: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Of rays (N, 3): the face that each meets first, -1 the hills, and (s, t) on it, by solving for every face."""
    best, face, st = np.full(len(rays), np.inf), np.full(len(rays), -2), np.zeros((len(rays), 2))
    for f, (origin, u, v, mark) in enumerate(room.faces):
        columns = np.stack(np.broadcast_arrays(-rays, u, v), axis=2)
        solved = np.linalg.solve(columns, (eye - origin)[None, :, None])[..., 0]
        t, a, b = solved.T
        inside = (a >= 0) & (b >= 0) & ((a + b <= 1) if mark[0] else (a <= 1) & (b <= 1))
        hit = (t > 0) & inside & (rays @ np.cross(u, v) < 0) & (t < best)
        best[hit], face[hit], st[hit] = t[hit], f, solved[hit, 1:]
    if room.hills:
        far = np.empty(len(rays))
        distances(room.surfaces, np.broadcast_to(eye, rays.shape), rays, far)
        face[far < best - 1e-9] = -1
    return face, st


def eye_before(room: Room, face: int, spot: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """(3,) in the room, some 0.7 m before a face, from where nothing hides what is around the spot."""
    u, v = (edge / np.linalg.norm(edge) for edge in room.faces[face, 1:3])
    around = spot + rng.uniform(-0.06, 0.06, (50, 1)) * u + rng.uniform(-0.06, 0.06, (50, 1)) * v
    while True:
        eye = spot + (0.6 * room.planes[face, :3] + rng.uniform(-0.5, 0.5, 3)) * rng.uniform(0.8, 1.2)
        inside = (np.abs(eye[:2]) < [1.9, 1.4]).all() and 0.1 < eye[2] < 2.4
        if inside and (seen_by_brute_force(room, around - eye, eye)[0] == face).all():
            return eye


@each("camera", DISTORTED[:1], full=DISTORTED[1:])
def test_marks_of_the_texture_are_where_their_surface_is(camera: SimCamera):
    """A spot on each face of a dark room, seen from all sides: its centroid, by the simulator's own projection."""
    room, sigma, rng = Room(SIZE, BLOCKS), 0.016, np.random.default_rng(5)
    for face in range(len(room.faces)):
        canvases = [np.zeros(side[::-1], dtype=np.float32) for side in sides(room)]
        along, across = np.linalg.norm(room.faces[face, 1:3], axis=1)
        st = rng.uniform(0.3, 0.4, 2)
        x, y = ((np.arange(n) + 0.5) / n for n in sides(room)[face])
        square = ((x - st[0]) * along) ** 2 + ((y[:, None] - st[1]) * across) ** 2
        canvases[face] = np.exp(-0.5 * square / sigma**2)
        spot = room.faces[face, 0] + st @ room.faces[face, 1:3]
        eye = eye_before(room, face, spot, rng)
        T = looking(eye, spot + rng.uniform(-0.1, 0.1, 3), rng.uniform(-1.0, 1.0))
        grey = RoomRenderer(camera, WHITE).grey(Interior(room, atlas=atlas_of(canvases)).view(), T, 1.0, None)
        centre = np.array([grey.sum(axis=0) @ np.arange(160), grey.sum(axis=1) @ np.arange(120)]) / grey.sum()
        np.testing.assert_allclose(centre, spot_centre(room, face, st, camera, T, sigma), atol=0.01, err_msg=f"{face}")


@pytest.mark.parametrize("hills", [None, hills_of_slope(25.0)])
def test_what_is_nearer_hides_what_is_behind_it_in_every_cell(hills):
    """Faces of one grey each: pixels are the means of what four rays meet."""
    room, camera = Room(SIZE, BLOCKS, hills), DISTORTED[1]
    greys = np.linspace(0.0, 1.0, len(room.faces) + bool(hills))
    interior = Interior(room, atlas=atlas_of([np.full((40, 30), g, dtype=np.float32) for g in greys]))
    for seed in range(3):
        rng = np.random.default_rng(seed)
        T = looking(np.array([-1.0, 0.2, 0.5]) + rng.uniform(-0.2, 0.2, 3), np.array([0.9, 0.0, 0.3]), 0.1 * seed)
        grey = RoomRenderer(camera, replace(WHITE, blur_px=0.0)).grey(interior.view(), T, 1.0, None)
        u, v = np.meshgrid(np.arange(320) / 2 - 0.25, np.arange(240) / 2 - 0.25)
        rays = unproject(camera, np.stack([u, v], axis=-1)).reshape(-1, 3) @ T[:3, :3].T
        face, _ = seen_by_brute_force(room, rays, T[:3, 3])
        assert len(np.unique(face)) > 7
        fine = greys[face].reshape(120, 2, 160, 2)
        np.testing.assert_allclose(grey, fine.mean(axis=(1, 3)), atol=1e-4)


def test_surfaces_do_not_alias():
    """As by 64 rays a pixel on the finest texture: no shift of the pattern, and little difference."""
    room = Room(SIZE, BLOCKS)
    canvases = [
        dead_leaves((n * 0.001, m * 0.001), 0.001, Texture(share=1.0), k) for k, (n, m) in enumerate(sides(room))
    ]
    camera = replace(DISTORTED[0], resolution=(96, 72), intrinsics=(48.0, 48.0, 47.5, 35.5))
    T = looking(np.array([-1.8, -1.2, 0.8]), np.array([1.9, 1.0, 0.9]), 0.2)
    grey = RoomRenderer(camera, WHITE).grey(Interior(room, atlas=atlas_of(canvases)).view(), T, 1.0, None)
    fine, pad = 8, 4
    u, v = ((np.arange((n + 2 * pad) * fine) + 0.5) / fine - 0.5 - pad for n in camera.resolution)
    rays = unproject(camera, np.stack(np.meshgrid(u, v), axis=-1)).reshape(-1, 3) @ T[:3, :3].T
    face, st = seen_by_brute_force(room, rays, T[:3, 3])
    shades = np.empty(len(rays), dtype=np.float32)
    for f, canvas in enumerate(canvases):
        own = face == f
        j, i = (st[own, ::-1] * canvas.shape).astype(int).T
        shades[own] = canvas[np.minimum(j, canvas.shape[0] - 1), np.minimum(i, canvas.shape[1] - 1)]
    true = np.empty(grey.shape)
    shrink(shades.reshape(len(v), len(u)), pixel_kernel(0.8, fine, pad), fine, true)
    by_v, by_u = (g[4:-4, 4:-4].ravel() for g in np.gradient(true))
    error = (grey - true)[4:-4, 4:-4].ravel()
    shift = np.linalg.lstsq(np.column_stack([by_u, by_v]), error, rcond=None)[0]
    assert np.abs(shift).max() < 0.01 and error.std() < 0.06 * true.std()


def test_an_exposure_takes_each_cell_at_its_own_instant():
    """The centroid of a spot is the mean over the poses."""
    room, camera, st, sigma = Room(SIZE), DISTORTED[0], np.array([0.5, 0.5]), 0.02
    canvases = [np.zeros(side[::-1], dtype=np.float32) for side in sides(room)]
    x, y = ((np.arange(n) + 0.5) / n - 0.5 for n in sides(room)[0])
    canvases[0] = np.exp(-0.5 * ((x * SIZE[0]) ** 2 + (y[:, None] * SIZE[1]) ** 2) / sigma**2)
    poses = np.stack(
        [looking(np.array([0.2 + d, 0.1, 1.4]), np.array([0.1, d, 0.0]), 0.1) for d in 0.02 * np.arange(4)]
    )
    grey = RoomRenderer(camera, WHITE).grey(Interior(room, atlas=atlas_of(canvases)).view(), poses, 1.0, None)
    centre = np.array([grey.sum(axis=0) @ np.arange(160), grey.sum(axis=1) @ np.arange(120)]) / grey.sum()
    expected = np.mean([spot_centre(room, 0, st, camera, T, sigma) for T in poses], axis=0)
    assert np.linalg.norm(np.diff([spot_centre(room, 0, st, camera, T, sigma) for T in poses[::3]], axis=0)) > 2.0
    np.testing.assert_allclose(centre, expected, atol=0.02)


def test_textures_repeat_with_their_seed_and_have_plain_regions():
    size = (3.2, 3.2)
    one, same, other = (dead_leaves(size, 0.01, Texture(seed), 3) for seed in (1, 1, 2))
    assert one.shape == (320, 320) and np.array_equal(one, same) and not np.array_equal(one, other)
    assert np.ptp(dead_leaves(size, 0.01, Texture(share=0.0), 0)) == 0.0
    crowded = dead_leaves((16.0, 16.0), 0.01, Texture(contrast=0.5), 0)
    assert 0.1 < (crowded == crowded[0, 0]).mean() < 0.9 and crowded.min() >= 0.25 and crowded.max() <= 0.75


@pytest.fixture(scope="module")
def scenario() -> Scenario:
    axes = np.array([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]])
    T = np.eye(4)
    T[:3, :3] = axes
    camera = replace(DISTORTED[0], T_imu_sensor=T, rate_hz=10.0)
    room = Room((6.0, 5.0, 2.5), texture=Texture(share=1.0))
    return Scenario((camera,), duration_s=2.0, motion=Drive("free"), board=False, room=room)


def images(scenario: Scenario, **faults) -> np.ndarray:
    shots = film(replace(scenario, image_faults=ImageFaults(**faults)), 4, Imaging(blur_px=0.5)).shots()
    return np.array([shot.pixels for shot in shots], dtype=float)


def test_what_goes_wrong_with_images(scenario: Scenario):
    plain = images(scenario)
    assert len(plain) == 20 and plain.std(axis=(1, 2)).min() > 15.0  # each shows something
    covered = (np.abs(images(scenario, people=2) - plain) > 2.0).mean(axis=(1, 2))
    assert 0.1 < covered.mean() < 0.35 and np.ptp(covered) > 0.01
    darker = images(scenario, gain_steps=((0.9, 0.5), (1.5, 1.0)))
    np.testing.assert_allclose(
        darker.mean(axis=(1, 2)) / plain.mean(axis=(1, 2)), [1.0] * 9 + [0.5] * 6 + [1.0] * 5, rtol=0.01
    )
    frozen = images(scenario, frozen=((0.5, 0.72),))
    np.testing.assert_array_equal(frozen[[5, 6]], plain[[4, 4]])
    np.testing.assert_array_equal(frozen[[4, 7]], plain[[4, 7]])
    part = images(scenario, robot_part=0.2)
    assert np.ptp(part[:, 108:], axis=0).max() == 0.0 and part[0, 108:].std() > 5.0
    np.testing.assert_array_equal(part[:, :88], plain[:, :88])
    dirty = images(scenario, dirt=3) / plain
    share = faults_of(ImageFaults(dirt=3), (160, 120), 0).share
    assert share is not None and share.min() < 0.7
    np.testing.assert_allclose(np.median(dirty, axis=0), share, atol=0.03)


def test_nothing_to_film_is_said():
    with pytest.raises(RigError, match="give the scenario a target or a room"):
        film(Scenario((DISTORTED[0],), board=False), 0)
