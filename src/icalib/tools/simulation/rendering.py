"""Rendered images of targets and rooms."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import cached_property
from math import erf

import numpy as np

from icalib.base.compiled import njit
from icalib.errors import RigError
from icalib.geometry.targets import Target
from icalib.geometry.targets.boards import Pattern, pattern_of
from icalib.tools.simulation.projection import in_range, project, visible
from icalib.tools.simulation.scenario import MODELS, SimCamera
from icalib.tools.simulation.trajectory import TrueTrajectory

RADTAN, EQUIDISTANT, EUCM, DOUBLE_SPHERE, OMNI, RATIONAL = range(6)
_CODES: dict[str, int] = dict(zip(MODELS, range(6), strict=True))
_STEPS = 20
_NONE = (0.0, 0.0, 0.0)


def lens_of(camera: SimCamera) -> tuple[int, np.ndarray]:
    """Code of the camera model, and its parameters (12,): fx, fy, cx, cy [px], distortion, zeros."""
    numbers = np.zeros(12)
    numbers[: 4 + len(camera.distortion)] = [*camera.intrinsics, *camera.distortion]
    return _CODES[camera.model], numbers


def unproject(camera: SimCamera, uv: np.ndarray) -> np.ndarray:
    """Unit rays (..., 3) in the camera frame of pixels uv (..., 2); NaN outside the range of the model."""
    code, numbers = lens_of(camera)
    flat = np.ascontiguousarray(uv, dtype=np.float64).reshape(-1, 2)
    rays = np.empty((len(flat), 3))
    _rays(code, numbers, flat, rays)
    with np.errstate(invalid="ignore"):
        rays /= np.linalg.norm(rays, axis=1, keepdims=True)
        rays[~in_range(camera, np.hypot(rays[:, 0], rays[:, 1]), rays[:, 2])] = np.nan
    return rays.reshape(*uv.shape[:-1], 3)


@njit(cache=True, nogil=True, error_model="numpy")
def _rays(code, numbers, uv, rays):
    for i in range(len(uv)):
        rays[i, 0], rays[i, 1], rays[i, 2] = ray(code, numbers, uv[i, 0], uv[i, 1])


@njit(cache=True, nogil=True, error_model="numpy")
def ray(code, n, u, v):
    """Direction (x, y, z) of pixel (u, v), not normalised; n: parameters of `lens_of`. Outside the range of the model
    it is NaN or meaningless."""
    a, b = (u - n[2]) / n[0], (v - n[3]) / n[1]
    if code in (RADTAN, RATIONAL):  # the coefficients that radtan lacks are zero
        w = _undistorted((n[4], n[5], n[8]), (n[9], n[10], n[11]), n[6], n[7], complex(a, b))
        return w.real, w.imag, 1.0
    if code == EQUIDISTANT:
        radius = np.sqrt(a * a + b * b)
        angle = _angle(n, radius)
        by_radius = np.sin(angle) / radius if radius > 0.0 else 1.0
        return by_radius * a, by_radius * b, np.cos(angle)
    if code == EUCM:
        # EUCM is the unified camera model with x and y scaled by sqrt(beta).
        stretch = np.sqrt(n[5])
        x, y, z = _from_behind(n[4] / (1.0 - n[4]), stretch * a * (1.0 - n[4]), stretch * b * (1.0 - n[4]), 1.0)
        return x / stretch, y / stretch, z
    if code == DOUBLE_SPHERE:
        x, y, z = _from_behind(n[5] / (1.0 - n[5]), a * (1.0 - n[5]), b * (1.0 - n[5]), 1.0)
        return _from_behind(n[4], x, y, z)
    w = _undistorted((n[5], n[6], 0.0), _NONE, n[7], n[8], complex(a, b))
    return _from_behind(n[4], w.real, w.imag, 1.0)


@njit(cache=True, nogil=True, error_model="numpy")
def _from_behind(shift, x, y, z):
    """Point at which the ray (x, y, z) from the point `shift` behind the centre meets the unit sphere."""
    norm = np.sqrt(x * x + y * y + z * z)
    x, y, z = x / norm, y / norm, z / norm
    t = shift * z + np.sqrt(1.0 - shift * shift * (1.0 - z * z))
    return t * x, t * y, t * z - shift


@njit(cache=True, nogil=True, error_model="numpy")
def _undistorted(above, below, p1, p2, image):
    """w with w N(s) / D(s) + 2 s q + w^2 conj(q) = image, s = |w|^2, q = p2 + i p1: Brown's model in one complex
    number, by Newton's method in w and conj(w). N, D: 1 + a s + b s^2 + c s^3 for above, below (a, b, c)."""
    q = complex(p2, p1)
    w = image
    for _ in range(_STEPS):
        s = w.real * w.real + w.imag * w.imag
        N = 1.0 + s * (above[0] + s * (above[1] + s * above[2]))
        D = 1.0 + s * (below[0] + s * (below[1] + s * below[2]))
        radial = N / D
        slope = (above[0] + s * (2.0 * above[1] + 3.0 * s * above[2])) / D
        slope -= radial * (below[0] + s * (2.0 * below[1] + 3.0 * s * below[2])) / D
        error = w * radial + 2.0 * s * q + w * w * q.conjugate() - image
        by_w = radial + s * slope + 2.0 * (w.conjugate() * q + w * q.conjugate())
        by_conj = w * w * slope + 2.0 * w * q
        scale = by_w.real**2 + by_w.imag**2 - by_conj.real**2 - by_conj.imag**2
        product = by_conj * error.conjugate() - by_w.conjugate() * error
        step = complex(product.real / scale, product.imag / scale)  # a complex divisor of zero would raise an error
        w += step
        if abs(step.real) + abs(step.imag) < 1e-13:
            return w
    return complex(np.nan, np.nan)


@njit(cache=True, nogil=True, error_model="numpy")
def _angle(n, radius):
    """theta with theta + k1 theta^3 + k2 theta^5 + k3 theta^7 + k4 theta^9 = radius."""
    theta = radius
    for _ in range(_STEPS):
        s = theta * theta
        value = theta * (1.0 + s * (n[4] + s * (n[5] + s * (n[6] + s * n[7]))))
        slope = 1.0 + s * (3.0 * n[4] + s * (5.0 * n[5] + s * (7.0 * n[6] + s * 9.0 * n[7])))
        step = (radius - value) / slope
        theta += step
        if abs(step) < 1e-13:
            return theta
    return np.nan


_CELLS = 4  # per pixel, along each axis
_REACH = 4.0  # standard deviations of the blur at which it is cut off


@dataclass(frozen=True, eq=False)
class Sheet:
    """A printed target in the world, on white paper that extends `margin` [m] beyond the print.

    border_bits: see `pattern_of`. If sheets overlap in the image, the one with the nearer centre covers the other.
    """

    target: Target
    T_world_target: np.ndarray = field(default_factory=lambda: np.eye(4))  # (4, 4)
    margin: float = 0.02
    border_bits: int | None = None

    @cached_property
    def pattern(self) -> Pattern:
        return pattern_of(self.target, self.border_bits).with_margin(self.margin)


@dataclass(frozen=True)
class Imaging:
    """Photometric model of a camera. white, black, background: grey levels (0 to 255) of the print and of everything
    else.

    blur_px: standard deviation of the lens's Gaussian blur. vignetting: fraction of the light that is lost in the
    corners of the image; the loss grows with the squared distance from the centre. gain: factor on all light. noise:
    standard deviation of the white Gaussian noise of each pixel, in grey levels.
    """

    white: float = 210.0
    black: float = 25.0
    background: float = 110.0
    blur_px: float = 0.5
    vignetting: float = 0.0
    gain: float = 1.0
    noise: float = 0.0


@dataclass(frozen=True, eq=False)
class SheetTruth:
    """True image points of one sheet. uv (n, 2): mean over the exposure [px]; seen (n,) bool: in the image, and seen
    from the front, during the whole exposure."""

    uv: np.ndarray
    seen: np.ndarray


@dataclass(frozen=True, eq=False)
class Picture:
    """A rendered image. grey (H, W) float64, neither rounded nor clipped; sheets: truth of each sheet, in the order of
    the argument."""

    grey: np.ndarray
    sheets: tuple[SheetTruth, ...]

    @property
    def pixels(self) -> np.ndarray:
        """(H, W) uint8: `grey`, rounded and clipped to 0 to 255."""
        return np.clip(np.rint(self.grey), 0.0, 255.0).astype(np.uint8)


@dataclass(frozen=True, eq=False)
class Optics:
    """Blur, vignetting and noise of a camera; the light is given in `cells` x `cells` cells per pixel."""

    camera: SimCamera
    imaging: Imaging
    cells: int

    @property
    def pad(self) -> int:
        """Width of the margin around the image from which blur brings in light [px]."""
        return int(np.ceil(_REACH * self.imaging.blur_px))

    @property
    def fine_shape(self) -> tuple[int, int]:
        width, height = self.camera.resolution
        return (height + 2 * self.pad) * self.cells, (width + 2 * self.pad) * self.cells

    @cached_property
    def falloff(self) -> np.ndarray:
        """(H, W) fraction of the light that vignetting leaves."""
        width, height = self.camera.resolution
        u, v = np.arange(width) - 0.5 * (width - 1), np.arange(height) - 0.5 * (height - 1)
        square = u[None] ** 2 + v[:, None] ** 2
        return 1.0 - self.imaging.vignetting * square / square.max()

    def grey(self, fine: np.ndarray) -> np.ndarray:
        """(H, W) greys without noise, from the greys of the cells `fine` (of `fine_shape`)."""
        width, height = self.camera.resolution
        grey = np.empty((height, width))
        shrink(fine, pixel_kernel(self.imaging.blur_px, self.cells, self.pad), self.cells, grey)
        return grey * (self.imaging.gain * self.falloff)

    def with_noise(self, grey: np.ndarray, rng: np.random.Generator | None) -> np.ndarray:
        """grey (H, W) with noise. Raises RigError if there is noise and rng is None."""
        if self.imaging.noise <= 0.0:
            return grey
        if rng is None:
            raise RigError("a noisy picture needs a generator of random numbers; give rng.")
        return grey + self.imaging.noise * rng.standard_normal(grey.shape)


@dataclass(frozen=True, eq=False)
class Renderer:
    """Renders images of sheets by one camera. The rays through the lens are computed once, for the first image."""

    camera: SimCamera
    imaging: Imaging = Imaging()

    def picture(
        self, sheets: Sequence[Sheet], T_world_cam: np.ndarray, rng: np.random.Generator | None = None
    ) -> Picture:
        """Image of `sheets` at the pose T_world_cam (4, 4), or the mean over the poses (K, 4, 4) of an exposure.

        rng: needed for noise, else RigError is raised.
        """
        poses = np.asarray(T_world_cam, dtype=np.float64).reshape(-1, 4, 4)
        fine = np.zeros(self._optics.fine_shape, dtype=np.float32)
        for pose in poses:
            fine += self._instant(sheets, pose)
        grey = self._optics.with_noise(self._optics.grey(fine) / len(poses), rng)
        return Picture(grey, tuple(self._truth(sheet, poses) for sheet in sheets))

    @cached_property
    def _optics(self) -> Optics:
        return Optics(self.camera, self.imaging, _CELLS)

    @cached_property
    def _rays(self) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
        """Rays (h, w, 3) through the centres of the pixels, a margin of `Optics.pad` included; their derivatives by u
        and by v, and second derivatives (3, h, w, 3) by uu, uv and vv."""
        width, height = self.camera.resolution
        pad = self._optics.pad
        u, v = np.meshgrid(np.arange(-pad - 1.0, width + pad + 1.0), np.arange(-pad - 1.0, height + pad + 1.0))
        rays = unproject(self.camera, np.stack([u, v], axis=-1))
        by_u, by_v = 0.5 * (rays[1:-1, 2:] - rays[1:-1, :-2]), 0.5 * (rays[2:, 1:-1] - rays[:-2, 1:-1])
        middle = np.ascontiguousarray(rays[1:-1, 1:-1])
        by_uu, by_vv = (
            a + b - 2.0 * middle for a, b in ((rays[1:-1, 2:], rays[1:-1, :-2]), (rays[2:, 1:-1], rays[:-2, 1:-1]))
        )
        by_uv = 0.25 * (rays[2:, 2:] + rays[:-2, :-2] - rays[2:, :-2] - rays[:-2, 2:])
        return middle, by_u, by_v, np.stack([by_uu, by_uv, by_vv])

    def _instant(self, sheets: Sequence[Sheet], T_world_cam: np.ndarray) -> np.ndarray:
        """Greys of the cells (shape `Optics.fine_shape`) at one pose, before blur."""
        fine = np.full(self._optics.fine_shape, self.imaging.background, dtype=np.float32)
        views = [(sheet, np.linalg.inv(sheet.T_world_target) @ T_world_cam) for sheet in sheets]
        for sheet, T_sheet_cam in sorted(views, key=lambda s: -_distance(*s)):
            pattern, R, C = sheet.pattern, T_sheet_cam[:3, :3], T_sheet_cam[:3, 3]
            front = C[2] > 0.0  # the back of the paper is white
            grey_of = np.where(pattern.white | (not front), self.imaging.white, self.imaging.black)
            paint(*self._rays, _CELLS, R, C, pattern.x, pattern.y, grey_of, fine)
            round_ = sheet.target.radii > 0.0
            if front and round_.any():
                discs = np.column_stack([sheet.target.points[round_, :2], sheet.target.radii[round_]])
                paint_discs(*self._rays, _CELLS, R, C, discs, self.imaging.black, fine)
        return fine

    def _truth(self, sheet: Sheet, poses: np.ndarray) -> SheetTruth:
        """True image points of a sheet, by the simulator's projection, over the poses (K, 4, 4)."""
        R_world_target, p_world_target = sheet.T_world_target[:3, :3], sheet.T_world_target[:3, 3]
        world = sheet.target.points @ R_world_target.T + p_world_target
        points = (world - poses[:, None, :3, 3]) @ poses[:, :3, :3]
        uv = project(self.camera, points)
        front = (poses[:, :3, 3] - p_world_target) @ R_world_target[:, 2] > 0.0
        in_view = visible(self.camera, points, uv) & front[:, None]
        return SheetTruth(uv.mean(axis=0), np.all(in_view, axis=0, keepdims=True)[0])


def _distance(sheet: Sheet, T_sheet_cam: np.ndarray) -> float:
    x, y = sheet.pattern.x, sheet.pattern.y
    middle = np.array([0.5 * (x[0] + x[-1]), 0.5 * (y[0] + y[-1]), 0.0])
    return float(np.linalg.norm(T_sheet_cam[:3, 3] - middle))


def exposure_poses(
    camera: SimCamera, trajectory: TrueTrajectory, seconds: float, exposure_s: float, count: int = 5
) -> np.ndarray:
    """(count, 4, 4) T_world_cam at the middles of `count` equal parts of an exposure of exposure_s [s], which is
    centred on the instant `seconds` of the IMU's clock."""
    at = seconds + exposure_s * ((np.arange(count) + 0.5) / count - 0.5)
    rotation, position, _ = trajectory.pose_at(at)
    T_world_imu = np.tile(np.eye(4), (count, 1, 1))
    T_world_imu[:, :3, :3], T_world_imu[:, :3, 3] = rotation, position
    return T_world_imu @ camera.T_imu_sensor


_SLACK = 1.3  # factor on a pixel's linear footprint, which allows for the curvature of the lens


@njit(cache=True, nogil=True, error_model="numpy")
def paint(rays, by_u, by_v, bends, s, R, C, x_edges, y_edges, grey_of, fine):
    """Paints the sheet over the greys in `fine` (H s, W s), with s x s cells per pixel.

    rays (H, W, 3): through the centres of the pixels, NaN for none; by_u, by_v (H, W, 3): their derivatives per pixel;
    bends (3, H, W, 3): second derivatives by uu, uv and vv. R (3, 3): R_sheet_cam; C (3,): position of the camera in
    the sheet's frame [m]; x_edges (nx + 1,), y_edges (ny + 1,): edges of the pattern [m]; grey_of (ny, nx): its greys.
    """
    for row in range(rays.shape[0]):
        for col in range(rays.shape[1]):
            X, Y, Xu, Yu, Xv, Yv, hits = _on_sheet(rays[row, col], by_u[row, col], by_v[row, col], R, C)
            if not hits:
                continue
            reach_x, reach_y = 0.5 * _SLACK * (abs(Xu) + abs(Xv)), 0.5 * _SLACK * (abs(Yu) + abs(Yv))
            if X + reach_x < x_edges[0] or X - reach_x > x_edges[-1]:
                continue
            if Y + reach_y < y_edges[0] or Y - reach_y > y_edges[-1]:
                continue
            i, j = _cell(x_edges, X), _cell(y_edges, Y)
            if (
                0 <= i < len(x_edges) - 1
                and 0 <= j < len(y_edges) - 1
                and X - reach_x >= x_edges[i]
                and X + reach_x <= x_edges[i + 1]
                and Y - reach_y >= y_edges[j]
                and Y + reach_y <= y_edges[j + 1]
            ):
                fine[row * s : (row + 1) * s, col * s : (col + 1) * s] = grey_of[j, i]
                continue
            for a in range(s):
                for b in range(s):
                    du, dv = (b + 0.5) / s - 0.5, (a + 0.5) / s - 0.5
                    x, y, z = _ray(rays[row, col], by_u[row, col], by_v[row, col], bends[:, row, col], du, dv)
                    grey, covered = _average(x, y, z, R, C, Xu / s, Yu / s, Xv / s, Yv / s, x_edges, y_edges, grey_of)
                    old = fine[row * s + a, col * s + b]
                    fine[row * s + a, col * s + b] = old * (1.0 - covered) + grey


@njit(cache=True, nogil=True, error_model="numpy")
def paint_discs(rays, by_u, by_v, bends, s, R, C, discs, black, fine):
    """Paints discs (n, 3), centre x, y and radius [m] on the sheet, over the greys in `fine`; other arguments as in
    `paint`.

    Within a cell, a quarter of a pixel, the edge of a disc is approximated by a line.
    """
    for row in range(rays.shape[0]):
        for col in range(rays.shape[1]):
            X, Y, Xu, Yu, Xv, Yv, hits = _on_sheet(rays[row, col], by_u[row, col], by_v[row, col], R, C)
            if not hits:
                continue
            reach = 0.5 * _SLACK * (np.hypot(Xu, Yu) + np.hypot(Xv, Yv))
            k = -1
            for i in range(len(discs)):
                if np.hypot(X - discs[i, 0], Y - discs[i, 1]) < discs[i, 2] + reach:
                    k = i
            if k < 0:
                continue
            for a in range(s):
                for b in range(s):
                    du, dv = (b + 0.5) / s - 0.5, (a + 0.5) / s - 0.5
                    d = np.array(_ray(rays[row, col], by_u[row, col], by_v[row, col], bends[:, row, col], du, dv))
                    x, y, xu, yu, xv, yv, hits = _on_sheet(d, by_u[row, col], by_v[row, col], R, C)
                    x, y = x - discs[k, 0], y - discs[k, 1]
                    far = np.hypot(x, y)
                    if not hits or far == 0.0:
                        share = 1.0 if hits else 0.0
                    else:
                        across_u, across_v = (x * xu + y * yu) / far / s, (x * xv + y * yv) / far / s
                        share = _below(discs[k, 2] - far, across_u, across_v)
                    cell = row * s + a, col * s + b
                    fine[cell] += share * (black - fine[cell])


@njit(cache=True, nogil=True)
def _ray(d, d_u, d_v, bend, du, dv):
    """The ray du, dv pixels beside the ray d, by a second-order expansion. d_u, d_v, bend: derivatives, see `paint`."""
    uu, uv, vv = 0.5 * du * du, du * dv, 0.5 * dv * dv
    x = d[0] + du * d_u[0] + dv * d_v[0] + uu * bend[0, 0] + uv * bend[1, 0] + vv * bend[2, 0]
    y = d[1] + du * d_u[1] + dv * d_v[1] + uu * bend[0, 1] + uv * bend[1, 1] + vv * bend[2, 1]
    z = d[2] + du * d_u[2] + dv * d_v[2] + uu * bend[0, 2] + uv * bend[1, 2] + vv * bend[2, 2]
    return x, y, z


@njit(cache=True, nogil=True, error_model="numpy")
def _on_sheet(d, d_u, d_v, R, C):
    """Point x, y at which a ray meets the sheet [m], its derivatives by u and v, and whether the ray meets the sheet
    (from either side)."""
    z = R[2, 0] * d[0] + R[2, 1] * d[1] + R[2, 2] * d[2]
    t = -C[2] / z
    if not (t > 0.0 and t < 1e12):
        return 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, False
    x = R[0, 0] * d[0] + R[0, 1] * d[1] + R[0, 2] * d[2]
    y = R[1, 0] * d[0] + R[1, 1] * d[1] + R[1, 2] * d[2]
    x_u = R[0, 0] * d_u[0] + R[0, 1] * d_u[1] + R[0, 2] * d_u[2]
    y_u = R[1, 0] * d_u[0] + R[1, 1] * d_u[1] + R[1, 2] * d_u[2]
    z_u = R[2, 0] * d_u[0] + R[2, 1] * d_u[1] + R[2, 2] * d_u[2]
    x_v = R[0, 0] * d_v[0] + R[0, 1] * d_v[1] + R[0, 2] * d_v[2]
    y_v = R[1, 0] * d_v[0] + R[1, 1] * d_v[1] + R[1, 2] * d_v[2]
    z_v = R[2, 0] * d_v[0] + R[2, 1] * d_v[1] + R[2, 2] * d_v[2]
    Xu, Yu, Xv, Yv = t * (x_u - x / z * z_u), t * (y_u - y / z * z_u), t * (x_v - x / z * z_v), t * (y_v - y / z * z_v)
    return C[0] + t * x, C[1] + t * y, Xu, Yu, Xv, Yv, np.isfinite(Xu + Yu + Xv + Yv)


@njit(cache=True, nogil=True)
def _cell(edges, value):
    """Index of the last of the ascending edges that is not above `value`; -1 if all are above."""
    low, high = -1, len(edges)
    while high - low > 1:
        middle = (low + high) // 2
        if edges[middle] <= value:
            low = middle
        else:
            high = middle
    return low


@njit(cache=True, nogil=True, error_model="numpy")
def _average(x, y, z, R, C, Xu, Yu, Xv, Yv, x_edges, y_edges, grey_of):
    """Integral of the sheet's grey over a cell with the central ray (x, y, z), and the share of the cell that the sheet
    covers.

    X and Y are averaged separately, which is exact unless edges of both directions cross the cell.
    """
    d_z = R[2, 0] * x + R[2, 1] * y + R[2, 2] * z
    t = -C[2] / d_z
    if not t > 0.0:
        return 0.0, 0.0
    X = C[0] + t * (R[0, 0] * x + R[0, 1] * y + R[0, 2] * z)
    Y = C[1] + t * (R[1, 0] * x + R[1, 1] * y + R[1, 2] * z)
    reach_x, reach_y = 0.5 * (abs(Xu) + abs(Xv)), 0.5 * (abs(Yu) + abs(Yv))
    i0, i1 = max(_cell(x_edges, X - reach_x), 0), min(_cell(x_edges, X + reach_x), len(x_edges) - 2)
    j0, j1 = max(_cell(y_edges, Y - reach_y), 0), min(_cell(y_edges, Y + reach_y), len(y_edges) - 2)
    grey, covered = 0.0, 0.0
    below = _below(y_edges[j0] - Y, Yu, Yv) if j0 <= j1 else 0.0
    for j in range(j0, j1 + 1):
        above = _below(y_edges[j + 1] - Y, Yu, Yv)
        left = _below(x_edges[i0] - X, Xu, Xv) if i0 <= i1 else 0.0
        for i in range(i0, i1 + 1):
            right = _below(x_edges[i + 1] - X, Xu, Xv)
            share = (right - left) * (above - below)
            grey += share * grey_of[j, i]
            covered += share
            left = right
        below = above
    return grey, covered


@njit(cache=True, nogil=True, error_model="numpy")
def _below(q, a, b):
    """P(a U + b V < q) for U and V uniform between -1/2 and 1/2."""
    a, b = abs(a), abs(b)
    if a < b:
        a, b = b, a
    half, flat = 0.5 * (a + b), 0.5 * (a - b)
    if q <= -half:
        return 0.0
    if q >= half:
        return 1.0
    if q < -flat:
        return (q + half) ** 2 / (2.0 * a * b)
    if q <= flat:
        return 0.5 + q / a
    return 1.0 - (half - q) ** 2 / (2.0 * a * b)


def pixel_kernel(sigma: float, s: int, pad: int) -> np.ndarray:
    """((2 pad + 1) s,) weights of the cells along one axis around a pixel: a box of one pixel, blurred by a Gaussian.

    sigma: of the Gaussian [px]; s: cells per pixel; pad: pixels on each side. The width of the cells adds a variance of
    1 / (12 s^2) px^2, which is subtracted from that of the Gaussian.
    """
    edges = np.arange((2 * pad + 1) * s + 1) / s - pad - 0.5
    spread = np.sqrt(max(sigma**2 - 1.0 / (12.0 * s * s), 0.0))
    integral = np.array([_ramp(e + 0.5, spread) - _ramp(e - 0.5, spread) for e in edges])
    kernel = np.diff(integral)
    return kernel / kernel.sum()


def _ramp(x: float, sigma: float) -> float:
    """The ramp function max(0, x), blurred by a Gaussian of standard deviation `sigma`."""
    if sigma == 0.0:
        return max(x, 0.0)
    z = x / sigma
    return x * 0.5 * (1.0 + erf(z / np.sqrt(2.0))) + sigma * np.exp(-0.5 * z * z) / np.sqrt(2.0 * np.pi)


@njit(cache=True, nogil=True)
def shrink(fine, kernel, s, out):
    """Fills out (H, W) with the convolution of `fine` by `kernel` along both axes, sampled at the pixels."""
    n_rows, n = fine.shape[0], len(kernel)
    narrow = np.empty((n_rows, out.shape[1]))
    for row in range(n_rows):
        for col in range(out.shape[1]):
            total = 0.0
            for k in range(n):
                total += kernel[k] * fine[row, col * s + k]
            narrow[row, col] = total
    for row in range(out.shape[0]):
        out[row] = 0.0
        for k in range(n):
            for col in range(out.shape[1]):
                out[row, col] += kernel[k] * narrow[row * s + k, col]
