"""Motion capture and odometry, with an IMU alone and beside a camera, from nothing: recovery, NEES, planar motion."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from tests.remarks import named
from tests.typed import not_none

from icalib.data.measurements import PoseStream
from icalib.errors import EstimationError
from icalib.pipeline import calibrate_measurements
from icalib.result import relative_poses
from icalib.sensors.pose.simulate import SimPoses
from icalib.tools.montecarlo.record import error, true_value
from icalib.tools.simulation import Drive, Room, Scenario, handheld, rig_for, simulate
from icalib.tools.simulation.trajectory import DriveKind

ROOM = Room((8.0, 6.0, 3.0))
NOISE = {"absolute": (2e-3, 1e-3), "relative": (5e-3, 1e-2)}
BLOCKS = ("rotation", "translation", "time_offset")


def pose(vector, position):
    T = np.eye(4)
    T[:3, :3], T[:3, 3] = Rotation.from_rotvec(vector).as_matrix(), position
    return T


def sensor(kind, name="mocap0", **others):
    """With a clock of its own; its frame is tilted against gravity."""
    turn, way = NOISE[kind]
    return SimPoses(
        name,
        pose([0.3, -0.5, 1.0], [0.1, -0.2, 0.15]),
        kind=kind,
        T_world_frame=pose([0.2, 0.1, 2.0], [3.0, -1.0, 0.5]),
        **({"time_offset_s": 0.0123, "clock_origin_ns": 777, "phase_s": 0.003} | others),
        rotation_noise=turn,
        position_noise=way,
    )


def alone(kind, motion: DriveKind = "free", **others):
    drive = Drive(motion)
    return Scenario((), duration_s=12.0, motion=drive, board=False, room=ROOM, sensors=(sensor(kind),), **others)


def errors(result, truth, name):
    """Of rotation [rad], translation [m], time offset [s]."""
    values = (result.group(name, b).value for b in BLOCKS)
    return [error(b, v, not_none(true_value(truth, name, b))) for b, v in zip(BLOCKS, values, strict=True)]


def without_noise(rig):
    """Noise to be found from the residuals."""
    return rig.with_(poses=tuple(replace(p, rotation_noise=None, position_noise=None) for p in rig.poses))


@pytest.mark.parametrize("kind", ["absolute", "relative"])
def test_without_noise_it_is_recovered(kind):
    scenario = alone(kind, imu_noise_enabled=False, robot_noise_enabled=False, imu_rate_hz=1000.0)
    sim = simulate(scenario, 1)
    result = calibrate_measurements(rig_for(scenario), sim.measurements)
    turn, way, late = errors(result, sim.truth, "mocap0")
    assert result.converged
    assert np.abs(turn).max() < 2e-7 and np.abs(way).max() < 2e-7 and np.abs(late).max() < 2e-7
    assert result.unobservable == ()


@pytest.mark.parametrize("kind", ["absolute", pytest.param("relative", marks=pytest.mark.full)])
def test_beside_a_camera_it_is_recovered(kind):
    """The target gives the motion, the world is the target's; frames still are anywhere. Poses are taken at stamps of
    the IMU: between these the simulated rates are constant, and the scheme takes them to be linear."""
    poses = (sensor(kind, clock_origin_ns=10**18, rate_hz=50.0, phase_s=0.0),)
    scenario = replace(handheld(8.0, noiseless=True), sensors=poses)
    scenario = replace(scenario, robot_noise_enabled=False, cameras=scenario.cameras[:1])
    sim = simulate(scenario, 1)
    result = calibrate_measurements(rig_for(scenario), sim.measurements)
    turn, way, late = errors(result, sim.truth, "mocap0")
    assert np.abs(turn).max() < 2e-7 and np.abs(way).max() < 2e-7 and np.abs(late).max() < 2e-7
    assert [r.name for r in relative_poses(result)] == ["T_cam0_mocap0"]


@pytest.mark.full
@pytest.mark.parametrize("kind", ["absolute", "relative"])
def test_errors_are_as_the_covariance_says(kind, consistency):
    """Six seeds, noise found from the residuals; 20 seeds by hand gave 0.98 and 1.04 per degree of freedom."""
    scenario = alone(kind)
    found = consistency(scenario, without_noise(rig_for(scenario)), range(6), 1.0 - 1e-4, BLOCKS)
    for name, nees in found.items():
        assert nees.consistent, f"{name}: {nees}"


def test_noise_is_found_and_said():
    scenario = alone("absolute")
    sim = simulate(scenario, 3)
    result = calibrate_measurements(without_noise(rig_for(scenario)), sim.measurements)
    fits = {f.kind: f for f in result.fits if f.sensor == "mocap0"}
    for kind, size in (("rotation", 2e-3), ("position", 1e-3)):
        assert fits[kind].rms == pytest.approx(size, rel=0.05)
        assert fits[kind].chi2_per_dof == pytest.approx(1.0, abs=0.05)
    (r,) = result.pose_residuals
    assert r.whitened.std() == pytest.approx(1.0, abs=0.05)
    np.testing.assert_allclose(r.residual[:, 3:].std(), 1e-3, rtol=0.06)
    words = named("pose_noise_used", result.notes)
    assert "as residuals show it" in words and "0.11" in words
    assert not any("mocap0" in w for w in result.warnings)


def test_poses_that_alternate_or_drift_are_named():
    """Poses with white noise taken for steps, and a drift taken for noise."""
    for kind, name in (
        ("absolute", "relative_poses_alternate"),
        ("relative", "poses_filtered_or_drifting"),
    ):
        scenario = alone(kind)
        sim = simulate(scenario, 2)
        rig = without_noise(rig_for(scenario))
        other = {"absolute": "relative", "relative": "absolute"}[kind]
        rig = rig.with_(poses=(replace(rig.poses[0], kind=other),))
        result = calibrate_measurements(rig, sim.measurements)
        assert any(w.name == name and f"kind: {kind}" in w for w in result.warnings), (kind, result.warnings)


def test_planar_motion_leaves_height_open():
    """About one axis the lever arm along it and the frame's height are one; the rest is right."""
    scenario = alone("absolute", "planar")
    sim = simulate(replace(scenario, duration_s=20.0), 4)
    result = calibrate_measurements(rig_for(scenario), sim.measurements)
    assert result.unobservable
    assert all("mocap0 translation" in s for s in result.unobservable)
    turn, way, late = errors(result, sim.truth, "mocap0")
    assert np.abs(way[:2]).max() < 6e-3 and np.abs(late).max() < 1e-3
    rotation, translation = result.group("mocap0", "rotation"), result.group("mocap0", "translation")
    assert (np.abs(turn) < 4.0 * rotation.std).all() and rotation.std.max() < 5e-3
    assert translation.verdict[2] == "unobservable"
    assert translation.std[2] == pytest.approx(0.5, rel=0.05)  # what a place that nobody guessed is worth
    assert way[2] == pytest.approx(-0.15, abs=0.01)  # held where nobody said anything: at 0


def test_two_of_them_and_one_gives_the_motion():
    mocap = sensor("absolute")
    odom = replace(sensor("relative", "odom0", rate_hz=20.0), T_imu_sensor=pose([0.0, 0.4, -0.3], [-0.2, 0.1, 0.0]))
    scenario = replace(alone("absolute"), sensors=(mocap, odom))
    sim = simulate(scenario, 6)
    result = calibrate_measurements(rig_for(scenario), sim.measurements)
    for name in ("mocap0", "odom0"):
        for block, e in zip(BLOCKS, errors(result, sim.truth, name), strict=True):
            assert (np.abs(e) < 4.0 * result.group(name, block).std).all(), (name, block)


@pytest.mark.full
def test_two_recordings_share_what_is_calibrated():
    """Each has a world and a frame of its own; the frame was put up anew in between."""
    scenario = replace(handheld(6.0), sensors=(sensor("absolute", clock_origin_ns=10**18, rate_hz=50.0),))
    scenario = replace(scenario, cameras=scenario.cameras[:1])
    (mocap,) = scenario.of(SimPoses)
    other = scenario.with_sensors(replace(mocap, T_world_frame=pose([0.0, -0.3, 1.0], [0, 1, 2])))
    sims = [simulate(scenario, 1), simulate(other, 2)]
    both = calibrate_measurements(rig_for(scenario), [s.measurements for s in sims])
    one = calibrate_measurements(rig_for(scenario), sims[0].measurements)
    for block, e in zip(BLOCKS, errors(both, sims[0].truth, "mocap0"), strict=True):
        std = both.group("mocap0", block).std
        assert (np.abs(e) < 4.0 * std).all() and (std < one.group("mocap0", block).std).all(), block


@pytest.mark.parametrize("kind", ["absolute", pytest.param("relative", marks=pytest.mark.full)])
def test_two_recordings_without_any_other_sensor(kind):
    """The shorter one first; its frame stands elsewhere, and its clocks began at another time."""
    scenario = alone(kind)
    short = replace(scenario, duration_s=8.0)
    if kind == "absolute":
        (mocap,) = short.of(SimPoses)
        short = short.with_sensors(replace(mocap, T_world_frame=pose([0.0, -0.3, 1.0], [0, 1, 2])))
    sims = [simulate(short, 3), simulate(scenario, 4)]
    both = calibrate_measurements(rig_for(scenario), [s.measurements for s in sims])
    one = calibrate_measurements(rig_for(scenario), sims[1].measurements)
    assert both.converged and len(both.recordings) == 2
    for block, e in zip(BLOCKS, errors(both, sims[1].truth, "mocap0"), strict=True):
        std, own = (c.group("mocap0", block).std for c in (both, one))
        assert (np.abs(e) < 4.0 * std).all() and (std < 1.05 * own).all(), block


def cut(sim, stream: PoseStream):
    return sim.measurements.with_streams(stream)


def test_what_cannot_be_calibrated_is_said():
    scenario = alone("absolute")
    sim = simulate(scenario, 1)
    rig, (stream,) = rig_for(scenario), sim.measurements.poses
    other = simulate(scenario, 2).measurements.poses[0]
    with pytest.raises(EstimationError, match="mocap0 does not match that of imu0 at any time offset[^/]*$"):
        calibrate_measurements(rig, cut(sim, other))
    still = PoseStream("mocap0", stream.stamps_ns, np.tile(np.eye(3), (len(stream.stamps_ns), 1, 1)), stream.position)
    with pytest.raises(EstimationError, match="its rotation is the same in all poses"):
        calibrate_measurements(rig, cut(sim, still))
    sparse = PoseStream("mocap0", stream.stamps_ns[::100], stream.rotation[::100], stream.position[::100])
    with pytest.raises(EstimationError, match="pairs of its 12 poses"):
        calibrate_measurements(rig, cut(sim, sparse))
    large = PoseStream("mocap0", stream.stamps_ns, stream.rotation, 3.28 * stream.position)
    with pytest.raises(EstimationError, match=r"its motion to be 0\.3\d \+- 0\.0\d times as large as its positions"):
        calibrate_measurements(rig, cut(sim, large))
    in_g = replace(not_none(sim.measurements.imu), accel=not_none(sim.measurements.imu).accel / 9.81)
    with pytest.raises(EstimationError, match=r"give a gravity of [\d.]* m/s\^2 instead of 9.81; check that the acc"):
        calibrate_measurements(rig, sim.measurements.with_streams(in_g))
    bad = replace(cut(sim, other), name="second")
    with pytest.raises(EstimationError, match="second: .*mocap0 does not turn as imu0 does"):
        calibrate_measurements(rig, [replace(sim.measurements, name="first"), bad])
