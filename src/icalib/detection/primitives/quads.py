"""Dark quads in an image, which are candidates for tags."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from icalib.base.extras import load_cv2
from icalib.detection.primitives.corners import checked_image

_QUAD_CONTRAST = 7  # grey levels below the local mean at which a pixel is dark
_LEAST_SIDE_PX = 7.0  # longer side of the bounding box, at least
_LEAST_FILL = 0.75  # share of its quad's area that a contour covers, at least
_STRAIGHT_SIDE = 0.05  # of the perimeter: largest distance of a contour from its polygon
_WINDOW_SHARES = (0.08, 0.03, 0.2)  # widths of the windows of the local mean, as shares of the image's width


@dataclass(frozen=True, eq=False)
class ImageWithQuads:
    """An image (h, w) uint8 with a cache of its dark quads, which several detectors share.

    Raises RecordingError for an image that is not grey with 8 bits.
    """

    image: np.ndarray
    _quads: dict[tuple[int, bool], np.ndarray] = field(default_factory=dict)

    def __post_init__(self) -> None:
        object.__setattr__(self, "image", checked_image(self.image))

    @property
    def windows(self) -> tuple[int, ...]:
        """Windows [px] of `threshold_windows` for this image."""
        return threshold_windows(self.image.shape[1])

    def quads(self, window: int, separate: bool) -> np.ndarray:
        """`dark_quads` of the image, from the cache if known."""
        if (window, separate) not in self._quads:
            self._quads[window, separate] = dark_quads(self.image, window, separate)
        return self._quads[window, separate]


def dark_quads(image: np.ndarray, window: int, separate: bool) -> np.ndarray:
    """(n, 4, 2) px: clockwise corners of dark regions with about four straight sides, accurate to about 2 px.

    image (h, w) uint8. Pixels are dark if they are darker than the mean of `window` x `window` px (odd). With
    `separate`, dark regions are first eroded by one pixel, so that tags whose corners touch other dark squares are
    separated.
    """
    cv2 = load_cv2()
    dark = cv2.adaptiveThreshold(
        image, 255, cv2.ADAPTIVE_THRESH_MEAN_C, cv2.THRESH_BINARY_INV, window, float(_QUAD_CONTRAST)
    )
    if separate:
        dark = cv2.erode(dark, np.ones((3, 3), dtype=np.uint8))
    contours, hierarchy = cv2.findContours(dark, cv2.RETR_CCOMP, cv2.CHAIN_APPROX_SIMPLE)
    if hierarchy is None:
        return np.zeros((0, 4, 2))
    quads = []
    for contour, parent in zip(contours, hierarchy[0, :, 3], strict=True):
        if parent < 0 and len(contour) >= 4:
            quad = _quad(cv2, contour)
            if quad is not None:
                quads.append(_grown(quad) if separate else quad)
    return np.array(quads).reshape(-1, 4, 2)


def _quad(cv2, contour: np.ndarray) -> np.ndarray | None:
    """The quad (4, 2) of a contour, clockwise; None if it is too small, has not four corners, or fills too little of
    its quad."""
    _, _, width, height = cv2.boundingRect(contour)
    if max(width, height) < _LEAST_SIDE_PX or min(width, height) < 0.25 * _LEAST_SIDE_PX:
        return None
    hull = cv2.convexHull(contour)
    corners = cv2.approxPolyDP(hull, _STRAIGHT_SIDE * cv2.arcLength(hull, True), True)
    if len(corners) != 4:
        return None
    quad = corners[:, 0, :].astype(np.float64)
    area = cv2.contourArea(corners, True)
    if cv2.contourArea(contour) < _LEAST_FILL * abs(area):
        return None
    return quad if area > 0 else quad[::-1]


def _grown(quad: np.ndarray) -> np.ndarray:
    """The quad with each corner moved outwards by one diagonal pixel."""
    out = quad - quad.mean(axis=0)
    return quad + np.sqrt(2.0) * out / np.linalg.norm(out, axis=1, keepdims=True)


def threshold_windows(width: int) -> tuple[int, ...]:
    """Windows [px] of `dark_quads` for images of this width, in the order in which they are tried."""
    return tuple(max(2 * int(0.5 * share * width) + 1, 11) for share in _WINDOW_SHARES)
