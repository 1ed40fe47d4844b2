"""Layout of the targets: the AprilGrid as the data's README states it, ChArUco boards as OpenCV does."""

from __future__ import annotations

import sys

import numpy as np
import pytest
from tests.cases import each

from icalib.errors import CalibrationError, RecordingError, RigError
from icalib.geometry.targets import AprilGrid, Charuco, Checkerboard, Markers, Scene, Tag, Target
from icalib.geometry.targets.families import FAMILIES, family_name, opencv_bits, tag_bits

GRID = AprilGrid(rows=6, cols=7, tag_size=0.088, tag_spacing=0.3)  # not square, so that rows and columns differ


@each(("row", "col"), [(0, 0), (0, 6), (1, 0), (3, 4), (5, 6)])
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


@each("tag", [-1, 42, 587])
def test_unknown_tag(tag: int) -> None:
    with pytest.raises(RecordingError, match=rf"tag {tag} is not on the target \(6 x 7 tags, ids 0 to 41\)"):
        GRID.point_index(np.array([0, tag, 3]), np.array([0, 1, 2]))


@pytest.mark.parametrize("corner", [-1, 4])
def test_unknown_corner(corner: int) -> None:
    with pytest.raises(RecordingError, match=f"corner {corner} is not one of"):
        GRID.point_index(np.array([0, 1]), np.array([0, corner]))


CHARUCO = Charuco(squares_x=7, squares_y=5, square_size=0.04, marker_size=0.03, dictionary="5x5_100")
BOARD = Checkerboard(rows=6, cols=9, square_size=0.03)
TAG = Tag("tag36h11", 12, 0.2)
TAGS = Markers("tag36h11", 0.2, (90, 60, 75))
SCENE = Scene(("grid", "tags"), (GRID, TAGS))
AMBIGUOUS = Scene(("grid", "tags", "board"), (GRID, TAGS, BOARD))


@each("target", [GRID, CHARUCO, BOARD, TAG, TAGS, SCENE])
def test_identities_and_indices_are_inverse_and_the_origin_is_point_0(target: Target):
    index = np.arange(len(target.points))
    np.testing.assert_array_equal(target.point_index(*target.point_identity(index)), index)
    np.testing.assert_array_equal(target.points[0], 0.0)
    np.testing.assert_array_equal(target.points[:, 2], 0.0)
    assert target.tag_centers.shape == target.points.shape
    assert (target.tag_centers != target.points).any() == target.blooms


@each("target", [GRID, CHARUCO, BOARD, TAG, TAGS])
@each("rows", [5, 7])
def test_corners_of_a_tag_have_its_number_alone_and_in_a_scene(target: Target, rows: int):
    tag, _ = target.point_identity(np.arange(len(target.points)))
    expected = tag if target.type in ("aprilgrid", "tag", "markers") else np.arange(len(tag))
    same = target.tag_number[:, None] == target.tag_number
    np.testing.assert_array_equal(same, expected[:, None] == expected)
    other = Checkerboard(rows, 5, 0.03)
    n, both = len(other.points), Scene(("board", "target"), (other, target)).tag_number
    np.testing.assert_array_equal(both[n:, None] == both[n:], same)
    assert len(np.unique(both[:n])) == n and not set(both[:n]) & set(both[n:])


def test_charuco_corners_are_opencvs():
    """Its corners run from the top left downwards, in a frame with y down whose origin is the board's own corner."""
    aruco = pytest.importorskip("cv2").aruco
    board = aruco.CharucoBoard((7, 5), 0.04, 0.03, aruco.getPredefinedDictionary(aruco.DICT_5X5_100))
    theirs = np.asarray(board.getChessboardCorners()) * [1.0, -1.0, 1.0]
    np.testing.assert_allclose(CHARUCO.points, theirs - theirs[0], atol=1e-7)


def test_checkerboard_runs_row_by_row_from_the_bottom_left():
    np.testing.assert_allclose(BOARD.points[[1, 9, 53]], [[0.03, 0, 0], [0, 0.03, 0], [0.24, 0.15, 0]])


@each(("rows", "cols", "symmetric"), [(6, 9, False), (6, 8, True), (7, 9, True), (6, 6, True)])
def test_symmetry_of_a_checkerboard(rows: int, cols: int, symmetric: bool):
    """Colours of the squares, the board turned by half a turn."""
    black = np.indices((rows + 1, cols + 1)).sum(axis=0) % 2 == 0
    board = Checkerboard(rows, cols, 0.03)
    assert board.symmetric == symmetric == np.array_equal(black, black[::-1, ::-1])
    if symmetric:
        turned = board.points.max(axis=0) - board.points
        np.testing.assert_allclose(turned, board.points[::-1], atol=1e-15)
        assert not Checkerboard(rows, cols, 0.03, upright=True).symmetric
    assert not CHARUCO.symmetric and not GRID.symmetric


@each(("rows", "cols", "quarters"), [(6, 8, (0, 2)), (7, 7, (0, 2)), (6, 6, (0, 1, 2, 3)), (6, 7, (0,))])
def test_turns_of_a_checkerboard_put_points_on_points(rows: int, cols: int, quarters: tuple[int, ...]):
    """Every turn by a multiple of 90 degrees about the middle that puts black on black, and no other."""
    board = Checkerboard(rows, cols, 0.03)
    black = np.indices((rows + 1, cols + 1)).sum(axis=0) % 2 == 0
    alike = [k for k in range(4) if rows == cols or k % 2 == 0]
    assert tuple(k for k in alike if np.array_equal(black, np.rot90(black, k))) == quarters
    assert len(board.turns) == len(quarters)
    middle = board.points.mean(axis=0)
    for turn in board.turns:
        assert sorted(turn) == list(range(rows * cols))
        own, other = (board.points - middle)[:, :2], (board.points - middle)[turn, :2]
        R = np.linalg.lstsq(own, other, rcond=None)[0]
        np.testing.assert_allclose(own @ R, other, atol=1e-12)
        assert np.linalg.det(R) == pytest.approx(1.0)


def test_tag_corners_run_counterclockwise_from_the_bottom_left():
    np.testing.assert_allclose(TAG.points[:, :2], [[0, 0], [0.2, 0], [0.2, 0.2], [0, 0.2]])
    np.testing.assert_allclose(TAG.tag_centers, [[0.1, 0.1, 0.0]] * 4)


@each(
    ("target", "tag_id", "corner", "words"),
    [
        (CHARUCO, 0, 24, "corner 24 is not on the target (corners 0 to 23); check squares_x and squares_y"),
        (CHARUCO, 3, 0, "tag 3 is not on the target, whose corners have tag 0"),
        (BOARD, 0, -1, "corner -1 is not on the target (corners 0 to 53); check rows and cols"),
        (TAG, 11, 0, "tag 11 is not tag 12"),
        (TAGS, 61, 0, "tag 61 is not one of the target's ids"),
        (TAGS, 60, 4, "corner 4 is not one of a tag's corners"),
        (SCENE, 42, 0, "corner 0 of tag 42 is on none of grid, tags"),
        (AMBIGUOUS, 0, 2, "corner 2 of tag 0 is on grid and board"),
        (TAG, 12, 4, "corner 4 is not one of a tag's corners"),
    ],
)
def test_points_that_a_target_lacks(target: Target, tag_id: int, corner: int, words: str):
    with pytest.raises(RecordingError) as caught:
        target.point_index(np.array([tag_id]), np.array([corner]))
    assert words in str(caught.value) and "\n" not in str(caught.value)


@each(
    ("make", "words"),
    [
        (lambda: Charuco(7, 5, 0.04, 0.04, "5x5_100"), "marker_size 0.04 does not fit a square of 0.04"),
        (lambda: Charuco(2, 5, 0.04, 0.03, "5x5_100"), "2 x 5 squares has too few inner corners"),
        (lambda: Charuco(20, 20, 0.04, 0.03, "5x5_100"), "needs 200 tags, but 5x5_100 has 100"),
        (
            lambda: Charuco(7, 5, 0.04, 0.03, "5x5"),
            "no tag family '5x5', did you mean '5x5_50'; available",
        ),
        (lambda: Checkerboard(1, 5, 0.04), "1 x 5 inner corners cannot tell x from y"),
        (lambda: Tag("tag36h11", 587, 0.1), "needs 588 tags, but tag36h11 has 587"),
    ],
)
def test_targets_that_cannot_be(make, words: str):
    with pytest.raises(RigError) as caught:
        make()
    assert words in str(caught.value)


def test_families_are_opencvs():
    aruco = pytest.importorskip("cv2").aruco
    for family, (bits, count) in FAMILIES.items():
        name = next(n for n in dir(aruco) if n.lower() == "dict_" + family.replace("tag", "apriltag_"))
        dictionary = aruco.getPredefinedDictionary(getattr(aruco, name))
        assert (dictionary.markerSize, len(dictionary.bytesList)) == (bits, count)
        assert tag_bits(family, count - 1).shape == (bits, bits)


@each(
    ("text", "name"),
    [
        ("tag36h11", "tag36h11"),
        ("apriltag_36h11", "tag36h11"),
        ("AprilTag36h11", "tag36h11"),
        ("36h11", "tag36h11"),
        ("DICT_APRILTAG_36h11", "tag36h11"),
        ("DICT_APRILTAG_16H5", "tag16h5"),
        ("tag25h9", "tag25h9"),
        ("5X5_100", "5x5_100"),
        ("DICT_4X4_50", "4x4_50"),
        ("DICT_ARUCO_ORIGINAL", "aruco_original"),
        ("DICT_ARUCO_MIP_36h12", "aruco_mip_36h12"),
    ],
)
def test_spellings_of_one_family(text: str, name: str):
    assert family_name(text) == name
    assert Tag(text, 3, 0.1) == Tag(name, 3, 0.1) and Markers(text, 0.1).family == name
    assert Charuco(3, 3, 0.04, 0.03, text).dictionary == name


@each("text", ["tagStandard41h12", "tagCircle21h7", "5x5", "", "36h12", "aruco_36h12"])
def test_families_that_there_are_not(text: str):
    with pytest.raises(RigError, match=f"no tag family '{text}'.*; available are 4x4_50, .*tag36h11"):
        family_name(text)


def test_apriltags_stand_as_their_authors_draw_them():
    """36h11's code of id 0 is 0xd5d628584, its highest bit at the top left (Olson 2011; Kalibr draws it so too)."""
    pytest.importorskip("cv2")
    code = f"{0xD5D628584:036b}"
    np.testing.assert_array_equal(tag_bits("tag36h11", 0).ravel(), [c == "1" for c in code])


def test_without_opencv_the_extra_is_named(monkeypatch):
    monkeypatch.setitem(sys.modules, "cv2", None)
    opencv_bits.cache_clear()
    with pytest.raises(CalibrationError, match=r"pip install .*\[images\]"):
        tag_bits("4x4_50", 0)
