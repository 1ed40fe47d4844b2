"""Targets in rig files: free tags, several targets by name, every spelling of a family, and what is refused."""

from __future__ import annotations

from pathlib import Path

import pytest
import yaml
from tests.cases import each

from icalib.errors import RigError
from icalib.geometry.targets import AprilGrid, Charuco, Checkerboard, Markers, Scene, Target
from icalib.rig.file import load_rig, load_target, rig_to_dict

SENSORS = "sensors:\n  cam0: {type: camera, model: eucm, resolution: [752, 480]}\n"
GRID = "{type: aprilgrid, rows: 6, cols: 7, tag_size: 0.088, tag_spacing: 0.3}"
TAGS = "{type: markers, family: tag36h11, size: 0.16, ids: [50, 47, 52]}"
BOARD = "{type: checkerboard, rows: 6, cols: 9, square_size: 0.03}"
CHARUCO = "{type: charuco, squares_x: 7, squares_y: 5, square_size: 0.04, marker_size: 0.03, dictionary: 5x5_100}"
MARKERS = Markers("tag36h11", 0.16, (50, 47, 52))


def several(**targets: str) -> str:
    return "targets:\n" + "".join(f"  {name}: {text}\n" for name, text in targets.items())


@pytest.fixture
def written(tmp_path: Path):
    def write(targets: str) -> Path:
        (tmp_path / "rig.yaml").write_text(SENSORS + targets)
        return tmp_path / "rig.yaml"

    return write


@each(
    ("text", "target"),
    [
        (f"target: {TAGS}", MARKERS),
        ("target: {type: markers, family: tag16h5, size: 0.1, border_bits: 2}", Markers("tag16h5", 0.1, (), 2)),
        (several(wall=TAGS), MARKERS),
        (
            several(grid=GRID, wall=TAGS, floor=BOARD),
            Scene(("grid", "wall", "floor"), (AprilGrid(6, 7, 0.088, 0.3), MARKERS, Checkerboard(6, 9, 0.03))),
        ),
        (several(a=CHARUCO, b=TAGS), Scene(("a", "b"), (Charuco(7, 5, 0.04, 0.03, "5x5_100"), MARKERS))),
        # Black borders of other widths tell tags apart.
        (
            several(grid=GRID, wall=TAGS.replace("50", "0")),
            Scene(("grid", "wall"), (AprilGrid(6, 7, 0.088, 0.3), Markers("tag36h11", 0.16, (0, 47, 52)))),
        ),
    ],
)
def test_targets_are_read_and_written(written, text: str, target: Target):
    path = written(text)
    rig = load_rig(path)
    assert rig.target == target == load_target(path)
    plain = rig_to_dict(rig)
    assert ("targets" in plain) == isinstance(target, Scene) and ("target" in plain) != ("targets" in plain)
    path.write_text(yaml.safe_dump(plain, sort_keys=False))
    assert load_rig(path).target == target


def test_a_file_of_targets_alone_is_read(tmp_path: Path):
    for text in (TAGS, f"target: {TAGS}", several(wall=TAGS)):
        (tmp_path / "target.yaml").write_text(text)
        assert load_target(tmp_path / "target.yaml") == MARKERS


@each("spelling", ["apriltag_36h11", "DICT_APRILTAG_36h11", "36h11", "Tag36h11"])
def test_spellings_of_a_family_are_one(written, spelling: str):
    assert load_rig(written(f"target: {TAGS.replace('tag36h11', spelling)}")).target == MARKERS
    board = load_rig(written(f"target: {CHARUCO.replace('5x5_100', spelling)}")).target
    assert board == Charuco(7, 5, 0.04, 0.03, "tag36h11")
    assert rig_to_dict(load_rig(written(f"target: {TAGS}")))["target"]["family"] == "tag36h11"


LARGER = CHARUCO.replace("5x5_100", "5x5_1000")
ONE_BIT = GRID.replace("}", ", border_bits: 1}")


@each(
    ("text", "words"),
    [
        ("", "rig.yaml:1: target is missing; add target, targets for several by name, or tracks"),
        (f"target: {GRID}\n" + several(a=TAGS), "targets: conflicts with target; put all targets under targets."),
        ("targets: {}", "targets: there is no target; add one"),
        (several(**{"0a": TAGS}), "targets.0a: a target's name is a letter, then up to 99 letters, digits"),
        (several(a=TAGS, b=BOARD.replace("6", "six")), "targets.b.rows: must be a number, but is 'six'"),
        (f"target: {TAGS.replace('52', '47')}", "target: tag 47 is listed twice"),
        (f"target: {TAGS.replace('52', '587')}", "target: needs 588 tags, but tag36h11 has 587"),
        (f"target: {TAGS.replace('52', '-1')}", "target.ids[2]: must be a whole number of at least 0"),
        (
            f"target: {TAGS.replace('[50, 47, 52]', '[]')}",
            "target.ids: the list of ids is empty; list them, or remove ids",
        ),
        (f"target: {TAGS.replace('[50, 47, 52]', '50')}", "target.ids: must be a list"),
        (f"target: {TAGS.replace('0.16', '16')}", "target.size: is in metres, and 16 m is too large for a tag"),
        (
            f"target: {TAGS.replace('tag36h11', 'tag36h12')}",
            "target.family: there is no tag family 'tag36h12'",
        ),
        (f"target: {TAGS.replace('tag36h11', 'tagStandard41h12')}", "no tag family 'tagStandard41h12'"),
        (f"target: {TAGS.replace('family', 'dictionary')}", "target.dictionary: there is no such field"),
        (
            several(a=TAGS, b=TAGS.replace("50, 47", "51, 49")),
            "targets: images cannot tell a from b: both have tag 52 of tag36h11; give them other ids or families",
        ),
        (several(a=TAGS, b="{type: markers, family: 36h11, size: 0.1}"), "both have tag 47 of tag36h11"),
        (several(a=ONE_BIT, b=TAGS.replace("47", "41")), "both have tag 41 of tag36h11"),
        (several(a=GRID, b=GRID.replace("6", "3")), "both have tag 0 of tag36h11"),
        (several(a=BOARD, b=TAGS, c=BOARD.replace("0.03", "0.05")), "cannot tell a from c: both are checkerboards"),
        (
            several(a=BOARD, b=BOARD.replace("rows: 6, cols: 9", "rows: 9, cols: 6")),
            "cannot tell a from b: both are checkerboards with as many corners; take another size",
        ),
        (several(a=CHARUCO, b=LARGER), "both have tag 0 of 5x5_100; give them other ids or families"),
        (several(a=CHARUCO, b="{type: markers, family: 5x5_250, size: 0.1, ids: [16]}"), "both have tag 16 of 5x5_100"),
    ],
)
def test_what_is_wrong_is_named(written, text: str, words: str):
    with pytest.raises(RigError) as caught:
        load_rig(written(text))
    assert words in str(caught.value) and "\n" not in str(caught.value)


@each(
    "others",
    [
        {"a": CHARUCO, "b": "{type: markers, family: 5x5_250, size: 0.1, ids: [17]}"},
        {"a": ONE_BIT, "b": TAGS, "c": GRID},
        {"a": BOARD, "b": BOARD.replace("6", "5")},
        {"a": CHARUCO, "b": CHARUCO.replace("5x5_100", "6x6_100")},
    ],
)
def test_what_images_can_tell_apart_is_taken(written, others: dict[str, str]):
    target = load_rig(written(several(**others))).target
    assert isinstance(target, Scene) and target.names == tuple(others)
