"""The detector of each target."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Protocol, runtime_checkable

import numpy as np

from icalib.detection.boards.aprilgrid import AprilGridDetector
from icalib.detection.boards.charuco import CharucoDetector
from icalib.detection.boards.checkerboard import CheckerboardDetector
from icalib.detection.boards.circles import CirclesDetector
from icalib.detection.boards.markers import MarkerDetector
from icalib.detection.primitives.corners import ImageCorners, no_corners
from icalib.detection.primitives.prediction import PredictedCorners, predict_corners
from icalib.detection.primitives.quads import ImageWithQuads
from icalib.errors import RigError
from icalib.geometry.targets import AprilGrid, Charuco, Checkerboard, Circles, Markers, Scene, Target

_SAME_PX = 3.0  # corners this close are one


class Detector(Protocol):
    """Finds one target in images."""

    def detect(self, image: np.ndarray, before: Sequence[ImageCorners] = ()) -> ImageCorners:
        """Corners in the image (h, w) uint8, indices into the target's points; faster where the last images
        `before` show how the target moves."""
        ...


class _Finder(Protocol):
    def find(self, view: ImageWithQuads) -> ImageCorners:
        """Corners in the whole image, indices into the target's points."""
        ...


@runtime_checkable
class _Follower(_Finder, Protocol):
    def find_near(self, view: ImageWithQuads, expected: PredictedCorners) -> ImageCorners | None:
        """As `find`, where corners are expected; None where the whole image is to be searched."""
        ...


def detector_of(target: Target) -> Detector:
    """The detector that finds `target`. Raises RigError for one that none finds in images."""
    return _Detector(_finder_of(target))


@dataclass(frozen=True, eq=False)
class _Detector:
    """Looks where motion leads `finder` to expect the target, and in the whole image where it is not there."""

    finder: _Finder

    def detect(self, image: np.ndarray, before: Sequence[ImageCorners] = ()) -> ImageCorners:
        view = ImageWithQuads(image)
        expected = predict_corners(before) if isinstance(self.finder, _Follower) else None
        if expected is not None and isinstance(self.finder, _Follower):
            found = self.finder.find_near(view, expected)
            if found is not None:
                return found
        return self.finder.find(view)


def _finder_of(target: Target) -> _Finder:
    if isinstance(target, Scene):
        members, tagged = (
            tuple(_finder_of(t) for t in target.targets),
            tuple(t.tags is not None for t in target.targets),
        )
        return _SceneDetector(members, target.first_points[:-1], tagged)
    if isinstance(target, Markers):
        return MarkerDetector(target.family, tuple(target.known.tolist()), target.border_bits)
    if isinstance(target, AprilGrid):
        of = target.rows, target.cols, target.tag_spacing, target.family, target.border_bits
        return AprilGridDetector(*of, target.squares, target.first_id)
    if isinstance(target, Charuco):
        return _Inverted(charuco_detector(target)) if target.inverted else charuco_detector(target)
    if isinstance(target, Checkerboard):
        number = _from_the_bottom(target.rows, target.cols)
        board = _Renumbered(CheckerboardDetector(target.rows, target.cols), number)
        return _Inverted(board) if target.inverted else board
    if isinstance(target, Circles):
        return CirclesDetector(target)
    raise RigError(f"targets of type {target.type} are not found in images; use corners as a table.")


def charuco_detector(board: Charuco) -> CharucoDetector:
    """That of the board, black on white."""
    ratio = board.marker_size / board.square_size
    return CharucoDetector(board.squares_y, board.squares_x, ratio, board.dictionary, board.legacy)


@dataclass(frozen=True, eq=False)
class _SceneDetector:
    """Finds each target with its own of `members`; first (members,): a scene's number of its first point."""

    members: tuple[_Finder, ...]
    first: np.ndarray
    tagged: tuple[bool, ...]  # whether tags tell a member from others

    def find(self, view: ImageWithQuads) -> ImageCorners:
        found = [member.find(view) for member in self.members]
        of_tags = np.concatenate([np.zeros((0, 2))] + [f.uv for f, t in zip(found, self.tagged, strict=True) if t])
        found = [f if t or _apart(f.uv, of_tags) else no_corners() for f, t in zip(found, self.tagged, strict=True)]
        fields = {f.name: np.concatenate([getattr(one, f.name) for one in found]) for f in dataclasses.fields(found[0])}
        point = np.concatenate([one.point + first for one, first in zip(found, self.first, strict=True)])
        return ImageCorners(**fields | {"point": point})


@dataclass(frozen=True, eq=False)
class _Inverted:
    """Finds with `detector` what is white on black."""

    detector: CharucoDetector | _Renumbered

    def find(self, view: ImageWithQuads) -> ImageCorners:
        return self.detector.find(ImageWithQuads(255 - view.image))

    def find_near(self, view: ImageWithQuads, expected: PredictedCorners) -> ImageCorners | None:
        return self.detector.find_near(ImageWithQuads(255 - view.image), expected)


@dataclass(frozen=True, eq=False)
class _Renumbered:
    """What `detector` calls k is the target's point number[k]."""

    detector: CheckerboardDetector
    number: np.ndarray

    def find(self, view: ImageWithQuads) -> ImageCorners:
        found = self.detector.find(view)
        return found.renumbered(self.number[found.point])

    def find_near(self, view: ImageWithQuads, expected: PredictedCorners) -> ImageCorners | None:
        found = self.detector.find_near(view, PredictedCorners(np.argsort(self.number)[expected.point], expected.uv))
        return None if found is None else found.renumbered(self.number[found.point])


def _apart(uv: np.ndarray, others: np.ndarray) -> bool:
    """Whether no corner of a board lies on another target's, whose squares may look like a small checkerboard."""
    return not len(others) or bool((np.linalg.norm(uv[:, None] - others, axis=2) > _SAME_PX).all())


def _from_the_bottom(rows: int, cols: int) -> np.ndarray:
    """(rows cols,) the target's point of each of the detector's corners.

    The target's y goes up the sheet, the detector's down. Both begin where the corner's square is dark: backwards along
    an even side, the first square is dark again.
    """
    number = np.arange(rows * cols).reshape(rows, cols)
    return (number[:, ::-1] if rows % 2 == 1 and cols % 2 == 0 else number[::-1]).ravel()
