"""`icalib inspect --follow`: figures that are in time, predictions against the final result, and what survives."""

from __future__ import annotations

import gzip
import io
import os
import signal
import subprocess
import sys
import time
import urllib.error
import urllib.request
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from rich.console import Console
from tests.typed import not_none

import icalib
from icalib.cli.commands import main
from icalib.data.folder import FilePart
from icalib.data.measurements import CornerStream
from icalib.pipeline import calibrate_measurements, measure
from icalib.rig import Parameter
from icalib.rig.file import load_rig
from icalib.tools.inspection import read_target
from icalib.tools.inspection.console import Page, screen
from icalib.tools.inspection.facts import GivenTarget
from icalib.tools.inspection.follow import (
    Arrivals,
    CoarseProblem,
    Expectation,
    ExpectedStd,
    Follower,
    Solver,
    follow,
    predict,
    view,
)
from icalib.tools.simulation import Imaging, film, handheld, write_film

pytestmark = pytest.mark.slow

EXAMPLE = Path(__file__).parents[3] / "examples" / "euroc"
SECONDS = 6.0
FACTOR = 1.5  # between a predicted and the final standard deviation of a determined parameter


@pytest.fixture(scope="module")
def filmed(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A bag of two small cameras and an IMU."""
    pytest.importorskip("cv2")
    base = handheld(SECONDS)
    half = tuple(tuple(x / 2 for x in c.intrinsics) for c in base.cameras)
    cameras = (replace(c, resolution=(376, 240), intrinsics=i) for c, i in zip(base.cameras, half, strict=True))
    path = tmp_path_factory.mktemp("film") / "bag"
    write_film(film(replace(base, cameras=tuple(cameras)), 4, Imaging(blur_px=0.6, noise=2.0)), {"mcap": path})
    return next(path.glob("*.mcap"))


@pytest.fixture(scope="module")
def target(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("target") / "target.yaml"
    path.write_text("{type: aprilgrid, rows: 6, cols: 6, tag_size: 0.088, tag_spacing: 0.3}")
    return path


def play(source: Path, to: Path, seconds: float) -> Iterator[float]:
    """Writes a file in real time; yields the share that is written."""
    whole, begin, at = source.read_bytes(), time.monotonic(), 0
    with to.open("wb") as file:
        while at < len(whole):
            end = min(len(whole), int(len(whole) * (time.monotonic() - begin) / seconds))
            file.write(whole[at:end])
            file.flush()
            at = end
            yield at / len(whole)


def test_a_bag_is_followed_in_time_with_half_a_core(filmed: Path, target: Path, tmp_path: Path):
    given = read_target(target)
    compiled = Follower(filmed, given)
    assert compiled.look()
    path, late = tmp_path / "live.mcap", [0.0]
    follower = Follower(path, given)
    assert not follower.look()
    assert follower.problem == f"{path} is not there yet; start the recorder, or correct the path."
    begin, processor = time.monotonic(), time.process_time()
    for share in play(filmed, path, SECONDS):
        worked = time.process_time()
        follower.look()
        late.append(share * SECONDS - follower.seconds)
        time.sleep(max(0.2, time.process_time() - worked))
    while follower.look():
        pass
    assert time.process_time() - processor < 0.5 * (time.monotonic() - begin)
    assert max(late) < 2.0
    arrived = {name: (round(a.rate_hz), a.topic.count) for name, a in follower.topics.items()}
    count = round(20 * SECONDS) - 1
    assert arrived == {
        "/imu0": (200, round(200 * SECONDS) + 1),
        "/cam0/image_raw": (20, count),
        "/cam1/image_raw": (20, count),
    }
    assert list(follower.sensors) == ["imu0", "cam0", "cam1"]
    camera = follower.topics["/cam0/image_raw"]
    assert camera.sees and 0 < camera.seen <= 10 * SECONDS + 1 and camera.cells.sum() > 1000
    assert follower.seconds == pytest.approx(SECONDS, abs=0.2)
    np.testing.assert_array_less(20.0, np.rad2deg(follower.motion.rates(np.eye(3))))
    np.testing.assert_array_less(1.0, follower.motion.shaking())


def test_a_rig_file_names_the_sensors(filmed: Path, tmp_path: Path):
    path = tmp_path / "rig.yaml"
    path.write_text(
        "sensors:\n  imu: {type: imu, topic: /imu0}\n  left: {type: camera, topic: cam0/image_raw, "
        "model: pinhole-radtan, resolution: [376, 240]}\n  wheels: {type: wheels, measures: rates}\n"
        "target: {type: aprilgrid, rows: 6, cols: 6, tag_size: 0.088, tag_spacing: 0.3}\n"
    )
    follower = Follower(filmed, read_target(path))
    while follower.look():
        pass
    sentence = f"wheels: {filmed} has no joints for wheels; it holds /cam0/image_raw (sensor_msgs/msg/Image), "
    assert view(follower, None).advice[0].startswith(sentence)
    assert {name: topic.name for name, topic in follower.sensors.items()} == {"imu": "/imu0", "left": "/cam0/image_raw"}
    problem = not_none(follower.coarse_problem())
    assert list(problem.rig.sensors) == ["imu", "left"] and [c.name for c in problem.corners] == ["left"]
    assert problem.share == 1.0 and problem.seconds == pytest.approx(SECONDS, abs=0.1)
    assert problem.density == pytest.approx(
        follower.topics["/cam0/image_raw"].topic.count / len(problem.corners[0].stamps_ns)
    )


def test_a_rig_without_a_target_is_followed(filmed: Path, tmp_path: Path):
    path = tmp_path / "rig.yaml"
    path.write_text("sensors:\n  imu: {type: imu, topic: /imu0}\n  lidar0: {type: lidar}\n")
    follower = Follower(filmed, read_target(path))
    assert follower.look() and list(follower.sensors) == ["imu"] and follower.motion.count > 0
    assert follower.coarse_problem() is None


def every(c: CornerStream, n: int) -> CornerStream:
    kept = np.arange(len(c.stamps_ns)) % n == 0
    return c.of_rows(kept[c.image], c.stamps_ns[kept], np.diff(c.start)[kept])


def test_predictions_are_those_of_the_final_result():
    """Of a real recording, from every second image, as of cameras of 20 Hz. Without the size effect of its IMU, of some
    three standard deviations: standard deviations may cover it of a part of the images, and not of all."""
    rig = load_rig(EXAMPLE / "rig.yaml")
    rig = rig.with_(imu=replace(not_none(rig.imu), size_effect=Parameter("fixed", np.zeros(6))))
    measured = measure(rig, EXAMPLE / "recording")[0]
    final = calibrate_measurements(rig, measured)
    imu = not_none(measured.imu)
    columns = np.column_stack([imu.gyro, imu.accel]).tolist()
    rows = "".join(f"{t},{','.join(map(repr, r))}\n" for t, r in zip(imu.stamps_ns.tolist(), columns, strict=True))
    part = FilePart({"imu0/data.csv": (b"", rows.encode())}, {})
    corners = tuple(every(c, 2) for c in measured.cameras)
    coarse = predict(CoarseProblem(rig, (part,), corners, 2.0, 1.0, 36.0))
    assert not coarse.problem and len(coarse.stds) == 14
    for s in coarse.stds:
        group = final.group(s.sensor, s.group)
        k = group.labels.index(s.label)
        assert group.verdict[k] == "determined" and s.needed_s == 0.0
        assert 1.0 / FACTOR < s.std / group.std[k] < FACTOR
    later = predict(CoarseProblem(rig, (part,), corners, 2.0, 0.25, 144.0))
    assert later.stds[0].std == pytest.approx(0.5 * coarse.stds[0].std)
    assert predict(CoarseProblem(rig, (part,), (every(corners[0], 40),), 2.0, 1.0, 36.0)).problem


def test_between_solves_what_arrives_reduces_standard_deviations(target: Path):
    f = follower_at(read_target(target), cam0=(50, 50))
    weak = expected("rotation", "x", 0.002)
    then = Expectation(10.0, (weak, replace(weak, std=np.inf)), progress=f.progress)
    assert view(f, then).tables[1].rows[0][2] == "0.11, unknown" and then.stds_at(10.0, f.progress)[0].std == weak.std
    f.topics["/cam0"].seen, f.motion.turning = 450, 4.0 * f.motion.turning  # 9 and 4 times as much
    known, unknown = then.stds_at(40.0, f.progress)
    assert known.std == pytest.approx(0.001) and known.needed_s == pytest.approx(0.0, abs=1e-9)
    assert unknown.std == np.inf and unknown.needed_s == np.inf
    f.motion.turning *= 0.5
    known, _ = then.stds_at(20.0, f.progress)
    assert known.needed_s == pytest.approx(20.0)  # the variance is twice that of the tolerance


def test_a_problem_has_the_newest_parts(filmed: Path, target: Path):
    follower = Follower(filmed, read_target(target))
    while follower.look():
        pass
    follower._kept.appendleft(replace(follower._kept[0], seconds=30.0, corners={}))
    follower.seconds += 30.0
    whole, late = not_none(follower.coarse_problem()), not_none(follower.coarse_problem(SECONDS))
    assert len(whole.parts) == len(late.parts) + 1 and late.progress == follower.progress
    assert (whole.share, late.share) == (1.0, pytest.approx(SECONDS / (30.0 + SECONDS), rel=0.02))


def follower_at(given: GivenTarget, **seen: tuple[int, int]) -> Follower:
    """A follower without a recording, with cameras and a motion about x and y of the IMU. seen: (searched, seen)."""
    f = Follower(Path("run.mcap"), given)
    for name, topic in (("imu0", "imu"), *((name, "image") for name in seen)):
        info = icalib.tools.inspection.follow.TopicInfo(f"/{name}", "", topic, 100, 0, 10)
        f.topics[f"/{name}"] = Arrivals(info, arrived=time.monotonic())
        f.sensors[name] = info
    for name, (searched, n) in seen.items():
        a = f.topics[f"/{name}"]
        a.searched, a.seen, a.sees = searched, n, n > 0
        a.cells[:, 1:] = n
    f.motion.seconds, f.motion.count, f.motion.turning = 10.0, 2000, np.diag([40.0, 50.0, 0.1])
    return f


def expected(group: str, label: str, std: float) -> ExpectedStd:
    return ExpectedStd("cam0", group, label, "rad" if group == "rotation" else "s", std, 0.001, 10.0)


def test_advice_names_the_axis_and_the_place_in_the_image(target: Path):
    given = read_target(target)
    f = follower_at(given, cam0=(50, 50))
    assert view(f, None).advice[0].startswith("Keep moving: the first prediction is on its way")
    few = view(follower_at(given, cam0=(20, 20)), None).advice[0]
    assert few == "Keep moving: a prediction needs 25 images with the target."
    assert view(follower_at(given), None).advice == (
        "A prediction needs a camera that sees the target: record its images, or correct the rig file.",
    )
    turned = {"cam0": np.array([[0.0, 0.0, 1.0], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0]])}  # y of cam0 is z of imu0
    weak = expected("rotation", "x", 0.002)
    now = view(f, Expectation(10.0, (weak,), turned))
    assert now.advice == (
        "Turn about the y axis of cam0, 30 s more, for its rotation x.",
        "Move the target into the left edge of the image of cam0.",
    )
    assert now.line.startswith("run.mcap, 0 s recorded: cam0 100 messages (100% with target), imu0 100 messages. Turn")
    late = expected("time_offset", "time_offset", np.inf)
    now = view(f, Expectation(10.0, (weak, late), turned, ("cam0: not determined by this motion; turn.",)))
    assert now.advice[:2] == (
        "cam0: not determined by this motion; turn.",
        "Turn and shake the rig faster, to and fro; cam0 needs it.",
    )
    done = Expectation(12.0, (expected("rotation", "x", 0.0001),), turned)
    assert view(f, done).advice[0] == "All extrinsics and time offsets are determined after 12 s."
    table = view(f, Expectation(10.0, (weak, late), turned)).tables[1]
    assert table.rows == (
        ("cam0", "rotation", "0.11", "0.057", "deg", "30 s more"),
        ("cam0", "time offset", "unknown", "1", "ms", "move otherwise"),
    )
    failed = Expectation(3.0, problem="too short.")
    assert view(f, failed).advice[:2] == (
        "No prediction yet: too short.",
        "imu0 turned least about its z axis so far; turn about it, too.",
    )


def readings(first_ns: int) -> str:
    """A second of readings of an IMU at rest."""
    return "".join(f"{first_ns + k * 10**7},0.1,0.0,0.0,0.0,0.0,9.81\n" for k in range(100))


def test_what_is_not_followed_is_said(target: Path, tmp_path: Path):
    def first(name: str) -> str:
        follower = Follower(tmp_path / name, read_target(target))
        follower.look()
        return view(follower, None).advice[0].replace(f"{tmp_path}/", "")

    for name, text in (("a.mcap", "some text"), ("b.mcap", "a line of text\n" * 9), ("c.mcap", "")):
        (tmp_path / name).write_text(text)
    for name in ("packed/imu0", "named/cam0", "words/imu0", "nothing"):
        (tmp_path / name).mkdir(parents=True)
    (tmp_path / "packed/imu0/data.csv.gz").write_bytes(gzip.compress(b"1,2,3"))
    (tmp_path / "named/cam0/image-1.png").touch()
    (tmp_path / "words/imu0/data.csv").write_text("never,a,number,in,a,row,here\n" * 2 + "1,x,x,x,x,x,x\n")
    no_bag = "is no bag that can be followed; give a .bag, .mcap or .db3 file, or a folder."
    assert (first("a.mcap"), first("b.mcap")) == (f"a.mcap {no_bag}", f"b.mcap {no_bag}")
    gives = "start the recorder, or give the bag or folder that it writes."
    assert first("c.mcap") == f"c.mcap has no messages yet; {gives}"
    assert first("nothing") == f"nothing has no bag, table or images yet; {gives}"
    packed = "packed/imu0/data.csv.gz is compressed and cannot be followed; let it be written as data.csv."
    assert first("packed") == packed
    assert first("named") == "named/cam0 has images that cannot be followed; name them by their stamps in ns."
    assert first("words").startswith("words/imu0/data.csv")


def test_a_bag_beside_a_file_that_is_none_is_followed(filmed: Path, tmp_path: Path):
    (tmp_path / "a.mcap").write_text("some text")
    (tmp_path / "b.mcap").symlink_to(filmed)
    follower = Follower(tmp_path)
    while follower.look():
        pass
    assert follower.topics.keys() >= {"/imu0"} and "a.mcap is no bag" in view(follower, None).advice[0]


def test_a_sensor_without_its_table_is_said(tmp_path: Path):
    (tmp_path / "imu0").mkdir()
    (tmp_path / "rig.yaml").write_text("sensors:\n  imu: {type: imu, path: imu/data.csv}\n  lidar0: {type: lidar}\n")
    (tmp_path / "imu0" / "data.csv").write_text("".join(readings(k * 10**9) for k in range(8)))
    follower = Follower(tmp_path, read_target(tmp_path / "rig.yaml"))
    assert follower.look() and not follower.sensors
    there = "it holds imu0/data.csv (table of readings); set `path` in the rig file."
    assert view(follower, None).advice[0] == f"imu: {tmp_path} has no imu/data.csv; {there}"


@pytest.mark.parametrize(("width", "height"), [(80, 24), (60, 12), (200, 60)])
def test_the_view_fits_the_terminal(width: int, height: int, target: Path):
    f = follower_at(read_target(target), cam0=(50, 50), a_camera_with_a_long_name=(9, 4))
    for k in range(9):
        f.topics[f"/robot/other/{k}"] = Arrivals(replace(f.sensors["imu0"], kind=""))
    stds = [expected("rotation", axis, 0.002) for axis in "xyz"]
    stds += [replace(stds[0], sensor=f"camera{k}", std=0.0001) for k in range(9)]
    now = view(f, Expectation(10.0, tuple(stds), {"cam0": np.eye(3)}))
    console = Console(width=width, height=height, file=io.StringIO(), record=True)
    console.print(screen(now, width, height))
    lines = console.export_text().splitlines()
    assert len(lines) <= height and max(map(len, lines)) <= width
    assert lines[0] == "run.mcap, 0 s recorded" and lines[1].startswith("  Turn about the")
    whole = not lines[-1].startswith("Enlarge the terminal for: ")
    assert whole == (height == 60)
    text = "\n".join(lines)
    assert ("/robot/other/8" in text) == ("camera8" in text) == whole
    assert ("0.11, 0.11, 0.11" in text) == (height >= 24)


def test_a_recorder_that_has_ended_is_said_first(target: Path):
    f = follower_at(read_target(target), cam0=(50, 50))
    f.arrived = time.monotonic() - 12.2
    assert view(f, None).advice[0] == "Nothing has arrived for 12 s: the recorder has ended, or its disk is full."


def test_a_target_out_of_view_is_said_first(target: Path):
    f = follower_at(read_target(target), cam0=(50, 0))
    assert view(f, None).advice[0] == "The target is not in view of cam0; bring it into view."
    f = Follower(Path("run.mcap"))
    assert view(f, None).advice == (
        "Standard deviations are predicted with a target; give it, or its rig file, with --target FILE.",
    )


def test_a_clock_that_is_set_leaves_out_what_was_before(tmp_path: Path):
    """As a clock that starts later, when the computer has the time."""
    arrivals = Arrivals(icalib.tools.inspection.follow.TopicInfo("/imu0", "", "imu", 0, None, None))
    assert arrivals.note([10**9, 2 * 10**9]) == 1.0 and arrivals.rate_hz == 1.0
    assert np.isnan(arrivals.note([10**18])) and arrivals.note([10**18 + 10**9]) == 1.0 and np.isnan(arrivals.note([5]))
    (tmp_path / "imu0").mkdir()
    table = tmp_path / "imu0" / "data.csv"
    follower = Follower(tmp_path)
    for first in (10**9, 10**18, 10**18 + 10**9, 10**12):
        with table.open("a") as file:
            file.write(readings(first))
        assert follower.look()
        assert len(follower._kept) == (2 if first == 10**18 + 10**9 else 1)
    assert follower.seconds == pytest.approx(0.99 + 1.0, abs=0.02)


def test_memory_is_bounded(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr("icalib.tools.inspection.follow.WINDOW_S", 5.0)
    (tmp_path / "imu0").mkdir()
    follower = Follower(tmp_path)
    for second in range(20):
        with (tmp_path / "imu0" / "data.csv").open("a") as file:
            file.write(readings(second * 10**9))
        assert follower.look()
    assert len(follower._kept) <= 7 and follower.seconds == pytest.approx(19.99)


def test_a_solver_predicts_in_a_process_of_its_own(target: Path):
    """A solve that fails is told, and another one follows only after a rest."""
    rig = load_rig(EXAMPLE / "rig.yaml")
    solver = Solver()
    problem = CoarseProblem(rig, (FilePart({}, {}),), (), 1.0, 1.0, 7.0)
    try:
        deadline = time.monotonic() + 120.0
        while solver.latest is None and time.monotonic() < deadline:
            solver.offer(lambda window_s: problem)
            time.sleep(0.1)
        assert solver.latest is not None and solver.latest.seconds == 7.0 and solver.latest.problem
        solver._is_idle, solver._free_at = True, np.inf
        solver.offer(lambda window_s: pytest.fail("it rests"))
        solver._process.kill()  # as for lack of memory
        solver._process.join()
        solver._free_at, solver.latest = 0.0, None
        while solver.latest is None and time.monotonic() < deadline:
            solver.offer(lambda window_s: problem)
            time.sleep(0.1)
        assert solver.latest is not None
    finally:
        solver.close()


def test_the_page_shows_the_view(target: Path):
    page = Page(("127.0.0.1", 0))
    try:
        page.show(view(follower_at(read_target(target), cam0=(50, 50)), None))
        url = f"http://127.0.0.1:{page.port}/"
        frame, body = (urllib.request.urlopen(url + name, timeout=10).read().decode() for name in ("", "body"))
        assert 'fetch("body")' in frame and "<h1>run.mcap, 0 s recorded</h1>" in body and "<td>cam0</td>" in body
        with pytest.raises(urllib.error.HTTPError):
            urllib.request.urlopen(url + "other", timeout=10)
        with pytest.raises(icalib.CalibrationError, match=r"--serve 127.0.0.1:\d+ cannot be used .* give another port"):
            Page(("127.0.0.1", page.port))
        for host in ("203.0.113.5", "x" * 70):  # an address of others, and no name
            with pytest.raises(icalib.CalibrationError, match=rf"--serve {host}:80 .*; give this computer's address"):
                Page((host, 80))
    finally:
        page.close()


def said(printed: Path, words: str) -> str:
    """What a process has printed, once these words are there."""
    deadline = time.monotonic() + 120.0
    while words not in (text := " ".join(printed.read_text().split())):
        assert time.monotonic() < deadline, text
        time.sleep(0.2)
    return text


def test_an_interrupt_ends_with_a_line(filmed: Path, target: Path, tmp_path: Path):
    path, printed = tmp_path / "live.mcap", tmp_path / "printed"
    program = "import signal, sys; signal.signal(signal.SIGINT, signal.default_int_handler); "
    program += "from icalib.cli.commands import main; sys.exit(main())"
    options = ["inspect", str(path), "--follow", "--target", str(target), "--serve", "0"]
    with printed.open("w") as out:
        process = subprocess.Popen([sys.executable, "-uc", program, *options], stdout=out, stderr=out, env=os.environ)
        said(printed, "is not there yet; start the recorder")
        path.write_bytes(filmed.read_bytes()[:-50_000])  # a writer that is killed
        said(printed, "imu0 200.0 Hz.")
        process.send_signal(signal.SIGINT)
        assert process.wait(60) == 0
    text = said(printed, "cam0 20.0 Hz (100% with target), cam1 20.0 Hz (100% with target), imu0 200.0 Hz.")
    assert text.startswith("Page: http://127.0.0.1:") and "Traceback" not in text and "icalib:" not in text
    assert f"/ Following {path}, until Ctrl-C." in text


@pytest.mark.parametrize("quiet", [True, False])
def test_quiet_prints_nothing(
    quiet: bool, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
):
    def interrupted(*_: object) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr("icalib.tools.inspection.follow._show", interrupted)
    follow(tmp_path / "run.mcap", None, ("127.0.0.1", 0), quiet)
    assert ("run.mcap" in capsys.readouterr().out) != quiet


@pytest.mark.parametrize(
    ("options", "sentence"),
    [
        (["--serve"], "--serve shows a recording that is being written; give --follow as well."),
        (["--follow", "--json", "x"], "--follow takes --target, --serve, --quiet only"),
        (["--follow", "--quiet"], "--follow with --quiet shows nothing; leave --quiet out, or give --serve, too."),
    ],
)
def test_options_that_do_not_go_together(options: list[str], sentence: str, capsys: pytest.CaptureFixture[str]):
    assert main(["inspect", "run.mcap", *options]) == 1
    assert sentence in capsys.readouterr().err


@pytest.mark.parametrize(("text", "fine"), [("8800", True), ("0.0.0.0:80", True), ("x", False), ("a:99999", False)])
def test_addresses(text: str, fine: bool, tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    if fine:
        assert main(["inspect", "run.mcap", "--serve", text]) == 1  # without --follow
        return
    with pytest.raises(SystemExit):
        main(["inspect", "run.mcap", "--follow", "--serve", text])
    assert "must be PORT or HOST:PORT" in capsys.readouterr().err
