"""Free tags and several targets in one image: corners where they are, sentences on what is seen of which."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from itertools import islice

import cv2
import numpy as np
import pytest
from tests.cases import each
from tests.typed import StandIn

from icalib.data.recordings import Payload, TopicInfo
from icalib.detection import tags as quads
from icalib.detection.decoding import ImageCorners, no_corners
from icalib.detection.detectors import detector_of
from icalib.detection.images import sightings, without_rare_tags
from icalib.errors import RecordingError
from icalib.geometry.targets import AprilGrid, Charuco, Checkerboard, Markers, Scene, Target
from icalib.rig import Camera
from icalib.sensors.camera.read import detected_corners
from icalib.tools.simulation import Imaging, Renderer, Shot, film, handheld, sheets_of, tag_map

pytest.importorskip("cv2")

CAMERA = Camera("cam0", "cam0/corners.csv", "pinhole-radtan", (752, 480))
TAGS = Markers("tag36h11", 0.16, tuple(range(40, 76, 3)))


class Shown(StandIn):
    """A recording of these images."""

    def __init__(self, images: list[np.ndarray]) -> None:
        self.images = images

    def image_topic(self, sensor: str, given: str | None) -> str:
        return "/cam0"

    def where(self, sensor: object) -> str:
        return "shown.bag /cam0"

    def topics(self) -> tuple[TopicInfo, ...]:
        return (TopicInfo("/cam0", "sensor_msgs/msg/Image", "image", len(self.images), 0, 1),)

    def payloads(self, topic: str) -> Iterator[Payload]:
        for i, image in enumerate(self.images):
            yield Payload(1000 + i, "shown.bag /cam0", "mono8", image.tobytes(), 752, 480, 752)


def found_in(images: list[np.ndarray], target: Target):
    return detected_corners.find_corners(Shown(images), CAMERA, target, keep=False)


@pytest.fixture(scope="module")
def shots() -> list[Shot]:
    """Images of a tag map with a grid on one wall: tags of 25 to 60 px, some seen at 70 degrees."""
    scenario = tag_map(6.3, with_grid=True)
    cameras = (replace(scenario.cameras[0], rate_hz=4.0),)
    return list(film(replace(scenario, cameras=cameras), 1, Imaging(blur_px=0.7, noise=2.0)).shots())


def test_corners_of_a_tag_map_with_a_grid_are_where_they_are(shots: list[Shot]):
    target = tag_map(with_grid=True).target
    detector, first = detector_of(target), 48  # of the grid's points
    error, inward, on_grid, tags = [], [], [], 0
    for shot in shots:
        found = detector.detect(shot.pixels)
        assert len(np.unique(found.point)) == len(found.point)
        point, uv = found.point[found.kept], found.uv[found.kept]
        assert shot.target.seen[point].all()
        truth = shot.target.uv[point]
        # The middle of the tag in the image, to first order: where its four corners' mean is.
        center = shot.target.uv.reshape(-1, 4, 2).mean(axis=1)[point // 4]
        error.append(uv - truth)
        inward.append(np.sum((uv - truth) * (center - truth), axis=1) / np.linalg.norm(center - truth, axis=1))
        on_grid.append(point >= first)
        tags += len(np.unique(found.point[found.point < first] // 4))
    uv, inside, grid = np.concatenate(error), np.concatenate(inward), np.concatenate(on_grid)
    whole = sum(int(shot.target.seen[:first].reshape(-1, 4).all(axis=1).sum()) for shot in shots)
    assert tags >= 0.95 * whole and (~grid).sum() >= 0.6 * 4 * whole and grid.sum() > 500
    for rows in (grid, ~grid):
        assert np.sqrt((uv[rows] ** 2).mean()) < 0.05 and np.hypot(*uv[rows].T).max() < 0.25
        assert abs(inside[rows].mean()) < 0.02 and np.abs(uv[rows].mean(axis=0)).max() < 0.02


@each(("family", "size"), [("tag36h11", 0.1), ("tag36h11", 0.15), ("4x4_50", 0.08)])
def test_small_and_oblique_tags(family: str, size: float):
    """Tags of 26 to 50 px in a row, turned about the vertical by up to 70 degrees; the lens bends their sides."""
    angles = np.radians([0.0, 30.0, 50.0, 60.0, 70.0])
    target = Markers(family, size, tuple(range(len(angles))))
    T = np.tile(np.eye(4), (len(angles), 1, 1))
    for k, (angle, pose) in enumerate(zip(angles, T, strict=True)):
        c, s = np.cos(angle), np.sin(angle)
        pose[:3, :3] = [[c, 0.0, s], [0.0, 1.0, 0.0], [-s, 0.0, c]]
        pose[0, 3] = 0.3 * (k - 2)
    renderer = Renderer(handheld().cameras[0], Imaging(blur_px=0.6, noise=2.0))
    T_world_cam = np.diag([1.0, -1.0, -1.0, 1.0])
    T_world_cam[:3, 3] = [0.02, 0.01, 1.4]
    detector, errors, kept = detector_of(target), [], np.zeros(len(angles), dtype=int)
    for seed in range(10):
        T_world_cam[0, 3] += 0.0013
        picture = renderer.picture(sheets_of(target, T), T_world_cam, np.random.default_rng(seed))
        truth = np.concatenate([sheet.uv for sheet in picture.sheets])
        found = detector.detect(picture.pixels)
        errors.append((found.uv - truth[found.point])[found.kept])
        kept += np.bincount(found.point[found.kept] // 4, minlength=len(angles))
    uv = np.concatenate(errors)
    assert np.sqrt((uv**2).mean()) < 0.1 and np.hypot(*uv.T).max() < 0.4
    assert np.abs(uv.mean(axis=0)).max() < 0.02 and (kept[:2] == 40).all()


def test_each_target_of_a_scene_is_found_as_if_it_were_alone(shots: list[Shot]):
    target = tag_map(with_grid=True).target
    assert isinstance(target, Scene)
    for shot in shots[::5]:
        whole = detector_of(target).detect(shot.pixels)
        parts = [detector_of(t).detect(shot.pixels) for t in target.targets]
        np.testing.assert_array_equal(whole.point, np.concatenate([parts[0].point, parts[1].point + 48]))
        np.testing.assert_array_equal(whole.uv, np.concatenate([p.uv for p in parts]))
        assert (np.diff(whole.point) > 0).all()


def test_a_checkerboard_is_not_seen_in_the_squares_of_a_grid(shots: list[Shot]):
    grid, board = AprilGrid(3, 3, 0.1, 0.3), Checkerboard(3, 4, 0.1)
    detectors = [detector_of(t) for t in (board, Scene(("board", "grid"), (board, grid)))]
    alone, beside = ([d.detect(shot.pixels).point for shot in shots[:4]] for d in detectors)
    assert not any(map(len, alone)) and all((b >= 12).all() and len(b) for b in beside)


def test_an_image_is_thresholded_once_for_all_targets(shots: list[Shot], monkeypatch: pytest.MonkeyPatch):
    asked, plain = [], quads.dark_quads
    monkeypatch.setattr(quads, "dark_quads", lambda image, *how: asked.append(how) or plain(image, *how))
    board = Charuco(5, 4, 0.05, 0.04, "4x4_50")
    detector_of(Scene(("tags", "board", "grid"), (TAGS, board, AprilGrid(6, 6, 0.1, 0.3, 1)))).detect(shots[0].pixels)
    assert len(asked) == len(set(asked)) == 6


def test_sentences_on_a_scene(shots: list[Shot]):
    images = [shot.pixels for shot in shots[:4]]
    found, notes = found_in(images, Scene(("wall", "grid"), (TAGS, AprilGrid(3, 3, 0.1, 0.3))))
    assert notes[0] == f"shown.bag /cam0: wall is in 4, grid is in 4 of 4 images, {len(found.uv)} corners."
    assert len(notes) == 1 and (np.diff(found.start) > 20).all()
    board = Checkerboard(5, 6, 0.1)
    _, notes = found_in(images, Scene(("wall", "board"), (TAGS, board)))
    assert notes[1:] == ("shown.bag /cam0: board is never seen; check its type, family, ids and sizes.",)
    none = Scene(("board", "charuco"), (board, Charuco(5, 4, 0.05, 0.04, "4x4_50")))
    with pytest.raises(RecordingError, match=r"board and charuco are in none of 2 images of cam0; the images show \d+"):
        found_in(images[:2], none)


@pytest.mark.parametrize(("true", "stated"), [(2, 1), pytest.param(1, 2, marks=pytest.mark.full)])
def test_a_border_of_the_other_width_is_named(true: int, stated: int):
    scenario = handheld(2.2)
    grids = {bits: AprilGrid(6, 6, 0.088, 0.3, bits) for bits in (1, 2)}
    camera = replace(scenario.cameras[0], rate_hz=5.0)
    recording = film(replace(scenario, cameras=(camera,), target=grids[true]), 0)
    images = [shot.pixels for shot in islice(recording.shots(), 3)]
    says = rf"\d+ tags of tag36h11 \(ids 0 to 35\) with border_bits {true}, not {stated}; correct border_bits"
    with pytest.raises(RecordingError, match=says) as caught:
        found_in(images, grids[stated])
    assert "\n" not in str(caught.value)
    with pytest.raises(RecordingError, match=says):
        found_in(images, Scene(("grid", "wall"), (grids[stated], TAGS)))
    # Free tags with the same ids and the other border may stand beside a grid.
    beside = Markers("tag36h11", 0.16, tuple(range(36)), true)
    found, _ = found_in(images, Scene(("grid", "wall"), (grids[true], replace(beside, border_bits=stated))))
    assert (found.point < 144).mean() > 0.95


def image_with(*points: int) -> ImageCorners:
    n = len(points)
    return ImageCorners(np.array(points), np.zeros((n, 2)), np.ones(n), np.ones(n), np.zeros(n, np.int8))


def test_tags_that_nobody_listed_are_kept_where_they_are_seen_often():
    target = Scene(("board", "tags"), (Checkerboard(3, 4, 0.1), Markers("tag16h5", 0.1)))
    often, rare = 12 + 4 * 7, 12 + 4 * 9
    images = [image_with(3, often, often + 1)] * 3 + [image_with(rare, rare + 1, rare + 2, rare + 3)] * 2
    kept, notes = without_rare_tags(target, images)
    assert [i.point.tolist() for i in kept] == [[3, often, often + 1]] * 3 + [[]] * 2
    assert notes == (
        "1 tags of tag16h5 (ids 9) are in fewer than 3 of 5 images and were ignored; "
        "list the ids of tags in the rig file if they exist.",
    )
    # 1 % of 400 images is more than 3 of them.
    kept, notes = without_rare_tags(target, images + [no_corners()] * 395)
    assert sum(len(i.point) for i in kept) == 3 and "(ids 7, 9) are in fewer than 4 of 400 images" in notes[0]
    listed = Markers("tag16h5", 0.1, (9, 7))
    single = [image_with(4)]
    assert without_rare_tags(listed, single)[0] is single and without_rare_tags(listed, single)[1] == ()


def test_what_is_kept_goes_by_the_whole_scene(shots: list[Shot], tmp_path, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setenv("ICALIB_CACHE", str(tmp_path))
    recording = Shown([shot.pixels for shot in shots[:2]])
    scenes = [Scene(("a", "b"), (TAGS, AprilGrid(3, 3, 0.1, spacing))) for spacing in (0.3, 0.31)]
    for scene in (scenes[0], scenes[0], scenes[1], replace(TAGS, ids=(40,)), TAGS):
        detected_corners.find_corners(recording, CAMERA, scene)
    assert len(list(tmp_path.iterdir())) == 4


def test_sightings_count_each_target():
    target = Scene(("board", "tags"), (Checkerboard(3, 4, 0.1), TAGS))
    notes = sightings(target, [image_with(3, 13), image_with(4), no_corners()])
    assert notes == ("board is in 2, tags is in 1 of 3 images, 3 corners.",)


def test_a_board_does_not_depend_on_the_images_before(shots: list[Shot]):
    """OpenCV's search draws at random; in one state of twelve it saw a board here."""
    detector, before = detector_of(Checkerboard(3, 4, 0.1)), []
    for state in (0, 7):
        cv2.setRNGSeed(state)
        before.append(detector.detect(shots[3].pixels).point)
    np.testing.assert_array_equal(*before)
