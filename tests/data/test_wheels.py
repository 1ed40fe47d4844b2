"""Wheels in tables and joints: the rates that come out, and what is refused."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from tests.cases import each
from tests.typed import instance

from icalib.data.measurements import WheelStream
from icalib.data.recordings import BagRecording, FolderRecording
from icalib.errors import RecordingError
from icalib.rig import Wheels
from icalib.sensors.wheels.read import WheelReadings, checked_wheels
from icalib.sensors.wheels.read import readings as wheel_readings

N, STEP, ORIGIN = 400, 20_000_000, 1_700_000_000_000_000_000
STAMPS = ORIGIN + STEP * np.arange(N) + np.random.default_rng(1).integers(-(10**6), 10**6, N)
SECONDS = (STAMPS - STAMPS[0]) * 1e-9
ANGLES = np.stack([4.0 * SECONDS + np.sin(SECONDS), 5.0 * SECONDS - 2.0 * np.cos(0.7 * SECONDS)], axis=1)
RATES = np.stack([4.0 + np.cos(SECONDS), 5.0 + 1.4 * np.sin(0.7 * SECONDS)], axis=1)
MEAN = np.diff(ANGLES, axis=0) / np.diff(SECONDS)[:, None]  # between the stamps
NAMES = {"rates": RATES, "angles": ANGLES}


def from_table(
    tmp_path, values: np.ndarray, stamps: np.ndarray = STAMPS, **fields: Any
) -> tuple[WheelStream, tuple[str, ...]]:
    wheels = Wheels("wheel0", "wheel0/data.csv", **fields)
    path = tmp_path / "wheel0"
    path.mkdir(exist_ok=True)
    rows = zip(stamps.tolist(), values.tolist(), strict=True)
    (path / "data.csv").write_text("#t,left,right\n" + "".join(f"{t},{a!r},{b!r}\n" for t, (a, b) in rows))
    folder = FolderRecording(tmp_path)
    stream, notes = checked_wheels(wheel_readings(folder, wheels), wheels, folder.where(wheels))
    assert isinstance(stream, WheelStream)
    assert folder.files() == [path / "data.csv"]
    return stream, notes


@pytest.mark.parametrize("sampling", ["interval-mean", "instantaneous"])
def test_rates(tmp_path, sampling):
    stream, notes = from_table(tmp_path, RATES, sampling=sampling)
    np.testing.assert_array_equal(stream.stamps_ns, STAMPS)
    np.testing.assert_allclose(stream.rate, RATES, rtol=1e-15)
    assert (stream.sampling, notes) == (sampling, ())


def test_angles(tmp_path):
    stream, notes = from_table(tmp_path, ANGLES, measures="angles")
    np.testing.assert_allclose(stream.rate[1:], MEAN, atol=1e-11)
    np.testing.assert_array_equal(stream.rate[0], stream.rate[1])
    assert (stream.sampling, notes) == ("interval-mean", ())


@each("size", [None, 256, 65536])
@each("sign", [1, -1])
def test_ticks(tmp_path, size, sign):
    """Forwards and backwards; a counter of 8 bits starts anew every 1.6 rad."""
    counts = np.floor(sign * ANGLES * 1000.5 / (2 * np.pi) + 200.0)
    assert np.ptp(counts // 256) > 10
    shown = counts if size is None else np.mod(counts, size)
    stream, _ = from_table(tmp_path, shown, measures="ticks", counts_per_turn=1000.5, counter_size=size)
    turned = np.concatenate([np.zeros((1, 2)), np.cumsum(stream.rate[1:] * np.diff(SECONDS)[:, None], axis=0)])
    np.testing.assert_allclose(turned, (counts - counts[0]) * 2 * np.pi / 1000.5, atol=1e-9)
    assert np.abs(turned - sign * (ANGLES - ANGLES[0])).max() < 2 * np.pi / 1000.5


TWICE = np.insert(STAMPS, 7, STAMPS[7])
REFUSED = {
    "back": (RATES, np.where(np.arange(N) == 9, STAMPS - 10**9, STAMPS), {}, f"ing at {STAMPS[9] - 10**9} ns comes"),
    "two": (
        np.insert(RATES, np.arange(0, N, 15), 1.0, axis=0),
        np.insert(STAMPS, np.arange(0, N, 15), STAMPS[::15]),
        {},
        f"readings share a stamp with a different reading, the first {STAMPS[0]} ns",
    ),
    "deg/s": (np.rad2deg(RATES), STAMPS, {}, "(wheel0): the wheels turn at 366.7 rad/s, which is implausible"),
    "degrees": (np.rad2deg(ANGLES), STAMPS, {"measures": "angles"}, "set measures of wheel0 to ticks and counts_pe"),
    "counter": (
        np.mod(np.round(ANGLES * 5000), 65536),
        STAMPS,
        {"measures": "ticks", "counts_per_turn": 31416.0},
        "which looks like an encoder wrap-around; set counter_size of wheel0 in the rig file (65536",
    ),
    "counts": (ANGLES * 1e3, STAMPS, {"measures": "ticks", "counts_per_turn": 1.0}, "; correct counts_per_turn"),
    "seconds": (RATES, STAMPS // 10**9, {}, "as if stamps were truncated to whole seconds"),
    "short": (RATES[:2], STAMPS[:2], {}, "only 2 readings"),
}


@each("case", REFUSED)
def test_what_would_be_wrong_is_refused(tmp_path, case):
    values, stamps, fields, words = REFUSED[case]
    with pytest.raises(RecordingError) as error:
        from_table(tmp_path, values, stamps, **fields)
    assert words in str(error.value) and str(error.value).startswith(str(tmp_path))


@pytest.mark.parametrize("measures", ["rates", "angles"])
def test_single_stamps_of_two_readings(tmp_path, measures):
    value = RATES if measures == "rates" else ANGLES
    twice = np.insert(value, 7, value[7] + [0.3, -0.2], axis=0)
    stream, notes = from_table(tmp_path, twice, TWICE, measures=measures)
    np.testing.assert_array_equal(stream.stamps_ns, np.delete(STAMPS, 7))
    assert "2 readings share a stamp with a different reading. Which one is right is unknown" in notes[0]
    assert f"the first at {STAMPS[7]} ns" in notes[0]


def test_what_looks_odd_is_noted(tmp_path):
    stream, notes = from_table(tmp_path, np.insert(RATES, 7, RATES[7], axis=0), TWICE)
    assert len(stream.rate) == N and f"1 repeated readings were dropped, the first at {STAMPS[7]} ns" in notes[0]
    gone = np.delete(np.arange(N), np.r_[50:60, 200:250])
    _, notes = from_table(tmp_path, RATES[gone], STAMPS[gone])
    assert len(notes) == 1 and f"2 gaps in the readings, the longest of 1.02 s from {STAMPS[199]} ns on" in notes[0]
    stuck = RATES.copy()
    stuck[50:350, 1] = 0.0
    _, notes = from_table(tmp_path, stuck)
    assert len(notes) == 1
    assert f"the right wheel reports 0 rad/s for 5.98 s from {STAMPS[50]} ns on while the left one" in notes[0]
    stuck[200, 1] = 0.1
    assert from_table(tmp_path, stuck)[1] == ()


@pytest.mark.parametrize(("unit", "size"), [("deg/s", np.pi / 180.0), ("rpm", np.pi / 30.0)])
def test_units_and_signs(tmp_path, unit, size):
    stream, notes = from_table(tmp_path, RATES / size * [1.0, -1.0], rate_unit=unit, signs=(1, -1))
    np.testing.assert_allclose(stream.rate, RATES, rtol=1e-14)
    assert notes == ()
    with pytest.raises(RecordingError, match="signs in the rig file has 4 entries for 2 columns"):
        from_table(tmp_path, RATES, signs=(1, -1, 1, -1))


@each(("low", "size"), [(-np.pi, 2 * np.pi), (0.0, 2 * np.pi), (-2 * np.pi, 4 * np.pi)])
def test_angles_that_wrap(tmp_path, low, size):
    wrapped = np.mod(ANGLES - low, size) + low
    whole, _ = from_table(tmp_path, ANGLES, measures="angles")
    stream, notes = from_table(tmp_path, wrapped, measures="angles")
    np.testing.assert_allclose(stream.rate, whole.rate, atol=1e-9)
    assert (
        len(notes) == 1 and f"the angles wrap around after {size:.6f} rad and were unwrapped; angle_range" in notes[0]
    )
    stream, notes = from_table(tmp_path, wrapped, measures="angles", angle_range=size)
    np.testing.assert_allclose(stream.rate, whole.rate, atol=1e-9)
    assert notes == ()
    odd = np.mod(ANGLES, 5.0)
    stream, _ = from_table(tmp_path, odd, measures="angles", angle_range=5.0)
    np.testing.assert_allclose(stream.rate, whole.rate, atol=1e-9)


WRONG = [30, 31, 120, 200, 299]


@each("size", [3.0, -40.0, 1e12, np.nan])
def test_single_rates_that_stand_apart(tmp_path, size):
    rates = RATES + 0.05 * np.random.default_rng(0).normal(size=RATES.shape)
    bad = rates.copy()
    bad[WRONG, 1] += size
    wheels = Wheels("wheel0", "")
    stream, notes = checked_wheels(WheelReadings("wheel0", STAMPS, bad), wheels, "here")
    assert isinstance(stream, WheelStream)
    np.testing.assert_array_equal(stream.stamps_ns, np.delete(STAMPS, WRONG))
    np.testing.assert_array_equal(stream.rate, np.delete(rates, WRONG, axis=0))
    words = "are not finite" if np.isnan(size) else "are outliers, off by up to"
    assert len(notes) == 1 and f"5 of {N} readings {words}" in notes[0] and f"the first at {STAMPS[30]} ns" in notes[0]
    bad[:] = np.nan
    with pytest.raises(RecordingError, match=f"here .*: {N} of {N} readings are not finite"):
        checked_wheels(WheelReadings("wheel0", STAMPS, bad), wheels, "here")


@each("measures", ["angles", "ticks"])
@each("wrong", [[30, 31, 120, 200, 299], [1], [N - 1]])
def test_single_wrong_counts(tmp_path, measures, wrong):
    """What is turned over the readings that are left is what the wheels turned."""
    fields: dict[str, Any] = {"counts_per_turn": 4096.0} if measures == "ticks" else {}
    values = np.floor(ANGLES * 4096.0 / (2 * np.pi)) if measures == "ticks" else ANGLES
    bad = values.copy()
    bad[wrong, 0] = -9999.0 if measures == "ticks" else -77.0
    there = np.delete(np.arange(N), wrong)
    stream, notes = from_table(tmp_path, bad, measures=measures, **fields)
    np.testing.assert_array_equal(stream.stamps_ns, STAMPS[there])
    whole, _ = from_table(tmp_path, values[there], STAMPS[there], measures=measures, **fields)
    np.testing.assert_allclose(stream.rate, whole.rate, atol=1e-9)
    assert len(notes) == 1 and f"the first at {STAMPS[wrong[0]]} ns" in notes[0]


@pytest.mark.parametrize("measures", ["angles", "ticks"])
def test_a_counter_that_is_set_back(tmp_path, measures):
    """It goes on from zero: the step there is left out, its neighbours stand in."""
    fields: dict[str, Any] = {"counts_per_turn": 1000.5} if measures == "ticks" else {}
    values = np.floor(ANGLES * 1000.5 / (2 * np.pi)) if measures == "ticks" else ANGLES.copy()
    values[250:] -= values[250]
    stream, notes = from_table(tmp_path, values, measures=measures, **fields)
    np.testing.assert_array_equal(stream.stamps_ns, np.delete(STAMPS, 250))
    assert np.abs(stream.rate - np.delete(RATES, 250, axis=0)).max() < 0.4
    assert len(notes) == 1 and f"the first at {STAMPS[250]} ns" in notes[0]


def test_few_ticks_of_a_slow_wheel_stay(tmp_path):
    """One tick in eleven readings is no single bad one."""
    counts = np.stack([np.arange(N) // 11, np.arange(N) // 23], axis=1).astype(float)
    stream, notes = from_table(tmp_path, counts, measures="ticks", counts_per_turn=40.0)
    assert len(stream.rate) == N and notes == ()


def test_brisk_wheels_are_not_left_out(tmp_path):
    """Starts and stops within two readings, at 10 and 50 Hz, with noise and without."""
    for step in (1, 5):
        stamps = STAMPS[0] + step * (STAMPS - STAMPS[0])
        for noise in (0.0, 0.25):
            rates = np.where((np.arange(N) // 7 % 3 == 1)[:, None], [6.0, 5.0], 0.0)
            rates += noise * np.random.default_rng(2).normal(size=rates.shape)
            stream, _ = from_table(tmp_path, rates, stamps)
            assert len(stream.rate) == N


def test_the_table_that_is_not_there(tmp_path):
    (tmp_path / "imu0").mkdir()
    (tmp_path / "imu0" / "data.csv").write_text("1,2\n")
    with pytest.raises(RecordingError, match="has no wheel0/rates.csv .* it holds imu0/data.csv; set `path`"):
        wheel_readings(FolderRecording(tmp_path), Wheels("wheel0", "wheel0/rates.csv"))


POSES = "0,10,0.1,1,0,1e-4,0,0,1e-4,0,1e-4\n"


@each(
    ("rows", "words"),
    [
        (
            POSES + POSES.replace("0,10,", "11,20,", 1),
            "the pose from 11 to 20 ns does not start where the previous one",
        ),
        (POSES.replace("0,10,", "10,10,", 1), "the pose from 10 to 10 ns does not start"),
        (
            POSES.replace("1e-4,0,0,1e-4", "1e-4,2e-4,0,1e-4"),
            "the covariance of the pose from 0 ns is not positive definite",
        ),
        (POSES.replace("1e-4", "0"), "the covariance of the pose from 0 ns is not positive definite"),
    ],
)
def test_relative_poses_that_are_none(tmp_path, rows, words):
    (tmp_path / "wheel0").mkdir()
    (tmp_path / "wheel0" / "poses.csv").write_text(rows)
    with pytest.raises(RecordingError, match=words):
        wheel_readings(FolderRecording(tmp_path), Wheels("wheel0", "wheel0/poses.csv", measures="poses"))


@pytest.fixture
def bag_of(tmp_path, write):
    """What each message holds (names, positions, velocities) -> a bag."""

    def build(content: Any, kind: str = "sensor_msgs/msg/JointState") -> BagRecording:
        make = write.maker()
        messages = []
        for k, t in enumerate(STAMPS.tolist()):
            names, position, velocity = content(k)
            message = make.make(kind, make.header(t), names, np.array(position), np.array(velocity), np.zeros(0))
            messages.append(("/joint_states", kind, t + 5, message))
        return BagRecording(write.ros2(tmp_path / "run", messages))

    return build


def arm_and_wheels(k: int) -> tuple[list[str], list[float], list[float]]:
    """Each third message is that of an arm."""
    if k % 3 == 2:
        return ["elbow"], [0.3], [0.1]
    (left, right), (left_rate, right_rate) = ANGLES[k], RATES[k]
    return ["wheel_right", "elbow", "wheel_left"], [right, 0.3, left], [right_rate, 0.1, left_rate]


@pytest.mark.parametrize("measures", ["rates", "angles"])
@pytest.mark.parametrize("joints", [None, ("wheel_left", "wheel_right")])
def test_joints(bag_of, measures, joints):
    bag, wheels = bag_of(arm_and_wheels), Wheels("wheel0", "", measures=measures, joints=joints)
    stream, notes = checked_wheels(wheel_readings(bag, wheels), wheels, bag.where(wheels))
    sent = np.arange(N) % 3 != 2
    assert isinstance(stream, WheelStream) and notes == ()
    np.testing.assert_array_equal(stream.stamps_ns, STAMPS[sent])
    if measures == "rates":
        np.testing.assert_array_equal(stream.rate, RATES[sent])
    else:
        mean = np.diff(ANGLES[sent], axis=0) / np.diff(SECONDS[sent])[:, None]
        np.testing.assert_allclose(stream.rate[1:], mean, atol=1e-11)


def test_joints_that_do_not_do(bag_of, tmp_path):
    bag = bag_of(lambda k: (["left", "right"], [1.0 * k, 2.0 * k], []))
    wheels = Wheels("wheel0", "")
    with pytest.raises(RecordingError, match="left and right have no velocity; set `measures` of wheel0 to angles"):
        wheel_readings(bag, wheels)
    with pytest.raises(RecordingError, match="has no joint rear; it has left, right; correct `joints` of wheel0"):
        wheel_readings(bag, replace(wheels, joints=("left", "rear")))
    with pytest.raises(RecordingError, match="a bag holds no relative planar poses; set another `measures`"):
        wheel_readings(bag, replace(wheels, measures="poses"))
    with pytest.raises(RecordingError, match="has no topic /wheels; it holds /joint_states"):
        wheel_readings(bag, replace(wheels, topic="/wheels"))


def test_joints_without_names_that_tell(bag_of):
    bag = bag_of(lambda k: (["a", "b"], [], [1.0, 2.0]))
    with pytest.raises(RecordingError, match="the joints a, b do not tell which are the left and the right wheel"):
        wheel_readings(bag, Wheels("wheel0", ""))
    read = wheel_readings(bag, Wheels("wheel0", "", joints=("b", "a")))
    assert instance(read, WheelReadings).value[0].tolist() == [2.0, 1.0]


def test_joints_one_at_a_time(bag_of):
    bag = bag_of(lambda k: ([["left"], ["right"]][k % 2], [], [1.0]))
    with pytest.raises(RecordingError, match=f"the message at {STAMPS[0]} ns has only one of left and right"):
        wheel_readings(bag, Wheels("wheel0", ""))


@pytest.mark.parametrize("bad", [np.nan, np.inf, -np.inf, 1e300])
@pytest.mark.parametrize("measures", ["rates", "angles"])
@pytest.mark.parametrize("column", [0, 1])
def test_single_messages_with_one_joint_that_is_none(bag_of, measures, column, bad):
    def content(k: int) -> tuple[list[str], list[float], list[float]]:
        value = (RATES if measures == "rates" else ANGLES)[k].copy()
        if k in (0, 33, 150):
            value[column] = bad
        position, rate = ([], value.tolist()) if measures == "rates" else (value.tolist(), [])
        return ["left", "right"], position, rate

    wheels = Wheels("wheel0", "", measures=measures)
    stream, notes = checked_wheels(wheel_readings(bag_of(content), wheels), wheels, "here")
    np.testing.assert_array_equal(stream.stamps_ns, np.delete(STAMPS, [0, 33, 150]))
    assert f"3 of {N} readings are not finite and were removed, the first at {STAMPS[0]} ns" in notes[0]
    assert np.isfinite(instance(stream, WheelStream).rate).all()


FILLED = {
    "rates": (lambda k: (["left", "right"], ANGLES[k].tolist(), [0.0, 0.0]), "velocity", "position", "angles"),
    "angles": (lambda k: (["left", "right"], [0.0, 0.0], RATES[k].tolist()), "position", "velocity", "rates"),
}


@pytest.mark.parametrize("measures", ["rates", "angles"])
def test_what_a_driver_fills_with_zeros(bag_of, measures):
    content, zero, other, advice = FILLED[measures]
    bag = bag_of(content)
    with pytest.raises(
        RecordingError, match=f"the {zero} of left and right is always 0, the {other} is not; .* {advice}"
    ):
        wheel_readings(bag, Wheels("wheel0", "", measures=measures))  # type: ignore[arg-type]
    assert isinstance(wheel_readings(bag, Wheels("wheel0", "", measures=advice)), WheelReadings)
