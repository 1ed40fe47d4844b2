"""Whole calibrations with position sensors: simulated ones against their truth, and a real one in the hand."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import yaml
from scipy.stats import chi2
from tests.remarks import named

from icalib.errors import EstimationError
from icalib.export.formats import export
from icalib.pipeline import calibrate, calibrate_measurements
from icalib.result import Calibration
from icalib.rig.file import load_rig
from icalib.sensors.pose.simulate import SimPoses
from icalib.sensors.position.simulate import SimPositions
from icalib.sensors.position.stream import PositionStream
from icalib.tools.simulation import Drive, Room, Scenario, Simulation, rig_for, simulate
from icalib.tools.simulation.room import hills_of_slope

pytestmark = pytest.mark.slow

ARM, OFFSET_S = np.array([0.4, -0.25, 0.6]), 0.037
WALK = """
gravity: 9.7985
sensors:
  imu0:
    {type: imu, path: imu.csv, columns: ["1", "5", "6", "7", "2", "3", "4"], accel_unit: g, time_unit: s}
  gnss0: {type: position, path: gnss.pos}
"""


def pose(position, yaw=0.0):
    T, c, s = np.eye(4), np.cos(yaw), np.sin(yaw)
    T[:2, :2], T[:3, 3] = [[c, -s], [s, c]], position
    return T


def antenna(name="gnss0", arm=ARM, **fields):
    frame = pose([3.0, -1.0, 0.5], 2.1)
    given = {"rate_hz": 5.0, "phase_s": 0.3, "clock_origin_ns": 5_000_000_000, "T_world_frame": frame} | fields
    return SimPositions(name, pose(arm), OFFSET_S, **given)


def recorded(motion, *sensors, seed=1, duration_s=60.0):
    room = Room((30.0, 20.0, 6.0), hills=hills_of_slope(12.0) if motion == "ramps" else None)
    drive = Drive(motion)
    return simulate(Scenario((), duration_s=duration_s, motion=drive, board=False, room=room, sensors=sensors), seed)


def calibrated(sim, *changed):
    """With the streams `changed` in place of those that were simulated."""
    return calibrate_measurements(rig_for(sim.scenario), [sim.measurements.with_streams(*changed)])


def errors(result: Calibration, sim: Simulation, name="gnss0", arm=ARM):
    """(4,) of lever arm [m] and time offset [s], and their standard deviations."""
    offset = np.ravel(result.value(name, "time_offset")) - sim.truth.time_offset[name]
    error = np.append(result.value(name, "translation") - arm, offset)
    return error, np.append(result.std(name, "translation"), np.ravel(result.std(name, "time_offset")))


def check_mins(result: Calibration, sim: Simulation):
    """What MINS predicts of each fix by its formula, p_IinE + R_EtoI^T pGinI at time + timeoffset, against the
    truth."""
    file = export(result, "mins").files["config_gps.yaml"]
    entry = yaml.safe_load(file.removeprefix("%YAML:1.0"))["gps0"]
    (stream,), reported = sim.measurements.of(PositionStream), sim.truth.reported["gnss0"]
    time = stream.stamps_ns * 1e-9 + entry["timeoffset"] - 1e-9 * sim.truth.imu_clock_origin_ns
    R, p, _ = sim.truth.pose_at(time)
    frame = pose([3.0, -1.0, 0.5], 2.1)
    expected = (p + R @ entry["pGinI"] - frame[:3, 3]) @ frame[:3, :3]
    assert np.median(np.linalg.norm(expected - reported.position, axis=1)) < 0.02


@pytest.mark.parametrize("motion", ["free", pytest.param("ramps", marks=pytest.mark.full)])
def test_lever_arm_and_clock_from_nothing(motion):
    sim = recorded(motion, antenna())
    result = calibrated(sim)
    check_mins(result, sim)
    error, std = errors(result, sim)
    assert (np.abs(error) < 3.0 * std).all()
    assert std[:3].max() < 0.02
    assert std[3] < 4e-3


@pytest.mark.full
@pytest.mark.parametrize("motion", ["free", "ramps"])
def test_errors_are_as_large_as_their_covariance_says(motion):
    nees = []
    for seed in range(30):
        sim = recorded(motion, antenna(), seed=seed)
        result = calibrated(sim)
        own = [k for k, name in enumerate(result.covariance_names) if name.startswith("gnss0.")]
        error, std = errors(result, sim)
        assert (np.abs(error) < 4.0 * std).all(), seed
        nees.append(error @ np.linalg.solve(result.covariance[np.ix_(own, own)], error))
    low, high = chi2.ppf([0.005, 0.995], 4 * len(nees)) / len(nees)
    assert low < np.mean(nees) < high


def test_the_height_of_the_lever_arm_is_not_determined_on_a_floor():
    sim = recorded("planar", antenna(), duration_s=30.0)
    result = calibrated(sim)
    assert result.group("gnss0", "translation").verdict[2] == "unobservable"
    assert any("gnss0 translation z" in words for words in result.unobservable)
    error, std = errors(result, sim)
    assert (np.abs(error[[0, 1, 3]]) < 3.5 * std[[0, 1, 3]]).all()


def test_no_lever_arm_is_determined_on_a_straight_line():
    sim = recorded("straight-line", antenna(), duration_s=30.0)
    result = calibrated(sim)
    assert result.group("gnss0", "translation").verdict == ("unobservable",) * 3
    error, std = errors(result, sim)
    assert abs(error[3]) < 3.5 * std[3]


def slow_fixes():
    """At 2 Hz, without noise."""
    return recorded("free", antenna(rate_hz=2.0, position_noise=1e-4), duration_s=15.0)


def test_slow_fixes_do_not_bias_the_clock():
    sim = slow_fixes()
    error, _ = errors(calibrated(sim), sim)
    assert abs(error[3]) < 5e-4
    assert np.abs(error[:3]).max() < 5e-3


@pytest.mark.full
def test_slow_fixes_that_are_interpolated_linearly_would_bias_it():
    """Or the test above could not fail: they lag. Taken for a stream of 50 Hz, the same fixes make the time offset and
    the lever arm far off."""
    sim = slow_fixes()
    (stream,) = sim.measurements.of(PositionStream)
    stamps = np.arange(stream.stamps_ns[0], stream.stamps_ns[-1], 20_000_000)
    between = np.stack([np.interp(stamps, stream.stamps_ns, p) for p in stream.position.T], axis=1)
    bent, _ = errors(calibrated(sim, replace(stream, stamps_ns=stamps, position=between)), sim)
    assert np.abs(bent[:3]).max() > 0.02
    assert abs(bent[3]) > 0.02


def test_fixes_that_jump_and_errors_that_last():
    sim = recorded("free", antenna(outliers=0.03, drift_noise=0.01, drift_time_s=3.0), seed=2)
    result = calibrated(sim)
    error, std = errors(result, sim)
    assert (np.abs(error) < 4.0 * std).all()
    assert std[:3].max() < 0.04


def test_two_antennas_and_a_pose_sensor():
    other = SimPositions("gnss1", pose([-0.5, 0.2, 0.3]), -0.021, 4.0, T_world_frame=pose([0.0, 2.0, 1.0], -0.7))
    sim = recorded("free", SimPoses("mocap0", pose([0.1, 0.1, 0.1])), antenna(), other, duration_s=20.0)
    result = calibrated(sim)
    for name, arm in (("gnss0", ARM), ("gnss1", np.array([-0.5, 0.2, 0.3]))):
        error, std = errors(result, sim, name, arm)
        assert (np.abs(error) < 4.0 * std).all()


def test_several_recordings_with_clocks_that_restart():
    sims = [recorded("free", antenna(), seed=seed, duration_s=25.0) for seed in (1, 2)]
    (stream,) = sims[1].measurements.of(PositionStream)
    later = replace(stream, stamps_ns=stream.stamps_ns + 250_000_000)
    second = sims[1].measurements.with_streams(later)
    rig = rig_for(sims[0].scenario).with_("gnss0", clock_restarts=True)
    result = calibrate_measurements(rig, [sims[0].measurements, second])
    offsets = np.ravel(result.value("gnss0", "time_offset")) - sims[0].truth.time_offset["gnss0"]
    np.testing.assert_allclose(offsets, [0.0, -0.25], atol=6e-3)


def test_a_leap_second_offset_is_named():
    sim = recorded("free", antenna(), duration_s=20.0)
    (stream,) = sim.measurements.of(PositionStream)
    truth = sim.truth.time_offset["gnss0"]
    moved = replace(stream, stamps_ns=stream.stamps_ns + round(1e9 * (truth + 18.0)))
    result = calibrated(sim, moved)
    assert float(result.value("gnss0", "time_offset")[0]) == pytest.approx(-18.0, abs=0.01)
    assert "18 s between GPS time and UTC" in named("time_scales_differ", result.notes)


@pytest.mark.parametrize(
    ("hours", "told"),
    [(30.0, "30.0 hours after imu0"), pytest.param(72.0, "3.0 days after imu0", marks=pytest.mark.full)],
)
def test_fixes_of_another_day(hours, told):
    """Unix stamps on both sides: the same rig, the next day, along another path."""
    sim, other = (recorded("free", antenna(), seed=seed, duration_s=25.0) for seed in (1, 2))
    (fixes,), imu = other.measurements.of(PositionStream), sim.measurements.imu
    assert imu is not None
    unix = 1_700_000_000_000_000_000
    imu = replace(imu, stamps_ns=imu.stamps_ns - imu.stamps_ns[0] + unix)
    stamps = fixes.stamps_ns - fixes.stamps_ns[0] + imu.stamps_ns[-1] + round(3600e9 * hours)
    with pytest.raises(EstimationError, match=rf"^gnss0 was recorded {told}, by the stamps of both, and does not"):
        calibrated(sim, imu, replace(fixes, stamps_ns=stamps))
    with pytest.raises(EstimationError, match="of its acceleration at any time offset; check that both[^_]*$"):
        calibrated(sim, imu, replace(fixes, stamps_ns=stamps - round(3600e9 * hours)))


def test_a_walk_with_an_antenna_in_the_hand(gnss_imu, tmp_path):
    """135 s of carrier-phase fixes, half of them float. Its owners held antenna and IMU side by side, 5 cm apart."""
    rig = tmp_path / "rig.yaml"
    rig.write_text(WALK)
    result = calibrate(load_rig(rig), gnss_imu / "walk")
    arm, std = result.value("gnss0", "translation"), result.std("gnss0", "translation")
    assert std[:2].max() < 0.01  # 9 mm: the size effect of the IMU may be there, by 3 to 5 standard deviations
    assert std[2] < 0.022  # 20.6 mm: the vertical acceleration of this recording is low-passed at 5 Hz
    along = arm / np.linalg.norm(arm)
    assert abs(np.linalg.norm(arm) - 0.05) < 4.0 * np.sqrt(along @ np.diag(std**2) @ along)
    assert abs(float(result.value("gnss0", "time_offset")[0])) < 0.03  # both stamps are GPS time
