"""Images of printed targets by a simulated camera, with the true image points.

A pixel is the mean light over its square, by rays through the distorted lens; no image is resampled. Pixel (0, 0) is
the CENTRE of the top left square. The renderer is independent of the detection of corners.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import cached_property

import numpy as np

from icalib.errors import RigError
from icalib.geometry.targets import Target
from icalib.geometry.targets.pattern import Pattern, pattern_of
from icalib.tools.simulation.images.lenses import unproject
from icalib.tools.simulation.images.raster import paint, paint_discs, pixel_kernel, shrink
from icalib.tools.simulation.scenario.projection import project, visible
from icalib.tools.simulation.scenario.scenario import SimCamera
from icalib.tools.simulation.scenario.trajectory import TrueTrajectory

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
