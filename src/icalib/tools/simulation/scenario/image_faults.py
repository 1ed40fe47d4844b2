"""What goes wrong with images: people who walk, changes of gain, repeated images, the robot itself, dirt."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from icalib.tools.simulation.scenario.texture import Texture, leaves

_PART_TEXEL_M = 0.002  # a pixel of the robot's own part, as if seen from 0.9 m at a focal length of 460 px
_DIRT_SIZE = (0.02, 0.06)  # standard deviation of a spot, share of the image's width
_DIRT_DARK = (0.4, 0.9)  # share of the light lost in its middle
_PART_STREAM, _DIRT_STREAM = 20_000, 20_001  # of random numbers


@dataclass(frozen=True)
class ImageFaults:
    """Of images of a room, by all cameras alike; instants are seconds on the IMU's clock, since its origin.

    people: how many walk before the first camera, 1.4 to 2.2 m away; one covers about an eighth of an image of 80 deg.
    gain_steps: (instant, gain), from when on all light is multiplied by gain. frozen: (start, end), in which a camera
    repeats the image before. robot_part: share of the image, from below, that a part of the robot hides. dirt: spots on
    the lens.
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
    """What stays in one camera's view. share (H, W): of the light that arrives; own (H, W): texture of what hides the
    rest, 0 to 1, of the robot's part (H, W) bool. Each may be None: nothing."""

    share: np.ndarray | None = None
    part: np.ndarray | None = None
    own: np.ndarray | None = None

    def applied(self, grey: np.ndarray, black: float, white: float) -> np.ndarray:
        """grey (H, W) as it arrives."""
        if self.part is not None and self.own is not None:
            grey = grey + self.part * (black + (white - black) * self.own - grey)
        return grey if self.share is None else grey * self.share


def faults_of(faults: ImageFaults, resolution: tuple[int, int], camera: int) -> CameraFaults:
    """Of the camera of this number."""
    width, height = resolution
    share = part = own = None
    u, v = np.meshgrid(np.arange(width) / width, np.arange(height) / height)
    if faults.robot_part > 0.0:
        edge = 1.0 - faults.robot_part * (1.0 + 0.2 * np.sin(9.0 * u + camera))
        part = np.clip((v - edge) * height + 0.5, 0.0, 1.0)
        size = (width * _PART_TEXEL_M, height * _PART_TEXEL_M)
        own = leaves(size, _PART_TEXEL_M, Texture(camera, 1.0), _PART_STREAM)[:height, :width]
    if faults.dirt:
        rng = np.random.default_rng([camera, _DIRT_STREAM])
        share = np.ones((height, width))
        for _ in range(faults.dirt):
            x, y = rng.random(2)
            size = rng.uniform(*_DIRT_SIZE)
            square = (u - x) ** 2 + ((v - y) * height / width) ** 2
            share *= 1.0 - rng.uniform(*_DIRT_DARK) * np.exp(-0.5 * square / size**2)
    return CameraFaults(share, part, own)
