"""Layout of the AprilGrid, as the data's README states it."""

from __future__ import annotations

import numpy as np
import pytest

from icalib.errors import RecordingError
from icalib.geometry.targets import AprilGrid

GRID = AprilGrid(rows=6, cols=7, tag_size=0.088, tag_spacing=0.3)  # not square, so that rows and columns differ


@pytest.mark.parametrize(("row", "col"), [(0, 0), (0, 6), (1, 0), (3, 4), (5, 6)])
def test_tags_run_row_major_and_corners_around(row: int, col: int) -> None:
    origin = np.array([col * 0.1144, row * 0.1144, 0.0])
    around = 0.088 * np.array([[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0]])
    index = GRID.point_index(np.full(4, row * 7 + col), np.arange(4))
    np.testing.assert_allclose(GRID.points[index], origin + around, atol=1e-15)
    np.testing.assert_allclose(GRID.tag_centers[index], np.tile(origin + [0.044, 0.044, 0.0], (4, 1)), atol=1e-15)


def test_every_corner_once() -> None:
    assert GRID.points.shape == GRID.tag_centers.shape == (168, 3)
    assert len(np.unique(GRID.points.round(9), axis=0)) == 168
    tags, corners = np.divmod(np.arange(168), 4)
    np.testing.assert_array_equal(GRID.point_index(tags, corners), np.arange(168))


def test_index_accepts_small_integers() -> None:
    tags = np.array([41], dtype=np.int8)  # 4 * 41 + 3 does not fit in int8
    np.testing.assert_array_equal(GRID.point_index(tags, np.array([3], dtype=np.int8)), [167])


@pytest.mark.parametrize("tag", [-1, 42, 587])
def test_unknown_tag(tag: int) -> None:
    with pytest.raises(RecordingError, match=rf"tag {tag} is not on the target \(6 x 7 tags, ids 0 to 41\)"):
        GRID.point_index(np.array([0, tag, 3]), np.array([0, 1, 2]))


@pytest.mark.parametrize("corner", [-1, 4])
def test_unknown_corner(corner: int) -> None:
    with pytest.raises(RecordingError, match=f"corner {corner} is not one of"):
        GRID.point_index(np.array([0, 1]), np.array([0, corner]))
