"""Several targets in one scene.

No target: cameras use feature tracks of the scene.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from itertools import combinations
from typing import Any, ClassVar, final

import numpy as np

from icalib.errors import RecordingError, RigError
from icalib.geometry.targets.base import Target
from icalib.geometry.targets.boards import Checkerboard, Circles


@dataclass(frozen=True)
class Scene(Target):
    """Several targets, by name, that do not move relative to each other. Their relative poses are unknown, and
    estimated.

    Points are those of the first target, then of the second, and so on. A body is named after its target, or after
    target and body if the target has several. All sizes share one relative error, with the largest `size_sigma` of all
    targets. Raises RigError if images cannot distinguish two of the targets.
    """

    type: ClassVar[str] = "scene"
    blooms: ClassVar[bool] = True

    names: tuple[str, ...]
    targets: tuple[Target, ...]

    def __post_init__(self) -> None:
        object.__setattr__(self, "size_sigma", max(t.size_sigma for t in self.targets))
        for (name, target), (second_name, second) in combinations(zip(self.names, self.targets, strict=True), 2):
            if common := _in_common(target, second):
                raise RigError(f"images cannot tell {name} from {second_name}: {common}.")

    def plain(self) -> dict[str, Any]:
        """The content of `targets` in a rig file: fields of each target by name."""
        return {name: target.plain() for name, target in zip(self.names, self.targets, strict=True)}

    @cached_property
    def first_points(self) -> np.ndarray:
        """(targets + 1,) index of the first point of each target, followed by the number of points."""
        return np.concatenate([[0], np.cumsum([len(t.points) for t in self.targets])]).astype(np.int64)

    @cached_property
    def points(self) -> np.ndarray:
        """(n, 3) points [m], each in the frame of its body."""
        return np.concatenate([t.points for t in self.targets])

    @cached_property
    def tag_centers(self) -> np.ndarray:
        return np.concatenate([t.tag_centers for t in self.targets])

    @cached_property
    def radii(self) -> np.ndarray:
        return np.concatenate([t.radii for t in self.targets])

    @cached_property
    def bodies(self) -> tuple[str, ...]:
        pairs = zip(self.names, self.targets, strict=True)
        return tuple(name if len(t.bodies) == 1 else f"{name} {body}" for name, t in pairs for body in t.bodies)

    @cached_property
    def body(self) -> np.ndarray:
        first = np.concatenate([[0], np.cumsum([len(t.bodies) for t in self.targets])])
        return np.concatenate([t.body + k for t, k in zip(self.targets, first[:-1], strict=True)])

    @cached_property
    def tag_number(self) -> np.ndarray:
        pairs = zip(self.targets, self.first_points[:-1], strict=True)
        return np.concatenate([t.tag_number + first for t, first in pairs])

    @property
    def has_sheet(self) -> tuple[bool, ...]:
        return tuple(has for t in self.targets for has in t.has_sheet)

    @cached_property
    def outlines(self) -> np.ndarray:
        return np.concatenate([t.outlines for t in self.targets])

    @cached_property
    def bends(self) -> np.ndarray:
        return np.concatenate([t.bends for t in self.targets])

    @property
    def symmetric(self) -> bool:
        return any(t.symmetric for t in self.targets)

    def point_index(self, tag_id: np.ndarray, corner: np.ndarray) -> np.ndarray:
        """See `Target`. Raises RecordingError also if two targets have such a corner, as a table does not say which is
        meant."""
        tag_id, corner = np.asarray(tag_id, dtype=np.int64), np.asarray(corner, dtype=np.int64)
        index = np.full(len(tag_id), -1)
        owner = np.full(len(tag_id), -1)
        for k, (target, first) in enumerate(zip(self.targets, self.first_points[:-1], strict=True)):
            is_point = _rows_of(target, tag_id, corner)
            if (repeated := is_point & (owner >= 0)).any():
                names = f"{self.names[owner[repeated][0]]} and {self.names[k]}"
                raise RecordingError(
                    f"corner {corner[repeated][0]} of tag {tag_id[repeated][0]} is on {names}; give them other ids, "
                    "or images."
                )
            owner[is_point] = k
            index[is_point] = first + target.point_index(tag_id[is_point], corner[is_point])
        if (unknown := owner < 0).any():
            raise RecordingError(
                f"corner {corner[unknown][0]} of tag {tag_id[unknown][0]} is on none of {', '.join(self.names)}; "
                "check the targets in the rig file."
            )
        return index

    def point_identity(self, index: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        index = np.asarray(index, dtype=np.int64)
        tag_id, corner = np.empty_like(index), np.empty_like(index)
        owner = np.searchsorted(self.first_points, index, side="right") - 1
        for k, target in enumerate(self.targets):
            rows = owner == k
            tag_id[rows], corner[rows] = target.point_identity(index[rows] - self.first_points[k])
        return tag_id, corner


def _in_common(first: Target, second: Target) -> str:
    """Why images cannot distinguish the two targets, and advice; empty if they can."""
    if first.tags and second.tags and (ids := first.tags.shared_with(second.tags)):
        advice = "give them other ids or families (first_id and family of an aprilgrid), or leave one out"
        return f"both have tag {ids[0]} of {first.tags.family}; {advice}"
    if isinstance(first, Circles) and isinstance(second, Circles):
        return "both are grids of circles; leave one out, or take a board with tags"
    boards = [{t.rows, t.cols} for t in (first, second) if isinstance(t, Checkerboard)]
    if len(boards) == 2 and boards[0] == boards[1]:
        return "both are checkerboards with as many corners; take another size, or boards with tags"
    return ""


def _rows_of(target: Target, tag_id: np.ndarray, corner: np.ndarray) -> np.ndarray:
    """(N,) bool: whether each tag id and corner number is a point of `target`."""
    identities = np.stack(target.point_identity(np.arange(len(target.points))), axis=1)
    base = 1 + int(max(identities.max(), tag_id.max(initial=0), corner.max(initial=0)))
    return np.isin(tag_id * base + corner, identities[:, 0] * base + identities[:, 1]) & (tag_id >= 0) & (corner >= 0)


@final
@dataclass(frozen=True)
class NoTarget(Target):
    """A target without points, for rigs without a target."""

    type: ClassVar[str] = "none"
    blooms: ClassVar[bool] = False

    @cached_property
    def points(self) -> np.ndarray:
        return np.zeros((0, 3))

    @cached_property
    def bodies(self) -> tuple[str, ...]:
        return ()

    def point_index(self, tag_id: np.ndarray, corner: np.ndarray) -> np.ndarray:
        raise RecordingError("the rig file has no target; add one.")

    def point_identity(self, index: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        return index, index
