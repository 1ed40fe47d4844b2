"""Single wrong readings, copies, held sensors, and stamps in bursts: what is left is what was measured, when it was."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from tests.cases import each

from icalib.data.measurements import ImuStream
from icalib.data.stamps import EvenStamps, even_stamps, followed
from icalib.sensors.imu.read import checked_imu
from icalib.tools.simulation import handheld, simulate


def simulated(seed: int, **options) -> ImuStream:
    imu = simulate(handheld(10.0, **options), seed).measurements.imu
    assert imu is not None
    return imu


@pytest.fixture(scope="module")
def waved() -> ImuStream:
    return simulated(1)


def some(imu: ImuStream, which: np.ndarray) -> ImuStream:
    return ImuStream(imu.name, imu.stamps_ns[which], imu.gyro[which], imu.accel[which])


def is_left(found: ImuStream, imu: ImuStream) -> np.ndarray:
    return np.isin(imu.stamps_ns, found.stamps_ns)


@each("noiseless", [False, True])
@each("seed", [2, 3])
def test_clean_readings_stay_bit_for_bit(seed, noiseless):
    imu = simulated(seed, noiseless=noiseless)
    found, notes = checked_imu(imu, "file")
    assert notes == ()
    for name in ("stamps_ns", "gyro", "accel"):
        np.testing.assert_array_equal(getattr(found, name), getattr(imu, name))


def test_the_note_names_time_and_count(waved):
    accel = waved.accel.copy()
    accel[700, 1] += 20.0
    found, notes = checked_imu(replace(waved, accel=accel), "file")
    assert is_left(found, waved).sum() == len(waved.stamps_ns) - 1 and not is_left(found, waved)[700]
    assert len(notes) == 1 and f"1 of {len(waved.stamps_ns)} readings are outliers of the" in notes[0]
    assert f"the first 3.500 s from the start, at {waved.stamps_ns[700]} ns" in notes[0]


@each("seed", range(4))
@each("size", [8.0, 20.0, 1e3, 1e28])
def test_one_reading_of_a_hundred_is_wrong(waved, seed, size):
    """Those next to each other, too; and none but these is left out."""
    rng = np.random.default_rng(seed)
    n = len(waved.gyro)
    accel, gyro, wrong = waved.accel.copy(), waved.gyro.copy(), np.zeros(n, bool)
    for values, factor in ((accel, size), (gyro, 0.1 * size)):
        bad = rng.random(n) < 0.005
        values[bad, rng.integers(0, 3, bad.sum())] += factor * rng.choice([-1.0, 1.0], bad.sum())
        wrong |= bad
    wrong[[0, 1, -2, -1]] = True  # at the ends there are no neighbours to compare with
    found, _ = checked_imu(replace(waved, accel=accel, gyro=gyro), "file")
    left = is_left(found, waved)
    assert left[~wrong].all() and not left[wrong][2:-2].any()


@each("value", [np.nan, np.inf, -np.inf])
def test_readings_that_are_no_numbers(waved, value):
    gyro = waved.gyro.copy()
    gyro[[0, 40, 41, -1], 2] = value
    found, notes = checked_imu(replace(waved, gyro=gyro), "file")
    assert not is_left(found, waved)[[0, 40, 41, -1]].any() and len(found.stamps_ns) == len(waved.stamps_ns) - 4
    assert "4 of 2001 readings are not finite" in notes[0]


@each("width", [0.004, 0.006, 0.01, 0.03])
def test_shocks_stay(waved, width):
    """Blows of 60 m/s^2, and of 6 rad/s, as long as a low-pass filter of an IMU makes them at least."""
    blows = np.arange(0.513, 9.8, 0.2037)
    shape = np.exp(-(((waved.seconds[:, None] - blows) / width) ** 2)).sum(axis=1)[:, None]
    blown = replace(
        waved, accel=waved.accel + 60.0 * shape * [1, 0.3, -0.2], gyro=waved.gyro + 6.0 * shape * [0, 1, 0.5]
    )
    assert checked_imu(blown, "file")[1] == ()


def test_a_sudden_start_and_a_sudden_stop_stay():
    """At rest, then a swing at once."""
    rng = np.random.default_rng(0)
    t = np.arange(4000) * 0.005
    swing = np.where((t > 5.0) & (t < 12.0), 12.0, 0.0)[:, None]
    accel = swing * [0.5, 1.0, 0.0] + [0, 0, 9.81] + rng.normal(0, 0.02, (4000, 3))
    gyro = swing * [0.1, 0.0, 0.2] + rng.normal(0, 2e-3, (4000, 3))
    assert checked_imu(ImuStream("imu0", (t * 1e9).astype(np.int64), gyro, accel), "file")[1] == ()


def test_a_sensor_that_is_stuck_for_a_while(waved):
    accel = waved.accel.copy()
    accel[500:530] = accel[499]
    found, notes = checked_imu(replace(waved, accel=accel), "file")
    assert np.flatnonzero(~is_left(found, waved)).tolist() == list(range(500, 530)), notes


@each("shift_ns", [-3_000_000, -8_000_000, 2_000_000, 12_000_000])
@each("share", [0.02, 0.25, 0.5])
def test_copies_under_other_stamps(waved, shift_ns, share):
    """As a T265 sends them; the originals are told by their even stamps."""
    again = np.random.default_rng(0).random(len(waved.gyro)) < share
    both = [np.concatenate([x, y[again]]) for x, y in ((waved.gyro, waved.gyro), (waved.accel, waved.accel))]
    stamps = np.concatenate([waved.stamps_ns, waved.stamps_ns[again] + shift_ns])
    order = np.argsort(stamps, kind="stable")
    found, notes = checked_imu(ImuStream("imu0", stamps[order], both[0][order], both[1][order]), "file")
    assert notes[0].name == "imu_readings_copied"
    assert np.isin(found.stamps_ns, waved.stamps_ns)[5:-5].all() and is_left(found, waved).mean() > 0.99


def test_copies_of_one_sensor_in_a_table_in_the_order_of_arrival(waved):
    """Each fourth accelerometer's reading came again with another rate, 2 ms early."""
    again = np.arange(0, len(waved.gyro), 4)
    at = np.sort(np.concatenate([np.arange(len(waved.gyro)), again]), kind="stable")
    second = np.concatenate([[False], np.diff(at) == 0])
    gyro = waved.gyro[at] + second[:, None] * 1e-3
    arrived = ImuStream("imu0", waved.stamps_ns[at] - 2_000_000 * second, gyro, waved.accel[at])
    found, _ = checked_imu(arrived, "file")
    np.testing.assert_array_equal(found.stamps_ns, waved.stamps_ns)


def test_a_held_accelerometer_is_interpolated(waved):
    """62.5 readings a second, sent 200 times a second, as RealSense's unite_imu_method: copy does."""
    number = np.floor(np.arange(len(waved.gyro)) * 62.5 / 200.0).astype(int)
    first = np.searchsorted(number, number)
    found, notes = checked_imu(replace(waved, accel=waved.accel[first]), "file")
    assert notes[0].name == "imu_sensor_slower" and "accelerometer" in notes[0]
    held_off, off = (np.abs(x - waved.accel).mean() for x in (waved.accel[first], found.accel))
    assert off < 0.6 * held_off


class TestEvenStamps:
    def even(self, imu: ImuStream, values: np.ndarray) -> EvenStamps | None:
        n = len(values)
        return even_stamps(
            imu.stamps_ns, lambda number, delay: followed(number, delay, np.zeros(n), np.arange(n), values)
        )

    @each("burst", [2, 5, 10, 32])
    @each("within_ns", [0, 1000, 100_000])
    def test_bursts(self, waved, burst, within_ns):
        """Each stamp is that of its burst's last reading, and so many ns more; the sampling clock comes back."""
        k = np.arange(len(waved.gyro))
        last = np.minimum(k // burst * burst + burst - 1, k[-1])
        found, notes = checked_imu(replace(waved, stamps_ns=waved.stamps_ns[last] + within_ns * (k % burst)), "file")
        off = found.stamps_ns - waved.stamps_ns
        assert len(off) == len(k) and np.ptp(off) < 1e4 + 20 * within_ns
        assert abs(off.mean() - within_ns * (burst - 1)) < 1e4 + 3 * within_ns
        assert len(notes) == 1 and ("come in bursts" in notes[0] or burst == 2)

    @pytest.mark.parametrize("burst", [2, 10])
    def test_bursts_of_which_some_are_lost(self, waved, burst):
        k = np.arange(len(waved.gyro))
        kept = ~np.isin(k // burst, [20, 21, 60])
        last = np.minimum(k // burst * burst + burst - 1, k[-1])
        stamped = some(replace(waved, stamps_ns=waved.stamps_ns[last]), kept)
        found, _ = checked_imu(stamped, "file")
        assert np.abs(found.stamps_ns - waved.stamps_ns[kept]).max() < 1e5

    @pytest.mark.parametrize("delay", ["normal", "exponential"])
    def test_jitter(self, waved, delay):
        rng = np.random.default_rng(4)
        late = rng.normal(0, 0.8e6, len(waved.gyro)) if delay == "normal" else rng.exponential(1e6, len(waved.gyro))
        stamps = np.maximum.accumulate(waved.stamps_ns + late.astype(np.int64)) + np.arange(len(late))
        found, notes = checked_imu(replace(waved, stamps_ns=stamps), "file")
        assert "the stamps jitter by" in notes[0]
        assert np.abs(found.stamps_ns - waved.stamps_ns).max() < 0.3e6

    def test_a_relay_that_stalls_once(self, waved):
        stamps = waved.stamps_ns.copy()
        stamps[800:860] = stamps[860] + 1000 * np.arange(-60, 0)
        found, _ = checked_imu(replace(waved, stamps_ns=stamps), "file")
        assert np.abs(found.stamps_ns - waved.stamps_ns).max() < 0.1e6

    def test_readings_that_were_sampled_unevenly_keep_their_stamps(self, waved):
        rng = np.random.default_rng(0)
        k = np.sort(rng.choice(len(waved.gyro), len(waved.gyro) // 2, replace=False))
        for which in (k, np.flatnonzero(np.arange(len(waved.gyro)) % 20 < 10)):
            imu = some(waved, which)
            assert self.even(imu, np.hstack([imu.gyro, imu.accel])) is None

    def test_noise_alone_keeps_its_stamps(self, waved):
        rng = np.random.default_rng(0)
        stamps = waved.stamps_ns + rng.normal(0, 0.5e6, len(waved.gyro)).astype(np.int64)
        assert self.even(replace(waved, stamps_ns=stamps), rng.normal(size=(len(stamps), 6))) is None
