"""Textures of a room's surfaces: patches of all sizes, and plain regions between them.

The patches are a dead leaves model (Lee, Mumford, Huang 2001): rectangles and ellipses that occlude one another. Their
number density falls with the cube of their size, so that every octave covers the same area. Each texture is stored as a
mipmap, a pyramid of averages over 2 x 2 texels (Williams 1983).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from icalib.base.compiled import njit

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
