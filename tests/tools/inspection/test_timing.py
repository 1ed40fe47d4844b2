"""Rates, gaps and jitter against stamps made for them."""

from __future__ import annotations

import json
from collections.abc import Callable

import numpy as np
import pytest
from rosbags.rosbag1 import Reader

from icalib.cli import main
from icalib.data.recordings import open_recording
from icalib.tools.inspection import inspect_recording
from icalib.tools.inspection.facts import clock_rate_of, overlap_s, timing_of

STEP = 50_000_000


def test_even_stamps():
    t = timing_of(1_700_000_000_000_000_001 + STEP * np.arange(101))
    assert t is not None
    assert (t.count, t.gaps, t.longest_gap_s, t.backwards, t.repeated) == (101, 0, None, 0, 0)
    assert (t.rate_hz, t.jitter_s, t.duration_s) == pytest.approx((20.0, 0.0, 5.0))


def test_gaps():
    """One image lost at 1 s, five at 3 s."""
    lost = {20, 60, 61, 62, 63, 64}
    t = timing_of(np.array([STEP * k for k in range(101) if k not in lost], np.int64))
    assert t is not None
    assert (t.gaps, t.longest_gap_s, t.longest_gap_at_s) == (2, pytest.approx(0.3), pytest.approx(2.95))
    assert t.rate_hz == pytest.approx(20.0)


def test_jitter():
    shift = np.random.default_rng(0).normal(scale=1e6, size=2001)
    t = timing_of((STEP * np.arange(2001) + shift).astype(np.int64))
    assert t is not None
    assert t.jitter_s == pytest.approx(np.sqrt(2) * 1e-3, rel=0.1)  # two instants to an interval
    assert t.gaps == 0


def test_stamps_that_go_back_and_repeat():
    t = timing_of(np.array([0, 1, 2, 2, 3, 1, 4], np.int64) * STEP)
    assert t is not None
    assert (t.backwards, t.repeated, t.first_ns, t.last_ns) == (1, 1, 0, 4 * STEP)


@pytest.mark.parametrize("stamps, rate", [([5], None), ([5, 5], None)])
def test_too_few_for_a_rate(stamps, rate):
    t = timing_of(np.array(stamps, np.int64))
    assert t is not None and t.rate_hz is rate and t.gaps == 0


def test_no_stamps():
    assert timing_of(np.zeros(0, np.int64)) is None


def test_overlap():
    a, b, c = (timing_of(np.arange(n, n + 11, dtype=np.int64) * STEP) for n in (0, 4, 30))
    assert a and b and c
    assert overlap_s(a, b) == pytest.approx(0.3) == overlap_s(b, a)
    assert overlap_s(a, c) == pytest.approx(-1.0)


def received(stamps_ns: np.ndarray, rate_ppm: float, delay_s: np.ndarray) -> np.ndarray:
    """(N, 2) stamps of a clock with that rate, and when the messages arrive."""
    since = stamps_ns - stamps_ns[:1]
    return np.stack([stamps_ns, stamps_ns + np.round(1e-6 * rate_ppm * since + 1e9 * delay_s).astype(np.int64)], axis=1)


LATE: dict[str, Callable[[np.random.Generator, int], np.ndarray]] = {
    "queued": lambda rng, n: rng.exponential(2e-3, n),
    "bursts": lambda rng, n: rng.exponential(2e-4, n) + 0.05 * (rng.random(n) < 0.1),
    "scheduled": lambda rng, n: 5e-3 + np.abs(rng.normal(scale=1e-3, size=n)),
}


@pytest.mark.parametrize("late", LATE)
def test_rate_of_a_clock_by_receive_times(late):
    """40 seeds; the tenth part of the least delays is some us of 60 s, and sigma has 8 degrees of freedom."""
    z = []
    for seed in range(40):
        delay = LATE[late](np.random.default_rng(seed), 1200)
        rate = clock_rate_of(received(1_700_000_000_000_000_001 + STEP * np.arange(1200), -35.0, delay))
        assert rate is not None and rate.std_ppm < 1.0 and rate.duration_s == pytest.approx(59.95)
        z.append((rate.ppm + 35.0) / rate.std_ppm)
    assert 0.7 < np.sqrt(np.mean(np.square(z))) < 1.7 and np.abs(z).max() < 6.0


def test_rate_of_the_longest_part_of_a_clock_that_jumps():
    times = received(STEP * np.arange(400), 20.0, np.zeros(400))
    times[300:, 0] += 10**13
    rate = clock_rate_of(times)
    assert rate is not None and rate.ppm == pytest.approx(20.0) and rate.duration_s == pytest.approx(14.95)


def test_a_clock_that_drifts_by_less_than_stamps_resolve_is_not_named(tmp_path, monkeypatch):
    """The rounding of sums gave 1.5e-12 +- 2.8e-13 ppm for a constant delay."""
    monkeypatch.chdir(tmp_path)
    (tmp_path / "scenario.yaml").write_text(
        "duration: 40\nmotion: {kind: free}\nroom: {size: [40, 30, 12]}\nsensors:\n"
        "  imu0: {type: imu, rate: 100, noise: {gyro: 1.7e-4, gyro_walk: 2e-5, accel: 2e-3, accel_walk: 3e-3}}\n"
        "  gnss0: {type: position, rate: 5, time_offset: 0.05, T_imu_sensor: "
        "[[1, 0, 0, 0.3], [0, 1, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]]}\n"
    )
    assert main(["simulate", "scenario.yaml", "-o", "run.bag", "--level", "sensor", "-q"]) == 0
    assert [f.sentence for f in inspect_recording("run.bag").findings if "receive times" in f.sentence] == []


@pytest.mark.parametrize("n, step", [(0, STEP), (49, STEP), (100, 0)])
def test_too_few_messages_for_the_rate_of_a_clock(n, step):
    assert clock_rate_of(received(7 + step * np.arange(n), 0.0, np.zeros(n))) is None


def test_a_bag_tells_the_rates_of_its_clocks(tmp_path, monkeypatch):
    """A simulated bag: the pose sensor's clock is 80 ppm slow, and that of the IMU is the recorder's."""
    monkeypatch.chdir(tmp_path)
    place, noise = "[[1, 0, 0, 0.1], [0, 1, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]]", "gyro: 1e-4, gyro_walk: 1e-5"
    (tmp_path / "scenario.yaml").write_text(
        "duration: 10\nmotion: {kind: free}\nroom: {size: [10, 8, 4]}\nsensors:\n"
        f"  imu0: {{type: imu, rate: 100, noise: {{{noise}, accel: 1e-3, accel_walk: 1e-4}}}}\n"
        f"  mocap: {{type: pose, T_imu_sensor: {place}, rate: 50, time_offset: 0.01, clock_rate: 80}}\n"
    )
    assert main(["simulate", "scenario.yaml", "-o", "run.bag", "--level", "sensor", "-q"]) == 0
    with Reader(tmp_path / "run.bag") as bag:
        poses = [received_ns for c, received_ns, _ in bag.messages() if c.topic == "/mocap/pose"]
    assert np.ptp(np.diff(poses)) < 100  # even on the clock of the recorder, to the rounding of stamps
    assert main(["inspect", "run.bag", "--json", "found.json", "-q"]) == 0
    rates = {t["name"]: t["clock_rate"] for t in json.loads((tmp_path / "found.json").read_text())["topics"]}
    assert rates["/imu0"]["ppm"] == 0.0 and rates["/mocap/pose"]["ppm"] == pytest.approx(80.0, abs=1e-3)
    hints = [f.sentence for f in inspect_recording("run.bag").findings if "receive times" in f.sentence]
    assert len(hints) == 1 and hints[0].startswith("/mocap/pose: header stamps run 80 +- ")
    assert "slow against receive times, 0.79 ms over the recording" in hints[0]
    opened = open_recording("run.bag", 2.0, 6.0)
    notes = opened.notes()
    inside = inspect_recording("run.bag", start_s=2.0, end_s=6.0)
    again = inspect_recording(opened)
    assert (again.findings, again.streams) == (inside.findings, inside.streams)
    assert opened.notes() == notes
    assert [s.clock_rate.duration_s for s in inside.streams if s.clock_rate] == pytest.approx([3.99, 3.98], abs=0.02)
