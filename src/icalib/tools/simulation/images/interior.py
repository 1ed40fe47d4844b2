"""Compiled ray casting in a room with textured surfaces.

Each pixel is divided into cells, and a cell has the ray through its middle. The faces that a tile of the image can see
are found first, by the planes of the pyramid through the tile; a cell takes the nearest of these. The light of a cell
is the mean texture over its footprint, by anisotropic filtering. Samples lie along the longer axis of the footprint.
Each sample interpolates the two mipmap levels with texels of about the length of the shorter axis (Heckbert 1989,
McCormack et al. 1999).

Images of a room with textured surfaces, from a camera inside it.

Each pixel is divided into 2 x 2 cells. A cell has a ray through the lens, an instant within the exposure, and the mean
brightness of its footprint on the surface that the ray meets.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple

import numpy as np

from icalib.base.compiled import njit
from icalib.tools.simulation.images.rendering import Imaging, Optics, unproject
from icalib.tools.simulation.scenario.image_faults import CameraFaults
from icalib.tools.simulation.scenario.room import Obstacle, Room, RoomSurfaces, ground
from icalib.tools.simulation.scenario.scenario import SimCamera
from icalib.tools.simulation.scenario.texture import Atlas, Texture, atlas_of, dead_leaves, texel_size

CELLS = 2  # per pixel, along each axis
TILE = 16  # pixels along each axis
_MOST_SAMPLES = 8  # per cell, along the longer axis of its footprint


class PixelRays(NamedTuple):
    """Rays of h x w pixels in the camera frame. rays (h s, w s, 3): of the cells, not normalised, NaN for none; by_u,
    by_v (h, w, 3): derivatives per pixel; sides (tiles down, tiles across, 4, 3): inward normals of each tile's
    pyramid, zeros for a tile without rays."""

    rays: np.ndarray
    by_u: np.ndarray
    by_v: np.ndarray
    sides: np.ndarray


class Tone(NamedTuple):
    """Grey levels of texture values 0 (black) and 1 (white), and of rays that meet nothing (background)."""

    black: float
    white: float
    background: float


class VisibleFaces(NamedTuple):
    """Surfaces for `light`. faces (F, 15): plane n, d; a, a0, b, b0 with the texture coordinates X = a . p - a0,
    Y = b . p - b0 [texels]; width and height of the texture [texels]; 1.0 for a triangle, 0.0 for a parallelogram.
    vertices (F, 4, 3) m, the last one of a triangle repeated. ground (4,): X = g0 x + g1, Y = g2 y + g3 on the hills,
    whose texture is the last one. surfaces: has the hills."""

    faces: np.ndarray
    vertices: np.ndarray
    ground: np.ndarray
    surfaces: RoomSurfaces
    atlas: Atlas


@njit(cache=True, nogil=True, error_model="numpy")
def light(view, lens, tone, R, C, fine):
    """Fills fine (h s, w s) with greys. R (s s, 3, 3), C (s s, 3): R_world_cam and camera position in the world [m].
    Entry a s + b is at the instant of cell (a, b) of each pixel."""
    chosen = np.empty(len(view.vertices), dtype=np.int64)
    for row in range(lens.sides.shape[0]):
        for col in range(lens.sides.shape[1]):
            count = _faces_of_tile(view, lens.sides[row, col], R, C, chosen)
            for i in range(row * TILE, min((row + 1) * TILE, lens.by_u.shape[0])):
                for j in range(col * TILE, min((col + 1) * TILE, lens.by_u.shape[1])):
                    _pixel(view, lens, tone, R, C, chosen[:count], i, j, fine)


@njit(cache=True, nogil=True, error_model="numpy")
def _faces_of_tile(view, sides, R, C, chosen):
    """Fills `chosen` with the numbers of the faces that the tile may see at any of the poses; returns their count."""
    count = 0
    plane = view.faces
    for f in range(len(plane)):
        for k in range(len(R)):
            c = C[k]
            if plane[f, 0] * c[0] + plane[f, 1] * c[1] + plane[f, 2] * c[2] <= plane[f, 3]:
                continue
            if _reaches(view.vertices[f], sides, R[k], c):
                chosen[count] = f
                count += 1
                break
    return count


@njit(cache=True, nogil=True, error_model="numpy")
def _reaches(vertices, sides, R, c):
    """False if all vertices are outside one plane of the tile's pyramid, so that the tile cannot show the face."""
    for k in range(4):
        x = R[0, 0] * sides[k, 0] + R[0, 1] * sides[k, 1] + R[0, 2] * sides[k, 2]
        y = R[1, 0] * sides[k, 0] + R[1, 1] * sides[k, 1] + R[1, 2] * sides[k, 2]
        z = R[2, 0] * sides[k, 0] + R[2, 1] * sides[k, 1] + R[2, 2] * sides[k, 2]
        outside = True
        for v in range(4):
            if x * (vertices[v, 0] - c[0]) + y * (vertices[v, 1] - c[1]) + z * (vertices[v, 2] - c[2]) > 0.0:
                outside = False
        if outside:
            return False
    return True


@njit(cache=True, nogil=True, error_model="numpy")
def _pixel(view, lens, tone, R, C, chosen, i, j, fine):
    """Fills the cells of pixel (i, j); their footprint is computed once for each face that they see."""
    last, plan = -2, (0.0, 0.0, 0.0, 1)
    for a in range(CELLS):
        for b in range(CELLS):
            k, m, n = a * CELLS + b, i * CELLS + a, j * CELLS + b
            d = _turned(R, k, lens.rays[m, n, 0], lens.rays[m, n, 1], lens.rays[m, n, 2])
            c = C[k, 0], C[k, 1], C[k, 2]
            t, face, X, Y = _nearest(view.faces, chosen, c, d)
            if len(view.surfaces.amplitude):
                on_ground = ground(view.surfaces, c[0], c[1], c[2], d[0], d[1], d[2], t)
                if not on_ground >= t:
                    t, face = on_ground, -1
                    X = view.ground[0] * (c[0] + t * d[0]) + view.ground[1]
                    Y = view.ground[2] * (c[1] + t * d[1]) + view.ground[3]
            if not t < np.inf:
                fine[m, n] = tone.background
                continue
            if face != last:
                u = _turned(R, k, lens.by_u[i, j, 0], lens.by_u[i, j, 1], lens.by_u[i, j, 2])
                v = _turned(R, k, lens.by_v[i, j, 0], lens.by_v[i, j, 1], lens.by_v[i, j, 2])
                scale = _scale(view, face, c[0] + t * d[0], c[1] + t * d[1])
                plan = _plan(scale, d, u, v, t / CELLS)
                last = face
            share = _mean(view.atlas, face, X, Y, plan)
            fine[m, n] = tone.black + share * (tone.white - tone.black)


@njit(cache=True, nogil=True)
def _turned(R, k, x, y, z):
    return (
        R[k, 0, 0] * x + R[k, 0, 1] * y + R[k, 0, 2] * z,
        R[k, 1, 0] * x + R[k, 1, 1] * y + R[k, 1, 2] * z,
        R[k, 2, 0] * x + R[k, 2, 1] * y + R[k, 2, 2] * z,
    )


@njit(cache=True, nogil=True, error_model="numpy")
def _nearest(faces, chosen, c, d):
    """Distance along the ray c + t d to the nearest of the chosen faces, in units of d; number of the face, and texture
    coordinates [texels]. The distance is infinite without a face."""
    best, hit, X, Y = np.inf, -1, 0.0, 0.0
    for m in range(len(chosen)):
        f = chosen[m]
        towards = faces[f, 0] * d[0] + faces[f, 1] * d[1] + faces[f, 2] * d[2]
        if not towards < 0.0:
            continue
        t = (faces[f, 3] - faces[f, 0] * c[0] - faces[f, 1] * c[1] - faces[f, 2] * c[2]) / towards
        if t <= 0.0 or t >= best:
            continue
        x, y, z = c[0] + t * d[0], c[1] + t * d[1], c[2] + t * d[2]
        u = faces[f, 4] * x + faces[f, 5] * y + faces[f, 6] * z - faces[f, 7]
        v = faces[f, 8] * x + faces[f, 9] * y + faces[f, 10] * z - faces[f, 11]
        W, H = faces[f, 12], faces[f, 13]
        if u >= 0.0 and v >= 0.0 and u <= W and v <= H and not (faces[f, 14] > 0.0 and u * H + v * W > W * H):
            best, hit, X, Y = t, f, u, v
    return best, hit, X, Y


@njit(cache=True, nogil=True, error_model="numpy")
def _scale(view, face, x, y):
    """Gradients of the texture coordinates X and Y [texels/m], and a normal, not normalised, of a face, or of the hills
    at x, y if face is -1."""
    if face >= 0:
        f = view.faces
        return (
            (f[face, 4], f[face, 5], f[face, 6]),
            (f[face, 8], f[face, 9], f[face, 10]),
            (f[face, 0], f[face, 1], f[face, 2]),
        )
    s, nx, ny = view.surfaces, 0.0, 0.0
    for w in range(len(s.amplitude)):
        rise = s.amplitude[w] * np.cos(s.wave[w, 0] * x + s.wave[w, 1] * y + s.phase[w])
        nx -= rise * s.wave[w, 0]
        ny -= rise * s.wave[w, 1]
    return (view.ground[0], 0.0, 0.0), (0.0, view.ground[2], 0.0), (nx, ny, 1.0)


@njit(cache=True, nogil=True, error_model="numpy")
def _plan(scale, d, d_u, d_v, length):
    """Longer axis (x, y) of a cell's footprint [texels], mipmap level, and number of samples.

    scale: see `_scale`; d, d_u, d_v: ray and its derivatives; length: distance times the cell's width [px]. The
    footprint is the image of a square; the lengths of its axes are the singular values of the derivative.
    """
    A, B, n = scale
    along = n[0] * d[0] + n[1] * d[1] + n[2] * d[2]
    q_u = (n[0] * d_u[0] + n[1] * d_u[1] + n[2] * d_u[2]) / along
    q_v = (n[0] * d_v[0] + n[1] * d_v[1] + n[2] * d_v[2]) / along
    d_A = A[0] * d[0] + A[1] * d[1] + A[2] * d[2]
    d_B = B[0] * d[0] + B[1] * d[1] + B[2] * d[2]
    Xu = length * (A[0] * d_u[0] + A[1] * d_u[1] + A[2] * d_u[2] - q_u * d_A)
    Yu = length * (B[0] * d_u[0] + B[1] * d_u[1] + B[2] * d_u[2] - q_u * d_B)
    Xv = length * (A[0] * d_v[0] + A[1] * d_v[1] + A[2] * d_v[2] - q_v * d_A)
    Yv = length * (B[0] * d_v[0] + B[1] * d_v[1] + B[2] * d_v[2] - q_v * d_B)
    xx, yy, xy = Xu * Xu + Xv * Xv, Yu * Yu + Yv * Yv, Xu * Yu + Xv * Yv
    half = 0.5 * (xx - yy)
    apart = np.sqrt(half * half + xy * xy)
    long = 0.5 * (xx + yy) + apart
    longer, shorter = np.sqrt(long), np.sqrt(max(long - 2.0 * apart, 0.0))
    count = min(int(np.ceil(longer / max(shorter, 1.0))), _MOST_SAMPLES)
    x, y = (apart + half, xy) if half > 0.0 else (xy, apart - half)  # along the longer axis
    norm = np.sqrt(x * x + y * y)
    if norm > 0.0:
        x, y = x / norm, y / norm
    return longer * x, longer * y, _level(max(shorter, longer / count)), count


@njit(cache=True, nogil=True)
def _level(width):
    """Binary logarithm of `width`, linearly interpolated between powers of 2; 0 for widths below 1."""
    level = 0.0
    while width >= 2.0:
        width *= 0.5
        level += 1.0
    return level + max(width - 1.0, 0.0)


@njit(cache=True, nogil=True, error_model="numpy")
def _mean(atlas, face, X, Y, plan):
    """Mean texture, 0 to 1, over the footprint `plan` about X, Y [texels of level 0]."""
    x, y, level, count = plan
    low = min(int(level), atlas.first.shape[1] - 1)
    high = min(low + 1, atlas.first.shape[1] - 1)
    share, total = level - low, 0.0
    for k in range(count):
        step = (k + 0.5) / count - 0.5
        grey = _between(atlas, face, low, X + step * x, Y + step * y)
        if share > 0.0:
            grey += share * (_between(atlas, face, high, X + step * x, Y + step * y) - grey)
        total += grey
    return total / (count * 65535.0)


@njit(cache=True, nogil=True, error_model="numpy")
def _between(atlas, face, level, X, Y):
    """Bilinear interpolation between the four texels of a level around X, Y [texels of level 0]."""
    W, H, first = atlas.width[face, level], atlas.height[face, level], atlas.first[face, level]
    shrunk = 1.0 / (1 << level)
    x, y = min(max(X * shrunk - 0.5, 0.0), W - 1.0), min(max(Y * shrunk - 0.5, 0.0), H - 1.0)
    i, j = int(x), int(y)
    fx, fy = x - i, y - j
    below, right = first + j * W + i, 1 if i + 1 < W else 0
    above = below + (W if j + 1 < H else 0)
    g = atlas.texels
    return (1.0 - fy) * ((1.0 - fx) * g[below] + fx * g[below + right]) + fy * (
        (1.0 - fx) * g[above] + fx * g[above + right]
    )


INSTANTS = CELLS * CELLS  # number of poses over an exposure
_PERSON_SURFACES = 10_000  # first texture number of people, so that they do not change the textures of the room


@dataclass(frozen=True, eq=False)
class Interior:
    """A room and its textures. people: moving blocks, whose textures move with them.

    atlas: textures of the room's faces, then of the people's, then of the hills; None: generated by `Room.texture`.
    """

    room: Room
    people: tuple[Obstacle, ...] = ()
    atlas: Atlas | None = None

    def view(self, people: tuple[Obstacle, ...] = ()) -> VisibleFaces:
        """The faces of room and people. people: current places of `self.people`, in the same order."""
        others, atlas = self.room.faces_of(people), self._atlas
        faces = np.concatenate([self.room.faces, others])
        origin, u, v, mark = np.moveaxis(faces, 1, 0)
        far = origin + u + np.where(mark[:, :1] > 0.0, 0.0, v)
        surfaces = self.room.surfaces_with(others) if people else self.room.surfaces
        texels = np.stack([atlas.width[: len(faces), 0], atlas.height[: len(faces), 0]], axis=1).astype(np.float64)
        placed = [surfaces.along * texels[:, :1], surfaces.across * texels[:, 1:]]
        x, y = np.array([atlas.width[-1, 0], atlas.height[-1, 0]]) / self.room.size[:2]
        return VisibleFaces(
            np.column_stack([surfaces.plane, *placed, texels, surfaces.triangle]),
            np.stack([origin, origin + u, origin + v, far], axis=1),
            np.array([x, 0.5 * atlas.width[-1, 0], y, 0.5 * atlas.height[-1, 0]]),
            surfaces,
            atlas,
        )

    @cached_property
    def _atlas(self) -> Atlas:
        if self.atlas is not None:
            return self.atlas
        faces = np.concatenate([self.room.faces, self.room.faces_of(self.people)])
        sizes = [tuple(np.linalg.norm(face[1:3], axis=1).tolist()) for face in faces]
        texture = self.room.texture
        looks = [(texture, k) for k in range(len(self.room.faces))]
        looks += [(Texture(texture.seed, share=1.0), _PERSON_SURFACES + k) for k in range(len(faces) - len(looks))]
        if self.room.hills:
            sizes.append(self.room.size[:2])
            looks.append((texture, _PERSON_SURFACES - 1))
        texel_m = texel_size(sum(a * b for a, b in sizes))
        return atlas_of([dead_leaves(s, texel_m, *look) for s, look in zip(sizes, looks, strict=True)])


@dataclass(frozen=True, eq=False)
class RoomRenderer:
    """Renders images of a room by one camera. The rays through the lens are computed once, for the first image."""

    camera: SimCamera
    imaging: Imaging = Imaging()
    faults: CameraFaults = CameraFaults()

    def grey(
        self, view: VisibleFaces, T_world_cam: np.ndarray, gain: float, rng: np.random.Generator | None
    ) -> np.ndarray:
        """(H, W) grey levels, neither rounded nor clipped, at the pose T_world_cam (4, 4), or over the poses (4, 4, 4)
        of an exposure.

        gain: factor on all light. rng: needed for noise, else RigError is raised.
        """
        poses = np.broadcast_to(T_world_cam, (INSTANTS, 4, 4))
        fine = np.empty(self._optics.fine_shape, dtype=np.float32)
        tone = Tone(self.imaging.black, self.imaging.white, self.imaging.background)
        R, C = np.ascontiguousarray(poses[:, :3, :3]), np.ascontiguousarray(poses[:, :3, 3])
        light(view, self._lens, tone, R, C, fine)
        arrived = self.faults.applied(self._optics.grey(fine), tone.black, tone.white)
        return self._optics.with_noise(gain * arrived, rng)

    @cached_property
    def _optics(self) -> Optics:
        return Optics(self.camera, self.imaging, CELLS)

    @cached_property
    def _lens(self) -> PixelRays:
        rows, cols = self._optics.fine_shape
        pad = self._optics.pad
        u, v = ((np.arange(n) + 0.5) / CELLS - 0.5 - pad for n in (cols, rows))
        rays = unproject(self.camera, np.stack(np.meshgrid(u, v), axis=-1))
        a, b, c, d = rays[::2, ::2], rays[::2, 1::2], rays[1::2, ::2], rays[1::2, 1::2]  # half a pixel apart
        return PixelRays(rays, b - a + d - c, c - a + d - b, _sides(rays))


def _sides(rays: np.ndarray) -> np.ndarray:
    """`PixelRays.sides` of rays (h s, w s, 3): for each tile the pyramid with rectangular base about the tile's mean
    ray that contains its rays."""
    step = TILE * CELLS
    down, across = (-(-n // step) for n in rays.shape[:2])
    sides = np.zeros((down, across, 4, 3))
    for i in range(down):
        for j in range(across):
            tile = rays[i * step : (i + 1) * step, j * step : (j + 1) * step].reshape(-1, 3)
            tile = tile[np.isfinite(tile[:, 0])]
            if not len(tile):
                continue
            z = tile.mean(axis=0)
            z /= np.linalg.norm(z)
            x = np.cross(np.eye(3)[np.argmin(np.abs(z))], z)
            x /= np.linalg.norm(x)
            y = np.cross(z, x)
            p, q = tile @ x / (tile @ z), tile @ y / (tile @ z)
            sides[i, j] = [x - p.min() * z, p.max() * z - x, y - q.min() * z, q.max() * z - y]
    return sides
