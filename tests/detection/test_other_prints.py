"""Boards as others print them: other first ids and families, the old layout of ChArUco boards, white on black."""

from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np
import pytest
from tests.cases import each

from icalib.detection import what_is_seen
from icalib.detection.detectors import detector_of, other_columns, other_size, with_other_layout
from icalib.errors import RecordingError, RigError
from icalib.geometry.targets import AprilGrid, Charuco, Checkerboard, Scene, Target
from icalib.geometry.targets.boards import pattern_of
from icalib.rig.file import load_target
from icalib.tools.simulation import Imaging, Renderer, Sheet
from icalib.tools.simulation.scenario import SimCamera

pytestmark = pytest.mark.slow

SIZE = (752, 480)
CHARUCO = Charuco(6, 8, 0.035, 0.026, "4x4_50")
GRID = AprilGrid(3, 4, 0.05, 0.3, first_id=36, family="tag36h10")


def rendered(*targets: Target) -> np.ndarray:
    """A picture of the targets beside one another, from the front and slightly tilted."""
    camera = SimCamera("cam0", "pinhole-radtan", SIZE, (460.0, 460.0, 375.5, 239.5), (0.0,) * 4, np.eye(4))
    a = np.radians(8.0)
    z = np.array([0.0, np.sin(a), -np.cos(a)])
    x = np.array([1.0, 0.0, 0.0])
    T = np.eye(4)
    T[:3, :3] = np.column_stack([x, np.cross(z, x), z])
    sheets, right = [], 0.0
    for target in targets:
        place = np.eye(4)
        place[0, 3] = right - target.points[:, 0].min()
        sheets.append(Sheet(target, place))
        right = place[0, 3] + target.points[:, 0].max() + 0.12
    middle = np.mean([s.target.points + s.T_world_target[:3, 3] for s in sheets[:1]], axis=(0, 1))
    T[:3, 3] = np.append(np.array([0.5 * (right - 0.12), middle[1]]), 0.0) - 0.55 * len(targets) * z
    return Renderer(camera, Imaging(noise=0.5)).picture(sheets, T, np.random.default_rng(0)).pixels


def found(target: Target, image: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    corners = detector_of(target).detect(image)
    return corners.point[corners.kept], corners.uv[corners.kept]


def test_a_grid_from_another_first_id_of_another_family():
    point, uv = found(GRID, rendered(GRID))
    assert len(point) > 0.9 * len(GRID.points)
    plain = AprilGrid(3, 4, 0.05, 0.3)
    at, expected = found(plain, rendered(plain))
    both = np.intersect1d(point, at)
    np.testing.assert_allclose(uv[np.isin(point, both)], expected[np.isin(at, both)], atol=0.15)
    np.testing.assert_array_equal(GRID.point_identity(np.arange(4 * 12))[0], 36 + np.arange(48) // 4)
    np.testing.assert_array_equal(GRID.point_index(*GRID.point_identity(np.arange(48))), np.arange(48))
    with pytest.raises(RecordingError, match=r"tag 35 is not on the target .*ids 36 to 47.*first_id"):
        GRID.point_index(np.array([35]), np.array([0]))


def test_two_grids_in_one_scene():
    other = replace(GRID, first_id=48)
    scene = Scene(("left", "right"), (GRID, other))
    point, _ = found(scene, rendered(GRID, other))
    assert (point < 48).sum() > 40 and (point >= 48).sum() > 40
    with pytest.raises(RigError, match="first_id and family of an aprilgrid"):
        Scene(("left", "right"), (GRID, replace(GRID, first_id=40)))


def test_a_family_with_too_few_tags():
    with pytest.raises(RigError, match="needs 40 tags, but tag25h9 has 35"):
        AprilGrid(6, 6, 0.1, 0.3, first_id=4, family="25h9")


def test_tags_of_another_first_id_are_named():
    image = rendered(GRID)
    sentence = what_is_seen([image], "tag36h10", 2, range(12))
    assert "ids 36 to 47" in sentence and "set first_id: 36 of an aprilgrid" in sentence


@pytest.mark.parametrize("rows", [7, 8])
def test_the_old_layout_is_opencvs(rows):
    board = replace(CHARUCO, squares_y=rows, legacy=True)
    dictionary = cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_4X4_50)
    theirs = cv2.aruco.CharucoBoard((6, rows), 0.035, 0.026, dictionary)
    theirs.setLegacyPattern(True)
    image = theirs.generateImage((60 * 6 + 80, 60 * rows + 80), marginSize=40)
    point, uv = found(board, image)
    assert len(point) == 5 * (rows - 1)
    row, col = np.divmod(point, 5)
    scale = (image.shape[1] - 80) / 6.0
    np.testing.assert_allclose(uv, scale * np.stack([col + 1, row + 1], axis=1) + 40.0 - 0.5, atol=0.7)
    # What is printed, too, looked at in 37 x 37 places of each square: no edge of a tag's cells lies on one.
    ours = pattern_of(board)
    x, y = (0.035 * (np.arange(37 * n) + 0.5) / 37.0 for n in (6, rows))
    column, line = (np.searchsorted(e - e[0], at) - 1 for e, at in ((ours.x, x), (ours.y, y[::-1])))
    fine = theirs.generateImage((12 * 37 * 6, 12 * 37 * rows), marginSize=0)[6::12, 6::12] > 127
    assert (ours.white[line][:, column] != fine).mean() < 0.01


@pytest.mark.parametrize("legacy", [False, True])
def test_the_wrong_layout_is_named(legacy):
    board = replace(CHARUCO, legacy=legacy)
    image = rendered(board)
    point, _ = found(board, image)
    assert len(point) > 0.9 * len(board.points)
    assert with_other_layout([image], board) == ""
    sentence = with_other_layout([image], replace(board, legacy=not legacy))
    assert ("before 4.6" in sentence and "set legacy: true" in sentence) != ("remove legacy: true" in sentence)
    assert ("before 4.6" in sentence) == legacy
    assert with_other_layout([image], replace(board, squares_y=7)) == ""  # the layouts are one


@each(
    ("board", "wrong", "words"),
    [
        (
            CHARUCO,
            {"squares_x": 8, "squares_y": 6},
            "squares_y and squares_x are swapped; write squares_y: 8, squares_x: 6",
        ),
        (CHARUCO, {"squares_x": 7}, "matches squares_x: 6, not 7; correct squares_y and squares_x"),
        (replace(CHARUCO, legacy=True), {"squares_x": 5, "squares_y": 7}, "matches squares_x: 6, not 5"),
        (replace(CHARUCO, inverted=True), {"squares_x": 8, "squares_y": 6}, "swapped"),
        (GRID, {"rows": 4, "cols": 3}, "rows and cols are swapped; write rows: 3, cols: 4"),
        (GRID, {"rows": 3, "cols": 5}, "matches cols: 4, not 5; correct rows and cols"),
    ],
)
def test_swapped_and_wrong_rows_of_tags_are_named(board, wrong, words):
    image = rendered(board)
    assert other_columns([image], board) == ""
    assert words in other_columns([image], replace(board, **wrong))


@each(
    ("board", "wrong"),
    [
        (AprilGrid(2, 30, 0.05, 0.3), {"cols": 29}),
        (AprilGrid(2, 30, 0.05, 0.3), {"cols": 15, "rows": 4}),
        (AprilGrid(30, 2, 0.05, 0.3), {"cols": 3}),
        (Charuco(24, 4, 0.05, 0.037, "4x4_50"), {"squares_x": 23}),
    ],
)
def test_a_long_board_of_which_a_part_is_seen(board, wrong):
    """The image shows about half of the grids' tags."""
    image = rendered(board)
    assert len(found(board, image)[0]) < 0.8 * len(board.points)
    assert other_columns([image], board) == ""
    across = "cols" if isinstance(board, AprilGrid) else "squares_x"
    right, said = getattr(board, across), wrong[across]
    assert f"matches {across}: {right}, not {said}" in other_columns([image], replace(board, **wrong))


def test_no_layout_is_named_that_the_tags_in_sight_do_not_tell_from_others():
    image = rendered(AprilGrid(1, 30, 0.05, 0.3))
    sentence = other_columns([image], AprilGrid(6, 5, 0.05, 0.3))
    assert sentence == "the layout of the tags does not match cols: 5; correct rows and cols."


@pytest.mark.parametrize(
    ("rows", "cols"), [(6, 9), *(pytest.param(*x, marks=pytest.mark.full) for x in ((5, 7), (9, 6)))]
)
def test_counted_squares_are_named(rows, cols):
    image = rendered(Checkerboard(rows, cols, 0.035))
    sentence = other_size([image], Checkerboard(rows + 1, cols + 1, 0.035))
    assert f"{rows} x {cols} inner corners is in 1 of 1" in sentence and "not squares" in sentence
    assert sentence.endswith(f"write rows: {rows}, cols: {cols}.")
    other = other_size([image], Checkerboard(rows + 3, cols + 1, 0.035))
    assert other.endswith(f"write rows: {rows}, cols: {cols}.") and "squares" not in other
    assert other_size([rendered(GRID)], Checkerboard(rows, cols, 0.035)) == ""
    # One of several images may show a board by chance, as cells of tags do.
    assert other_size([image, rendered(GRID), rendered(GRID)], Checkerboard(rows + 3, cols + 1, 0.035)) == ""


@each("board", [CHARUCO, replace(CHARUCO, legacy=True), Checkerboard(6, 7, 0.04)])
def test_white_on_black(board):
    inverted = replace(board, inverted=True)
    image = rendered(inverted)
    point, uv = found(inverted, image)
    assert len(point) > 0.9 * len(board.points)
    at, expected = found(board, 255 - image)
    np.testing.assert_array_equal(point, at)
    np.testing.assert_allclose(uv, expected)
    np.testing.assert_array_equal(pattern_of(inverted).white, ~pattern_of(board).white)
    if isinstance(board, Charuco):
        assert "white on black; set inverted: true" in what_is_seen([image], "4x4_50", 1, range(24))


@each(
    ("text", "target"),
    [
        ("{type: aprilgrid, rows: 3, cols: 4, tag_size: 0.05, tag_spacing: 0.3, first_id: 36, family: 36h10}", GRID),
        (
            "{type: charuco, squares_x: 6, squares_y: 8, square_size: 0.035, marker_size: 0.026, dictionary: 4x4_50, "
            "legacy: true, inverted: true}",
            replace(CHARUCO, legacy=True, inverted=True),
        ),
        ("{type: checkerboard, rows: 6, cols: 7, square_size: 0.04, inverted: true}", Checkerboard(6, 7, 0.04, True)),
        (
            "{type: checkerboard, rows: 6, cols: 8, square_size: 0.04, upright: true}",
            Checkerboard(6, 8, 0.04, upright=True),
        ),
    ],
)
def test_fields_of_the_rig_file(tmp_path, text, target):
    (tmp_path / "target.yaml").write_text(text)
    assert load_target(tmp_path / "target.yaml") == target
    plain = ", ".join(f"{name}: {str(value).lower()}" for name, value in target.plain().items())
    (tmp_path / "again.yaml").write_text(f"{{{plain}}}")
    assert load_target(tmp_path / "again.yaml") == target
