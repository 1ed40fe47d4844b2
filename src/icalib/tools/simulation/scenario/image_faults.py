"""Disturbances of images: walking people, changes of gain, repeated images, parts of the robot in view, dirt."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from icalib.tools.simulation.scenario.texture import Texture, dead_leaves

_PART_TEXEL_M = 0.002  # width of a pixel on the part of the robot, as from 0.9 m at a focal length of 460 px
_DIRT_SIZE = (0.02, 0.06)  # range of the standard deviation of a spot, relative to the image's width
_DIRT_DARK = (0.4, 0.9)  # range of the fraction of light that is lost in the middle of a spot
_PART_STREAM, _DIRT_STREAM = 20_000, 20_001  # numbers of random streams


@dataclass(frozen=True)
class ImageFaults:
    """Disturbances of the images of a room, the same for all cameras. Instants are seconds on the IMU's clock since its
    origin.

    people: number of people who walk in front of the first camera, at 1.4 to 2.2 m; one covers about an eighth of an
    image of 80 deg. gain_steps: (instant, gain), from the instant on all light is multiplied by gain. frozen: (start,
    end), in which cameras repeat the image before. robot_part: fraction of the image, from the bottom, that a part of
    the robot hides. dirt: number of spots on the lens.
    """

    people: int = 0
    gain_steps: tuple[tuple[float, float], ...] = ()
    frozen: tuple[tuple[float, float], ...] = ()
    robot_part: float = 0.0
    dirt: int = 0

    def gain_at(self, seconds: float) -> float:
        past = [step for step in self.gain_steps if step[0] <= seconds]
        return max(past)[1] if past else 1.0


@dataclass(frozen=True, eq=False)
class CameraFaults:
    """Constant disturbances in the view of one camera. share (H, W): fraction of the light that passes the dirt; part
    (H, W): fraction of each pixel that the robot covers; texture (H, W): of the robot there, 0 to 1. None stands for no
    disturbance."""

    share: np.ndarray | None = None
    part: np.ndarray | None = None
    texture: np.ndarray | None = None

    def applied(self, grey: np.ndarray, black: float, white: float) -> np.ndarray:
        """grey (H, W) with the part of the robot and the dirt; black, white: greys of texture 0 and 1."""
        if self.part is not None and self.texture is not None:
            grey = grey + self.part * (black + (white - black) * self.texture - grey)
        return grey if self.share is None else grey * self.share


def faults_of(faults: ImageFaults, resolution: tuple[int, int], camera: int) -> CameraFaults:
    """The constant disturbances of camera number `camera`; resolution: (width, height) px."""
    width, height = resolution
    share = part = texture = None
    u, v = np.meshgrid(np.arange(width) / width, np.arange(height) / height)
    if faults.robot_part > 0.0:
        edge = 1.0 - faults.robot_part * (1.0 + 0.2 * np.sin(9.0 * u + camera))
        part = np.clip((v - edge) * height + 0.5, 0.0, 1.0)
        size = (width * _PART_TEXEL_M, height * _PART_TEXEL_M)
        texture = dead_leaves(size, _PART_TEXEL_M, Texture(camera, 1.0), _PART_STREAM)[:height, :width]
    if faults.dirt:
        rng = np.random.default_rng([camera, _DIRT_STREAM])
        share = np.ones((height, width))
        for _ in range(faults.dirt):
            x, y = rng.random(2)
            size = rng.uniform(*_DIRT_SIZE)
            square = (u - x) ** 2 + ((v - y) * height / width) ** 2
            share *= 1.0 - rng.uniform(*_DIRT_DARK) * np.exp(-0.5 * square / size**2)
    return CameraFaults(share, part, texture)
