"""The room of a robot (walls, floor, ceiling, boxes, ramps, hills), and intersections of rays with it.

World frame: z up, the origin in the middle of the floor.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from itertools import product
from typing import NamedTuple

import numpy as np

from icalib.base.compiled import njit
from icalib.errors import RigError

# Textures of a room's surfaces: patches of all sizes, and plain regions between them.
#
# The patches are a dead leaves model (Lee, Mumford, Huang 2001): rectangles and ellipses that occlude one another.
# Their number density falls with the cube of their size, so that every octave covers the same area. Each texture is
# stored as a mipmap, a pyramid of averages over 2 x 2 texels (Williams 1983).

_TEXEL_M = 0.004  # smallest texel: 1.8 px from 1 m at a focal length of 460 px
_MOST_TEXELS = 40_000_000  # of all surfaces together, 110 MB with their pyramids; texels of larger rooms are larger
_PANEL_M = 1.6  # side of the regions, each with patches or plain
_RADII_M = (0.012, 0.3)  # range of half the longer side of a patch
_COVER = (0.1, 1.5)  # range of the total area of patches in a region, relative to the region's area
_FULL = 65535.0  # a texel's value for white


@dataclass(frozen=True)
class Texture:
    """Settings of the textures. share: fraction of the regions (1.6 m wide) with patches; 0: all are plain. contrast:
    of patches and surfaces; 1: from black to white. seed: of the random textures."""

    seed: int = 0
    share: float = 0.65
    contrast: float = 1.0


class Atlas(NamedTuple):
    """Mipmaps of T surfaces in one array. Texel (i, j) of level l covers the texels 2^l i to 2^l (i + 1) of level 0
    along the surface's first edge; likewise j along its second edge. Its index is first + j width + i. Values are 0
    (black) to 65535 (white).
    """

    texels: np.ndarray  # uint16
    first: np.ndarray  # (T, levels)
    width: np.ndarray  # (T, levels)
    height: np.ndarray  # (T, levels)


def texel_size(area_m2: float) -> float:
    """Width of a texel [m] for surfaces of this total area."""
    return max(_TEXEL_M, float(np.sqrt(area_m2 / _MOST_TEXELS)))


def dead_leaves(size: tuple[float, float], texel_m: float, texture: Texture, number: int) -> np.ndarray:
    """Texture (height, width) float32, 0 to 1, by the dead leaves model, of a surface of `size` (width, height) m.
    number: of the surface, for its random numbers."""
    rng = np.random.default_rng([texture.seed, number])
    shape = tuple(max(int(np.ceil(side / texel_m)), 1) for side in size)
    canvas = np.full(shape[::-1], 0.5 + texture.contrast * rng.uniform(-0.25, 0.25), dtype=np.float32)
    panels = [max(round(side / _PANEL_M), 1) for side in size]
    (sparse, crowded), (small, large) = _COVER, _RADII_M
    rough = rng.random(panels[0] * panels[1]) < texture.share
    cover = np.where(rough, np.exp(rng.uniform(np.log(sparse), np.log(crowded), len(rough))), 0.0)
    squares = 2.0 * small**2 * np.log(large / small) / (1.0 - (small / large) ** 2)  # mean of the radius squared
    panel = rng.permutation(np.repeat(np.arange(len(cover)), _counts(cover, size, 3.0 * squares)))
    count = len(panel)
    x = (panel % panels[0] + rng.random(count)) / panels[0] * shape[0]
    y = (panel // panels[0] + rng.random(count)) / panels[1] * shape[1]
    radius = small / np.sqrt(1.0 - rng.random(count) * (1.0 - (small / large) ** 2)) / texel_m
    angle = rng.choice([0.0, 1.0], count) * rng.uniform(-np.pi, np.pi, count)  # half of them upright
    grey = 0.5 + texture.contrast * rng.uniform(-0.5, 0.5, count)
    _paint(
        np.column_stack([x, y, radius, radius * rng.uniform(0.5, 1.0, count), np.cos(angle), np.sin(angle), grey]),
        rng.random(count) < 0.3,
        canvas,
    )
    return canvas


def _counts(cover: np.ndarray, size: tuple[float, float], area_m2: float) -> np.ndarray:
    """Number of patches in each region of a surface. cover: area of patches over that of the region; size: of the
    surface (width, height) m; area_m2: mean area of a patch."""
    return np.rint(cover * size[0] * size[1] / (len(cover) * area_m2)).astype(np.int64)


@njit(cache=True, nogil=True, error_model="numpy")
def _paint(patches, rounded, canvas):
    """Paints patches (n, 7) on the canvas, later ones over earlier ones: x, y, half axes a, b [texels], cosine and sine
    of the angle, grey. rounded (n,): ellipses instead of rectangles. Edges are one texel wide."""
    for k in range(len(patches)):
        x, y, a, b, c, s, grey = patches[k]
        reach_x, reach_y = abs(a * c) + abs(b * s) + 1.0, abs(a * s) + abs(b * c) + 1.0
        for j in range(max(int(y - reach_y), 0), min(int(y + reach_y) + 1, canvas.shape[0])):
            for i in range(max(int(x - reach_x), 0), min(int(x + reach_x) + 1, canvas.shape[1])):
                dx, dy = i + 0.5 - x, j + 0.5 - y
                along, across = abs(c * dx + s * dy), abs(c * dy - s * dx)
                if rounded[k]:
                    inside = b * (1.0 - np.sqrt((along / a) ** 2 + (across / b) ** 2))
                else:
                    inside = min(a - along, b - across)
                share = min(max(inside + 0.5, 0.0), 1.0)
                canvas[j, i] += share * (grey - canvas[j, i])


def atlas_of(canvases: Sequence[np.ndarray]) -> Atlas:
    """The mipmaps of textures (height, width), 0 to 1, down to one texel."""
    levels = max(int(np.ceil(np.log2(max(canvas.shape)))) for canvas in canvases) + 1
    first, width, height = (np.zeros((len(canvases), levels), dtype=np.int64) for _ in range(3))
    stored: list[np.ndarray] = []
    filled = 0
    for k, canvas in enumerate(canvases):
        level = canvas
        for i in range(levels):
            if i:
                level = _halved(level)
            stored.append(np.rint(_FULL * level).astype(np.uint16).ravel())
            height[k, i], width[k, i] = level.shape
            first[k, i] = filled
            filled += level.size
    return Atlas(np.concatenate(stored), first, width, height)


def _halved(level: np.ndarray) -> np.ndarray:
    """Means over 2 x 2 texels; the last row or column is repeated if their number is odd."""
    even = np.pad(level, [(0, n % 2) for n in level.shape], mode="edge")
    return 0.25 * (even[::2, ::2] + even[1::2, ::2] + even[::2, 1::2] + even[1::2, 1::2])


_STEPS = 1000  # most steps of a ray over hills; a grazing ray that needs more meets nothing
_CLOSE_M = 1e-9  # height above the ground at which a ray has met it


@dataclass(frozen=True)
class Obstacle:
    """A box, or with `ramp` a wedge whose height rises from 0 to size z along its x axis. center (x, y) of its base
    [m], size (x, y, z) [m]; yaw_rad: rotation about the vertical."""

    center: tuple[float, float]
    size: tuple[float, float, float]
    yaw_rad: float = 0.0
    ramp: bool = False


@dataclass(frozen=True)
class Hills:
    """A floor z(x, y) = sum a_i sin(k_i . (x, y) + phase_i). amplitude (W,): a_i [m]; wave (W, 2): k_i [rad/m]; phase
    (W,) [rad]."""

    amplitude: tuple[float, ...]
    wave: tuple[tuple[float, float], ...]
    phase: tuple[float, ...]

    @property
    def depth(self) -> float:
        """Bound of the floor's height: |z| <= depth [m]."""
        return float(np.abs(self.amplitude).sum())

    @property
    def steepest(self) -> float:
        """Bound of the slope (tangent): that of all waves at the worst combination of their phases."""
        slopes = np.array(self.amplitude)[:, None] * np.array(self.wave)
        signs = np.array(list(product((-1.0, 1.0), repeat=len(slopes))))
        return float(np.linalg.norm(signs @ slopes, axis=1).max())

    def height(self, xy: np.ndarray) -> np.ndarray:
        """(N,) height z at xy (N, 2), all in m."""
        return np.sin(xy @ np.array(self.wave).T + self.phase) @ np.array(self.amplitude)


def hills_of_slope(slope_deg: float) -> Hills:
    """Hills of three waves of 6.3, 4.2 and 2.9 m in different directions, with slopes up to `slope_deg`."""
    waves, phases = ((0.97, 0.24), (-0.45, 1.43), (1.6, -1.45)), (0.3, 1.9, 4.0)
    shares = np.array([0.5, 0.35, 0.15]) / np.linalg.norm(waves, axis=1)
    scale = np.tan(np.deg2rad(slope_deg)) / Hills(tuple(shares), waves, phases).steepest
    return Hills(tuple((scale * shares).tolist()), waves, phases)


class RoomSurfaces(NamedTuple):
    """Surfaces for ray casting: F faces and W waves of `Hills`. Faces are parallelograms origin + s u + t v,
    0 <= s, t <= 1, or triangles (s + t <= 1), visible from the side of the normal."""

    plane: np.ndarray  # (F, 4) n, d: n . p = d
    along: np.ndarray  # (F, 4) a, a0: s = a . p - a0
    across: np.ndarray  # (F, 4) b, b0: t = b . p - b0
    triangle: np.ndarray  # (F,) bool
    amplitude: np.ndarray  # (W,), W = 0: no hills
    wave: np.ndarray  # (W, 2)
    phase: np.ndarray  # (W,)


@dataclass(frozen=True)
class Room:
    """A room. size (x, y, z) [m]; blocks: boxes and ramps; hills: replace the flat floor, walls and blocks then reach
    below them; texture: of all surfaces in images. Raises RigError if a block does not fit into the room."""

    size: tuple[float, float, float] = (12.0, 10.0, 3.2)
    blocks: tuple[Obstacle, ...] = ()
    hills: Hills | None = None
    texture: Texture = Texture()

    def __post_init__(self) -> None:
        half = np.array(self.size[:2]) / 2.0
        for i, block in enumerate(self.blocks):
            c, s = abs(np.cos(block.yaw_rad)), abs(np.sin(block.yaw_rad))
            reach = np.array([[c, s], [s, c]]) @ block.size[:2] / 2.0
            if (np.abs(block.center) + reach > half).any() or block.size[2] > self.size[2]:
                raise RigError(f"block {i} does not fit into the room; make it smaller, or move it inwards.")

    @property
    def base(self) -> float:
        """Height of the lower end of walls and blocks [m]."""
        return -self.hills.depth if self.hills else 0.0

    @cached_property
    def faces(self) -> np.ndarray:
        """(F, 4, 3): origin, edges u and v [m], and (1, 0, 0) for a triangle or zeros. u x v points to the visible
        side."""
        x, y, z = self.size
        low = np.array([-0.5 * x, -0.5 * y, self.base])
        ex, ey, ez = np.diag([x, y, z - self.base])
        flat = [] if self.hills else [(low, ex, ey)]
        shell = [(low + ez, ey, ex), (low, ey, ez), (low + ex, ez, ey), (low, ez, ex), (low + ey, ex, ez)]
        return np.concatenate([[(*face, np.zeros(3)) for face in flat + shell], self.faces_of(self.blocks)])

    @property
    def planes(self) -> np.ndarray:
        """(F, 4): normal n, towards the visible side, and d [m] of each face, on which n . p = d."""
        return _with_offset(_normals(self.faces), self.faces[:, 0])

    @cached_property
    def surfaces(self) -> RoomSurfaces:
        return self.surfaces_with(np.empty((0, 4, 3)))

    def surfaces_with(self, others: np.ndarray) -> RoomSurfaces:
        """Surfaces of the room and of further faces (n, 4, 3), in the form of `faces`."""
        faces = np.concatenate([self.faces, others])
        origin, u, v, mark = np.moveaxis(faces, 1, 0)
        normal = _normals(faces)
        area = np.sum(normal * np.cross(u, v), axis=1)[:, None]
        hills = self.hills or Hills((), (), ())
        return RoomSurfaces(
            _with_offset(normal, origin),
            _with_offset(np.cross(v, normal) / area, origin),
            _with_offset(np.cross(normal, u) / area, origin),
            mark[:, 0] > 0.0,
            np.array(hills.amplitude, dtype=np.float64),
            np.array(hills.wave, dtype=np.float64).reshape(-1, 2),
            np.array(hills.phase, dtype=np.float64),
        )

    def faces_of(self, blocks: Sequence[Obstacle]) -> np.ndarray:
        """(n, 4, 3) faces of blocks in the room, in the form of `faces`."""
        faces = [face for b in blocks for face in (_ramp if b.ramp else _box)(b, self.base)]
        return np.array(faces).reshape(-1, 4, 3)

    def points(self, count: int, rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
        """Random points (count, 3) m, uniform over the area of all surfaces, and normals (count, 3) of the surfaces.
        Hills have the area of a flat floor, and the normal (0, 0, 1)."""
        u, v, triangle = self.faces[:, 1], self.faces[:, 2], self.faces[:, 3, 0] > 0.0
        area = np.linalg.norm(np.cross(u, v), axis=1) * np.where(triangle, 0.5, 1.0)
        ground = self.size[0] * self.size[1] if self.hills else 0.0
        share = np.append(area, ground) / (area.sum() + ground)
        face = rng.choice(len(share), count, p=share)
        st = rng.random((count, 2))
        on_ground = face == len(area)
        face[on_ground] = 0
        st = np.where((triangle[face] & (st.sum(axis=1) > 1.0))[:, None], 1.0 - st, st)
        points = self.faces[face, 0] + st[:, :1] * u[face] + st[:, 1:] * v[face]
        if self.hills:
            xy = (rng.random((count, 2)) - 0.5) * self.size[:2]
            points[on_ground] = np.column_stack([xy, self.hills.height(xy)])[on_ground]
        return points, np.where(on_ground[:, None], [0.0, 0.0, 1.0], _normals(self.faces)[face])


def _normals(faces: np.ndarray) -> np.ndarray:
    normal = np.cross(faces[:, 1], faces[:, 2])
    return normal / np.linalg.norm(normal, axis=1, keepdims=True)


def _with_offset(directions: np.ndarray, origin: np.ndarray) -> np.ndarray:
    """(F, 4): directions (F, 3), each followed by its scalar product with the origin (F, 3)."""
    return np.column_stack([directions, np.sum(directions * origin, axis=1)])


Face = tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]


def _placed(block: Obstacle, base: float) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """A lower corner of a block (3,) m, and its edges along the block's x, y and z axes."""
    c, s = np.cos(block.yaw_rad), np.sin(block.yaw_rad)
    ex, ey = block.size[0] * np.array([c, s, 0.0]), block.size[1] * np.array([-s, c, 0.0])
    ez = np.array([0.0, 0.0, block.size[2] - base])
    return np.array([*block.center, base]) - 0.5 * (ex + ey), ex, ey, ez


def _box(block: Obstacle, base: float) -> list[Face]:
    low, ex, ey, ez = _placed(block, base)
    sides = [(low + ez, ex, ey), (low, ex, ez), (low + ey, ez, ex), (low, ez, ey), (low + ex, ey, ez)]
    return [(*side, np.zeros(3)) for side in sides]


def _ramp(block: Obstacle, base: float) -> list[Face]:
    low, ex, ey, ez = _placed(block, base)
    quad, triangle = np.zeros(3), np.array([1.0, 0.0, 0.0])
    return [
        (low, ex + ez, ey, quad),
        (low + ex, ey, ez, quad),
        (low + ex, ez, -ex, triangle),
        (low + ex + ey, -ex, ez, triangle),
    ]


@njit(cache=True, nogil=True, error_model="numpy")
def nearest(surfaces, px, py, pz, dx, dy, dz):
    """First intersection of the ray p + t d: t, and the number of the face, -1 for the hills. t is inf or NaN if the
    ray meets nothing."""
    best, hit = np.inf, -1
    plane, along, across = surfaces.plane, surfaces.along, surfaces.across
    for f in range(len(plane)):
        towards = plane[f, 0] * dx + plane[f, 1] * dy + plane[f, 2] * dz
        if towards >= 0.0:
            continue
        t = (plane[f, 3] - plane[f, 0] * px - plane[f, 1] * py - plane[f, 2] * pz) / towards
        if t <= 0.0 or t >= best:
            continue
        x, y, z = px + t * dx, py + t * dy, pz + t * dz
        u = along[f, 0] * x + along[f, 1] * y + along[f, 2] * z - along[f, 3]
        v = across[f, 0] * x + across[f, 1] * y + across[f, 2] * z - across[f, 3]
        if u >= 0.0 and v >= 0.0 and u <= 1.0 and v <= 1.0 and not (surfaces.triangle[f] and u + v > 1.0):
            best, hit = t, f
    if len(surfaces.amplitude):
        t = ground(surfaces, px, py, pz, dx, dy, dz, best)
        if not t >= best:
            return t, -1
    return best, hit


@njit(cache=True, nogil=True, error_model="numpy")
def ground(surfaces, px, py, pz, dx, dy, dz, limit):
    """t < limit at which the ray p + t d meets the hills, else inf; NaN if it takes too many steps.

    The second derivative of the height above the ground along the ray is at most `bend`. Each step ends where a
    parabola of this curvature would first meet the ground. It thus never passes through the ground, and converges like
    Newton's method. A ray that starts on the ground and leaves it does not meet it there.
    """
    bend, highest = 0.0, 0.0
    for w in range(len(surfaces.amplitude)):
        turn = surfaces.wave[w, 0] * dx + surfaces.wave[w, 1] * dy
        bend += abs(surfaces.amplitude[w]) * turn * turn
        highest += abs(surfaces.amplitude[w])
    t = max((highest - pz) / dz, 0.0) if dz < 0.0 else 0.0
    if (pz > highest and dz >= 0.0) or t >= limit:
        return np.inf
    for _ in range(_STEPS):
        gap, slope = pz + t * dz, dz
        for w in range(len(surfaces.amplitude)):
            kx, ky, amplitude = surfaces.wave[w, 0], surfaces.wave[w, 1], surfaces.amplitude[w]
            angle = kx * (px + t * dx) + ky * (py + t * dy) + surfaces.phase[w]
            gap -= amplitude * np.sin(angle)
            slope -= amplitude * np.cos(angle) * (kx * dx + ky * dy)
        if gap < _CLOSE_M and slope < 0.0:
            return t
        gap = max(gap, 0.0)
        root = np.sqrt(slope * slope + 2.0 * bend * gap)
        t += (slope + root) / bend if slope > 0.0 else 2.0 * gap / (root - slope)
        if t >= limit:
            return np.inf
    return np.nan


@njit(cache=True, nogil=True, error_model="numpy")
def distances(surfaces, origins, directions, distance):
    """Fills distance (N,): from origins (N, 3) to the first surface along directions (N, 3), in units of each
    direction; inf or NaN if there is none."""
    for i in range(len(origins)):
        p, d = origins[i], directions[i]
        distance[i], _ = nearest(surfaces, p[0], p[1], p[2], d[0], d[1], d[2])
