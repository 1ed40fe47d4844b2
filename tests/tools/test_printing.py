"""Printed targets: every size on the page in points, and the sentence for what cannot be printed."""

from __future__ import annotations

import re
import sys
from pathlib import Path

import numpy as np
import pytest
import yaml
from tests.cases import each

from icalib.base.files import sealed
from icalib.cli import main
from icalib.errors import CalibrationError, RigError
from icalib.geometry.targets import AprilGrid, Charuco, Checkerboard, Circles, Markers, Tag, Target
from icalib.geometry.targets.boards import pattern_of
from icalib.tools.printing import PAPERS, target_pdf, write_target

pytest.importorskip("reportlab")
pytest.importorskip("cv2")

POINTS = 72.0 / 0.0254  # a metre
NUMBER = r"(-?[\d.]+)"
TARGETS = {
    "aprilgrid": (AprilGrid(5, 7, 0.025, 0.3), "a4"),
    "large aprilgrid": (AprilGrid(6, 6, 0.088, 0.3), "a0"),
    "charuco": (Charuco(8, 5, 0.03, 0.022, "5x5_100"), "letter"),
    "checkerboard": (Checkerboard(6, 9, 0.035), "a3"),
    "tag": (Tag("tag36h11", 3, 0.15), "a4"),
}


def rows(pattern: str, text: str) -> np.ndarray:
    return np.array(re.findall(pattern, text), dtype=float)


def stream(pdf: bytes) -> str:
    found = re.search(r"stream\r?\n(.*?)endstream", pdf.decode("latin1"), re.DOTALL)
    assert found
    return found[1]


def boxes(pdf: bytes) -> np.ndarray:
    """(n, 4) left, bottom, right, top [points] of what is filled."""
    x, y, width, height = rows(rf"{NUMBER} {NUMBER} {NUMBER} {NUMBER} re", stream(pdf)).T
    return np.stack([x, y, x + width, y + height], axis=1)


def page(pdf: bytes) -> np.ndarray:
    return rows(rf"/MediaBox \[ 0 0 {NUMBER} {NUMBER} \]", pdf.decode("latin1"))[0]


@each("name", TARGETS)
def test_the_page_holds_the_pattern_at_true_scale(name: str):
    target, paper = TARGETS[name]
    pdf, pattern = target_pdf(target, paper), pattern_of(target)
    black = boxes(pdf)
    low, high = black.min(axis=0)[:2], black.max(axis=0)[2:]
    size = np.array([pattern.x[-1] - pattern.x[0], pattern.y[-1] - pattern.y[0]])
    np.testing.assert_allclose(high - low, POINTS * size, atol=2e-3)
    origin = low - POINTS * np.array([pattern.x[0], pattern.y[0]])
    expected = POINTS * pattern.black_boxes() + np.tile(origin, 2)
    np.testing.assert_allclose(black, expected, atol=2e-3)  # points: 0.7 um
    assert stream(pdf).count("\nf") == 1 and "\nf\n" in stream(pdf)  # one path, non-zero winding
    sides = sorted(page(pdf))
    np.testing.assert_allclose(sides, np.array(sorted(PAPERS[paper])) * 72.0 / 25.4, atol=1e-3)
    assert (low > 8.0 * 72 / 25.4 - 1e-3).all() and (high < page(pdf) - 8.0 * 72 / 25.4 + 1e-3).all()
    np.testing.assert_allclose(low[0], page(pdf)[0] - high[0], atol=1e-2)  # in the middle


def test_corners_of_an_aprilgrid_are_its_points():
    """A box ends at each corner of each tag, at the place that the rig file states."""
    target, paper = TARGETS["aprilgrid"]
    black = boxes(target_pdf(target, paper))
    left, bottom = black.min(axis=0)[:2] + POINTS * 0.3 * 0.025  # the corner squares stick out
    ends = np.concatenate([black[:, [i, j]] for i in (0, 2) for j in (1, 3)])
    for x, y, _ in POINTS * target.points:
        assert np.abs(ends - [left + x, bottom + y]).max(axis=1).min() < 2e-3


@each("name", TARGETS)
def test_the_ruler_is_100_mm_and_below_the_target(name: str):
    pdf = target_pdf(*TARGETS[name])
    lines = rows(rf"n {NUMBER} {NUMBER} m {NUMBER} {NUMBER} l S", stream(pdf))
    horizontal = lines[lines[:, 1] == lines[:, 3]]
    assert len(horizontal) == 1 and horizontal[0, 2] - horizontal[0, 0] == pytest.approx(0.1 * POINTS, abs=1e-3)
    ticks = np.sort(lines[lines[:, 1] != lines[:, 3]][:, 0])
    np.testing.assert_allclose(np.diff(ticks), 0.01 * POINTS, atol=2e-3)
    assert lines.max(axis=0)[3] < boxes(pdf).min(axis=0)[1]


def texts(pdf: bytes) -> list[str]:
    return re.findall(r"Tm \((.*?)\) Tj", stream(pdf))


def test_the_sheet_says_what_the_rig_file_must_say():
    target, paper = TARGETS["charuco"]
    found = texts(target_pdf(target, paper))
    assert yaml.safe_load(found[0])["target"] == {
        "type": "charuco",
        "squares_x": 8,
        "squares_y": 5,
        "square_size": 0.03,
        "marker_size": 0.022,
        "dictionary": "5x5_100",
    }
    assert "Print at 100 %" in found[1] and found[2] == "100 mm"
    assert yaml.safe_load(texts(target_pdf(*TARGETS["tag"]))[0])["id"] == 3


def pages(pdf: bytes) -> list[bytes]:
    return re.findall(rb"stream\r?\n.*?endstream", pdf, re.DOTALL)


def test_free_tags_have_a_page_each_with_its_id_and_the_line_for_all():
    printed = pages(target_pdf(Markers("tag36h11", 0.15, (9, 3)), "a4"))
    assert len(printed) == 2
    for tag_id, one in zip((3, 9), printed, strict=True):
        alone = target_pdf(Tag("tag36h11", tag_id, 0.15), "a4")
        np.testing.assert_array_equal(boxes(one), boxes(alone))
        line, how, _ = texts(one)
        fields = {"type": "markers", "family": "tag36h11", "size": 0.15, "ids": [9, 3], "border_bits": 1}
        assert yaml.safe_load(line) == {"target": fields} and how.startswith(f"Tag {tag_id}. icalib, sizes in metres.")


def test_border_bits_are_printed_and_said():
    grid = AprilGrid(2, 2, 0.05, 0.3)
    two, one = target_pdf(grid, "a4"), target_pdf(grid, "a4", border_bits=1)
    # The lowest box of tag 0 is its border, from the bottom up.
    for pdf, bits in ((two, 2), (one, 1)):
        black = boxes(pdf)
        lowest = black[(black[:, 2] - black[:, 0]) > 0.9 * 0.05 * POINTS][:, [1, 3]].min(axis=0)
        assert lowest[1] - lowest[0] == pytest.approx(0.05 * POINTS * bits / (6 + 2 * bits), abs=2e-3)
    assert "border_bits: 1" in texts(one)[0] and "border_bits: 2" in texts(two)[0]
    said = texts(target_pdf(*TARGETS["tag"], border_bits=2))[1]  # a tag's line has no place for it
    assert "a border of 2 bits" in said and "border" not in texts(one)[1]


def test_the_same_target_gives_the_same_file():
    assert target_pdf(*TARGETS["checkerboard"]) == target_pdf(*TARGETS["checkerboard"])


@each(
    ("target", "paper", "words"),
    [
        (
            AprilGrid(6, 6, 0.088, 0.3),
            "a4",
            "713 x 713 mm, but a4 has space for 194 x 265 mm, or in landscape for 281 x 178",
        ),
        (AprilGrid(6, 6, 0.088, 0.3), "a3", "choose a0, or make the target smaller."),
        (Checkerboard(6, 9, 0.2), "a0", "in landscape for 1173 x 809 mm; make the target smaller."),
        (Checkerboard(6, 9, 0.02), "a5", "no paper 'a5'; available are a4, letter"),
    ],
)
def test_what_does_not_fit_is_refused(target: Target, paper: str, words: str):
    with pytest.raises(RigError) as caught:
        target_pdf(target, paper)
    assert words in str(caught.value) and "\n" not in str(caught.value)


def test_a_target_that_just_fits_fits():
    assert len(target_pdf(Checkerboard(3, 5, 0.265 / 6), "a4"))
    with pytest.raises(RigError, match="choose a3"):
        target_pdf(Checkerboard(3, 5, 0.2821 / 6), "a4")


def test_without_reportlab_the_extra_is_named(monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setitem(sys.modules, "reportlab.pdfgen.canvas", None)
    with pytest.raises(CalibrationError, match=r"pip install .\.\[print\]"):
        target_pdf(*TARGETS["checkerboard"])


def test_a_place_that_cannot_be_written_is_named(tmp_path: Path):
    with pytest.raises(CalibrationError, match="cannot be written"):
        write_target(tmp_path / "none" / "board.pdf", *TARGETS["checkerboard"])


COMMANDS = {
    "aprilgrid --rows 5 --cols 7 --tag-size 0.025 --tag-spacing 0.3": TARGETS["aprilgrid"],
    "charuco --squares-x 8 --squares-y 5 --square-size 0.03 --marker-size 0.022 --dictionary 5x5_100 --paper letter": (
        TARGETS["charuco"]
    ),
    "checkerboard --rows 6 --cols 9 --square-size 0.035 --paper a3": TARGETS["checkerboard"],
    "circles --rows 4 --cols 5 --spacing 0.03 --diameter 0.02": (Circles(4, 5, 0.03, 0.02), "a4"),
    "circles --rows 5 --cols 4 --spacing 0.02 --diameter 0.015 --asymmetric": (
        Circles(5, 4, 0.02, 0.015, asymmetric=True),
        "a4",
    ),
    "tag --family tag36h11 --id 3 --size 0.15": TARGETS["tag"],
    "tag --family apriltag_36h11 --id 3 --size 0.15": TARGETS["tag"],
    "markers --family tag36h11 --size 0.15 --ids 0-2,9": (Markers("tag36h11", 0.15, (0, 1, 2, 9)), "a4"),
    "markers --family 4x4_50 --size 0.1 --ids 7 --border-bits 2": (Markers("4x4_50", 0.1, (7,), 2), "a4"),
}


@each("command", COMMANDS)
def test_the_command_prints_each_target(command: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    path = tmp_path / "board.pdf"
    assert main(["target", *command.split(), "--output", str(path)]) == 0
    assert path.read_bytes() == sealed(target_pdf(*COMMANDS[command]))
    assert capsys.readouterr().out == f"{path}: print at 100 %, and measure the ruler.\n"


def test_the_command_takes_border_bits(tmp_path: Path):
    path = tmp_path / "board.pdf"
    command = "aprilgrid --rows 2 --cols 2 --tag-size 0.05 --tag-spacing 0.3 --border-bits 1 -o"
    assert main(["target", *command.split(), str(path)]) == 0
    assert path.read_bytes() == sealed(target_pdf(AprilGrid(2, 2, 0.05, 0.3), "a4", 1))


def test_the_command_refuses_in_one_line_and_writes_nothing(tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    path = tmp_path / "board.pdf"
    command = "checkerboard --rows 6 --cols 9 --square-size 0.05 -o"
    assert main(["target", *command.split(), str(path)]) == 1
    error = capsys.readouterr().err
    assert error.startswith("icalib: the target is 500 x 350 mm") and error.count("\n") == 1 and not path.exists()


@each(
    ("arguments", "words"),
    [
        ("checkerboard --rows 0 --cols 9 --square-size 0.05 -o x.pdf", "must be at least 1"),
        ("checkerboard --rows six --cols 9 --square-size 0.05 -o x.pdf", "must be a whole number, but is 'six'"),
        ("checkerboard --rows 6 --cols 9 --square-size -1 -o x.pdf", "must be a number above 0, but is '-1'"),
        ("checkerboard --rows 6 --cols 9 --square-size x -o x.pdf", "must be a number above 0, but is 'x'"),
        ("checkerboard --rows 6 --cols 9 -o x.pdf", "--square-size"),
        ("markers --family tag36h11 --size 0.1 --ids x -o x.pdf", "must be a whole number, but is 'x'"),
        ("markers --family tag36h11 --size 0.1 --ids 5-3 -o x.pdf", "as in 0-11 or 0,3,7, but is '5-3'"),
        ("markers --family tag36h11 --size 0.1 -o x.pdf", "--ids"),
        ("board", "there is no 'board'; available are aprilgrid"),
    ],
)
def test_wrong_usage_is_named(arguments: str, words: str, capsys: pytest.CaptureFixture[str]):
    with pytest.raises(SystemExit) as caught:
        main(["target", *arguments.split()])
    assert caught.value.code == 2 and words in capsys.readouterr().err


def test_circles_are_printed_at_true_scale():
    """Each circle of the PDF is four curves; its place is that of the point, its size that of the diameter."""
    target = Circles(4, 5, 0.03, 0.02, asymmetric=True)
    text = stream(target_pdf(target, "a3"))
    right = 25.4 / 72.0 * rows(rf"\nn {NUMBER} {NUMBER} m\b", text.replace("\nn\n", "\nn "))[:20]
    left = 25.4 / 72.0 * rows(rf"{NUMBER} {NUMBER} c\n", text)[1:80:4]
    expected = 1e3 * target.points[:, :2]
    np.testing.assert_allclose(right - right[0], expected - expected[0], atol=0.02)
    np.testing.assert_allclose(right[:, 0] - left[:, 0], 20.0, atol=0.02)
