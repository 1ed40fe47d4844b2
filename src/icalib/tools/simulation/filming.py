"""Simulates recordings with rendered images instead of corners, and the interior of rooms that they show."""

from __future__ import annotations

import os
from collections import deque
from collections.abc import Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple, Protocol

import numpy as np

from icalib.base.compiled import njit
from icalib.data.measurements import ImuStream
from icalib.errors import RigError
from icalib.geometry.targets import Markers, Scene, Tag, Target
from icalib.tools.simulation.corners import image_stamps
from icalib.tools.simulation.motion import inside
from icalib.tools.simulation.recording import Truth, simulate
from icalib.tools.simulation.rendering import (
    Imaging,
    Optics,
    Picture,
    Renderer,
    Sheet,
    SheetTruth,
    exposure_poses,
    unproject,
)
from icalib.tools.simulation.room import (
    Atlas,
    Obstacle,
    Room,
    RoomSurfaces,
    Texture,
    atlas_of,
    dead_leaves,
    ground,
    texel_size,
)
from icalib.tools.simulation.scenario import CameraFaults, Scenario, SimCamera, faults_of
from icalib.tools.simulation.trajectory import TrueTrajectory

# Compiled ray casting in a room with textured surfaces.
#
# Each pixel is divided into cells, and a cell has the ray through its middle. The faces that a tile of the image can
# see are found first, by the planes of the pyramid through the tile; a cell takes the nearest of these. The light of a
# cell is the mean texture over its footprint, by anisotropic filtering. Samples lie along the longer axis of the
# footprint. Each sample interpolates the two mipmap levels with texels of about the length of the shorter axis
# (Heckbert 1989, McCormack et al. 1999).
#
# Images of a room with textured surfaces, from a camera inside it.
#
# Each pixel is divided into 2 x 2 cells. A cell has a ray through the lens, an instant within the exposure, and the
# mean brightness of its footprint on the surface that the ray meets.

# Stamps and motion are those of `simulate`. Images are rendered by threads on demand, a few ahead, so that a recording
# is never in memory as a whole.
#
# People in front of a camera: upright boxes that follow it with a delay, and sway from side to side.

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


_AHEAD = 2  # images per thread that are rendered or waiting


@dataclass(frozen=True, eq=False)
class Shot:
    """One image. camera: its name; stamp_ns: on the camera's clock; seconds: true instant on the IMU's clock since its
    origin; pixels (H, W) uint8; target: true image points of the target."""

    camera: str
    stamp_ns: int
    seconds: float
    pixels: np.ndarray
    target: SheetTruth


@dataclass(frozen=True, eq=False)
class Film:
    """A recording of IMU readings and images. exposure_s: exposure time [s], 0 for an instant. `truth.corners` belongs
    to the corners of `simulate`, not to these images."""

    scenario: Scenario
    seed: int
    imaging: Imaging
    exposure_s: float
    imu: ImuStream
    truth: Truth

    def shots(self, workers: int | None = None) -> Iterator[Shot]:
        """All images of all cameras in order of time. workers: number of threads; None: one per core."""
        take = self._taker()
        workers = workers or _cores()
        waiting: deque[Future[Shot]] = deque()
        with ThreadPoolExecutor(workers, thread_name_prefix="icalib-render") as pool:
            for frame in self._schedule():
                waiting.append(pool.submit(self._shot, take, frame))
                if len(waiting) > _AHEAD * workers:
                    yield waiting.popleft().result()
            while waiting:
                yield waiting.popleft().result()

    def count(self) -> int:
        """Number of images of all cameras."""
        return len(self._schedule())

    def _schedule(self) -> list[_Frame]:
        """All images in order of time; stamps are those of `simulate`."""
        due: list[_Frame] = []
        for i, camera in enumerate(self.scenario.cameras):
            stamps, seconds = image_stamps(self.scenario, camera, np.random.default_rng([self.seed, 2 + i]))
            image = _image_numbers(seconds, self.scenario.image_faults.frozen)
            times = zip(seconds.tolist(), stamps.tolist(), image.tolist(), strict=True)
            due += [_Frame(s, i, stamp, int(k), float(seconds[k])) for s, stamp, k in times]
        return sorted(due)

    def _taker(self) -> _Taker:
        return _Sheets(self) if self.scenario.board else _Room(self)

    def _shot(self, take: _Taker, frame: _Frame) -> Shot:
        camera = self.scenario.cameras[frame.camera]
        count = take.instants if self.exposure_s > 0.0 else 1
        poses = exposure_poses(camera, self.truth.trajectory, frame.image_s, self.exposure_s, count)
        picture = take.picture(frame, poses, np.random.default_rng([self.seed, 2 + frame.camera, 1 + frame.image]))
        uv = np.concatenate([np.empty((0, 2)), *(sheet.uv for sheet in picture.sheets)])
        in_view = np.concatenate([np.empty(0, dtype=bool), *(sheet.seen for sheet in picture.sheets)])
        return Shot(camera.name, frame.stamp_ns, frame.seconds, picture.pixels, SheetTruth(uv, in_view))


class _Frame(NamedTuple):
    """One image. seconds: instant on the IMU's clock; camera: its number; stamp_ns: on its clock; image, image_s:
    number and instant of the image that is rendered, an earlier one while the camera is frozen."""

    seconds: float
    camera: int
    stamp_ns: int
    image: int
    image_s: float


class _Taker(Protocol):
    """Renders the images of a film."""

    @property
    def instants(self) -> int:
        """Number of poses over an exposure."""
        ...

    def picture(self, frame: _Frame, poses: np.ndarray, rng: np.random.Generator) -> Picture: ...


class _Sheets:
    """Renders images of printed targets."""

    instants = 5

    def __init__(self, film: Film) -> None:
        self._renderers = [Renderer(camera, film.imaging) for camera in film.scenario.cameras]
        if film.scenario.target_size != 1.0:
            raise RigError("images show targets of the stated size only; leave target_size out, or simulate tables.")
        self._sheets = sheets_of(film.scenario.target, film.scenario.body_poses)

    def picture(self, frame: _Frame, poses: np.ndarray, rng: np.random.Generator) -> Picture:
        return self._renderers[frame.camera].picture(self._sheets, poses, rng)


class _Room:
    """Renders images of a room without targets."""

    instants = INSTANTS

    def __init__(self, film: Film) -> None:
        scenario = film.scenario
        assert scenario.room is not None
        self._film, self._people = film, scenario.image_faults.people
        self._interior = Interior(scenario.room, standing(self._people))
        self._renderers = [
            RoomRenderer(camera, film.imaging, faults_of(scenario.image_faults, camera.resolution, i))
            for i, camera in enumerate(scenario.cameras)
        ]

    def picture(self, frame: _Frame, poses: np.ndarray, rng: np.random.Generator) -> Picture:
        scenario, trajectory = self._film.scenario, self._film.truth.trajectory
        people = walking(self._people, scenario.cameras[0], trajectory, frame.image_s)
        gain = scenario.image_faults.gain_at(frame.image_s)
        return Picture(self._renderers[frame.camera].grey(self._interior.view(people), poses, gain, rng), ())


def _image_numbers(seconds: np.ndarray, frozen: tuple[tuple[float, float], ...]) -> np.ndarray:
    """(M,) number of the image that each image shows: its own, or the last one before an interval in which the camera
    is frozen. seconds (M,): instants of the images."""
    fresh = ~inside(frozen, seconds)
    return np.maximum(np.maximum.accumulate(np.where(fresh, np.arange(len(seconds)), -1)), 0)


def sheets_of(target: Target, T_world_bodies: np.ndarray) -> list[Sheet]:
    """A sheet for each body of `target`, at the poses T_world_bodies (bodies, 4, 4). The points of all sheets, in
    order, are those of the target."""
    if isinstance(target, Scene):
        first = np.cumsum([0] + [len(t.bodies) for t in target.targets])
        groups = zip(target.targets, first[:-1], first[1:], strict=True)
        return [sheet for t, a, b in groups for sheet in sheets_of(t, T_world_bodies[a:b])]
    if isinstance(target, Markers):
        tags = [Tag(target.family, int(i), target.size) for i in target.known]
        pairs = zip(tags, T_world_bodies, strict=True)
        return [Sheet(tag, T, border_bits=target.border_bits) for tag, T in pairs]
    return [Sheet(target, T_world_bodies[0])]


def film(scenario: Scenario, seed: int, imaging: Imaging | None = None, exposure_s: float = 0.0) -> Film:
    """The scenario as a recording with images; motion, IMU readings and stamps are those of `simulate`.

    Images show the target, or without one the textured room from the inside. imaging: by default a lens blur of 0.8 px
    and a noise of 2 grey levels. exposure_s: exposure time, centred on the stamp and averaged over 5 poses, or 4 in a
    room; 0: an instant. The scenario's corner noise, bloom and outliers do not affect images. Raises RigError for a
    board that is not flat, for rolling shutters, and if there is neither target nor room.
    """
    if not scenario.board and scenario.room is None:
        raise RigError("there is nothing to film; give the scenario a target or a room.")
    if any(scenario.bow):
        raise RigError("boards are rendered flat; set the scenario's bow to zero.")
    if rolling := next((camera.name for camera in scenario.cameras if camera.readout_s), ""):
        raise RigError(f"{rolling}: images are rendered with a global shutter; simulate tables, or remove shutter.")
    simulation = simulate(scenario, seed)
    imu = simulation.measurements.imu
    assert imu is not None  # of every scenario
    imaging = Imaging(blur_px=0.8, noise=2.0) if imaging is None else imaging
    return Film(scenario, seed, imaging, exposure_s, imu, simulation.truth)


def _cores() -> int:
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


_SIZE_M = (0.5, 0.3, 1.75)
_AWAY_M, _NEARER_M = 1.8, 0.4  # mean distance from the camera, and amplitude of its change
_APART_RAD, _SWAY_RAD = 0.5, 0.35  # angle between neighbours, and amplitude of the sway
_LATE_S = 0.5  # delay with which people follow the camera
_HZ = 0.13  # frequency of the first person's sway; that of each further person is a tenth higher


def standing(count: int) -> tuple[Obstacle, ...]:
    """`count` people at the origin; `walking` gives their places."""
    return tuple(Obstacle((0.0, 0.0), _SIZE_M) for _ in range(count))


def walking(count: int, camera: SimCamera, trajectory: TrueTrajectory, seconds: float) -> tuple[Obstacle, ...]:
    """`count` people at an instant [s] on the IMU's clock, in front of `camera`."""
    if not count:
        return ()
    rotation, position, _ = trajectory.pose_at(np.array([seconds - _LATE_S]))
    eye = position[0] + rotation[0] @ camera.T_imu_sensor[:3, 3]
    ahead = rotation[0] @ camera.T_imu_sensor[:3, 2]
    people = []
    for i in range(count):
        phase = 2.0 * np.pi * _HZ * 1.1**i * seconds + 2.0 * i
        angle = np.arctan2(ahead[1], ahead[0]) + _APART_RAD * (i - 0.5 * (count - 1)) + _SWAY_RAD * np.sin(phase)
        away = _AWAY_M + _NEARER_M * np.sin(1.7 * phase)
        place = (float(eye[0] + away * np.cos(angle)), float(eye[1] + away * np.sin(angle)))
        people.append(Obstacle(place, _SIZE_M, float(angle + 0.5 * np.pi + 0.3 * np.sin(2.0 * phase))))
    return tuple(people)
