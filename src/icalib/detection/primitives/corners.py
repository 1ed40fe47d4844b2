"""The corners of one image as a detector returns them, and the rules by which corners are dropped."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, fields
from itertools import pairwise

import numpy as np

from icalib.data.measurements import CornerStream
from icalib.errors import RecordingError
from icalib.geometry.edge_fits import EDGE, NO_EDGES

IMAGE_NOISE = 2.0  # grey levels, assumed for every image: sigmas are right up to a common factor
MODEL_SIGMA_PX = 0.02  # standard deviation by sampling, printing and the lens, added to that by noise
MOST_SIGMA_PX = 0.25  # corners with a larger sigma are faint
# Sigma [px] of an L-corner for each px by which the nearest other feature is too near, up to MOST_LACKS_PX. On rendered
# tags of 12 to 28 px under three blurs, errors are 0.08 to 0.13 px per px and axis, outwards, because bits near an edge
# lighten its dark side. Beyond the limit they grow faster.
CROWDED, MOST_LACKS_PX = 0.12, 1.25
LEAST_ANGLE_DEG = 15.0  # angle between the edges of a corner, below which it is oblique

VERDICTS = ("kept", "faint", "blurred", "oblique", "inconsistent")
KEPT, FAINT, BLURRED, OBLIQUE, INCONSISTENT = range(5)


@dataclass(frozen=True)
class ImageCorners:
    """Corners of the target in one image, dropped ones included, in the order of `point`.

    point (N,) int64: index into the target's points, each at most once; uv (N, 2) px: (0, 0) is the centre of the
    top-left pixel; sigma (N,) px: expected standard deviation per axis; blur (N,) px: of a Gaussian; verdict (N,) int8:
    index into `VERDICTS`; edges (N, 2, EDGE) float32: as in `edge_fits`, zeros if they are not given.
    """

    point: np.ndarray
    uv: np.ndarray
    sigma: np.ndarray
    blur: np.ndarray
    verdict: np.ndarray
    edges: np.ndarray = field(default_factory=lambda: NO_EDGES)

    def __post_init__(self) -> None:
        if len(self.edges) != len(self.point):
            object.__setattr__(self, "edges", np.zeros((len(self.point), *NO_EDGES.shape[1:]), dtype=np.float32))

    @property
    def kept(self) -> np.ndarray:
        """(N,) bool: whether each corner is kept."""
        return self.verdict == KEPT

    def renumbered(self, point: np.ndarray) -> ImageCorners:
        """The same corners with new indices point (N,) into the target's points, sorted by these."""
        order = np.argsort(point)
        values = {f.name: getattr(self, f.name)[order] for f in fields(self)}
        return ImageCorners(**values | {"point": point[order]})

    def counts(self) -> dict[str, int]:
        """Number of corners with each verdict of `VERDICTS`."""
        return {name: int((self.verdict == k).sum()) for k, name in enumerate(VERDICTS)}


def packed(images: Sequence[ImageCorners]) -> list[ImageCorners]:
    """The same corners, as slices of a few arrays for all images: thousands of small arrays fragment the memory."""
    ends = np.cumsum([0] + [len(image.point) for image in images])
    joined = [np.concatenate([getattr(image, f.name) for image in images]) for f in fields(ImageCorners)]
    return [ImageCorners(*(values[a:b] for values in joined)) for a, b in pairwise(ends)]


def no_corners() -> ImageCorners:
    """An image without corners."""
    nothing = np.zeros(0)
    return ImageCorners(
        nothing.astype(np.int64), np.zeros((0, 2)), nothing.copy(), nothing.copy(), nothing.astype(np.int8)
    )


def with_verdicts(
    point: np.ndarray,
    uv: np.ndarray,
    quality: np.ndarray,
    consistent: np.ndarray,
    crowded: float = np.inf,
) -> ImageCorners:
    """Corners with sigma and verdict. The first of these rules that applies gives the verdict.

    inconsistent: not at the position that neighbours predict. oblique: its edges meet at less than 15 degrees. blurred:
    the nearest other feature is less than 1.5 px + 1.5 blurs away (L-corners: 1.5 px + 2.25 blurs; cells of a tag in
    the dark field: 1 px + 1.5 blurs; markers in the white field: 0.5 px + 1.5 blurs). With `crowded`, sigma [px] for
    each px below this limit, corners up to 1.25 px below it are kept. faint: sigma is above 0.25 px.

    point (N,) int64; uv (N, 2) px; quality (5, N), or with edges (5 + 2 EDGE, N), as `refined_crossings` returns it;
    consistent (N,) bool.
    """
    unit_sigma, blur, sine, room_px, _ = quality[:5]
    rows = np.flatnonzero(np.isfinite(unit_sigma))
    rows = rows[np.argsort(point[rows], kind="stable")]
    sigma, lacks = np.hypot(IMAGE_NOISE * unit_sigma[rows], MODEL_SIGMA_PX), np.maximum(-room_px[rows], 0.0)
    most_lacks = 0.0 if np.isinf(crowded) else MOST_LACKS_PX
    if most_lacks > 0.0:
        sigma = np.hypot(sigma, crowded * lacks)
    verdict = np.full(len(rows), KEPT, dtype=np.int8)
    verdict[sigma > MOST_SIGMA_PX] = FAINT
    verdict[~(lacks <= most_lacks)] = BLURRED
    verdict[sine[rows] < np.sin(np.radians(LEAST_ANGLE_DEG))] = OBLIQUE
    verdict[~consistent[rows]] = INCONSISTENT
    edges = quality[5:, rows].T.reshape(-1, 2, EDGE).astype(np.float32)
    return ImageCorners(point[rows].astype(np.int64), uv[rows], sigma, blur[rows], verdict, edges)


def corner_stream(name: str, stamps_ns: np.ndarray, images: Sequence[ImageCorners]) -> CornerStream:
    """The kept corners of the images of camera `name` at stamps_ns (M,) int64, strictly increasing.

    Raises RecordingError if the stamps do not increase, or if there is not one for each image.
    """
    stamps_ns = np.asarray(stamps_ns, dtype=np.int64)
    if len(stamps_ns) != len(images):
        raise RecordingError(f"{name}: {len(images)} images have {len(stamps_ns)} stamps; give one for each.")
    if (np.diff(stamps_ns) <= 0).any():
        row = int(np.argmax(np.diff(stamps_ns) <= 0)) + 1
        raise RecordingError(
            f"{name}: the image at {stamps_ns[row]} ns does not come after the one at {stamps_ns[row - 1]} ns; "
            "sort the images by stamp and remove repeated ones."
        )
    start = np.concatenate([[0], np.cumsum([int(image.kept.sum()) for image in images])]).astype(np.int64)
    point = np.concatenate([np.zeros(0, dtype=np.int64)] + [image.point[image.kept] for image in images])
    uv = np.concatenate([np.zeros((0, 2))] + [image.uv[image.kept] for image in images])
    sigma = np.concatenate([np.zeros(0)] + [image.sigma[image.kept] for image in images])
    edges = np.concatenate([NO_EDGES] + [image.edges[image.kept] for image in images])
    return CornerStream(name, stamps_ns, start, point, uv, sigma=sigma, edges=edges)


def checked_image(image: np.ndarray) -> np.ndarray:
    """The image as contiguous (h, w) uint8. Raises RecordingError if it is not grey with 8 bits."""
    if image.ndim != 2 or image.dtype != np.uint8:
        raise RecordingError(
            f"an image has shape {image.shape} and type {image.dtype}; convert it to grey levels, (h, w) uint8."
        )
    return np.ascontiguousarray(image)
