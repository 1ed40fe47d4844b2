"""Several recordings of one rig: one calibration, a trajectory, biases and an attitude of the board each."""

from __future__ import annotations

import dataclasses
from typing import Literal

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from scipy.stats import chi2
from tests.remarks import names
from tests.typed import not_none

from icalib.data.measurements import CornerStream, ImuStream
from icalib.errors import EstimationError, RecordingError
from icalib.export.formats import write_outputs
from icalib.pipeline import calibrate_measurements
from icalib.result import Calibration, load_calibration
from icalib.rig import Rig
from icalib.tools.simulation import Scenario, Simulation, Truth, handheld, rig_for, simulate

GROUPS = ("rotation", "translation", "time_offset", "intrinsics", "distortion")


def second(scenario: Scenario) -> Scenario:
    """The same rig on another day: the board leans elsewhere, biases differ, all clocks were set back by a month."""
    T = scenario.T_world_board.copy()
    T[:3, :3] = Rotation.from_euler("xyz", [-0.3, 0.2, 0.8]).as_matrix() @ T[:3, :3]
    T[:3, 3] += [0.5, -1.0, 0.3]
    earlier = 30 * 86_400 * 10**9 + 123_456_789
    return dataclasses.replace(
        scenario,
        T_world_board=T,
        gyro_bias=(0.05, -0.03, -0.04),
        accel_bias=(0.2, -0.1, 0.05),
        imu_clock_origin_ns=scenario.imu_clock_origin_ns - earlier,
        cameras=tuple(dataclasses.replace(c, clock_origin_ns=c.clock_origin_ns - earlier) for c in scenario.cameras),
    )


def pair(seed: int, seconds: tuple[float, float] = (12.0, 9.0), **options) -> tuple[Simulation, Simulation]:
    first, other = handheld(seconds[0], **options), second(handheld(seconds[1], **options))
    return simulate(first, 2 * seed), simulate(other, 2 * seed + 1)


def rig_of(simulation: Simulation, lens: Literal["free", "start"] = "start") -> Rig:
    """Lenses are estimated in either case; "free": without a guess of them, which takes as long as all the rest."""
    return rig_for(simulation.scenario, intrinsics=lens, distortion=lens)


def joint(simulations: tuple[Simulation, ...], rig: Rig | None = None) -> Calibration:
    return calibrate_measurements(rig or rig_of(simulations[0]), [s.measurements for s in simulations])


def errors(result: Calibration, truth: Truth) -> tuple[np.ndarray, np.ndarray]:
    """Estimated minus true (n,) of all that the recordings share, and their columns."""
    found, columns = [], []
    for camera, T in truth.T_imu_sensor.items():
        true = {
            "translation": T[:3, 3],
            "time_offset": np.array([truth.time_offset[camera]]),
            "intrinsics": truth.values[camera]["intrinsics"],
            "distortion": truth.values[camera]["distortion"],
        }
        for name in GROUPS:
            g = result.group(camera, name)
            turned = name == "rotation"
            found.append(Rotation.from_matrix(T[:3, :3].T @ g.value).as_rotvec() if turned else g.value - true[name])
            columns.extend(not_none(g.columns))
    return np.concatenate(found), np.array(columns)


@pytest.fixture(scope="module")
def noisy() -> tuple[Simulation, Simulation]:
    return pair(3)


@pytest.fixture(scope="module")
def noisy_joint(noisy) -> Calibration:
    rig = rig_of(noisy[0])
    return joint(noisy, dataclasses.replace(rig, settings=dataclasses.replace(rig.settings, segments=4)))


@pytest.mark.parametrize("asynchronous", [True, pytest.param(False, marks=pytest.mark.full)])
def test_two_noiseless_recordings_give_the_truth(asynchronous: bool):
    simulations = pair(0, asynchronous=asynchronous, noiseless=True)
    result = joint(simulations, rig_of(simulations[0], "free"))
    assert result.converged, result.status
    error, _ = errors(result, simulations[0].truth)
    scale = np.tile([1.0] * 7 + [460.0] * 4 + [1.0] * 4, 2)
    assert np.abs(error / scale).max() < 1e-8
    for k, name in enumerate(("board0", "board0 in recording 2")):
        up = simulations[k].truth.T_world_board[2, :3]
        np.testing.assert_allclose(result.group(name, "tilt").value[2], up, atol=1e-8)
    bias = simulations[1].truth.gyro_bias[0]
    np.testing.assert_allclose(result.trajectory.gyro_bias[-1], bias, atol=1e-8)


@pytest.mark.full
def test_the_covariance_is_honest():
    """NEES of all that the recordings share, over twelve pairs."""
    total, dof = 0.0, 0
    for seed in range(12):
        simulations = pair(seed, (8.0, 8.0))
        result = joint(simulations)
        assert result.converged, result.status
        error, columns = errors(result, simulations[0].truth)
        total += float(error @ np.linalg.solve(result.covariance[np.ix_(columns, columns)], error))
        dof += len(error)
    low, high = chi2.ppf([0.0005, 0.9995], dof)
    assert low < total < high


def test_the_information_of_the_pair_is_the_sum_of_both(noisy, noisy_joint):
    rig, information = rig_of(noisy[0]), []
    for simulation in noisy:
        alone = joint((simulation,), rig)
        _, columns = errors(alone, simulation.truth)
        information.append(np.linalg.inv(alone.covariance[np.ix_(columns, columns)]))
    _, columns = errors(noisy_joint, noisy[0].truth)
    covariance = noisy_joint.covariance[np.ix_(columns, columns)]
    # In units of its own: the two were linearised at estimates of their own.
    ratio = np.linalg.eigvals(covariance @ (information[0] + information[1])).real
    assert np.abs(ratio - 1.0).max() < 0.1


@pytest.mark.full
def test_a_list_of_one_is_one_recording(noisy):
    rig = rig_of(noisy[1])
    one, listed = (calibrate_measurements(rig, m) for m in (noisy[1].measurements, [noisy[1].measurements]))
    np.testing.assert_array_equal(one.covariance, listed.covariance)
    for a, b in zip(one.groups, listed.groups, strict=True):
        assert a.sensor == b.sensor
        np.testing.assert_array_equal(a.value, b.value)
    np.testing.assert_array_equal(one.trajectory.seconds, listed.trajectory.seconds)
    assert one.notes == listed.notes


@pytest.mark.full
def test_the_order_of_recordings_does_not_matter(noisy, noisy_joint):
    turned = joint(noisy[::-1], rig_of(noisy[0]))
    for camera in ("cam0", "cam1"):
        for name in GROUPS:
            a, b = noisy_joint.group(camera, name), turned.group(camera, name)
            assert np.abs(a.value - b.value).max() < 1e-6 * max(1.0, np.abs(a.value).max())


def test_splits_keep_recordings_apart(noisy_joint):
    """Segments end where a recording does: were one to run across, its chain would not be determined."""
    factor = noisy_joint.group("cam0", "rotation").factor
    assert "recording_too_short" not in names(noisy_joint.warnings)
    assert factor is not None and 1.0 <= factor.max() < 4.0


def test_times_and_notes_name_the_recording(noisy, noisy_joint):
    spans = noisy_joint.recordings
    assert [s.name for s in spans] == ["recording 1", "recording 2"]
    assert spans[1].start == pytest.approx(spans[0].end + 1.0)
    path = noisy_joint.trajectory
    recording = noisy_joint.recording_of(path.seconds)
    for k, (span, simulation) in enumerate(zip(spans, noisy, strict=True)):
        own = path.seconds[recording == k]
        stamps = simulation.measurements.imu.stamps_ns
        shown = span.origin_ns + np.round(1e9 * (own - span.start)).astype(np.int64)
        assert stamps[0] <= shown[0] < stamps[0] + 10**8
        assert stamps[-1] - 10**8 < shown[-1] <= stamps[-1]
        assert span.start <= own[0] and own[-1] <= span.end
    for residuals in noisy_joint.corner_residuals:
        assert (np.diff(residuals.seconds) > 0.0).all()
        count = np.bincount(noisy_joint.recording_of(residuals.seconds))
        camera = int(residuals.sensor[-1])
        assert count.tolist() == [len(s.measurements.cameras[camera].stamps_ns) for s in noisy]
    assert len(noisy_joint.imu_residuals[0].seconds) == len(path.seconds) - 2
    assert noisy_joint.imu_residuals[0].whitened.any(axis=1).all()
    assert any(
        note.startswith("recording 2: 9.0 s from ") for note in noisy_joint.notes if note.name == "recording_span"
    )


def test_outputs(noisy_joint, tmp_path):
    write_outputs(noisy_joint, tmp_path)
    again = load_calibration(tmp_path)
    assert again.recordings == noisy_joint.recordings
    np.testing.assert_array_equal(again.covariance, noisy_joint.covariance)
    assert "board0 in recording 2" in (tmp_path / "calibration.yaml").read_text()


def later(imu: ImuStream, ns: int) -> ImuStream:
    return dataclasses.replace(imu, stamps_ns=imu.stamps_ns + np.int64(ns))


@pytest.mark.parametrize("shift_ns", [300_000_000, pytest.param(10**15, marks=pytest.mark.full)])
def test_a_clock_that_was_set_between_recordings_is_named(noisy, shift_ns: int):
    first, other = (s.measurements for s in noisy)
    moved = dataclasses.replace(other.with_streams(later(other.imu, shift_ns)), name="evening")
    with pytest.raises(
        EstimationError, match=rf"^evening: the time offset of cam0 differs by \+{shift_ns * 1e-9:.3f} s from that in"
    ):
        calibrate_measurements(rig_of(noisy[0]), [first, moved])


def test_a_recording_without_a_guess_is_named(noisy):
    first, other = (s.measurements for s in noisy)
    imu = other.imu
    wild = ImuStream(imu.name, imu.stamps_ns, np.roll(imu.gyro, 1, axis=1)[::-1].copy(), imu.accel)
    with pytest.raises(EstimationError, match=r"^recording 2: "):
        calibrate_measurements(rig_of(noisy[0]), [first, other.with_streams(wild)])


@pytest.mark.parametrize("scheme", ["kinematic", pytest.param("pose", marks=pytest.mark.full)])
def test_gaps_and_other_schemes(noisy, scheme):
    """A gap is told with its recording, and images between two keyframes never reach into another recording."""
    first, other = (s.measurements for s in noisy)
    t = other.imu.seconds
    kept = (t < 4.0) | (t > 4.1)
    imu = ImuStream(other.imu.name, other.imu.stamps_ns[kept], other.imu.gyro[kept], other.imu.accel[kept])
    rig = rig_of(noisy[0])
    settings = dataclasses.replace(rig.settings, scheme=scheme, keyframes="first-camera")
    result = calibrate_measurements(dataclasses.replace(rig, settings=settings), [first, other.with_streams(imu)])
    error, _ = errors(result, noisy[0].truth)
    assert np.abs(error[:6]).max() < 5e-3
    assert any("gap of 0.1" in n and "s of recording 2, bridged" in n for n in result.notes if n.name == "imu_gap")


def test_without_an_imu_recordings_are_more_images():
    def still(scenario: Scenario) -> Scenario:
        cameras = (dataclasses.replace(c, time_offset_s=0.0, rate_hz=4.0) for c in scenario.cameras)
        return dataclasses.replace(scenario, cameras=tuple(cameras))

    scenario = still(handheld(8.0))
    simulations = simulate(scenario, 1), simulate(second(scenario), 2)
    rig = rig_of(simulations[0]).with_(imu=None)
    recordings = [s.measurements.without("imu0") for s in simulations]
    both, alone = calibrate_measurements(rig, recordings), calibrate_measurements(rig, recordings[:1])
    assert both.converged, both.status
    assert len(both.trajectory.seconds) == sum(len(m.cameras[0].stamps_ns) for m in recordings)
    counts = np.bincount(both.recording_of(both.trajectory.seconds))
    assert counts.tolist() == [len(m.cameras[0].stamps_ns) for m in recordings]
    g, truth = both.group("cam0", "intrinsics"), simulations[0].truth.values["cam0"]["intrinsics"]
    assert np.abs((g.value - truth) / g.std_formal).max() < 4.0
    assert (g.std_formal < 0.9 * alone.group("cam0", "intrinsics").std_formal).all()


def test_a_recording_that_shows_too_little_is_named(noisy):
    """The first guess needs motion, and a chain needs three images within the recording of the IMU."""
    first, other = (s.measurements for s in noisy)
    short = dataclasses.replace(other.with_streams(*(only(c, 0, 15) for c in other.cameras)), name="short")
    with pytest.raises(EstimationError, match=r"^short: cam0: only \d+ pairs of consecutive images"):
        calibrate_measurements(rig_of(noisy[0]), [first, short])


def only(c: CornerStream, first: int, end: int) -> CornerStream:
    """Images first..end."""
    own = slice(c.start[first], c.start[end])
    return CornerStream(c.name, c.stamps_ns[first:end], c.start[first : end + 1] - own.start, c.point[own], c.uv[own])


def test_no_recording_is_refused(noisy):
    with pytest.raises(RecordingError, match="no recording was given"):
        calibrate_measurements(rig_of(noisy[0]), [])


def test_a_recording_on_wheels_needs_another():
    """Turning about one axis alone gives no guess, even where it shows most; beside a recording in hand it counts."""
    still = handheld(12.0, noiseless=True)
    wheels = simulate(dataclasses.replace(still, motion=dataclasses.replace(still.motion, kind="single_axis")), 3)
    hand = simulate(second(handheld(9.0, noiseless=True)), 4)
    rig = rig_for(hand.scenario)
    with pytest.raises(EstimationError, match="turned about one axis only"):
        calibrate_measurements(rig, wheels.measurements)
    result = calibrate_measurements(rig, [wheels.measurements, hand.measurements])
    assert result.converged, result.status
    for camera, T in hand.truth.T_imu_sensor.items():
        np.testing.assert_allclose(result.T_imu_sensor(camera), T, atol=1e-8)


def test_images_that_outlast_the_imu_are_left_out(noisy):
    """Cameras of the first recording ran on for seconds, those of the second began earlier; none goes astray."""
    first, other = (s.measurements for s in noisy)
    early, late = first.imu.stamps_ns < first.imu.stamps_ns[0] + 9 * 10**9, other.imu.seconds > 2.0
    cut = [
        m.with_streams(ImuStream("imu0", m.imu.stamps_ns[k], m.imu.gyro[k], m.imu.accel[k]))
        for m, k in ((first, early), (other, late))
    ]
    result = calibrate_measurements(rig_of(noisy[0]), cut)
    error, _ = errors(result, noisy[0].truth)
    assert np.abs(error[:6]).max() < 5e-3
    for residuals in result.corner_residuals:
        assert (np.diff(residuals.seconds) > 0.0).all()
        recording = result.recording_of(residuals.seconds)
        camera = int(residuals.sensor[-1])
        assert np.bincount(recording).tolist() == [len(m.cameras[camera].stamps_ns) for m in cut]
        unseen = np.add.reduceat(residuals.rejected, residuals.start[:-1]) == np.diff(residuals.start)
        assert 90 < unseen.sum() < 110
    assert names(result.notes).count("images_outside_imu") == 2


@pytest.mark.full
def test_three_recordings_share_bloom_and_bow():
    """What is of the target or of its image is the same in all, whichever way the target leans."""
    seconds = (9.0, 8.0, 7.0)
    scenarios = [handheld(s) if k == 0 else second(handheld(s)) for k, s in enumerate(seconds)]
    bow, blooms = (1.0e-3, -0.5e-3, 0.7e-3), (0.25, 0.30)
    simulations = []
    for k, scenario in enumerate(scenarios):
        cameras = tuple(dataclasses.replace(c, bloom_px=b) for c, b in zip(scenario.cameras, blooms, strict=True))
        simulations.append(simulate(dataclasses.replace(scenario, cameras=cameras, bow=bow, blur_s=3e-4), 20 + k))
    rig = rig_of(simulations[0])
    cameras = tuple(dataclasses.replace(c, corner_noise_px=None) for c in rig.cameras)
    settings = dataclasses.replace(rig.settings, segments=6, common_error=True)
    result = joint(tuple(simulations), rig.with_(cameras=cameras, settings=settings))
    assert result.converged, result.status
    shape = result.group("board0", "shape")
    assert np.abs((shape.value[:3] - np.array(bow)) / shape.std_formal[:3]).max() < 4.0
    for camera, bloom in zip(("cam0", "cam1"), blooms, strict=True):
        found = result.group(camera, "bloom")
        assert abs(found.value[0] - bloom) < 4.0 * found.std_formal[0]
    error, columns = errors(result, simulations[0].truth)
    low, high = chi2.ppf([0.0005, 0.9995], len(error))
    assert low < error @ np.linalg.solve(result.covariance[np.ix_(columns, columns)], error) < high
    assert "recording_too_short" not in names(result.warnings)
    assert [g.sensor for g in result.groups if g.name == "tilt"] == [
        "board0",
        "board0 in recording 2",
        "board0 in recording 3",
    ]
