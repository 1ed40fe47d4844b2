"""The room that a robot moves through: walls, floor and ceiling, boxes, ramps, hills, and where a ray meets them.

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
from icalib.tools.simulation.scenario.texture import Texture

_STEPS = 1000  # of a ray's march over hills; one that grazes them for longer meets nothing
_CLOSE_M = 1e-9  # to the ground, where the march ends


@dataclass(frozen=True)
class Obstacle:
    """A box, or with `ramp` a wedge that rises from nothing to size z along its own x. center (x, y) [m] of its base,
    size (x, y, z) [m], turned by yaw_rad about the vertical."""

    center: tuple[float, float]
    size: tuple[float, float, float]
    yaw_rad: float = 0.0
    ramp: bool = False


@dataclass(frozen=True)
class Hills:
    """A floor z(x, y) = sum a_i sin(k_i . (x, y) + phase_i): amplitude (W,) [m], wave (W, 2) [rad/m], phase (W,)."""

    amplitude: tuple[float, ...]
    wave: tuple[tuple[float, float], ...]
    phase: tuple[float, ...]

    @property
    def depth(self) -> float:
        """The floor stays within +-depth [m]."""
        return float(np.abs(self.amplitude).sum())

    @property
    def steepest(self) -> float:
        """No slope is above this (a tangent): that of all waves together, at the worst of their phases."""
        slopes = np.array(self.amplitude)[:, None] * np.array(self.wave)
        signs = np.array(list(product((-1.0, 1.0), repeat=len(slopes))))
        return float(np.linalg.norm(signs @ slopes, axis=1).max())

    def height(self, xy: np.ndarray) -> np.ndarray:
        """(N,) z at xy (N, 2)."""
        return np.sin(xy @ np.array(self.wave).T + self.phase) @ np.array(self.amplitude)


def hills_of_slope(slope_deg: float) -> Hills:
    """Three waves of 6.3, 4.2 and 2.9 m in different directions, of which no slope is above `slope_deg`."""
    waves, phases = ((0.97, 0.24), (-0.45, 1.43), (1.6, -1.45)), (0.3, 1.9, 4.0)
    shares = np.array([0.5, 0.35, 0.15]) / np.linalg.norm(waves, axis=1)
    scale = np.tan(np.deg2rad(slope_deg)) / Hills(tuple(shares), waves, phases).steepest
    return Hills(tuple((scale * shares).tolist()), waves, phases)


class RoomSurfaces(NamedTuple):
    """What rays meet. Faces are parallelograms origin + s u + t v, 0 <= s, t <= 1, or triangles (s + t <= 1), seen
    from the side that the normal points to. Of the hills: see `Hills`."""

    plane: np.ndarray  # (F, 4) n, d: n . p = d
    along: np.ndarray  # (F, 4) a, a0: s = a . p - a0
    across: np.ndarray  # (F, 4) b, b0: t = b . p - b0
    triangle: np.ndarray  # (F,) bool
    amplitude: np.ndarray  # (W,), W = 0: no hills
    wave: np.ndarray  # (W, 2)
    phase: np.ndarray  # (W,)


@dataclass(frozen=True)
class Room:
    """size (x, y, z) [m]. With hills there is no flat floor, and all else reaches down below them. texture: what images
    show of it."""

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
        """Where walls and blocks begin [m]."""
        return -self.hills.depth if self.hills else 0.0

    @cached_property
    def faces(self) -> np.ndarray:
        """(F, 4, 3): origin, u, v and (1, 0, 0) of a triangle or zeros; u x v points into the open."""
        x, y, z = self.size
        low = np.array([-0.5 * x, -0.5 * y, self.base])
        ex, ey, ez = np.diag([x, y, z - self.base])
        flat = [] if self.hills else [(low, ex, ey)]
        shell = [(low + ez, ey, ex), (low, ey, ez), (low + ex, ez, ey), (low, ez, ex), (low + ey, ex, ez)]
        return np.concatenate([[(*face, np.zeros(3)) for face in flat + shell], self.faces_of(self.blocks)])

    @property
    def planes(self) -> np.ndarray:
        """(F, 4): normal, into the open, and d [m] of each face; n . p = d on it."""
        return _with_offset(_normals(self.faces), self.faces[:, 0])

    @cached_property
    def surfaces(self) -> RoomSurfaces:
        return self.surfaces_with(np.empty((0, 4, 3)))

    def surfaces_with(self, others: np.ndarray) -> RoomSurfaces:
        """The room's, and faces (n, 4, 3) of what else is in it."""
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
        """(n, 4, 3), as `faces`, of blocks that stand in it."""
        found = [face for b in blocks for face in (_ramp if b.ramp else _box)(b, self.base)]
        return np.array(found).reshape(-1, 4, 3)

    def points(self, count: int, rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
        """(count, 3) points spread over all surfaces by area, hills as if they were flat, and the surfaces' normals
        there, upwards on hills."""
        u, v, triangle = self.faces[:, 1], self.faces[:, 2], self.faces[:, 3, 0] > 0.0
        area = np.linalg.norm(np.cross(u, v), axis=1) * np.where(triangle, 0.5, 1.0)
        ground = self.size[0] * self.size[1] if self.hills else 0.0
        share = np.append(area, ground) / (area.sum() + ground)
        face = rng.choice(len(share), count, p=share)
        st = rng.random((count, 2))
        on_ground = face == len(area)
        face[on_ground] = 0
        st = np.where((triangle[face] & (st.sum(axis=1) > 1.0))[:, None], 1.0 - st, st)
        found = self.faces[face, 0] + st[:, :1] * u[face] + st[:, 1:] * v[face]
        if self.hills:
            xy = (rng.random((count, 2)) - 0.5) * self.size[:2]
            found[on_ground] = np.column_stack([xy, self.hills.height(xy)])[on_ground]
        return found, np.where(on_ground[:, None], [0.0, 0.0, 1.0], _normals(self.faces)[face])


def _normals(faces: np.ndarray) -> np.ndarray:
    normal = np.cross(faces[:, 1], faces[:, 2])
    return normal / np.linalg.norm(normal, axis=1, keepdims=True)


def _with_offset(directions: np.ndarray, origin: np.ndarray) -> np.ndarray:
    """(F, 4): each direction (F, 3) with its product with the origin (F, 3)."""
    return np.column_stack([directions, np.sum(directions * origin, axis=1)])


Face = tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]


def _placed(block: Obstacle, base: float) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """The lowest corner of a block, and its edges along its own x, y and z."""
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
    whole, half = np.zeros(3), np.array([1.0, 0.0, 0.0])
    return [
        (low, ex + ez, ey, whole),
        (low + ex, ey, ez, whole),
        (low + ex, ez, -ex, half),
        (low + ex + ey, -ex, ez, half),
    ]


@njit(cache=True, nogil=True, error_model="numpy")
def nearest(surfaces, px, py, pz, dx, dy, dz):
    """Distance t in units of d, and the face that p + t d meets first, -1: the hills. t = inf or NaN: nothing."""
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
    """t at which the ray meets the hills before `limit`, else inf; NaN where it takes too many steps.

    The height above the ground has a second derivative of at most `bend` along the ray. Each step ends where a parabola
    of that curvature would meet the ground first: it never passes through, and near the end it is Newton's. A ray that
    leaves from the ground does not meet it there.
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
def distances(surfaces, origins, directions, found):
    """found (N,): distance, in units of each direction (N, 3), to what is met first from origins (N, 3)."""
    for i in range(len(origins)):
        p, d = origins[i], directions[i]
        found[i], _ = nearest(surfaces, p[0], p[1], p[2], d[0], d[1], d[2])
