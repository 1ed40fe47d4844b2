"""Clocks that jump forward while they run: one part is used, and nothing is as large as the time between."""

from __future__ import annotations

import dataclasses
from pathlib import Path

import numpy as np
import pytest
from tests.cases import each

from icalib.data.measurements import (
    CornerStream,
    ImuStream,
    LidarStream,
    Measurements,
    PoseStream,
    TrackStream,
    WheelPoses,
    WheelStream,
)
from icalib.data.recordings import FolderRecording
from icalib.data.stamps import ClockJumps, longest_part, section
from icalib.errors import EstimationError, RecordingError
from icalib.pipeline import calibrate_measurements
from icalib.tools.allan import study_recording
from icalib.tools.inspection import inspect_recording
from icalib.tools.simulation import handheld, rig_for, simulate

pytestmark = pytest.mark.slow

YEARS = 1_700_000_000_000_000_000
STEP = 5_000_000


def imu(stamps: np.ndarray, name: str = "imu0") -> ImuStream:
    n = len(stamps)
    return ImuStream(name, stamps, np.arange(3.0 * n).reshape(n, 3), np.ones((n, 3)))


def jumped(*lengths: int, by: int = YEARS) -> np.ndarray:
    """Stamps whose clock jumps between parts of so many steps."""
    return np.concatenate(
        [k * by + STEP * np.arange(sum(lengths[:k]), sum(lengths[: k + 1])) for k in range(len(lengths))]
    )


def test_the_longest_part_is_used_with_a_note():
    jumps = ClockJumps()
    kept = jumps.cut(imu(jumped(100, 900, 300, by=3600 * 10**9)), "a.csv (imu0)")
    assert len(kept.stamps_ns) == len(kept.gyro) == 900 and kept.stamps_ns[0] == 3600 * 10**9 + 100 * STEP
    assert kept.gyro[0, 0] == 300.0
    (note,) = jumps.notes
    assert note.startswith(
        "a.csv (imu0): the clock jumps forward by 3600.01 s (and 1 more times) after the stamp 495000000 ns"
    )
    assert "0.495 s from the start. Only the 4.495 s from 3600500000000 ns on are used; choose another part" in note


def test_streams_that_jump_alike_keep_the_same_part():
    jumps = ClockJumps()
    first, second = imu(jumped(600, 500)), imu(jumped(400, 500), "other")
    assert jumps.cut(first, "first").stamps_ns[0] == 0
    assert jumps.cut(second, "second").stamps_ns[0] == 0
    assert len(jumps.cut(imu(jumped(10, 20, 30)), "third").stamps_ns) == 30
    whole = imu(STEP * np.arange(50))
    assert jumps.cut(whole, "fourth") is whole


def test_pauses_are_no_jumps():
    stamps = np.concatenate([STEP * np.arange(400), 500 * 10**9 + STEP * np.arange(400)])
    assert longest_part(stamps) == (slice(0, 800), 0)
    pairs = 60 * 10**9 * np.arange(30) + (np.arange(30) > 14) * 3600 * 10**9  # still poses, and a break of an hour
    assert longest_part(pairs) == (slice(0, 30), 0)
    assert longest_part(np.empty(0, np.int64)) == (slice(0, 0), 0)


def test_stamps_that_no_clock_has():
    with pytest.raises(RecordingError, match=r"here: the stamp 9223372036854775807 ns is more than a hundred years"):
        ClockJumps().cut(imu(np.array([0, 5, 2**63 - 1])), "here")
    hours = imu(500_000_000_000 * np.arange(60))
    with pytest.raises(
        RecordingError, match=r"here: the stamps span 8\.194 h, and a calibration takes at most 6 h; choose"
    ):
        ClockJumps(6 * 3600.0).cut(hours, "here")


def test_sections_of_every_stream():
    t = STEP * np.arange(5)
    start, n = np.array([0, 2, 2, 5, 6, 9]), 9
    corners = CornerStream("c", t, start, np.arange(n), np.arange(2.0 * n).reshape(n, 2))
    tracks = TrackStream("c", t, start, np.arange(n), np.zeros((n, 2)))
    xyz, plane = np.zeros((n, 3), np.float32), np.arange(n, dtype=np.int32)
    scans = LidarStream("l", t, start, np.zeros(n, np.float32), xyz, plane)
    for stream, rows in ((corners, "point"), (tracks, "feature"), (scans, "plane")):
        part = section(stream, 2, 4)
        assert part.stamps_ns.tolist() == t[2:4].tolist() and part.start.tolist() == [0, 3, 4]
        assert getattr(part, rows).tolist() == [2, 3, 4, 5]
    poses = PoseStream("p", t, np.tile(np.eye(3), (5, 1, 1)), np.arange(15.0).reshape(5, 3))
    assert section(poses, 1, 3).position.tolist() == [[3, 4, 5], [6, 7, 8]]
    wheels = WheelStream("w", t, np.arange(10.0).reshape(5, 2))
    assert section(wheels, 3, 5).rate.tolist() == [[6, 7], [8, 9]]
    relative = WheelPoses("w", t, np.arange(12.0).reshape(4, 3), np.tile(np.eye(3), (4, 1, 1)))
    assert section(relative, 1, 4).pose.tolist() == [[3, 4, 5], [6, 7, 8]]
    assert section(poses, 0, 5) is poses


@pytest.fixture(scope="module")
def simulation():
    return simulate(handheld(10.0), 3)


def shifted(stream, index: int, by: int):
    stamps = stream.stamps_ns.copy()
    stamps[index:] += by
    return dataclasses.replace(stream, stamps_ns=stamps)


@each("which", ["imu", "cameras", "both"])
def test_a_jump_does_not_move_the_result(simulation, which):
    m: Measurements = simulation.measurements
    rig = rig_for(simulation.scenario)
    assert m.imu is not None
    by = 5 * 86_400 * 10**9
    given = m.with_streams(shifted(m.imu, 300, by)) if which != "cameras" else m
    if which != "imu":
        cameras = tuple(shifted(c, int(np.searchsorted(c.stamps_ns, m.imu.stamps_ns[300])), by) for c in m.cameras)
        given = given.with_streams(*cameras)
    result = calibrate_measurements(rig, given)
    assert (
        sum("the clock jumps forward by 432000 s" in note for note in result.notes)
        == {"imu": 1, "cameras": 2, "both": 3}[which]
    )
    offset = result.group("cam0", "time_offset")
    truth = 0.0042 - {"imu": -1, "cameras": 1, "both": 0}[which] * by * 1e-9
    assert abs(offset.value[0] - truth) < 5.0 * offset.std[0] + 1e-6 * (which != "both")
    T = result.T_imu_sensor("cam0")
    np.testing.assert_allclose(T, simulation.scenario.cameras[0].T_imu_sensor, atol=3e-3)


def test_commands_that_read_an_imu_alone(tmp_path: Path):
    rng = np.random.default_rng(0)
    stamps = jumped(1000, 4000)
    values = np.hstack([1e-3 * rng.normal(size=(5000, 3)), 1e-2 * rng.normal(size=(5000, 3)) + [0, 0, 9.81]])
    (tmp_path / "imu0").mkdir()
    rows = zip(stamps.tolist(), values.tolist(), strict=True)
    (tmp_path / "imu0" / "data.csv").write_text("".join(f"{t},{','.join(map(repr, row))}\n" for t, row in rows))
    study = study_recording(tmp_path)
    assert abs(study.seconds - 20.0) < 0.1 and "the clock jumps forward" in study.notes[0]
    found = inspect_recording(tmp_path)
    (stream,) = found.streams
    assert stream.timing is not None and stream.timing.jumps == 1 and abs(stream.timing.duration_s - 19.995) < 1e-6
    assert any("the clock jumps forward" in f.sentence for f in found.findings)
    assert isinstance(FolderRecording(tmp_path).stamps("imu0/data.csv"), np.ndarray)


@pytest.mark.parametrize(
    ("which", "index"),
    [
        ("imu", 500),
        pytest.param("cameras", 1400, marks=pytest.mark.full),
        pytest.param("imu", 1400, marks=pytest.mark.full),
        pytest.param("cameras", 500, marks=pytest.mark.full),
    ],
)
def test_a_clock_that_is_set_by_seconds_is_named(simulation, which, index):
    m, by = simulation.measurements, 3 * 10**9
    at = m.imu.stamps_ns[index]
    if which == "imu":
        given = m.with_streams(shifted(m.imu, index, by))
    else:
        cameras = tuple(shifted(c, int(np.searchsorted(c.stamps_ns, at)), by) for c in m.cameras)
        given = m.with_streams(*cameras)
    whose = {"imu": "imu0", "cameras": "cam0"}[which]
    with pytest.raises(EstimationError, match=rf"the clock of {whose} was set forward by 3 s about .* --from and --to"):
        calibrate_measurements(rig_for(simulation.scenario), given)


def test_a_gap_is_no_step_of_a_clock(simulation):
    m = simulation.measurements
    kept = np.r_[0:600, 800:2000]
    imu_gap = ImuStream("imu0", m.imu.stamps_ns[kept], m.imu.gyro[kept], m.imu.accel[kept])
    found = calibrate_measurements(rig_for(simulation.scenario), m.with_streams(imu_gap))
    assert abs(found.group("cam0", "time_offset").value[0] - 0.0042) < 1e-4
