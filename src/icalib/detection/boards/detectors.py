"""Chooses the detector of each target."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Protocol, runtime_checkable

import numpy as np

from icalib.detection.boards.aprilgrid import AprilGridDetector, MarkerDetector
from icalib.detection.boards.charuco import CharucoDetector
from icalib.detection.boards.checkerboard import CheckerboardDetector
from icalib.detection.boards.circles import CirclesDetector
from icalib.detection.primitives.corners import ImageCorners, no_corners
from icalib.detection.primitives.prediction import PredictedCorners, predict_corners
from icalib.detection.primitives.tags import ImageWithQuads
from icalib.errors import RigError
from icalib.geometry.targets import AprilGrid, Charuco, Checkerboard, Circles, Markers, Scene, Target

_SAME_PX = 3.0  # corners closer together are the same


class Detector(Protocol):
    """Finds one target in images."""

    def detect(self, image: np.ndarray, before: Sequence[ImageCorners] = ()) -> ImageCorners:
        """Corners in the image (h, w) uint8, as indices into the target's points. Faster if the preceding images
        `before` show how the target moves."""
        ...


class _Finder(Protocol):
    """Finds a target by a search of the whole image."""

    def find(self, view: ImageWithQuads) -> ImageCorners:
        """Corners in the whole image, as indices into the target's points."""
        ...


@runtime_checkable
class _Follower(_Finder, Protocol):
    """Finds a target also near predicted corners."""

    def find_near(self, view: ImageWithQuads, expected: PredictedCorners) -> ImageCorners | None:
        """As `find`, near predicted corners; None if the whole image is to be searched."""
        ...


def detector_of(target: Target) -> Detector:
    """The detector that finds `target`. Raises RigError for a target that cannot be found in images."""
    return _Detector(_finder_of(target))


@dataclass(frozen=True, eq=False)
class _Detector:
    """Uses `finder` near predicted corners, and in the whole image if the target is not found there."""

    finder: _Finder

    def detect(self, image: np.ndarray, before: Sequence[ImageCorners] = ()) -> ImageCorners:
        """As `Detector.detect`."""
        view = ImageWithQuads(image)
        expected = predict_corners(before) if isinstance(self.finder, _Follower) else None
        if expected is not None and isinstance(self.finder, _Follower):
            corners = self.finder.find_near(view, expected)
            if corners is not None:
                return corners
        return self.finder.find(view)


def _finder_of(target: Target) -> _Finder:
    """The finder of a target. Raises RigError if there is none."""
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
        return _Inverted(CirclesDetector(target), either=True)
    raise RigError(f"targets of type {target.type} are not found in images; use corners as a table.")


def charuco_detector(board: Charuco) -> CharucoDetector:
    """The detector of the board, for black on white."""
    ratio = board.marker_size / board.square_size
    return CharucoDetector(board.squares_y, board.squares_x, ratio, board.dictionary, board.legacy)


@dataclass(frozen=True, eq=False)
class _SceneDetector:
    """Finds each target of a scene with its detector in `members`. first (members,): number of its first point in the
    scene.

    A board without tags is dropped if it overlaps with a tagged target, whose squares may look like a small
    checkerboard.
    """

    members: tuple[_Finder, ...]
    first: np.ndarray
    tagged: tuple[bool, ...]  # whether tags identify the member

    def find(self, view: ImageWithQuads) -> ImageCorners:
        detections = list(zip([member.find(view) for member in self.members], self.tagged, strict=True))
        of_tags = np.concatenate([np.zeros((0, 2))] + [corners.uv for corners, tagged in detections if tagged])
        kept = [corners if tagged or _apart(corners.uv, of_tags) else no_corners() for corners, tagged in detections]
        fields = {f.name: np.concatenate([getattr(c, f.name) for c in kept]) for f in dataclasses.fields(ImageCorners)}
        point = np.concatenate([corners.point + first for corners, first in zip(kept, self.first, strict=True)])
        return ImageCorners(**fields | {"point": point})


@dataclass(frozen=True, eq=False)
class _Inverted:
    """Finds with `detector` a board that is white on black; either: in the image as it is, or else white on black."""

    detector: CharucoDetector | CirclesDetector | _Renumbered
    either: bool = False

    def find(self, view: ImageWithQuads) -> ImageCorners:
        corners = self.detector.find(view) if self.either else no_corners()
        return corners if len(corners.point) else self.detector.find(ImageWithQuads(255 - view.image))

    def find_near(self, view: ImageWithQuads, expected: PredictedCorners) -> ImageCorners | None:
        corners = self.detector.find_near(view, expected) if self.either else None
        return corners or self.detector.find_near(ImageWithQuads(255 - view.image), expected)


@dataclass(frozen=True, eq=False)
class _Renumbered:
    """Converts the numbers of `detector` to those of the target: corner k is point number[k]."""

    detector: CheckerboardDetector
    number: np.ndarray

    def find(self, view: ImageWithQuads) -> ImageCorners:
        corners = self.detector.find(view)
        return corners.renumbered(self.number[corners.point])

    def find_near(self, view: ImageWithQuads, expected: PredictedCorners) -> ImageCorners | None:
        corners = self.detector.find_near(view, PredictedCorners(np.argsort(self.number)[expected.point], expected.uv))
        return None if corners is None else corners.renumbered(self.number[corners.point])


def _apart(uv: np.ndarray, others: np.ndarray) -> bool:
    """Whether no corner uv (n, 2) px of a board coincides with a corner of the other targets, `others` (m, 2) px."""
    return not len(others) or bool((np.linalg.norm(uv[:, None] - others, axis=2) > _SAME_PX).all())


def _from_the_bottom(rows: int, cols: int) -> np.ndarray:
    """(rows cols,) the target's point of each corner of the detector.

    The target's y points up the sheet, the detector's down. In both orders the square at the first corner is dark. If
    rows is odd and cols even, this holds for the order that reverses each row, else for the one that reverses the rows'
    sequence.
    """
    number = np.arange(rows * cols).reshape(rows, cols)
    return (number[:, ::-1] if rows % 2 == 1 and cols % 2 == 0 else number[::-1]).ravel()
