"""Corners of one camera, grouped by image and body of the target."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from icalib.data.measurements import CornerStream


@dataclass(frozen=True)
class Views:
    """V views; a view is one body of the target in one image.

    start (V + 1,): corners of view j are start[j]:start[j + 1]; image, body (V,): indices of its image and body."""

    start: np.ndarray
    image: np.ndarray
    body: np.ndarray

    @classmethod
    def of(cls, stream: CornerStream, body: np.ndarray) -> Views:
        """Views of a stream whose corners are sorted by body in each image.

        body (n_points,): index of the body of each target point."""
        if not body.any():
            images = np.flatnonzero(np.diff(stream.start))
            start = np.append(stream.start[images], stream.start[-1])
            return cls(start, images, np.zeros(len(images), dtype=np.int64))
        body_of_corner, image = body[stream.point], stream.image
        fresh = np.ones(len(body_of_corner), dtype=bool)
        fresh[1:] = (np.diff(image) != 0) | (np.diff(body_of_corner) != 0)
        first = np.flatnonzero(fresh)
        return cls(np.append(first, len(body_of_corner)).astype(np.int64), image[first], body_of_corner[first])

    def of_corners(self, v0: int, v1: int) -> np.ndarray:
        """(n,) index of the view of each corner of views v0..v1."""
        return np.repeat(np.arange(v0, v1), np.diff(self.start[v0 : v1 + 1]))
