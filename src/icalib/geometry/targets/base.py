"""Interface of the calibration targets; all other packages use only this class."""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import dataclass, field, fields
from functools import cached_property
from typing import Any, ClassVar

import numpy as np

from icalib.errors import RecordingError
from icalib.geometry.targets.families import TagSet

BOARD = "board0"
UNIT_TAG = np.array([(0.0, 0.0, 0.0), (1.0, 0.0, 0.0), (1.0, 1.0, 0.0), (0.0, 1.0, 0.0)])  # corners of a tag of edge 1
# Relative standard deviation of a printed size: a ruler is read to 0.2 mm in 100 mm, and printers and damp paper have
# errors of the same size.
SIZE_SIGMA = 0.002


@dataclass(frozen=True)
class Target(ABC):
    """Known points on flat, rigid bodies; most targets have one body. A body's frame has its origin at its first point.
    Its x axis points right and y up on the sheet, z out of the print. All points have z = 0.

    A point is identified by a tag id and the number of a corner. On targets whose points are not corners of tags, the
    tag id is 0. type: name in rig files. blooms: whether points are corners of tags, which edge bloom shifts towards
    the tag's centre; it does not shift corners where squares touch diagonally. seldom: fields that `plain` omits if
    they have their default values.
    """

    type: ClassVar[str]
    blooms: ClassVar[bool]
    seldom: ClassVar[tuple[str, ...]] = ()

    size_sigma: float = field(default=SIZE_SIGMA, kw_only=True)  # relative, common to all lengths; 0: exact
    # (width, height) [m] of the flat sheet, x and y of its body, with the points in its middle; None: see `outlines`
    sheet: tuple[float, float] | None = field(default=None, kw_only=True)

    @cached_property
    @abstractmethod
    def points(self) -> np.ndarray:
        """(n, 3) points [m], each in the frame of its body."""

    @cached_property
    def tag_centers(self) -> np.ndarray:
        """(n, 3) centre of the tag of each point [m]; the point itself if the target has no bloom."""
        return self.points

    @cached_property
    def radii(self) -> np.ndarray:
        """(n,) radius of the circle around each point [m]; 0 for points that are not centres of circles."""
        return np.zeros(len(self.points))

    @property
    def has_sheet(self) -> tuple[bool, ...]:
        """Whether the size of each body's sheet is given, so that its edges are known."""
        return (self.sheet is not None,) * len(self.bodies)

    @cached_property
    def outlines(self) -> np.ndarray:
        """(bodies, 2, 2) least and greatest x and y [m] of the flat sheet of each body. Without `sheet` it is what the
        points span, with the squares or circles around them."""
        rim = getattr(self, "square_size", 0.0) + self.radii.max(initial=0.0)
        out = np.empty((len(self.bodies), 2, 2))
        for k in range(len(self.bodies)):
            xy = self.points[self.body == k, :2]
            low, high = xy.min(axis=0) - rim, xy.max(axis=0) + rim
            middle, half = 0.5 * (low + high), 0.5 * (high - low if self.sheet is None else np.array(self.sheet))
            out[k] = middle - half, middle + half
        return out

    @cached_property
    def bodies(self) -> tuple[str, ...]:
        """Name of each rigid body. The relative poses of several bodies are unknown, and estimated."""
        return (BOARD,)

    @cached_property
    def body(self) -> np.ndarray:
        """(n,) int64: index of the body of each point."""
        return np.zeros(len(self.points), dtype=np.int64)

    @cached_property
    def tag_number(self) -> np.ndarray:
        """(n,) int64: index that all corners of one tag share, as they are detected together. Each corner without a tag
        has a different index."""
        return np.arange(len(self.points))

    @cached_property
    def bends(self) -> np.ndarray:
        """(bodies,) bool: whether each body is large enough to bend."""
        return np.ones(len(self.bodies), dtype=bool)

    @property
    def tags(self) -> TagSet | None:
        """The tags that identify this target in images; None if it has no tags."""
        return None

    def plain(self) -> dict[str, Any]:
        """Fields as in a rig file: text, numbers, lists. Empty lists are omitted, and so are `seldom` fields with
        default values."""
        usual = {f.name: f.default for f in fields(self) if f.name in (*self.seldom, "size_sigma", "sheet")}
        values = {f.name: getattr(self, f.name) for f in fields(self)}
        values = {name: value for name, value in values.items() if name not in usual or value != usual[name]}
        lists = {name: list(value) if isinstance(value, tuple) else value for name, value in values.items()}
        return {"type": self.type} | {name: value for name, value in lists.items() if value != []}

    @cached_property
    def turns(self) -> tuple[np.ndarray, ...]:
        """Permutations (n,) of the point numbers by each rotation of the sheet that leaves its appearance unchanged.
        The first is the identity."""
        return (np.arange(len(self.points)),)

    @property
    def symmetric(self) -> bool:
        """Whether a rotation of the sheet leaves its appearance unchanged, so that images cannot identify its
        points."""
        return len(self.turns) > 1

    @abstractmethod
    def point_index(self, tag_id: np.ndarray, corner: np.ndarray) -> np.ndarray:
        """(N,) indices into `points`, from (N,) tag ids and (N,) corner numbers. Raises RecordingError if the target
        has no such point."""

    @abstractmethod
    def point_identity(self, index: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """(N,) tag ids and (N,) corner numbers of (N,) indices into `points`."""


@dataclass(frozen=True)
class TagTarget(Target):
    """Target whose points are the corners of tags. Corner c of tag number i has index 4 i + c. Corner 0 of a tag is at
    its bottom left; the others follow counterclockwise."""

    blooms: ClassVar[bool] = True

    @cached_property
    def tag_centers(self) -> np.ndarray:
        return np.repeat(self.points.reshape(-1, 4, 3).mean(axis=1), 4, axis=0)

    @cached_property
    def tag_number(self) -> np.ndarray:
        return np.arange(len(self.points)) // 4

    def point_index(self, tag_id: np.ndarray, corner: np.ndarray) -> np.ndarray:
        tag_id, corner = np.asarray(tag_id, dtype=np.int64), np.asarray(corner, dtype=np.int64)
        numbers = self.tag_numbers(tag_id)
        if (bad := (corner < 0) | (corner > 3)).any():
            raise RecordingError(f"corner {corner[bad][0]} is not one of a tag's corners 0 to 3.")
        return 4 * numbers + corner

    @abstractmethod
    def tag_numbers(self, tag_id: np.ndarray) -> np.ndarray:
        """(N,) numbers of the tags with ids (N,). Raises RecordingError if the target has no such tag."""


@dataclass(frozen=True)
class UntaggedTarget(Target):
    """Target whose points are not corners of tags. sizes: words for the fields that give the number of points."""

    blooms: ClassVar[bool] = False
    sizes: ClassVar[str] = "rows and cols"

    def point_index(self, tag_id: np.ndarray, corner: np.ndarray) -> np.ndarray:
        tag_id, corner = np.asarray(tag_id, dtype=np.int64), np.asarray(corner, dtype=np.int64)
        if (tag_id != 0).any():
            raise RecordingError(
                f"tag {tag_id[tag_id != 0][0]} is not on the target, whose corners have tag 0; correct the tag."
            )
        bad = (corner < 0) | (corner >= len(self.points))
        if bad.any():
            raise RecordingError(
                f"corner {corner[bad][0]} is not on the target (corners 0 to {len(self.points) - 1}); "
                f"check {self.sizes} in the rig file."
            )
        return corner

    def point_identity(self, index: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        return np.zeros_like(index), index
