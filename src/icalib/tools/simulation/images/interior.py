"""Images of a room from the inside: textured surfaces, as a camera in it sees them.

Every cell of a pixel, of 2 x 2, has its own ray through the lens, its own instant within the exposure, and the light of
its footprint on the surface that it meets.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from icalib.tools.simulation.images.lenses import unproject
from icalib.tools.simulation.images.rendering import Imaging, Optics
from icalib.tools.simulation.images.roomlight import CELLS, TILE, PixelRays, Tone, VisibleFaces, light
from icalib.tools.simulation.scenario.image_faults import CameraFaults
from icalib.tools.simulation.scenario.room import Obstacle, Room
from icalib.tools.simulation.scenario.scenario import SimCamera
from icalib.tools.simulation.scenario.texture import Atlas, Texture, atlas_of, leaves, texel_size

INSTANTS = CELLS * CELLS  # of an exposure, as many poses are wanted
_PERSON_SURFACES = 10_000  # numbers of their textures, so that people leave those of the room as they are


@dataclass(frozen=True, eq=False)
class Interior:
    """A room and its textures. people: blocks that may stand anywhere in it, whose textures they keep.

    atlas: by default textures made as the room says. Those of the room's faces come first, then those of the people's,
    then that of the hills.
    """

    room: Room
    people: tuple[Obstacle, ...] = ()
    atlas: Atlas | None = None

    def view(self, people: tuple[Obstacle, ...] = ()) -> VisibleFaces:
        """Faces visible with the obstacles at their current places. people: those of this room, in their order."""
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
        return atlas_of([leaves(s, texel_m, *look) for s, look in zip(sizes, looks, strict=True)])


@dataclass(frozen=True, eq=False)
class RoomRenderer:
    """Takes pictures with one camera. What the lens does to the rays is worked out once, at the first picture."""

    camera: SimCamera
    imaging: Imaging = Imaging()
    faults: CameraFaults = CameraFaults()

    def grey(
        self, view: VisibleFaces, T_world_cam: np.ndarray, gain: float, rng: np.random.Generator | None
    ) -> np.ndarray:
        """(H, W) neither rounded nor clipped, from T_world_cam (4, 4), or over the poses (4, 4, 4) of an exposure.

        gain: times all light. rng: where noise is wanted. Raises RigError where noise is wanted without one.
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
    """`Lens.sides` of rays (h s, w s, 3): a pyramid of rectangular base about a tile's mean ray that holds the tile."""
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
