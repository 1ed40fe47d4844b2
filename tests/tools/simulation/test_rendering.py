"""Rendered images: edges where they truly are, light as it should fall, and targets that OpenCV reads as it should."""

from __future__ import annotations

import math
from dataclasses import replace
from functools import cached_property

import numpy as np
import pytest
from tests.cases import each

from icalib.errors import RigError
from icalib.geometry.targets import AprilGrid, Charuco, Checkerboard, Tag, Target
from icalib.geometry.targets.boards import Pattern, pattern_of
from icalib.tools.simulation import handheld, simulate
from icalib.tools.simulation.projection import project
from icalib.tools.simulation.rendering import Imaging, Picture, Renderer, Sheet, exposure_poses, unproject
from icalib.tools.simulation.scenario import SimCamera

from .conftest import DISTORTED, lens

PINHOLE = lens("pinhole-radtan", 150.0, (0.0, 0.0, 0.0, 0.0))
LENSES = [PINHOLE, *DISTORTED]
SHARP = Imaging(white=1.0, black=0.0, background=0.5, blur_px=0.0)


class Half(Target):
    """A print that is black left of x = 0."""

    type, blooms = "half", False

    @cached_property
    def points(self) -> np.ndarray:
        return np.zeros((1, 3))

    def point_index(self, tag_id, corner):
        return corner

    def point_identity(self, index):
        return index, index


def half(T_world_target: np.ndarray | None = None, size: float = 50.0) -> Sheet:
    sheet = Sheet(Half(), np.eye(4) if T_world_target is None else T_world_target, margin=0.0)
    edges = np.array([-size, 0.0, size])
    sheet.__dict__["pattern"] = Pattern(edges, edges[[0, 2]], np.array([[False, True]]))
    return sheet


def facing(target_middle: tuple[float, float] = (0.0, 0.0), distance: float = 1.0, **turns_deg: float) -> np.ndarray:
    """T_target_cam (4, 4): in front of the sheet, looking at its `middle`, then turned by x, y, z in camera axes."""
    R = np.diag([1.0, -1.0, -1.0])
    for axis, angle in turns_deg.items():
        a, k = math.radians(angle), "xyz".index(axis)
        i, j = (k + 1) % 3, (k + 2) % 3
        turn = np.eye(3)
        turn[[i, i, j, j], [i, j, i, j]] = math.cos(a), -math.sin(a), math.sin(a), math.cos(a)
        R = R @ turn
    T = np.eye(4)
    T[:3, :3], T[:3, 3] = R, [*target_middle, 0.0] - distance * R[:, 2]
    return T


def middle_of(target: Target) -> tuple[float, float]:
    low, high = target.points.min(axis=0), target.points.max(axis=0)
    return tuple(0.5 * (low + high)[:2])


@each("camera", LENSES)
def test_unprojection_is_the_inverse_of_projection(camera: SimCamera):
    u, v = np.meshgrid(np.linspace(-3.0, 162.0, 67), np.linspace(-3.0, 122.0, 51))
    uv = np.stack([u, v], axis=-1)
    rays = unproject(camera, uv)
    assert np.isfinite(rays).all()
    np.testing.assert_allclose(np.linalg.norm(rays, axis=-1), 1.0, rtol=1e-14)
    np.testing.assert_allclose(project(camera, 3.0 * rays), uv, atol=1e-10)


def test_pixels_that_a_lens_does_not_see_are_background():
    camera = lens("eucm", 25.0, (0.7, 1.2))
    rays = unproject(camera, np.array([[0.0, 0.0], [80.0, 60.0]]))
    assert np.isnan(rays[0]).all() and np.isfinite(rays[1]).all()
    grey = Renderer(camera, SHARP).picture([half()], facing()).grey
    assert grey[0, 0] == 0.5 and {grey[60, 65], grey[60, 95]} == {0.0, 1.0}


def edge_by_rows(camera: SimCamera, T_world_cam: np.ndarray) -> np.ndarray:
    """u where each row's black ends, averaged over the height of the row: the edge's own points, projected."""
    y = np.linspace(-3.0, 3.0, 20001)
    points = np.stack([0.0 * y, y, 0.0 * y], axis=1)
    u, v = project(camera, (points - T_world_cam[:3, 3]) @ T_world_cam[:3, :3]).T
    order = np.argsort(v)
    height = camera.resolution[1]
    fine = np.interp((np.arange(height * 40) + 0.5) / 40 - 0.5, v[order], u[order])
    return fine.reshape(height, 40).mean(axis=1)


def test_a_lens_that_no_ray_passes_sees_background():
    """A tangential distortion far beyond any lens: the search for a ray meets a singular equation."""
    camera = SimCamera(
        "cam0", "pinhole-radtan", (320, 240), (200.0, 200.0, 160.0, 120.0), (0.0, 0.0, 1.0, 0.0), np.eye(4)
    )
    rays = unproject(camera, np.stack(np.meshgrid(np.arange(-2.0, 322.0), np.arange(-2.0, 242.0)), axis=-1))
    assert np.isnan(rays).any()


@each("blur", [0.0, 0.45, 0.9])
@each("camera", LENSES)
@each("shift", [0.0, 0.0031, 0.0057])
def test_edges_are_where_they_truly_are(camera: SimCamera, blur: float, shift: float):
    """The integral of the black along a row ends at the edge, whatever the blur; seen at an angle, through the lens."""
    pose = facing((shift, 0.0), 0.6, z=3.0, y=12.0, x=-9.0)
    grey = Renderer(camera, replace(SHARP, blur_px=blur)).picture([half()], pose).grey
    rows = slice(8, 112)  # beyond them the blur brings in what the edge does outside
    black = (1.0 - grey[rows]).sum(axis=1) - 0.5
    np.testing.assert_allclose(black, edge_by_rows(camera, pose)[rows], atol=5e-4)


@each("phase", [0.0, 0.2, 0.5, 0.77])
@each("sigma", [0.3, 0.6, 1.2])
def test_an_edge_is_blurred_as_a_gaussian_blurs_it(phase: float, sigma: float):
    """Square on, its profile is the difference of two integrals of the normal distribution."""
    cx = PINHOLE.intrinsics[2]
    edge = 80.0 + phase
    pose = facing(((cx - edge) / 150.0, 0.0), 1.0)
    grey = Renderer(PINHOLE, replace(SHARP, blur_px=sigma)).picture([half()], pose).grey[60]

    def integral(x: float) -> float:
        z = x / sigma
        return x * 0.5 * math.erfc(-z / math.sqrt(2.0)) + sigma * math.exp(-0.5 * z * z) / math.sqrt(2.0 * math.pi)

    expected = [integral(u + 0.5 - edge) - integral(u - 0.5 - edge) for u in range(160)]
    np.testing.assert_allclose(grey, expected, atol=4e-3)


def test_pixel_0_0_is_the_centre_of_the_top_left_pixel():
    """An edge through the middle of pixel 80 leaves it half black."""
    pose = facing(((PINHOLE.intrinsics[2] - 80.0) / 150.0, 0.0), 1.0)
    grey = Renderer(PINHOLE, SHARP).picture([half()], pose).grey
    np.testing.assert_allclose(grey[:, 79:82], np.tile([0.0, 0.5, 1.0], (120, 1)), atol=1e-6)


def test_black_area_is_that_of_the_print():
    """Square on, every black square has its area in pixels, wherever its edges fall."""
    board = Checkerboard(6, 9, 0.0173)
    grey = Renderer(PINHOLE, SHARP).picture([Sheet(board, margin=1.0)], facing(middle_of(board), 0.31, z=17.0)).grey
    squares = 7 * 10 // 2
    area = squares * 0.0173**2 * 150.0 * 151.5 / 0.31**2
    assert (1.0 - grey).sum() == pytest.approx(area, rel=2e-5)


def test_a_symmetric_board_turned_by_half_a_turn_is_the_same_image():
    board = Checkerboard(6, 8, 0.02)
    camera = replace(LENSES[3], intrinsics=(70.0, 70.0, 79.5, 59.5))
    pictures = [Renderer(camera).picture([Sheet(board)], facing(middle_of(board), 0.2, z=z)) for z in (0.0, 180.0)]
    np.testing.assert_allclose(pictures[0].grey, pictures[1].grey, atol=1e-3)
    np.testing.assert_allclose(pictures[0].grey, pictures[0].grey[::-1, ::-1], atol=1e-3)
    np.testing.assert_allclose(pictures[0].sheets[0].uv, pictures[1].sheets[0].uv[::-1], atol=1e-9)
    odd = Renderer(camera).picture([Sheet(Checkerboard(6, 9, 0.02))], facing(middle_of(board), 0.2)).grey
    assert np.abs(odd - odd[::-1, ::-1]).max() > 100.0


@each("camera", LENSES)
def test_flat_fields(camera: SimCamera):
    imaging = Imaging(blur_px=0.7)
    np.testing.assert_allclose(Renderer(camera, imaging).picture([], facing()).grey, 110.0, rtol=1e-6)
    white = facing((40.0, 0.0), 0.01)  # far inside the white half
    np.testing.assert_allclose(Renderer(camera, imaging).picture([half()], white).grey, 210.0, rtol=1e-6)
    np.testing.assert_allclose(Renderer(camera, replace(imaging, gain=0.5)).picture([], facing()).grey, 55.0, rtol=1e-6)


def test_vignetting_takes_its_share_in_the_corners_and_none_in_the_middle():
    grey = Renderer(PINHOLE, Imaging(vignetting=0.4)).picture([], facing()).grey
    assert grey[0, 0] == pytest.approx(0.6 * 110.0, rel=1e-6) and grey[60, 80] == pytest.approx(110.0, rel=1e-3)
    np.testing.assert_allclose(grey, grey[::-1, ::-1])
    assert grey[60, 0] == pytest.approx(110.0 * (1.0 - 0.4 * 79.5**2 / (79.5**2 + 59.5**2)), rel=1e-3)


def test_noise_is_white_repeats_with_its_seed_and_needs_one():
    renderer = Renderer(PINHOLE, Imaging(noise=3.0))
    noisy = [renderer.picture([half()], facing(), np.random.default_rng(s)) for s in (1, 1, 2)]
    clean = Renderer(PINHOLE).picture([half()], facing()).grey
    error = noisy[0].grey - clean
    assert error.std() == pytest.approx(3.0, rel=0.02) and abs(np.mean(error[1:] * error[:-1])) < 0.3
    assert np.array_equal(noisy[0].grey, noisy[1].grey) and not np.array_equal(noisy[0].grey, noisy[2].grey)
    with pytest.raises(RigError, match="give rng"):
        renderer.picture([half()], facing())


def test_pixels_are_rounded_and_clipped():
    picture = Picture(np.array([[-3.0, 0.4, 99.6, 300.0]]), ())
    assert picture.pixels.tolist() == [[0, 0, 100, 255]] and picture.pixels.dtype == np.uint8


def test_motion_blur_is_the_mean_over_the_poses():
    poses = np.stack([facing((x, 0.0), 1.0, z=5.0) for x in (0.0, 0.01, 0.03)])
    renderer, sheet = Renderer(LENSES[1]), Sheet(Checkerboard(3, 4, 0.1), margin=0.1)
    blurred, single = renderer.picture([sheet], poses), [renderer.picture([sheet], T) for T in poses]
    np.testing.assert_allclose(blurred.grey, np.mean([p.grey for p in single], axis=0), atol=1e-3)
    np.testing.assert_allclose(blurred.sheets[0].uv, np.mean([p.sheets[0].uv for p in single], axis=0))
    np.testing.assert_array_equal(blurred.sheets[0].seen, np.all([p.sheets[0].seen for p in single], axis=0))


def test_points_are_where_the_simulated_corners_are():
    pytest.importorskip("cv2")
    scenario = handheld(0.5, noiseless=True)
    simulation = simulate(scenario, 0)
    camera, stream = scenario.cameras[0], simulation.measurements.cameras[0]
    instant = simulation.truth.corners["cam0"].seconds[3]
    poses = exposure_poses(camera, simulation.truth.trajectory, instant, 0.0, 1)
    small = replace(camera, resolution=(16, 16))
    sheet = Sheet(scenario.target, scenario.T_world_board)
    uv = Renderer(small).picture([sheet], poses).sheets[0].uv
    mine = slice(stream.start[3], stream.start[4])
    np.testing.assert_allclose(uv[stream.point[mine]], stream.uv[mine], atol=1e-8)
    spread = exposure_poses(camera, simulation.truth.trajectory, instant, 0.01, 4)
    middle = 0.5 * (spread[1, :3, 3] + spread[2, :3, 3])
    assert spread.shape == (4, 4, 4) and np.linalg.norm(middle - poses[0, :3, 3]) < 1e-4
    assert np.linalg.norm(spread[3, :3, 3] - spread[0, :3, 3]) > 1e-4


def test_the_back_of_a_sheet_is_white_and_shows_no_points():
    board = Checkerboard(3, 4, 0.1)
    behind = facing(middle_of(board), -0.8)
    behind[:3, :3] = np.eye(3)
    picture = Renderer(PINHOLE, SHARP).picture([Sheet(board)], behind)
    assert not picture.sheets[0].seen.any() and picture.grey[60, 80] == 1.0
    assert Renderer(PINHOLE, SHARP).picture([Sheet(board)], facing(middle_of(board), 0.8)).sheets[0].seen.all()


def test_the_nearer_sheet_covers_the_other_and_free_tags_stand_side_by_side():
    pytest.importorskip("cv2")
    near, far = np.eye(4), np.eye(4)
    near[2, 3], far[0, 3] = 0.3, -0.05
    tags = [Sheet(Tag("tag36h11", 3, 0.1), near), Sheet(Tag("tag36h11", 4, 0.1), far)]
    pose = facing((0.05, 0.05), 1.0)
    both = [Renderer(PINHOLE, SHARP).picture(order, pose) for order in (tags, tags[::-1])]
    alone = Renderer(PINHOLE, SHARP).picture(tags[:1], pose)
    np.testing.assert_array_equal(both[0].grey, both[1].grey)
    np.testing.assert_array_equal(both[0].sheets[1].uv, both[1].sheets[0].uv)
    np.testing.assert_array_equal(both[0].grey[52:68, 72:90], alone.grey[52:68, 72:90])
    assert np.abs(both[0].grey - alone.grey).max() > 0.4


FULL = handheld().cameras[0]


@pytest.mark.parametrize("family", ["tag36h11", "tag16h5", "5x5_250", "aruco_original"])
def test_opencv_reads_the_tags_and_finds_their_corners(family: str):
    """Kalibr's and AprilTag's tags are upside down to OpenCV: its first corner, top left, is our corner 1."""
    aruco = pytest.importorskip("cv2").aruco
    pose = facing((0.3, 0.1), 0.9, x=8.0, y=-15.0, z=4.0)
    places = [np.eye(4) for _ in range(3)]
    for i, T in enumerate(places):
        T[0, 3] = 0.25 * i
    sheets = [Sheet(Tag(family, 7 + i, 0.15), T) for i, T in enumerate(places)]
    picture = Renderer(FULL).picture(sheets, pose)
    name = next(n for n in dir(aruco) if n.lower() == "dict_" + family.replace("tag", "apriltag_"))
    parameters = aruco.DetectorParameters()
    parameters.cornerRefinementMethod = aruco.CORNER_REFINE_SUBPIX
    detector = aruco.ArucoDetector(aruco.getPredefinedDictionary(getattr(aruco, name)), parameters)
    corners, ids, _ = detector.detectMarkers(picture.pixels)
    assert sorted(np.ravel(ids)) == [7, 8, 9]
    ours = [1, 0, 3, 2] if family.startswith("tag") else [3, 2, 1, 0]
    for tag_id, found in zip(np.ravel(ids), corners, strict=True):
        np.testing.assert_allclose(found[0], picture.sheets[tag_id - 7].uv[ours], atol=0.6)


@pytest.mark.parametrize("border", [1, 2])
def test_opencv_reads_an_aprilgrid_with_either_border(border: int):
    aruco = pytest.importorskip("cv2").aruco
    grid = AprilGrid(6, 6, 0.088, 0.3)
    picture = Renderer(FULL, Imaging(noise=2.0)).picture(
        [Sheet(grid, border_bits=border)], facing(middle_of(grid), 0.8, y=10.0), np.random.default_rng(0)
    )
    parameters = aruco.DetectorParameters()
    parameters.markerBorderBits = border
    detector = aruco.ArucoDetector(aruco.getPredefinedDictionary(aruco.DICT_APRILTAG_36h11), parameters)
    corners, ids, _ = detector.detectMarkers(picture.pixels)
    assert len(np.unique(ids)) > 30  # its thresholds merge a few tags with the squares at their corners
    for tag_id, found in zip(np.ravel(ids), corners, strict=True):
        np.testing.assert_allclose(found[0], picture.sheets[0].uv[4 * tag_id + np.array([1, 0, 3, 2])], atol=4.0)


@pytest.mark.parametrize("rows", [5, 6])
def test_opencv_finds_the_corners_of_a_charuco_board(rows: int):
    aruco = pytest.importorskip("cv2").aruco
    target = Charuco(8, rows, 0.08, 0.06, "5x5_100")
    picture = Renderer(FULL).picture([Sheet(target)], facing(middle_of(target), 0.7, x=10.0, z=-6.0))
    board = aruco.CharucoBoard((8, rows), 0.08, 0.06, aruco.getPredefinedDictionary(aruco.DICT_5X5_100))
    corners, ids, _, _ = aruco.CharucoDetector(board).detectBoard(picture.pixels)
    assert len(ids) == 7 * (rows - 1)
    np.testing.assert_allclose(np.reshape(corners, (-1, 2)), picture.sheets[0].uv[np.ravel(ids)], atol=0.2)


def test_opencv_finds_the_corners_of_a_checkerboard_where_they_are():
    cv2 = pytest.importorskip("cv2")
    target = Checkerboard(6, 9, 0.06)
    picture = Renderer(FULL).picture([Sheet(target, margin=0.06)], facing(middle_of(target), 0.7, x=10.0, y=-12.0))
    found, corners = cv2.findChessboardCornersSB(picture.pixels, (9, 6))
    assert found
    apart = np.linalg.norm(np.reshape(corners, (-1, 1, 2)) - picture.sheets[0].uv, axis=2).min(axis=1)
    assert apart.max() < 0.1


@pytest.mark.parametrize("dictionary", ["DICT_4X4_50", "DICT_APRILTAG_36h11", "DICT_APRILTAG_16h5"])
def test_the_pattern_of_a_charuco_board_is_opencvs(dictionary: str):
    """Boards with AprilTags too: OpenCV prints these upside down, as seen by their authors."""
    aruco = pytest.importorskip("cv2").aruco
    for rows in (5, 6):
        source = aruco.getPredefinedDictionary(getattr(aruco, dictionary))
        board = aruco.CharucoBoard((7, rows), 0.07, 0.048, source)
        image = board.generateImage((7 * 70, rows * 70), marginSize=0) > 127
        pattern = pattern_of(Charuco(7, rows, 0.07, 0.048, dictionary))
        x, y = (np.arange(7 * 70) + 0.5) * 1e-3 - 0.07, 0.07 - (np.arange(rows * 70) + 0.5) * 1e-3
        ours = pattern.white[np.searchsorted(pattern.y, y)[:, None] - 1, np.searchsorted(pattern.x, x) - 1]
        assert (ours != image).mean() < 0.01  # OpenCV rounds the edges of bits to its pixels


@pytest.mark.parametrize(
    "target", [AprilGrid(2, 3, 0.1, 0.3), Charuco(5, 4, 0.04, 0.03, "4x4_50"), Checkerboard(3, 4, 0.05)]
)
def test_black_boxes_cover_the_black_once(target: Target):
    pytest.importorskip("cv2")
    pattern = pattern_of(target)
    left, bottom, right, top = pattern.black_boxes().T
    x, y = 0.5 * (pattern.x[1:] + pattern.x[:-1]), 0.5 * (pattern.y[1:] + pattern.y[:-1])
    within_x, within_y = (left[:, None] < x) & (x < right[:, None]), (bottom[:, None] < y) & (y < top[:, None])
    np.testing.assert_array_equal(np.einsum("nj,ni->ji", within_y * 1, within_x * 1), ~pattern.white)


def test_an_aprilgrid_has_kalibrs_borders_and_corner_squares():
    pytest.importorskip("cv2")
    grid = AprilGrid(2, 3, 0.1, 0.3)
    for border, default in ((2, True), (1, False)):
        pattern = pattern_of(grid, None if default else border)

        def white(x: float, y: float, pattern: Pattern = pattern) -> bool:
            return bool(pattern.white[np.searchsorted(pattern.y, y) - 1, np.searchsorted(pattern.x, x) - 1])

        assert pattern.x[[0, -1]] == pytest.approx([-0.03, 0.39]) and pattern.y[[0, -1]] == pytest.approx([-0.03, 0.26])
        bit = 0.1 / (6 + 2 * border)
        assert not white((border - 0.5) * bit, 0.05) and not white(-0.015, -0.015) and not white(0.115, 0.115)
        assert white(0.05, -0.015) and white(0.115, 0.05)
        assert white((border + 0.5) * bit, 0.1 - (border + 0.5) * bit)  # the highest bit of 0xd5d628584, top left
    with pytest.raises(RigError, match="border of 0 bits"):
        pattern_of(grid, 0)


def test_a_target_without_a_print_is_refused():
    with pytest.raises(RigError, match="cannot print targets of type half"):
        pattern_of(Half())
