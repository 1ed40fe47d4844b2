"""Images stamped on arrival by a computer: even stamps come back where the camera ran evenly, and only there."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from tests.cases import each

from icalib.data.measurements import CornerStream, TrackStream
from icalib.sensors.camera.read.detected_corners import with_even_stamps
from icalib.tools.simulation import handheld, simulate

RATE_HZ, SECONDS = 20.0, 20.0


def filmed(**changed) -> CornerStream:
    scenario = handheld(SECONDS)
    camera = replace(scenario.cameras[0], **{"rate_hz": RATE_HZ, **changed})
    return simulate(replace(scenario, cameras=(camera,)), 1).measurements.cameras[0]


@pytest.fixture(scope="module")
def even() -> CornerStream:
    return filmed()


def stamped(stream: CornerStream, late_ns: np.ndarray) -> CornerStream:
    stamps = np.maximum.accumulate(stream.stamps_ns + late_ns.astype(np.int64)) + np.arange(len(late_ns))
    return replace(stream, stamps_ns=stamps)


def some(stream: CornerStream, kept: np.ndarray) -> CornerStream:
    count = np.diff(stream.start)
    return stream.of_rows(np.repeat(kept, count), stream.stamps_ns[kept], count[kept])


def evened(*streams: CornerStream | TrackStream) -> tuple[list[CornerStream | TrackStream], tuple[str, ...]]:
    found = with_even_stamps([(s, ()) for s in streams], {s.name: f"here ({s.name})" for s in streams})
    return [s for s, _ in found], tuple(note for _, notes in found for note in notes)


@each("size_ms", [0.2, 1.0, 3.0])
@each("delay", ["normal", "exponential", "dropped frames"])
def test_jitter(even, delay, size_ms):
    """A line through symmetric delays is off by 2 sigma / sqrt(n) at its ends; the envelope of one-sided ones less."""
    rng = np.random.default_rng(2)
    n = len(even.stamps_ns)
    late = rng.normal(size=n) if delay == "normal" else rng.exponential(size=n)
    kept = rng.random(n) > (0.1 if delay == "dropped frames" else 0.0)
    (found,), notes = evened(some(stamped(even, 1e6 * size_ms * late), kept))
    off = 1e-6 * (found.stamps_ns - even.stamps_ns[kept])
    assert np.std(off) < 0.1 * size_ms and np.ptp(off) < 0.3 * size_ms
    assert len(notes) == 1 and "jitter by" in notes[0] and "made even at 20.00 Hz" in notes[0]
    assert found.jitter_s == pytest.approx(1e-3 * size_ms * np.sqrt(2.0 / kept.sum()), rel=0.2)


def test_a_clock_that_drifts_stays(even):
    """By 200 ppm against the other sensors, and bent by 2 ms: neither is jitter."""
    t = np.linspace(-1.0, 1.0, len(even.stamps_ns))
    clock = 2e6 * t + 2e6 * (1.0 - t**2)
    late = np.random.default_rng(3).exponential(5e5, len(t))
    (found,), notes = evened(stamped(even, clock + late))
    off = found.stamps_ns - even.stamps_ns - clock
    assert len(notes) == 1 and np.std(off) < 2e5


@each("jitter_ms", [0.5, 2.0, 8.0])
def test_a_camera_that_is_exposed_unevenly_keeps_its_stamps(jitter_ms):
    stream = filmed(jitter_s=1e-3 * jitter_ms)
    (found,), notes = evened(stream)
    assert notes == () and found.stamps_ns.tolist() == stream.stamps_ns.tolist()
    assert found.jitter_s == pytest.approx(1e-3 * jitter_ms / np.sqrt(3.0), rel=0.15)


def test_a_rate_that_changes_keeps_its_stamps(even):
    """As automatic exposure does: 20 Hz, then 16 Hz."""
    slower, change = filmed(rate_hz=16.0), even.stamps_ns[len(even.stamps_ns) // 2]
    parts = some(even, even.stamps_ns < change), some(slower, slower.stamps_ns > change)
    stream = replace(CornerStream.joined(parts), joins_ns=())
    (found,), notes = evened(stream)
    assert notes == () and found.stamps_ns.tolist() == stream.stamps_ns.tolist()


def test_stamps_of_the_hardware_stay(even):
    (found,), notes = evened(even)
    assert notes == () and found == even


def test_one_camera_of_two(even):
    late = np.random.default_rng(4).normal(0.0, 1e6, len(even.stamps_ns))
    other = replace(even, name="cam1")
    (cam0, cam1), notes = evened(stamped(even, late), other)
    assert len(notes) == 1 and "here (cam0)" in notes[0]
    assert cam1 == other and np.std(cam0.stamps_ns - even.stamps_ns) < 2e5


def test_cameras_that_are_triggered_together_stay_together(even):
    """Also tracks of the same images, and file names."""
    rng = np.random.default_rng(5)
    one = stamped(even, rng.exponential(2e6, len(even.stamps_ns)))
    one = replace(one, files={int(t): f"{k}.png" for k, t in enumerate(one.stamps_ns)})
    two = some(replace(one, name="cam1"), rng.random(len(one.stamps_ns)) > 0.1)
    tracks = TrackStream("cam0", one.stamps_ns, one.start, one.point, one.uv)
    (a, b, c), notes = evened(one, two, tracks)
    assert len(notes) == 3 and c.stamps_ns.tolist() == a.stamps_ns.tolist()
    assert np.isin(b.stamps_ns, a.stamps_ns).all() and isinstance(a, CornerStream)
    assert a.files == {int(t): f"{k}.png" for k, t in enumerate(a.stamps_ns)}
