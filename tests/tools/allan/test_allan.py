"""`icalib allan`: what it finds of simulated IMUs, how certain it says to be, and what it says of bad recordings."""

from __future__ import annotations

import dataclasses
import json
import re
import shutil
from pathlib import Path

import numpy as np
import pytest
import yaml
from tests.cases import each

from icalib.cli import main
from icalib.data.measurements import ImuStream
from icalib.errors import EstimationError, RecordingError
from icalib.rig.file import load_rig
from icalib.tools.allan import allan_deviation, study_imu, study_recording, write_study
from icalib.tools.allan.analysis import (
    AllanFit,
    _most_likely,
    _std,
    allan_deviation_of_all,
    bands_of,
    bands_of_all,
    fit_noise,
    model_variance,
    pooled,
    still_readings,
)
from icalib.tools.simulation import handheld
from icalib.tools.simulation.motion import read_imu
from icalib.tools.simulation.output import IMU, BagForm, BagWriter

TRUTH = {"gyro": 1.6e-4, "gyro_walk": 2.2e-5, "accel": 2.8e-3, "accel_walk": 8.6e-4}
REST = np.array([2e-3, -1e-3, 3e-3, 0.1, -0.2, 9.8])


def noise(n: int, period: float, white: float, walk: float, rng: np.random.Generator) -> np.ndarray:
    """(n,) white noise and a bias that walks: a reading is a mean over its period."""
    steps = walk * np.sqrt(period) * rng.normal(size=n)
    return white / np.sqrt(period) * rng.normal(size=n) + np.cumsum(steps)


def at_rest(seconds: float, rate: float, seed: int) -> ImuStream:
    rng, n = np.random.default_rng(seed), round(seconds * rate)
    kinds = [("gyro", "gyro_walk")] * 3 + [("accel", "accel_walk")] * 3
    readings = np.stack([noise(n, 1.0 / rate, TRUTH[a], TRUTH[b], rng) for a, b in kinds], axis=1) + REST
    stamps = np.round(np.arange(n) * (1e9 / rate)).astype(np.int64) + 1_700_000_000_000_000_000
    return ImuStream("imu0", stamps, readings[:, :3], readings[:, 3:])


def with_readings(imu: ImuStream, readings: np.ndarray) -> ImuStream:
    return dataclasses.replace(imu, gyro=readings[:, :3], accel=readings[:, 3:])


def write(imu: ImuStream, folder: Path) -> Path:
    path = folder / "recording" / "imu0" / "data.csv"
    path.parent.mkdir(parents=True)
    rows = zip(imu.stamps_ns.tolist(), np.hstack([imu.gyro, imu.accel]).tolist(), strict=True)
    path.write_text("\n".join(f"{t}," + ",".join(f"{v:.10g}" for v in row) for t, row in rows) + "\n")
    return folder / "recording"


@pytest.mark.slow
def test_three_hours_give_densities_and_walks():
    """The bounds of the task: 5 % and 20 %, at 200 and at 100 Hz; the standard deviations say far less."""
    for rate, seed in ((200.0, 1), (100.0, 2)):
        study = study_imu(at_rest(3 * 3600.0, rate, seed), "here")
        for sensor, names in ((study.gyro, ("gyro", "gyro_walk")), (study.accel, ("accel", "accel_walk"))):
            for fit in (*sensor.axes, sensor.together):
                assert fit.white == pytest.approx(TRUTH[names[0]], rel=0.05)
                assert fit.walk == pytest.approx(TRUTH[names[1]], rel=0.2)
                assert abs(fit.white - TRUTH[names[0]]) < 4.5 * fit.white_std < 0.01 * fit.white
                assert abs(fit.walk - TRUTH[names[1]]) < 4.5 * fit.walk_std < 0.2 * fit.walk
            # A third of the variance, where the axes are alike.
            ratio = np.mean([f.white_std for f in sensor.axes]) / sensor.together.white_std
            assert ratio == pytest.approx(np.sqrt(3.0), rel=0.02)
        assert study.warnings == ()


@pytest.mark.parametrize("seconds", [600.0, pytest.param(3600.0, marks=pytest.mark.full)])
def test_errors_are_as_large_as_their_standard_deviations(seconds: float):
    """Mean NEES over 300 seeds inside the 99.9 % bounds of chi^2, of a gyroscope read at 50 Hz."""
    n, period, white, walk = int(seconds * 50), 0.02, TRUTH["gyro"], TRUTH["gyro_walk"]
    fits = [
        fit_noise(bands_of(noise(n, period, white, walk, np.random.default_rng(seed)), period), period)
        for seed in range(300)
    ]
    # chi^2 with 300 degrees of freedom, over 300
    assert 0.75 < np.mean([((f.white - white) / f.white_std) ** 2 for f in fits]) < 1.29
    # The standard deviation of K belongs to the estimate, which a low K makes low: NEES is a little above 1.
    relative = [(np.log(f.walk / walk) * f.walk / f.walk_std) ** 2 for f in fits]
    assert 0.75 < np.mean(relative) < 1.29
    assert all(f.resolved for f in fits)
    assert 0.90 < np.mean([f.walk_upper > walk for f in fits]) < 0.99
    assert np.mean([f.misfit > 0 for f in fits]) < 0.02


def test_the_likelihood_is_that_of_the_differences():
    """The sine transform against the dense covariance of the differences."""
    n, period, a, c = 23, 0.01, 2.0, 0.7
    covariance = c * np.eye(n) + a * (2.0 * np.eye(n) - np.eye(n, k=1) - np.eye(n, k=-1))
    k = np.arange(1, n + 1)
    sines = np.sqrt(2.0 / (n + 1)) * np.sin(np.pi * np.outer(k, k) / (n + 1))
    expected = c + a * (2.0 - 2.0 * np.cos(np.pi * k / (n + 1)))
    np.testing.assert_allclose(sines @ covariance @ sines.T, np.diag(expected), atol=1e-12)
    readings = np.random.default_rng(3).normal(size=n + 1)
    bands = bands_of(readings, period)
    last = int(bands.count.sum())
    squares = (sines @ np.diff(readings)) ** 2
    np.testing.assert_allclose((bands.power * bands.count).sum(), squares[:last].sum(), rtol=1e-12)
    slopes = 2.0 - 2.0 * np.cos(np.pi * k[:last] / (n + 1))
    np.testing.assert_allclose((bands.slope * bands.count).sum(), slopes.sum(), rtol=1e-12)


def test_the_fit_is_at_the_top_of_the_likelihood():
    """Score zero by central differences, and the curvature is the information, on the expected spectrum."""
    bands = bands_of(noise(40_000, 0.01, 1e-3, 1e-3, np.random.default_rng(0)), 0.01)
    weight, true_a, true_c = 0.5 * bands.count, 3.0, 0.02
    bands = dataclasses.replace(bands, power=true_c + true_a * bands.slope)
    ratio, a = _most_likely(bands, weight)
    assert (a, ratio * a) == (pytest.approx(true_a, rel=1e-6), pytest.approx(true_c, rel=1e-5))

    def cost(x: np.ndarray) -> float:
        s = x[1] + x[0] * bands.slope
        return float((weight * (np.log(s) + bands.power / s)).sum())

    at, steps = np.array([true_a, true_c]), np.diag([1e-3 * true_a, 1e-3 * true_c])
    hessian = np.array(
        [
            [
                sum(s * t * cost(at + s * p + t * q) for s in (1, -1) for t in (1, -1)) / (4 * p.max() * q.max())
                for q in steps
            ]
            for p in steps
        ]
    )
    std = np.sqrt(np.diag(np.linalg.inv(hessian)))
    np.testing.assert_allclose(_std(bands, weight, true_a, true_c), std, rtol=1e-3)


def test_allan_deviation_is_its_definition():
    readings, period = np.random.default_rng(5).normal(size=(400, 2)), 0.1
    d = allan_deviation(readings, period)
    for tau, got in zip(d.tau, d.deviation, strict=True):
        m = round(tau / period)
        means = np.stack([readings[i : i + m].mean(axis=0) for i in range(400 - m + 1)])
        half = 0.5 * ((means[m:] - means[:-m])[:: max(1, m // 16)] ** 2).mean(axis=0)  # 16 starts a cluster
        np.testing.assert_allclose(got**2, half, rtol=1e-9)


def test_allan_variance_of_the_model():
    """Against the exact expectation from the covariance of readings, where the walk matters and where it does not."""
    n, period, white, walk = 64, 0.5, 0.3, 0.2
    i = np.arange(n)
    covariance = walk**2 * period * (1 + np.minimum(i[:, None], i)) + white**2 / period * np.eye(n)
    for m in (1, 2, 7, 30):
        row = np.zeros(n)
        row[:m], row[m : 2 * m] = -1.0 / m, 1.0 / m
        tau = np.array([m * period])
        np.testing.assert_allclose(model_variance(white, walk, tau, period), 0.5 * row @ covariance @ row, rtol=1e-12)


def test_instability_is_the_lowest_deviation_over_its_flicker_factor():
    readings = noise(200_000, 0.01, 1e-3, 1e-3, np.random.default_rng(1))[:, None]
    d = allan_deviation(readings, 0.01)
    value, tau = d.instability()
    # N^2 / tau + K^2 tau / 3 is lowest at sqrt(3) N / K, where it is 2 N K / sqrt(3).
    assert value[0] == pytest.approx(np.sqrt(2e-6 / np.sqrt(3.0)) / 0.664, rel=0.1)
    assert 0.5 < tau[0] / np.sqrt(3.0) < 2.0


def test_a_short_recording_is_told_by_which_factor():
    short, long = (study_imu(at_rest(seconds, 100.0, 7), "here") for seconds in (60.0, 1800.0))
    sentence = next(w for w in short.warnings if "bias walk of the gyroscope" in w)
    said = re.search(r"record (?:at least )?([\d.]+) times as long", sentence)
    assert said is not None
    factor = float(said[1])
    assert 1.5 < factor < 60.0
    relative = long.gyro.together.walk_std / long.gyro.together.walk
    assert relative < 0.2 and not any("too short" in w for w in long.warnings)
    # Twice the time halves the variance: the factor follows the standard deviation.
    assert long.gyro.together.lacking == pytest.approx((relative / 0.2) ** 2, rel=0.05)


def test_a_walk_that_is_not_seen_is_bounded():
    """White noise alone: the bound is what the snippet gives, and it says so."""
    rng = np.random.default_rng(2)
    fit = fit_noise(bands_of(noise(20_000, 0.01, 1e-3, 0.0, rng), 0.01), 0.01)
    assert not fit.resolved and 0.0 < fit.walk_upper < 1e-3 and fit.lacking > 1.0
    assert fit.white == pytest.approx(1e-3, rel=0.1)


def test_axes_that_differ_are_taken_together_by_their_mean_square():
    rng, n, period = np.random.default_rng(4), 200_000, 0.01
    bands = [bands_of(noise(n, period, white, 1e-4, rng), period) for white in (1e-3, 1e-3, 4e-3)]
    together = fit_noise(pooled(bands), period)
    assert together.white == pytest.approx(np.sqrt((1.0 + 1.0 + 16.0) / 3.0) * 1e-3, rel=0.02)
    loudest = fit_noise(bands[2], period)
    assert together.white_std / together.white > 0.8 * loudest.white_std / loudest.white


def test_another_spectrum_widens_the_standard_deviations():
    """A slow hum on top, as of an air conditioner: the misfit is said, and N is not more certain than it is."""
    imu = at_rest(1200.0, 100.0, 3)
    t = np.arange(len(imu.stamps_ns)) / 100.0
    hum = 2e-4 * np.sin(2 * np.pi * np.outer(t, [0.31, 0.9, 2.3, 4.7])).sum(axis=1)
    plain = study_imu(imu, "here").gyro.together
    study = study_imu(with_readings(imu, np.hstack([imu.gyro + hum[:, None], imu.accel])), "here")
    assert study.gyro.together.misfit > 0.15 and study.gyro.together.white_std > 3.0 * plain.white_std
    assert any("gyroscope has more than white noise and a random walk" in w for w in study.warnings)
    assert not any("accelerometer is not" in w for w in study.warnings)


def test_what_was_moved_is_left_out():
    imu = at_rest(300.0, 100.0, 6)
    readings = np.hstack([imu.gyro, imu.accel])
    readings[:3000, :3] += 0.3 * np.sin(np.arange(3000) / 40.0)[:, None]  # carried to the table
    readings[25_000:, 3:] += [1.0, 0.0, 0.0]  # tilted
    study = study_imu(with_readings(imu, readings), "here")
    assert study.seconds == pytest.approx(220.0, abs=2.0)
    assert any("only the longest stretch at rest of 300 s is used, 219 s from 31 s on" in w for w in study.warnings)
    assert study.gyro.together.white == pytest.approx(TRUTH["gyro"], rel=0.05)


def touched(imu: ImuStream, at_s: float, tilt: float) -> ImuStream:
    """A knock that rings for seconds on the table, after which the IMU lies a little otherwise."""
    readings, t = np.hstack([imu.gyro, imu.accel]), np.arange(len(imu.stamps_ns)) / 100.0 - at_s
    ring = np.where(t > 0.0, np.exp(-np.maximum(t, 0.0) / 1.2) * np.sin(50.0 * t), 0.0)[:, None]
    readings += ring * [0.3, 0.2, 0.1, 1.0, 3.0, 0.5]
    readings[:, 3:5] += tilt * (t > 0.0)[:, None]
    return with_readings(imu, readings)


@each("seed", [0, 1, 2])
def test_what_was_touched_is_left_out(seed: int):
    imu = touched(touched(at_rest(60.0, 100.0, seed), 20.3, 0.05), 38.9, -0.02)
    study = study_imu(imu, "here")
    assert "imu0 was moved or touched; only the 3 longest stretches at rest of 60 s are used" in study.warnings[0]
    assert 35.0 < study.seconds < 50.0
    for sensor, white in ((study.gyro, TRUTH["gyro"]), (study.accel, TRUTH["accel"])):
        assert abs(sensor.together.white - white) < 4.0 * sensor.together.white_std < 0.15 * white
        shortest = sensor.deviation.deviation[0] * np.sqrt(0.01)
        np.testing.assert_allclose(shortest, white, rtol=0.05)


@pytest.mark.parametrize("size", [20.0, 1e28])
def test_glitches_are_left_out(size: float):
    """One reading in a hundred, on one axis or on all."""
    imu = at_rest(100.0, 100.0, 2)
    readings, rng = np.hstack([imu.gyro, imu.accel]), np.random.default_rng(0)
    at = np.arange(50, 10_000, 100)
    readings[at, rng.integers(0, 6, len(at))] += size * rng.choice([-1.0, 1.0], len(at))
    study = study_imu(with_readings(imu, readings), "here")
    assert study.seconds == pytest.approx(100.0)
    assert any("100 readings of imu0 are outliers and were removed" in w for w in study.warnings)
    clean = study_imu(imu, "here")
    for a, b in zip(study.sensors, clean.sensors, strict=True):
        assert abs(a.together.white - b.together.white) < b.together.white_std
        assert abs(a.together.walk - b.together.walk) < b.together.walk_std


def test_rests_between_motion_are_found():
    """Two thirds of the recording move, and the IMU rests in three attitudes: noise is the same in all."""
    imu = at_rest(180.0, 100.0, 4)
    readings, t = np.hstack([imu.gyro, imu.accel]), np.arange(18_000) / 100.0
    moving = ((t > 12) & (t < 70)) | ((t > 90) & (t < 160))
    readings += moving[:, None] * np.sin(np.outer(t, [3.0, 2.2, 1.7, 2.0, 2.5, 1.1])) * [1.0, 1.0, 1.0, 3.0, 3.0, 3.0]
    readings[t > 80 - 10, 3:] = readings[t > 70, 3:][:, [2, 0, 1]] * [-1.0, 1.0, -1.0]
    study = study_imu(with_readings(imu, readings), "here")
    assert study.seconds == pytest.approx(52.0, abs=6.0)
    assert study.gyro.together.white == pytest.approx(TRUTH["gyro"], rel=0.06)
    assert study.accel.together.white == pytest.approx(TRUTH["accel"], rel=0.06)


def test_stretches_count_together_without_the_steps_between_them():
    rng = np.random.default_rng(8)
    parts = [noise(6_000, 0.01, 1e-3, 2e-3, rng) + rng.normal() for _ in range(40)]
    fit = fit_noise(bands_of_all(parts, 0.01), 0.01)
    assert abs(fit.white - 1e-3) < 4.0 * fit.white_std < 0.03e-3
    assert abs(fit.walk - 2e-3) < 4.0 * fit.walk_std < 0.4e-3
    found = allan_deviation_of_all([part[:, None] for part in parts], 0.01)
    assert found.tau[-1] == pytest.approx(15.0)
    model = np.sqrt(model_variance(1e-3, 2e-3, found.tau, 0.01))
    assert (np.abs(found.deviation[:, 0] / model - 1.0) < 4.0 * found.relative).all() and found.relative[-1] < 0.1


def test_one_stretch_alone_is_what_it_was():
    values = noise(5_000, 0.01, 1e-3, 1e-4, np.random.default_rng(1))
    for a, b in zip(
        dataclasses.astuple(bands_of_all([values], 0.01)), dataclasses.astuple(bands_of(values, 0.01)), strict=True
    ):
        np.testing.assert_array_equal(a, b)


@each("rate", [12.0, 25.0, 400.0])
def test_noise_that_scatters_is_no_motion(rate: float):
    """Few readings a second, or many through a filter of 4 Hz: the noise of a second scatters by a fifth."""
    imu = at_rest(4000.0 if rate < 400.0 else 600.0, rate, 5)
    if rate == 400.0:
        kernel = np.exp(-np.arange(400) / 16.0)
        rows = np.hstack([imu.gyro, imu.accel]) - REST
        filtered = [np.convolve(x, kernel / kernel.sum(), "valid") for x in rows.T]
        values = np.stack(filtered, axis=1) + REST
        imu = ImuStream("imu0", imu.stamps_ns[: len(values)], values[:, :3], values[:, 3:])
    assert len(still_readings(imu).readings) == len(imu.stamps_ns)
    assert not any("moved or touched" in w for w in still_readings(imu).warnings)


def test_a_long_gap_is_not_filled():
    imu = at_rest(300.0, 100.0, 8)
    stamps = imu.stamps_ns.copy()
    stamps[12_000:] += 3_600_000_000_000
    still = still_readings(dataclasses.replace(imu, stamps_ns=stamps))
    assert [len(part) for part in still.stretches] == [12_000, 18_000] and still.period == pytest.approx(0.01)
    assert (
        "or has gaps of more than a second; only the 2 longest stretches at rest of 300 s are used, 300 s in total"
        in (still.warnings[0])
    )


def test_short_pieces_between_gaps_are_left_out():
    """Half a second, and one and a half, with a knock in it."""
    imu = at_rest(300.0, 100.0, 8)
    stamps, readings = imu.stamps_ns.copy(), np.hstack([imu.gyro, imu.accel])
    for at in (12_000, 12_050, 12_200):
        stamps[at:] += 5_000_000_000
    readings[12_100:12_110] += 1.0
    still = still_readings(with_readings(dataclasses.replace(imu, stamps_ns=stamps), readings))
    assert [len(part) for part in still.stretches] == [12_000, 17_800]


@pytest.mark.parametrize("scale", [0.3, 1.0])
def test_rates_in_degrees_are_named(scale: float):
    """A quiet gyroscope and a usual one; the accelerometer as it is."""
    imu = at_rest(60.0, 100.0, 3)
    degrees = dataclasses.replace(imu, gyro=imu.gyro * scale * 180.0 / np.pi)
    (warning,) = [w for w in study_imu(degrees, "here").warnings if "deg/s" in w]
    assert (
        f"the angular rates look like deg/s: at rest their noise is {57.3 * scale:.0f} times that of a consumer"
        in warning
    )
    assert not any("deg/s" in w for w in study_imu(imu, "here").warnings)
    shaken = with_readings(imu, (np.hstack([imu.gyro, imu.accel]) - REST) * 30.0 + REST)
    assert not any("deg/s" in w for w in study_imu(shaken, "here").warnings)


def test_units_of_the_readings_may_be_given(tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    """g is recognised; deg/s is a warning, in the file too."""
    imu = at_rest(60.0, 100.0, 7)
    study = study_imu(imu, "here")
    other = dataclasses.replace(imu, gyro=imu.gyro * 180.0 / np.pi, accel=imu.accel / 9.80665)
    recording, out = write(other, tmp_path), tmp_path / "out"
    assert main(["allan", str(recording), "-o", str(out)]) == 0
    assert "the accelerometer is in units of g" in re.sub(r"\s+", " ", capsys.readouterr().out)
    assert "# Warning: the angular rates look like deg/s" in (out / "noise.yaml").read_text()
    for accel in ([], ["--accel-unit", "g"]):
        assert main(["allan", str(recording), "-o", str(out), "--gyro-unit", "deg/s", *accel]) == 0
        assert "deg/s" not in (out / "noise.yaml").read_text()
        found = json.loads((out / "allan.json").read_text())
        for kind, sensor in (("gyroscope", study.gyro), ("accelerometer", study.accel)):
            assert found[kind]["together"]["noise_density"] == pytest.approx(sensor.together.white, rel=1e-6)


def test_an_imu_in_the_hand_is_refused():
    imu = at_rest(30.0, 100.0, 6)
    swing = np.sin(np.arange(3000) / 60.0)[:, None]
    with pytest.raises(EstimationError, match="imu0 was not at rest for 10 s anywhere in 30 s; put it on"):
        study_imu(dataclasses.replace(imu, gyro=imu.gyro + swing), "here")


def test_gaps_are_filled_and_said():
    imu = at_rest(600.0, 100.0, 8)
    keep = np.ones(len(imu.stamps_ns), dtype=bool)
    keep[10_000:10_050] = keep[30_000:30_020] = False
    cut = ImuStream("imu0", imu.stamps_ns[keep], imu.gyro[keep], imu.accel[keep])
    still = still_readings(cut)
    assert len(still.readings) == len(imu.stamps_ns) and still.period == pytest.approx(0.01, rel=1e-9)
    assert "imu0 has 2 gaps, the longest of 0.51 s; 70 of 60000 readings were interpolated" in still.warnings[0]
    assert study_imu(cut, "here").gyro.together.white == pytest.approx(TRUTH["gyro"], rel=0.03)


def test_stamps_in_bursts_are_taken_as_even():
    """Eight readings a packet, stamped when it came."""
    imu = at_rest(600.0, 100.0, 9)
    stamps = imu.stamps_ns[7::8].repeat(8) + np.tile(np.arange(8) * 20_000, len(imu.stamps_ns) // 8)
    still = still_readings(dataclasses.replace(imu, stamps_ns=stamps))
    assert still.period == pytest.approx(0.01, rel=1e-3) and "come in bursts" in still.warnings[0]


def test_rounded_readings_are_named():
    imu = at_rest(300.0, 100.0, 10)
    coarse = np.round(imu.gyro / 5e-3) * 5e-3
    study = study_imu(dataclasses.replace(imu, gyro=coarse), "here")
    rounded = r"the gyroscope [xyz] is quantised in steps of 0.005, more than its noise"
    assert any(re.search(rounded, w) for w in study.warnings)
    fine = np.round(imu.gyro / 1e-4) * 1e-4
    assert not any("rounded" in w for w in study_imu(dataclasses.replace(imu, gyro=fine), "here").warnings)


def test_the_snippet_goes_into_a_rig_file(tmp_path: Path):
    study = study_imu(at_rest(60.0, 100.0, 7), "here")
    write_study(study, tmp_path)
    noise_fields = yaml.safe_load((tmp_path / "noise.yaml").read_text())
    lidar = {"type": "lidar"}
    rig = {"sensors": {"imu0": {"type": "imu"} | noise_fields, "lidar0": lidar}}
    (tmp_path / "rig.yaml").write_text(yaml.safe_dump(rig))
    imu = load_rig(tmp_path / "rig.yaml").imu
    assert imu is not None and imu.noise.source == "60 s at rest"
    assert imu.noise.gyro == pytest.approx(study.gyro.together.white, rel=1e-3)
    found = json.loads((tmp_path / "allan.json").read_text())
    assert found["gyroscope"]["together"]["noise_density"] == study.gyro.together.white


def test_the_page_is_drawn(tmp_path: Path, assert_drawn):
    write_study(study_imu(at_rest(120.0, 100.0, 7), "a <b> & c"), tmp_path)
    page = (tmp_path / "allan.html").read_text()
    assert "a &lt;b&gt; &amp; c" in page and "http" not in page.split("<script>")[0]
    assert_drawn(page, {"gyroscope", "accelerometer"})


def test_the_command(tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    recording = write(at_rest(60.0, 100.0, 7), tmp_path)
    assert main(["allan", str(recording), "-o", str(tmp_path / "out")]) == 0
    printed = capsys.readouterr().out
    assert "gyro_walk:" in printed and "rad/s^2/sqrt(Hz)" in printed and "too short for the bias walk" in printed
    assert sorted(p.name for p in (tmp_path / "out").iterdir()) == ["allan.html", "allan.json", "noise.yaml"]
    assert main(["allan", str(recording), "-o", str(tmp_path / "two"), "--imu", "imu0/data.csv", "-q"]) == 0
    assert capsys.readouterr().out == ""


@pytest.mark.parametrize(
    ("imu", "words"),
    [
        ("imu7", "has no topic imu7; it holds cam0/corners.csv (table of corners)"),
        ("cam0/corners.csv", "holds no readings of an IMU"),
    ],
)
def test_a_wrong_topic_is_one_sentence(tmp_path: Path, capsys: pytest.CaptureFixture[str], imu: str, words: str):
    recording = write(at_rest(2.0, 100.0, 7), tmp_path)
    (recording / "cam0").mkdir()
    (recording / "cam0" / "corners.csv").write_text("1,0,0,1.0,2.0\n")
    assert main(["allan", str(recording), "-o", str(tmp_path / "out"), "--imu", imu]) == 1
    error = capsys.readouterr().err
    assert words in error and error.count("\n") == 1


def test_several_imus_or_none_are_one_sentence(tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    recording = write(at_rest(2.0, 100.0, 7), tmp_path)
    shutil.copytree(recording / "imu0", recording / "imu1")
    assert main(["allan", str(recording), "-o", str(tmp_path / "out")]) == 1
    assert "has several IMUs, imu0/data.csv, imu1/data.csv; give one as --imu" in capsys.readouterr().err
    shutil.rmtree(recording / "imu0")
    assert main(["allan", str(recording), "-o", str(tmp_path / "out")]) == 1
    assert "was not at rest for 10 s anywhere in 2 s" in capsys.readouterr().err
    (recording / "cam0").mkdir()
    (recording / "imu1" / "data.csv").rename(recording / "cam0" / "corners.csv")
    (recording / "cam0" / "corners.csv").write_text("1,0,0,1.0,2.0\n")
    assert main(["allan", str(recording), "-o", str(tmp_path / "out")]) == 1
    assert "has no readings of an IMU; it holds cam0/corners.csv" in capsys.readouterr().err
    assert main(["allan", str(tmp_path / "nowhere"), "-o", str(tmp_path / "out")]) == 1
    assert "nowhere does not exist" in capsys.readouterr().err


def test_an_imu_on_two_topics(tmp_path: Path):
    """As RealSense sends it: what a topic does not carry is zero."""
    imu = at_rest(40.0, 100.0, 7)
    bag = tmp_path / "static.bag"
    topics = ("/camera/accel/sample", "/camera/gyro/sample")
    with BagWriter("ros1", bag, dict.fromkeys(topics, IMU)) as writer:
        for t, w, f in zip(imu.stamps_ns.tolist(), imu.gyro.tolist(), imu.accel.tolist(), strict=True):
            writer.write(topics[0], writer.imu(t, [0.0, 0.0, 0.0, *f]), t)
            writer.write(topics[1], writer.imu(t, [*w, 0.0, 0.0, 0.0]), t)
    study, whole = study_recording(bag), study_imu(imu, "here")
    for found, there in zip(study.sensors, whole.sensors, strict=True):
        assert found.together.white == pytest.approx(there.together.white, rel=1e-6)


def test_a_fit_is_plain_numbers():
    assert all(isinstance(v, float | bool) for v in dataclasses.astuple(_fit()))


def _fit() -> AllanFit:
    return fit_noise(bands_of(noise(2_000, 0.01, 1e-3, 1e-3, np.random.default_rng(0)), 0.01), 0.01)


def test_the_simulated_imu_has_the_densities_of_its_scenario():
    """The units are those of the rig file, and of the simulator."""
    scenario = handheld(imu="noisy")
    rng, rate = np.random.default_rng(5), scenario.imu_rate_hz
    seconds = np.arange(round(1200 * rate)) / rate
    readings = read_imu(scenario, seconds, np.tile([0.0, 0.0, 0.0, 0.0, 0.0, 9.81], (len(seconds), 1)), rng)
    stamps = np.round(1e9 * seconds).astype(np.int64)
    study = study_imu(ImuStream("imu0", stamps, readings.gyro, readings.accel), "here")
    for sensor, white, walk in ((study.gyro, "gyro", "gyro_walk"), (study.accel, "accel", "accel_walk")):
        fit = sensor.together
        assert abs(fit.white - getattr(scenario.imu_noise, white)) < 4.0 * fit.white_std < 0.02 * fit.white
        assert abs(fit.walk - getattr(scenario.imu_noise, walk)) < 4.0 * fit.walk_std < 0.4 * fit.walk


def test_the_filter_of_a_sensor_does_not_pass_for_low_noise():
    """A mean of three readings has the gain (1 + 2 cos w) / 3: below a twentieth of the rate 1.1 % too little, over all
    frequencies half."""
    imu = at_rest(1800.0, 100.0, 11)
    smooth = np.stack([np.convolve(x, np.ones(3) / 3.0, "same") for x in imu.gyro.T], axis=1)[1:-1]
    filtered = ImuStream("imu0", imu.stamps_ns[1:-1], smooth, imu.accel[1:-1])
    fit = study_imu(filtered, "here").gyro.together
    assert fit.white == pytest.approx(TRUTH["gyro"], rel=0.02)
    assert fit.walk == pytest.approx(TRUTH["gyro_walk"], rel=0.15)


@pytest.mark.parametrize("form", ["ros1", "mcap"])
def test_a_bag_gives_what_its_table_gives(tmp_path: Path, form: BagForm):
    """Two IMUs in it: the topic says which."""
    imu = at_rest(30.0, 100.0, 7)
    bag = tmp_path / "static.bag"
    topics = ("/left/imu", "/right/imu")
    with BagWriter(form, bag, dict.fromkeys(topics, IMU)) as writer:
        for t, row in zip(imu.stamps_ns.tolist(), np.hstack([imu.gyro, imu.accel]).tolist(), strict=True):
            writer.write(topics[0], writer.imu(t, row), t)
            writer.write(topics[1], writer.imu(t, [2.0 * v for v in row[:3]] + row[3:]), t)
    table = study_recording(write(imu, tmp_path)).gyro.together
    left, right = (study_recording(bag, topic).gyro.together for topic in topics)
    assert left.white == pytest.approx(table.white, rel=1e-6)
    assert right.white == pytest.approx(2.0 * table.white, rel=1e-6)
    with pytest.raises(RecordingError, match="has several IMUs, /left/imu, /right/imu; give one as --imu"):
        study_recording(bag)


@each(("axis", "name"), [(0, "gyroscope x"), (5, "accelerometer z"), (slice(None), "gyroscope x")])
def test_an_axis_that_never_changes(axis, name: str):
    readings = np.concatenate([(imu := at_rest(20.0, 100.0, 3)).gyro, imu.accel], axis=1)
    readings[:, axis] = 0.25
    with pytest.raises(EstimationError, match=rf"imu0: the {name} is 0.25 in all readings at rest, so its noise is un"):
        study_imu(with_readings(imu, readings), "here")
