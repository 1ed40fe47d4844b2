"""A position sensor from nothing: time offset, attitude, biases and lever arm by the fixes and the IMU alone."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.interpolate import CubicSpline
from scipy.spatial.transform import Rotation
from tests.typed import not_none

from icalib.data.measurements import ImuStream
from icalib.errors import EstimationError
from icalib.initialize.initializer import KnownExtrinsics
from icalib.initialize.rate_correlation import closest_of_equals
from icalib.motion.imu_data import ImuData
from icalib.motion.poses import EstimatedMotion
from icalib.optim.state import State
from icalib.sensors.imu.spec import class_noise
from icalib.sensors.position.frame import PositionFrame
from icalib.sensors.position.initialize import KnownPlace, motion_from_fixes, place
from icalib.sensors.position.initialize.attitude import Fix
from icalib.sensors.position.simulate import SimPositions
from icalib.sensors.position.stream import PositionStream
from icalib.tools.simulation import Drive, Room, Scenario, simulate
from icalib.tools.simulation.room import hills_of_slope

ARM = np.array([0.4, -0.25, 0.6])
FRAME_YAW, ORIGIN = 2.1, np.array([3.0, -1.0, 0.5])
GRAVITY = 9.81


def yaw(angle):
    c, s = np.cos(angle), np.sin(angle)
    return np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])


def recording(motion, seed):
    room = Room((30.0, 20.0, 6.0), hills=hills_of_slope(12.0) if motion == "ramps" else None)
    T_imu_sensor, T_world_frame = np.eye(4), np.eye(4)
    T_imu_sensor[:3, 3] = ARM
    T_world_frame[:3, :3], T_world_frame[:3, 3] = yaw(FRAME_YAW), ORIGIN
    gnss = SimPositions("gnss0", T_imu_sensor, 7.3, 5.0, 0.5, T_world_frame=T_world_frame)
    return simulate(Scenario((), duration_s=40.0, motion=Drive(motion), board=False, room=room, sensors=(gnss,)), seed)


@pytest.fixture(scope="module", params=["free", "ramps"])
def world(request):
    """40 s at 5 Hz with 2 cm of noise: the simulated recording, the IMU's readings, fixes, their instants, and the true
    offset to the IMU's clock since the first stamps."""
    sim = recording(request.param, 3)
    scenario = sim.scenario
    imu = ImuData.build(not_none(sim.measurements.imu), scenario.imu_noise)
    (stream,) = sim.measurements.of(PositionStream)
    t = sim.truth.reported["gnss0"].seconds
    return sim, imu, Fix(stream.seconds, stream.position), t, float(t[0] - sim.truth.seconds[0])


def test_everything_from_fixes_and_readings(world):
    sim, imu, fix, t, offset = world
    found = motion_from_fixes(imu, "gnss0", fix, GRAVITY, KnownExtrinsics())
    assert found.best.at.offset == pytest.approx(offset, abs=0.02)
    planar = 0.3 if sim.scenario.motion.kind == "ramps" else 0.08
    np.testing.assert_allclose(found.best.at.arm, ARM, atol=planar)
    R, p, v, bias = found.at(t - sim.truth.seconds[0])
    R_true, p_true, v_true = sim.truth.pose_at(t)
    off = yaw(FRAME_YAW) @ R @ R_true.transpose(0, 2, 1)
    assert np.degrees(np.arccos((np.trace(off, axis1=1, axis2=2) - 1.0) / 2.0)).max() < 4.0
    np.testing.assert_allclose(p @ yaw(FRAME_YAW).T + ORIGIN, p_true, atol=0.5)
    assert np.median(np.abs(v @ yaw(FRAME_YAW).T - v_true)) < 0.15
    assert bias.shape == (len(t), 6)


@pytest.mark.parametrize("noise", [0.02, 0.4])
def test_a_robot_that_turns_on_the_spot(noise):
    """The antenna moves by its lever arm alone, in whichever direction: the heading of the frame is not known."""
    T_imu_sensor = np.eye(4)
    T_imu_sensor[:3, 3] = ARM
    gnss = SimPositions("gnss0", T_imu_sensor, time_offset_s=0.3, position_noise=noise)
    made = Scenario(
        (), duration_s=40.0, motion=Drive("spin"), board=False, room=Room((30.0, 20.0, 6.0)), sensors=(gnss,)
    )
    sim = simulate(made, 1)
    imu = ImuData.build(not_none(sim.measurements.imu), made.imu_noise)
    (stream,) = sim.measurements.of(PositionStream)
    same_clock = 1e-9 * (stream.origin_ns - not_none(sim.measurements.imu).origin_ns)
    fix = Fix(stream.seconds, stream.position, same_clock)
    if noise > 0.1:
        with pytest.raises(EstimationError, match=r"too noisy for imu0 alone: 0\.\d+ m at 5 Hz .* (wheels|odometry)"):
            motion_from_fixes(imu, "gnss0", fix, GRAVITY, KnownExtrinsics())
        return
    best = motion_from_fixes(imu, "gnss0", fix, GRAVITY, KnownExtrinsics()).best.at
    offset = float(sim.truth.reported["gnss0"].seconds[0] - sim.truth.seconds[0])
    assert best.offset == pytest.approx(offset, abs=0.03)
    assert np.linalg.norm(best.arm[:2]) == pytest.approx(np.linalg.norm(ARM[:2]), abs=0.05)


def test_noise_is_averaged_over_longer_triples():
    """0.4 m of noise makes 1 m/s^2 over a second, more than the robot reaches."""
    sim = recording("planar", 1)
    (stream,) = sim.measurements.of(PositionStream)
    imu = ImuData.build(not_none(sim.measurements.imu), sim.scenario.imu_noise)
    noise = 0.4 * np.random.default_rng(0).normal(size=stream.position.shape)
    fix = Fix(stream.seconds, stream.position + noise)
    assert np.median(fix.triples.half) > 3.0
    best = motion_from_fixes(imu, "gnss0", fix, GRAVITY, KnownExtrinsics()).best.at
    np.testing.assert_allclose(best.arm[:2], ARM[:2], atol=0.5)


def test_the_offset_of_one_clock_wins_among_equals():
    fits = [(0.0130, -29.96, "a period early"), (0.0137, 0.04, "one clock"), (0.5, 0.0, "no fit")]
    assert closest_of_equals(fits, 0.0, 0.01) == "one clock"
    assert closest_of_equals([], 0.0, 0.01) is None


def test_what_is_known_stays(world):
    _, imu, fix, _, offset = world
    found = motion_from_fixes(imu, "gnss0", fix, GRAVITY, KnownExtrinsics(position=ARM, offset=offset))
    np.testing.assert_allclose(found.best.at.arm, ARM, atol=5e-3)
    assert found.best.at.offset == pytest.approx(offset, abs=5e-3)


@pytest.mark.parametrize("levelled", [True, False])
def test_placed_on_a_known_motion(world, levelled):
    sim, imu, fix, _, offset = world
    keyframes = np.arange(0.2, imu.seconds[-1] - 0.2, 0.1)
    bias = np.tile(np.concatenate([sim.truth.gyro_bias[0], sim.truth.accel_bias[0]]), (len(keyframes), 1))
    values = {("imu0", "intrinsics"): sim.truth.values["imu0"]["intrinsics"]}
    R, p, v = sim.truth.pose_at(keyframes + sim.truth.seconds[0])
    state = State(keyframes, R, p, v, bias, values)
    found = place(EstimatedMotion(state, imu, GRAVITY, 0.5), "gnss0", fix, KnownPlace(levelled))
    assert found.offset == pytest.approx(offset, abs=0.01)
    planar = 0.1 if sim.scenario.motion.kind == "ramps" else 0.04
    np.testing.assert_allclose(found.arm, ARM, atol=planar)
    np.testing.assert_allclose(found.R_wf, yaw(FRAME_YAW), atol=0.02)
    np.testing.assert_allclose(found.p_wf, ORIGIN, atol=planar + 0.1)


def other_path(n):
    """(n, 3) of a smooth random path at 5 Hz."""
    rng = np.random.default_rng(4)
    knots = rng.normal(size=(n // 8 + 4, 3)) * [4.0, 4.0, 0.4]
    return CubicSpline(8.0 * np.arange(len(knots)), knots)(np.arange(n))


@pytest.mark.parametrize("frame", [None, PositionFrame(yaw(FRAME_YAW), ORIGIN, ())], ids=["own", "shared"])
def test_placed_on_a_rig_that_turns_in_place(frame):
    """A camera before a target: the antenna moves by its lever arm more than the rig does."""
    known = KnownPlace(frame is None, frame=frame)
    seconds = np.arange(0.0, 30.0, 0.005)
    angle = np.stack([0.5 * np.sin(1.1 * seconds), 0.4 * np.sin(1.7 * seconds), 0.9 * np.sin(0.6 * seconds)], axis=1)
    R = Rotation.from_rotvec(angle).as_matrix()
    turn = R[:-1].transpose(0, 2, 1) @ R[1:]
    rate = Rotation.from_matrix(turn).as_rotvec() / 0.005
    gyro = np.vstack([rate[:1], 0.5 * (rate[1:] + rate[:-1]), rate[-1:]])
    accel = np.ascontiguousarray(R.transpose(0, 2, 1) @ [0.0, 0.0, GRAVITY])
    stream = ImuStream("imu0", np.round(1e9 * seconds).astype(np.int64), gyro, accel)
    imu = ImuData.build(stream, class_noise("consumer"))
    keyframes = seconds[100:-100:20].copy()
    still = np.zeros((len(keyframes), 3))
    values = {("imu0", "intrinsics"): np.zeros(24)}
    state = State(keyframes, R[100:-100:20].copy(), still, still, np.zeros((len(keyframes), 6)), values)
    k = np.arange(200, 5800, 40)
    position = (R[k] @ ARM - ORIGIN) @ yaw(FRAME_YAW) + 0.005 * np.random.default_rng(1).normal(size=(len(k), 3))
    found = place(EstimatedMotion(state, imu, GRAVITY, 0.5), "gnss0", Fix(seconds[k] - seconds[k[0]], position), known)
    assert found.offset == pytest.approx(seconds[k[0]], abs=5e-3)
    np.testing.assert_allclose(found.arm, ARM, atol=0.01)
    np.testing.assert_allclose(found.R_wf, yaw(FRAME_YAW), atol=0.02)


@pytest.mark.parametrize(
    ("change", "sentence"),
    [
        (lambda p: other_path(len(p)), "at any time offset"),
        (lambda p: p[:, [1, 0, 2]].copy(), "where east and north are swapped"),
        (lambda p: np.zeros_like(p) + 0.001 * np.arange(len(p))[:, None], "motionless or move evenly"),
        (lambda p: 0.02 * np.random.default_rng(2).normal(size=p.shape), "motionless or move evenly"),
        (lambda p: p[:5], "groups of three fixes"),
    ],
)
def test_fixes_that_do_not_fit(world, change, sentence):
    """Of another vehicle, with east and north swapped, at rest, and too few."""
    _, imu, fix, _, _ = world
    position = change(fix.position)
    with pytest.raises(EstimationError, match=sentence):
        motion_from_fixes(
            imu, "gnss0", replace(fix, t=fix.t[: len(position)], position=position), GRAVITY, KnownExtrinsics()
        )


def test_fixes_in_another_frame_than_they_are_said_to_share(world):
    sim, imu, fix, _, _ = world
    keyframes = np.arange(0.2, imu.seconds[-1] - 0.2, 0.1)
    R, p, v = sim.truth.pose_at(keyframes + sim.truth.seconds[0])
    state = State(
        keyframes,
        R,
        p,
        v,
        np.zeros((len(keyframes), 6)),
        {("imu0", "intrinsics"): sim.truth.values["imu0"]["intrinsics"]},
    )
    known = KnownPlace(False, frame=PositionFrame(yaw(FRAME_YAW + 1.0), ORIGIN, ()))
    with pytest.raises(EstimationError, match="of their spread; .*in the frame that the rig file names"):
        place(EstimatedMotion(state, imu, GRAVITY, 0.5), "gnss0", fix, known)
    upright = replace(fix, position=fix.position[:, [0, 2, 1]] * [1.0, -1.0, 1.0])
    with pytest.raises(EstimationError, match="write frame: tilted if z of its frame does not point up"):
        place(EstimatedMotion(state, imu, GRAVITY, 0.5), "gnss0", upright, KnownPlace(True))
