"""`icalib inspect` as a user runs it: what is said of good recordings, and of those that cannot be calibrated."""

from __future__ import annotations

import io
import json
import re
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
from rich.console import Console

from icalib.cli import main
from icalib.data.recordings import FolderRecording, TopicInfo
from icalib.geometry.targets import AprilGrid, Markers, Target
from icalib.sensors.camera.inspect.facts import CameraSource, camera_views, target_view
from icalib.tools.inspection import Inspection, inspect_recording, read_target
from icalib.tools.inspection.console import coverage, empty_borders, print_inspection
from icalib.tools.inspection.facts import findings
from icalib.tools.simulation import Imaging, Renderer, Sheet
from icalib.tools.simulation.scenario import SimCamera

EXAMPLE = Path(__file__).parents[3] / "examples" / "euroc"
SIZE = (320, 240)
TARGET = AprilGrid(3, 3, 0.088, 0.3)
TARGET_YAML = "{type: aprilgrid, rows: 3, cols: 3, tag_size: 0.088, tag_spacing: 0.3}"
STEP = 50_000_000


def sentences(found: Inspection, severity: str = "") -> list[str]:
    return [f.sentence for f in found.findings if severity in ("", f.severity)]


def looking(tilt_deg: float, shift: float) -> np.ndarray:
    """T_world_cam: at the target from 0.6 m, from above by `tilt_deg`, moved along x by `shift` m."""
    a = np.radians(tilt_deg)
    z = np.array([0.0, np.sin(a), -np.cos(a)])
    x = np.array([1.0, 0.0, 0.0])
    T = np.eye(4)
    T[:3, :3] = np.column_stack([x, np.cross(z, x), z])
    T[:3, 3] = TARGET.points.mean(axis=0) - 0.6 * z + [shift, 0, 0]
    return T


@pytest.fixture(scope="session")
def pictures() -> list[np.ndarray]:
    """Six images of the target in the left half, then four without it."""
    camera = SimCamera("cam0", "pinhole-radtan", SIZE, (300.0, 300.0, 159.5, 119.5), (0.0,) * 4, np.eye(4))
    renderer = Renderer(camera, Imaging(noise=1.0))
    rng = np.random.default_rng(0)
    seen = [renderer.picture([Sheet(TARGET)], looking(5.0 * k, 0.12), rng).pixels for k in range(6)]
    blank = [np.clip(rng.normal(110, 2, SIZE[::-1]), 0, 255).astype(np.uint8) for _ in range(4)]
    return seen + blank


def images(bags, pictures, topic="/cam0/image_raw") -> list:
    return [bags.image(topic, bags.origin_ns + k * STEP, p) for k, p in enumerate(pictures)]


class TestTarget:
    @pytest.fixture
    def bag(self, bags, brief, pictures, tmp_path) -> Path:
        (tmp_path / "target.yaml").write_text(TARGET_YAML)
        return bags.write(tmp_path / "run", images(bags, pictures) + bags.imu("/imu0", brief))

    def test_how_often_and_where_it_is_seen(self, bag, tmp_path, capsys):
        out = tmp_path / "figures.json"
        target = tmp_path / "target.yaml"
        assert main(["inspect", str(bag), "--target", str(target), "--json", str(out)]) == 0
        figures = json.loads(out.read_text())
        view = figures["cameras"]["cam0"]["target"]
        assert (view["images"], view["seen"]) == (10, 6)
        assert 0.9 * 6 * 36 <= view["corners"] <= 6 * 36
        cells = np.array(view["cells"])
        assert cells.shape == (5, 8) and cells.sum() == view["corners"]
        assert not cells[:, 6:].any() and cells[2, 2:4].all()
        assert view["tilt_deg"][0] < 10.0 and 20.0 < view["tilt_deg"][2] < 35.0
        shown = capsys.readouterr().out
        assert "cam0 has 10 images, too few" in shown
        assert "6 (60%)" in shown and "never sees the target at the" in shown and "right edge" in shown

    def test_a_page_shows_it(self, bag, tmp_path, assert_drawn):
        out = tmp_path / "page.html"
        given = [
            "--target",
            str(tmp_path / "target.yaml"),
            "--html",
            str(out),
            "--json",
            str(tmp_path / "f.json"),
            "-q",
        ]
        assert main(["inspect", str(bag), *given]) == 0
        page = out.read_text()
        assert "No." in page and "cam0 has 10 images, too few" in page and "6 (60%)" in page
        assert page.count("data:image/jpeg") == page.count("cam0: 36 corners of the target") == 3
        assert_drawn(page, {"coverage-cam0", "motion-imu0"})
        figures = json.loads((tmp_path / "f.json").read_text())
        assert "curves" not in figures["imus"]["imu0"] and "images_seen" not in figures["cameras"]["cam0"]["target"]

    def test_the_target_of_a_rig_file_or_of_kalibr(self, bag, tmp_path, capsys):
        assert main(["inspect", str(bag), "--rig", str(tmp_path / "rig.yaml"), "--quiet"]) == 0
        text = (tmp_path / "rig.yaml").read_text()
        (tmp_path / "rig.yaml").write_text(text[: text.index("# FILL IN the target")] + f"target: {TARGET_YAML}\n")
        kalibr = "{target_type: aprilgrid, tagRows: 3, tagCols: 3, tagSize: 0.088, tagSpacing: 0.3}"
        (tmp_path / "kalibr.yaml").write_text(kalibr)
        for name in ("rig.yaml", "kalibr.yaml"):
            assert main(["inspect", str(bag), "--target", str(tmp_path / name)]) == 0
            assert "6 (60%)" in capsys.readouterr().out
        assert camera_views(inspect_recording(bag))["cam0"].seen == 6  # Kalibr's lies beside the bag

    def test_a_target_that_is_never_seen(self, bags, brief, pictures, tmp_path):
        bag = bags.write(tmp_path / "run", images(bags, pictures[6:]) + bags.imu("/imu0", brief))
        (tmp_path / "kalibr.yaml").write_text("{target_type: checkerboard, targetRows: 6, targetCols: 7}")
        (tmp_path / "target.yaml").write_text(TARGET_YAML)
        assert main(["inspect", str(bag), "--target", str(tmp_path / "target.yaml"), "-q"]) == 0
        found = inspect_recording(bag)
        assert any("kalibr.yaml: rowSpacingMeters" in n for n in found.notes)
        (tmp_path / "kalibr.yaml").write_text(
            "{target_type: aprilgrid, tagRows: 3, tagCols: 3, tagSize: 0.088, tagSpacing: 0.3}"
        )
        found = inspect_recording(bag)
        assert found.verdict == "no"
        assert any("the target is in none of 4 images of cam0; the images show" in s for s in sentences(found))

    @pytest.mark.parametrize(
        ("text", "words"),
        [
            ("{type: aprilgrid, rows: 3}", r"target\.yaml:1: cols, tag_size, tag_spacing are missing"),
            ("{target_type: starfield}", r"target\.yaml: icalib does not know the target_type 'starfield'"),
            ("{target_type: circlegrid}", r"target\.yaml: targetRows must be a number above 0"),
            (
                "{target_type: circlegrid, targetRows: 5, targetCols: 4, spacingMeters: 0.05, asymmetricGrid: true}",
                r"target\.yaml: the circle grid of Kalibr's file has no diameter, .*; measure it and write `target: "
                r"\{type: circles, rows: 5, cols: 4, spacing: 0\.05, diameter: ..., asymmetric: true\}` in the rig",
            ),
            ("- 1", r"target\.yaml:1: must be a mapping"),
            (None, r"target\.yaml does not exist; check the path"),
        ],
    )
    def test_a_wrong_target_file(self, text, words, bag, tmp_path, capsys):
        path = tmp_path / "target.yaml"
        path.unlink() if text is None else path.write_text(text)
        assert main(["inspect", str(bag), "--target", str(path)]) == 1
        assert re.fullmatch(rf"icalib: .*{words}.*\.\n", capsys.readouterr().err)


def test_coverage():
    uv = np.array([[-0.5, -0.5], [319.4, 239.4], [39.4, 0.0], [39.6, 0.0], [320.0, 100.0]])
    cells = np.array(coverage(uv, SIZE))
    assert cells.sum() == 5
    assert (cells[0, 0], cells[0, 1], cells[4, 7], cells[2, 7]) == (2, 1, 1, 1)


def test_borders_that_are_empty():
    full = np.ones((5, 8), int)
    assert empty_borders(tuple(map(tuple, full))) == ()
    left = full.copy()
    left[:, 0] = 0
    assert empty_borders(tuple(map(tuple, left))) == ("left edge",)
    corner = full.copy()
    corner[4, 7] = 0
    assert empty_borders(tuple(map(tuple, corner))) == ("bottom right corner",)


def with_corners(root: Path, target: Target, stamps: np.ndarray, uv: np.ndarray) -> FolderRecording:
    """A recording with a table of all points of the target at uv (N, 2) px, in one image for each stamp."""
    tag, corner = target.point_identity(np.tile(np.arange(len(target.points)), len(stamps)))
    rows = np.column_stack([np.repeat(stamps, len(target.points)), tag, corner])
    (root / "cam0").mkdir()
    lines = [f"{t},{a},{b},{u},{v}\n" for (t, a, b), (u, v) in zip(rows.tolist(), uv.tolist(), strict=True)]
    (root / "cam0" / "corners.csv").write_text("".join(lines))
    return FolderRecording(root)


def test_tilts_and_distances(tmp_path):
    """Against a pinhole far away, where they are exact."""
    rng = np.random.default_rng(1)
    tilts, distances = np.radians(np.linspace(0, 40, 41)), np.linspace(5.0, 10.0, 41)
    uv = []
    for tilt, distance in zip(tilts, rng.permutation(distances), strict=True):
        xyz = TARGET.points - TARGET.points.mean(axis=0)
        z = distance + xyz[:, 1] * np.sin(tilt)
        uv.append(1000.0 * np.column_stack([xyz[:, 0] / z, xyz[:, 1] * np.cos(tilt) / z]))
    recording = with_corners(tmp_path, TARGET, np.arange(41, dtype=np.int64) * STEP, np.concatenate(uv))
    topic = TopicInfo("cam0/corners.csv", "table", "corners", 41, 0, 1)
    source = CameraSource("camera", topic, None, topic, None)
    view = target_view(recording, "cam0", source, TARGET, None, lambda _: None)
    assert view.tilt_deg == pytest.approx((4.0, 20.0, 36.0), abs=2.0)
    assert view.distance_ratio == pytest.approx(9.5 / 5.5, rel=0.05)
    assert view.images is None and view.cells is None


def test_tilts_are_those_of_each_free_tag(tmp_path):
    """Two tags in every image, one from the front, one tilted by 40 degrees about another axis."""
    target, stamps = Markers("tag36h11", 0.2, (5, 8)), np.arange(20, dtype=np.int64) * STEP
    xy = target.points[:4, :2] - 0.1
    front = 1000.0 / 8.0 * xy
    tilted = 1000.0 * xy * [np.cos(np.radians(40.0)), 1.0] / (8.0 + xy[:, :1] * np.sin(np.radians(40.0)))
    recording = with_corners(tmp_path, target, stamps, np.tile([*front, *tilted], (20, 1)))
    topic = TopicInfo("cam0/corners.csv", "table", "corners", 20, 0, 1)
    source = CameraSource("camera", topic, None, topic, None)
    view = target_view(recording, "cam0", source, target, None, lambda _: None)
    assert view.tilt_deg == pytest.approx((0.0, 20.0, 40.0), abs=0.5)


def test_the_example_that_comes_with_icalib(tmp_path, capsys):
    arguments = ["--target", str(EXAMPLE / "rig.yaml"), "--json", str(tmp_path / "f.json")]
    assert main(["inspect", str(EXAMPLE / "recording"), *arguments]) == 0
    shown = capsys.readouterr().out
    assert shown.startswith("Can this be calibrated? Yes.\n")
    assert "40 of 40" in shown and "rate [Hz]" in shown
    figures = json.loads((tmp_path / "f.json").read_text())
    assert figures["verdict"] == "yes" and figures["findings"] == []
    assert [t["timing"]["rate_hz"] for t in figures["topics"]] == pytest.approx([20.0, 20.0, 200.0], rel=1e-3)
    assert figures["imus"]["imu0"]["mean_accel"] == pytest.approx(9.9, abs=0.3)
    assert figures["cameras"]["cam1"]["target"]["seen"] == 720


@pytest.fixture(scope="module")
def example() -> Inspection:
    return inspect_recording(EXAMPLE / "recording", read_target(EXAMPLE / "rig.yaml"))


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"seen": 20}, "cam1 sees the target in 20 images, too few"),
        ({"images": 2900}, r"cam1 sees the target in 720 of 2900 images \(25%\); keep it in view"),
        ({"tilt_deg": (1.0, 2.0, 3.0)}, r"cam1 sees the target nearly from the front only \(tilts up to about 3 deg\)"),
        ({"cells": ((0,) * 8, *((1,) * 8,) * 4)}, "cam1 never sees the target at the top edge of the image"),
        ({"problem": "cam1 is broken."}, "cam1 is broken"),
    ],
)
def test_a_camera_that_hardly_sees_the_target(change, words, example):
    """One of two, so a warning; both, so no calibration can be made where one would be refused."""
    changed = {n: replace(example.facts[n], view=replace(v, **change)) for n, v in camera_views(example).items()}
    one = replace(example, facts={**example.facts, "cam1": changed["cam1"]})
    (finding,) = findings(one)
    assert finding.severity == "warning" and re.search(words, finding.sentence)
    both = replace(example, facts={**example.facts, **changed})
    refused = "seen" in change or "problem" in change
    assert {f.severity for f in findings(both)} == {"problem" if refused else "warning"}


class TestStreams:
    """What is wrong with one stream is a sentence in the answer."""

    def inspected(self, bags, tmp_path, messages) -> Inspection:
        return inspect_recording(bags.write(tmp_path / "run", messages))

    def test_figures(self, bags, brief, tmp_path):
        found = self.inspected(bags, tmp_path, bags.noise("/cam0/image_raw") + bags.imu("/imu0", brief))
        assert found.facts["cam0"].images.resolution == (32, 24)
        assert (found.facts["cam0"].images.encoding, found.facts["cam0"].images.frame) == ("mono8", "lens")
        camera, imu = (s.timing for s in found.streams)
        assert camera and imu
        assert (camera.count, imu.count) == (50, 600)
        assert (camera.rate_hz, imu.rate_hz) == pytest.approx((20.0, 200.0))
        assert camera.first_ns == bags.origin_ns
        assert found.verdict == "yes, but"  # it is short
        assert any("The IMU ran for 3.0 s; record for 30 to 90 s." in s for s in sentences(found, "warning")), (
            found.findings
        )

    def test_topics_of_no_sensor(self, bags, brief, tmp_path):
        others = [bags.pose("/[bold]", bags.origin_ns + k * STEP) for k in range(5)]
        others += [bags.text("/chatter", bags.origin_ns + k * STEP) for k in range(7)]
        found = self.inspected(bags, tmp_path, others + bags.noise("/cam0/image_raw") + bags.imu("/imu0", brief))
        by_name = {s.topic.name: s for s in found.streams}
        timing = by_name["/[bold]"].timing
        assert timing and timing.rate_hz == pytest.approx(20.0) and timing.first_ns == bags.origin_ns
        assert (by_name["/chatter"].timing, by_name["/chatter"].topic.count) == (None, 7)
        shown = io.StringIO()
        print_inspection(found, Console(file=shown, width=80))
        assert "/[bold]" in shown.getvalue() and max(map(len, shown.getvalue().splitlines())) <= 80

    def test_gaps(self, bags, brief, tmp_path):
        cut = np.delete(np.arange(600), np.s_[201:241])
        imu = replace(brief, stamps_ns=brief.stamps_ns[cut], gyro=brief.gyro[cut], accel=brief.accel[cut])
        found = self.inspected(bags, tmp_path, bags.noise("/cam0/image_raw") + bags.imu("/imu0", imu))
        assert any("imu0 has 1 gap, the longest of 0.205 s at 1.00 s" in s for s in sentences(found, "warning")), (
            found.findings
        )

    @pytest.mark.parametrize("together", [True, False])
    def test_clocks_that_do_not_overlap(self, together, bags, brief, tmp_path):
        imu = replace(brief, stamps_ns=brief.stamps_ns - 10**18)
        messages = bags.imu("/imu0", imu)
        if together:
            messages = [(*m[:2], m[2] + 10**18, m[3]) for m in messages]
        found = self.inspected(bags, tmp_path, bags.noise("/cam0/image_raw") + messages)
        (sentence,) = (s for s in sentences(found) if "The stamps of cam0 and imu0 do not overlap" in s)
        assert "11574.1 days apart" in sentence
        assert ("received together" in sentence) == together

    def test_an_imu_that_stops_early(self, bags, brief, tmp_path):
        imu = replace(brief, stamps_ns=brief.stamps_ns[:200], gyro=brief.gyro[:200], accel=brief.accel[:200])
        found = self.inspected(bags, tmp_path, bags.noise("/cam0/image_raw") + bags.imu("/imu0", imu))
        assert any(re.search(r"imu0 was running during 1\.0 s of the 2\.\d s of cam0", s) for s in sentences(found))

    def test_no_images(self, bags, brief, tmp_path):
        found = self.inspected(bags, tmp_path, bags.imu("/imu0", brief))
        assert found.verdict == "no"
        assert "There is only an IMU: it holds /imu0 (sensor_msgs/msg/Imu); record" in sentences(found)[0]

    def test_no_imu(self, bags, tmp_path):
        found = self.inspected(bags, tmp_path, bags.noise("/cam0/image_raw"))
        assert found.verdict == "yes, but" and found.imu is None
        assert any(s.startswith("There is no IMU: it holds /cam0/image_raw") for s in sentences(found, "warning"))

    def test_images_that_cannot_be_decoded(self, bags, brief, tmp_path):
        bad = [
            bags.compressed("/cam0/compressed", bags.origin_ns + k * STEP, b"\xff\xd8\xff" + bytes([k + 1] * 99))
            for k in range(20)
        ]
        found = self.inspected(bags, tmp_path, bad + bags.imu("/imu0", brief))
        assert found.verdict == "no" and found.facts["cam0"].images.damaged == found.facts["cam0"].images.decoded == 20
        assert any("none of 20 sampled images can be decoded" in s for s in sentences(found, "problem"))

    def test_some_that_cannot_be_decoded(self, bags, brief, tmp_path):
        good = cv2.imencode(".jpg", np.arange(64 * 48, dtype=np.uint8).reshape(48, 64))[1].tobytes()
        data = [good + bytes([k]) for k in range(20)]
        data[3] = b"\xff\xd8\xff" + bytes(90) + b"x"
        messages = [bags.compressed("/cam0/compressed", bags.origin_ns + k * STEP, d) for k, d in enumerate(data)]
        found = self.inspected(bags, tmp_path, messages + bags.imu("/imu0", brief))
        assert any("1 of 20 sampled images cannot be decoded" in s for s in sentences(found, "warning")), found.findings
        assert found.facts["cam0"].images.resolution == (64, 48)

    def test_an_unknown_encoding_beside_a_good_camera(self, bags, brief, tmp_path):
        odd = [
            bags.image("/odd/image", bags.origin_ns + k * STEP, np.full((4, 4), k + 1, np.uint8), "32FC9")
            for k in (0, 1)
        ]
        found = self.inspected(bags, tmp_path, odd + bags.noise("/cam0/image_raw") + bags.imu("/imu0", brief))
        assert any("has the encoding '32FC9'" in s for s in sentences(found, "warning")), found.findings
        assert found.verdict == "yes, but"

    def test_slow_and_few_images(self, bags, brief, tmp_path):
        slow = [m for k, m in enumerate(bags.noise("/cam0/image_raw")) if k % 10 == 0]
        found = self.inspected(bags, tmp_path, slow + bags.imu("/imu0", brief))
        assert any("cam0 has 5 images, too few; record" in s for s in sentences(found, "problem")), found.findings
        pixels = np.random.default_rng(0).integers(0, 255, (30, 4, 4), dtype=np.uint8)
        slow = [bags.image("/c/image", bags.origin_ns + k * 60 * STEP, p) for k, p in enumerate(pixels)]
        found = inspect_recording(bags.write(tmp_path / "slow", slow + bags.imu("/imu0", brief)))
        (problem,) = sentences(found, "problem")
        assert "c takes 0.33 images per second, too few" in problem and "remove imu0 from the rig file" in problem

    def test_stills_beside_the_joints_of_an_arm(self, bags, tmp_path):
        pixels = np.random.default_rng(0).integers(0, 255, (12, 4, 4), dtype=np.uint8)
        messages = [bags.image("/c/image", bags.origin_ns + k * 100 * STEP, p) for k, p in enumerate(pixels)]
        kind, empty = "sensor_msgs/msg/JointState", np.zeros(0)
        for k in range(100):
            stamp = bags.origin_ns + k * 10 * STEP
            joints = bags.make(kind, bags.header(stamp, ""), ["elbow"], np.array([0.1 * k]), empty, empty)
            messages.append(("/joint_states", kind, stamp, joints))
        found = inspect_recording(bags.write(tmp_path / "run", messages))
        assert not sentences(found, "problem") and "90 s" not in str(found.findings)


class TestNoRecording:
    def refusal(self, path: Path, capsys) -> str:
        assert main(["inspect", str(path)]) == 1
        captured = capsys.readouterr()
        assert captured.out == "" and captured.err.count("\n") == 1 and captured.err.startswith("icalib: ")
        return captured.err

    def test_nothing_there(self, tmp_path, capsys):
        assert "does not exist" in self.refusal(tmp_path / "run.bag", capsys)

    def test_another_file(self, tmp_path, capsys):
        (tmp_path / "notes.txt").write_text("cameras")
        assert "neither a ROS 1 bag nor" in self.refusal(tmp_path / "notes.txt", capsys)

    def test_an_empty_folder(self, tmp_path, capsys):
        (tmp_path / "run").mkdir()
        assert "holds no messages, images or tables; give a bag" in self.refusal(tmp_path / "run", capsys)

    def test_an_empty_bag(self, bags, tmp_path, capsys):
        assert "run" in self.refusal(bags.write(tmp_path / "run", []), capsys)

    @pytest.mark.parametrize("kind", ["json", "html"])
    def test_files_that_cannot_be_written(self, kind, bags, brief, tmp_path, capsys):
        bag = bags.write(tmp_path / "run", bags.noise("/cam0/image_raw") + bags.imu("/imu0", brief))
        assert main(["inspect", str(bag), f"--{kind}", str(tmp_path / "away" / f"f.{kind}"), "-q"]) == 1
        assert f"f.{kind} cannot be written" in capsys.readouterr().err
