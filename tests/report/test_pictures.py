"""Images in the report: what is drawn over them, how large they are, and that none is there where none is wanted."""

from __future__ import annotations

import re
from dataclasses import replace

import cv2
import numpy as np
import pytest

from icalib.cli import main
from icalib.detection.images import MOST_BYTES
from icalib.errors import CalibrationError
from icalib.report import report_html
from icalib.report.pictures import MOST_MARKS, NEAR_TO_FAR, Drawing, figures
from icalib.result import Calibration
from icalib.result.calibration import PointsInImage, ReportImage
from icalib.result.pictures import MOST_EDGE_POINTS, MOST_POINTS

JPEG = cv2.imencode(".jpg", np.tile(np.arange(200, dtype=np.uint8), (128, 1)))[1].tobytes()
TRIANGLE = np.array([[10.0, 10.0], [90.0, 10.0], [10.0, 90.0], [np.nan, np.nan], [300.0, 200.0], [310.0, 200.0]])
MOST_OF_POINTS = 24 * MOST_POINTS  # bytes: at most "M1234 5678h0" in each of two drawings
MOST_OF_EDGES = 64 * MOST_EDGE_POINTS  # twice "M1234.5 5678.9h0" in each


def cloud(count: int) -> PointsInImage:
    u, v = np.random.default_rng(2).uniform([1000, 1000], [3000, 2000], (count, 2)).T
    return PointsInImage(np.stack([u, v], axis=1), np.geomspace(30.0, 2.0, count), np.arange(count) % 5 == 0)


def with_images(c: Calibration, jpeg: bytes = JPEG, count: int = 24) -> Calibration:
    second = float(c.corner_residuals[0].seconds[70])
    corners = ReportImage("cam0", second, "the worst of 20 images, 0.3 px RMS", jpeg, TRIANGLE)
    points = replace(corners, file="<pose>.jpg", sensor="lidar0", before=cloud(count), after=cloud(count))
    return replace(c, pictures=(corners, points))


def paths(drawing: Drawing, css: str) -> list[str]:
    return [line.data for line in drawing.lines if line.css == css]


def size_of(drawing: Drawing) -> int:
    return len(drawing.jpeg) + sum(len(line.data) for line in drawing.lines)


def test_points_are_coloured_by_distance_and_the_outline_has_two_lines(calibration: Calibration):
    _, before, after = figures(with_images(calibration))
    colours = [line.color for line in after.lines if line.css == "dots"]
    assert colours == [*reversed(NEAR_TO_FAR)]  # the nearest last, over the others
    assert sum(path.count("M") for path in paths(after, "dots")) == 24
    assert paths(after, "outline") == ["M10.0 10.0L90.0 10.0L10.0 90.0M300.0 200.0L310.0 200.0"]
    assert after.words.startswith("As calibrated. lidar0 in cam0 <pose>.jpg, the worst of 20 images")
    assert before.jpeg and not after.jpeg and before.image == after.image == "shot-1"


def test_the_part_with_most_depth_edges_is_enlarged(calibration: Calibration):
    c = with_images(calibration)
    edge = np.array([[5.0, 4.0], [300.0, 200.0], [301.0, 210.0], [299.0, 190.0], [700.0, 470.0]])
    points = PointsInImage(np.vstack([edge, edge[:3]]), np.full(8, 3.0), np.arange(8) < 5)
    corners, pair = c.pictures
    _, before, after = figures(replace(c, pictures=(corners, replace(pair, before=cloud(3), after=points))))
    assert before.window == after.window == (300.0 - 752 / 12, 200.0 - 480 / 12, 752 / 6, 480 / 6)
    assert paths(after, "edge") == paths(after, "rim") and paths(after, "edge")[0].count("M") == 5
    found = report_html(replace(c, pictures=(replace(pair, before=None, after=points),)))
    assert found.count(f'<use href="#{after.name.replace("1", "0")}"/>') == 1
    assert 'viewBox="237.3 160.0 125.3 80.0"' in found
    near = replace(points, distance=np.array([1.7, 3.0, 3.0, 3.0, 2.0, 1.0, 1.0, 1.0]))  # one point in the corner
    *_, after = figures(replace(c, pictures=(replace(pair, after=near),)))
    assert after.window == (0.0, 0.0, 752 / 6, 480 / 6)
    *_, after = figures(replace(c, pictures=(replace(pair, after=replace(points, edge=np.zeros(8, bool))),)))
    assert after.window is None


def test_lines_lead_to_where_a_point_is_projected(calibration: Calibration):
    """A residual of +1 px in u is a line to the right; a rejected corner is a cross."""
    c = with_images(calibration)
    r = c.corner_residuals[0]
    rejected = np.zeros(len(r.uv), bool)
    rejected[r.start[70]] = True
    ones = replace(r, residual=np.tile([1.0, 0.0], (len(r.uv), 1)), rejected=rejected)
    drawing = next(iter(figures(replace(c, residuals=c.residuals | {("cam0", "corners"): ones}))))
    count = int(np.diff(r.start)[70])
    lines = re.findall(r"M([\d.]+) ([\d.]+)l([-\d.]+) ([-\d.]+)", "".join(paths(drawing, "residual")))
    assert len(lines) == count <= MOST_MARKS
    assert {(float(du), float(dv)) for _, _, du, dv in lines} == {(20.0, 0.0)}
    np.testing.assert_allclose([float(u) for u, *_ in lines], r.uv[r.start[70] : r.start[71], 0], atol=0.051)
    assert paths(drawing, "rejected")[0].count("M") == 1
    assert f"{count - 1} corners, 1 rejected; residuals are 20 times as long" in drawing.words


def test_the_page_holds_its_images(calibration: Calibration):
    _, found = report_html(with_images(calibration)).split('<section id="pictures">')
    section, _ = found.split("</section>", 1)
    assert "&lt;pose&gt;.jpg" in section
    links = re.findall(r'(?:src|href)="([^"]*)"', section)
    enlarged, jpeg = ["#shot-1-F", "#shot-1-A"], "data:image/jpeg;base64"
    assert [link.split(",")[0] for link in links] == [jpeg, jpeg, enlarged[0], "#shot-1", enlarged[1]]
    assert "What the sensors saw" not in report_html(calibration)


def test_pictures_have_a_bounded_size(calibration: Calibration):
    noise = np.random.default_rng(0).bytes(MOST_BYTES)
    corners, *points = figures(with_images(calibration, noise, MOST_POINTS))
    in_page = 4 / 3 * MOST_BYTES + 2_000
    assert size_of(corners) < in_page + 100 * MOST_MARKS
    assert sum(map(size_of, points)) < in_page + MOST_OF_POINTS + MOST_OF_EDGES + 4_000


@pytest.mark.parametrize(("option", "wanted"), [([], True), (["--no-images"], False)])
def test_no_images_are_kept_where_the_command_says_so(option, wanted, tmp_path, monkeypatch):
    rigs = []

    def calibrate(rig, *_, **__):
        rigs.append(rig)
        raise CalibrationError("enough.")

    monkeypatch.setattr("icalib.pipeline.calibrate", calibrate)
    rig = tmp_path / "rig.yaml"
    rig.write_text("sensors:\n  cam0: {type: camera, model: eucm, resolution: [64, 48], tracks: images}\n")
    assert main(["calibrate", str(rig), str(tmp_path), "-o", str(tmp_path / "out"), *option]) == 1
    assert [r.settings.images_in_report for r in rigs] == [wanted]
