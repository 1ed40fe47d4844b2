"""Motions of a robot: readings against numerical derivatives, and that each motion is what it is called."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from tests.cases import each
from tests.typed import not_none

from icalib.errors import RecordingError, RigError
from icalib.sensors.wheels.simulate import SimWheels
from icalib.tools.simulation import Drive, Room, hills_of_slope, simulate
from icalib.tools.simulation.trajectory import Jet

from .conftest import alone, on_ground, turn, wheel_path

GRAVITY = np.array([0.0, 0.0, -9.81])
GROUND = ("planar", "ramps", "constant-velocity", "straight-line", "standing", "arc", "spin")
STEP_S = 1e-4


def simulated(robot, kind, duration_s=4.0, seed=1, **motion):
    scenario = on_ground(robot, kind, **motion) if kind in GROUND else replace(robot, motion=Drive(kind, **motion))
    return simulate(replace(alone(scenario), duration_s=duration_s), seed)


def write_tum(path, seconds, rotation, position):
    """A TUM file; the quaternion of each rotation from the axis and the angle of R - R^T."""
    lines = ["# t x y z qx qy qz qw"]
    for t, R, p in zip(seconds, rotation, position, strict=True):
        w = 0.5 * np.sqrt(1.0 + np.trace(R))
        v = np.array([R[2, 1] - R[1, 2], R[0, 2] - R[2, 0], R[1, 0] - R[0, 1]]) / (4.0 * w)
        lines.append(" ".join([f"{t:.9f}", *(repr(float(x)) for x in (*p, *v, w))]))
    path.write_text("\n".join(lines) + "\n")
    return path


def swing(seconds):
    """A motion of below 1 Hz, and its pose: rotation about a fixed axis, position on an ellipse."""
    angle = 0.8 * np.sin(2.0 * np.pi * 0.4 * seconds)
    rotation = np.array([turn([1.0, 2.0, 3.0], a) for a in angle])
    position = np.stack([np.sin(2.0 * seconds), 0.5 * np.cos(2.0 * seconds), 1.0 + 0.2 * np.sin(3.0 * seconds)], axis=1)
    return rotation, position


@pytest.fixture(scope="module")
def swing_file(tmp_path_factory):
    seconds = np.arange(0.0, 6.0, 0.02)
    return write_tum(tmp_path_factory.mktemp("tum") / "swing.tum", seconds + 1.7e9, *swing(seconds))


@each("kind", ["free", "single-axis", *GROUND, "recorded"])
def test_readings_are_derivatives_of_the_pose(robot, kind, swing_file):
    only_of: dict[str, dict[str, Any]] = {"recorded": {"path": swing_file}, "arc": {"sideslip_deg": 1.0}}
    sim = simulated(robot, kind, **only_of.get(kind, {}))
    t = sim.truth.seconds[30:-30:37]
    R, _, v = sim.truth.pose_at(t)
    (R0, p0, v0), (R1, p1, v1) = sim.truth.pose_at(t - STEP_S), sim.truth.pose_at(t + STEP_S)
    spin = np.einsum("nji,njk->nik", R, (R1 - R0) / (2.0 * STEP_S))
    rate = np.stack([spin[:, 2, 1], spin[:, 0, 2], spin[:, 1, 0]], axis=1)
    force = np.einsum("nji,nj->ni", R, (v1 - v0) / (2.0 * STEP_S) - GRAVITY)
    np.testing.assert_allclose((p1 - p0) / (2.0 * STEP_S), v, atol=1e-6)
    np.testing.assert_allclose(not_none(sim.measurements.imu).gyro[30:-30:37], rate, atol=1e-5)
    np.testing.assert_allclose(not_none(sim.measurements.imu).accel[30:-30:37], force, atol=1e-5)
    np.testing.assert_allclose(sim.truth.trajectory.rate_at(t), rate, atol=1e-5)
    np.testing.assert_allclose(np.swapaxes(R, 1, 2) @ R, np.broadcast_to(np.eye(3), R.shape), atol=1e-12)


@each("kind", GROUND)
def test_wheels_do_not_slide(robot, kind):
    sim = simulated(robot, kind)
    t = np.linspace(0.1, 3.9, 200)
    T = sim.scenario.of(SimWheels)[0].T_imu_sensor
    R, p = wheel_path(sim.truth, T, t)
    velocity = (wheel_path(sim.truth, T, t + STEP_S)[1] - wheel_path(sim.truth, T, t - STEP_S)[1]) / (2.0 * STEP_S)
    local = np.einsum("nji,nj->ni", R, velocity)
    np.testing.assert_allclose(local[:, 1:], 0.0, atol=2e-8)
    height = not_none(not_none(sim.scenario.room).hills).height(p[:, :2]) if kind == "ramps" else 0.0
    np.testing.assert_allclose(p[:, 2], height, atol=1e-12)


def test_sideslip_slides_by_its_angle(robot):
    sim = simulated(robot, "planar", duration_s=20.0, sideslip_deg=2.0)
    t = np.linspace(0.1, 19.9, 2000)
    T = sim.scenario.of(SimWheels)[0].T_imu_sensor
    velocity = (wheel_path(sim.truth, T, t + STEP_S)[1] - wheel_path(sim.truth, T, t - STEP_S)[1]) / (2.0 * STEP_S)
    local = np.einsum("nji,nj->ni", wheel_path(sim.truth, T, t)[0], velocity)
    angle = np.rad2deg(np.arctan2(local[:, 1], local[:, 0]))
    assert 1.5 < np.abs(angle).max() <= 2.0 + 1e-6
    assert abs(angle.mean()) < 0.2


def test_each_motion_is_what_it_is_called(robot):
    found = {kind: simulated(robot, kind, duration_s=30.0, seed=3) for kind in ("free", "single-axis", *GROUND)}
    T = robot.of(SimWheels)[0].T_imu_sensor
    paths = {kind: wheel_path(sim.truth, T, sim.truth.seconds) for kind, sim in found.items()}
    rates = {kind: not_none(sim.measurements.imu).gyro for kind, sim in found.items()}
    spread = {kind: np.ptp(position, axis=0) for kind, (_, position) in paths.items()}
    up = T[:3, 2]  # the wheel frame's z in imu axes

    assert (spread["free"] > 0.5).all() and (rates["free"].std(axis=0) > 0.2).all()
    axis = np.array(found["single-axis"].scenario.motion.axis_imu)
    np.testing.assert_allclose(np.cross(rates["single-axis"], axis), 0.0, atol=1e-9)
    assert (np.ptp(found["single-axis"].truth.position, axis=0) > 0.5).all() and rates["single-axis"].std() > 0.2

    for kind in ("planar", "arc", "spin", "straight-line", "constant-velocity", "standing"):
        np.testing.assert_allclose(np.cross(rates[kind], up), 0.0, atol=1e-9)
        assert spread[kind][2] < 1e-12
    assert (spread["planar"][:2] > 3.0).all() and (rates["planar"] @ up).min() < -0.3 < 0.3 < (
        rates["planar"] @ up
    ).max()
    tilt = np.rad2deg(np.arccos(paths["ramps"][0][:, 2, 2]))
    assert 7.0 < tilt.max() <= 12.0 and spread["ramps"][2] > 0.15

    clock = found["arc"].truth.seconds
    speed = {kind: np.linalg.norm(np.gradient(paths[kind][1], clock, axis=0), axis=1)[1:-1] for kind in found}
    np.testing.assert_allclose(rates["arc"] @ up, (rates["arc"] @ up)[0], atol=1e-9)
    np.testing.assert_allclose(speed["arc"], 0.5, atol=1e-6)
    assert spread["spin"][:2].max() < 1e-9 and np.ptp(rates["spin"] @ up) > 1.0
    for kind in ("straight-line", "constant-velocity", "standing"):
        np.testing.assert_allclose(rates[kind], 0.0, atol=1e-12)
    assert np.linalg.matrix_rank(paths["straight-line"][1] - paths["straight-line"][1][0], tol=1e-8) == 1
    forwards = np.gradient(paths["straight-line"][1] @ paths["straight-line"][0][0, :, 0], clock)
    assert forwards.min() < -0.3 < 0.3 < forwards.max()
    np.testing.assert_allclose(speed["constant-velocity"], speed["constant-velocity"][0], atol=1e-9)
    assert speed["constant-velocity"][0] > 0.2
    assert spread["standing"].max() < 1e-12


@each("kind", ["free", "single-axis", *GROUND])
@each("seed", [1], full=[2, 3])
def test_the_robot_stays_in_its_room_clear_of_the_blocks(robot, kind, seed):
    position = simulated(robot, kind, duration_s=60.0, seed=seed).truth.position
    assert (np.abs(position[:, 0]) < 5.6).all() and (np.abs(position[:, 1]) < 4.6).all()
    assert (position[:, 2] > 0.0).all() and (position[:, 2] < 3.0).all()
    for block in robot.room.blocks:
        assert (np.linalg.norm(position[:, :2] - block.center, axis=1) > np.hypot(*block.size[:2]) / 2.0).all()


def test_motion_seed_holds_the_motion(robot):
    free = replace(robot, motion=Drive("planar"), features=None, sensors=())
    held = replace(free, motion=Drive("planar", seed=5))
    np.testing.assert_array_equal(simulate(held, 1).truth.position, simulate(held, 2).truth.position)
    assert np.abs(simulate(free, 1).truth.position - simulate(free, 2).truth.position).max() > 0.1


@pytest.mark.parametrize("form", ["tum", "euroc"])
def test_a_recorded_motion_goes_through_its_poses(robot, swing_file, tmp_path, form):
    path = swing_file
    if form == "euroc":
        rows = np.loadtxt(swing_file)
        stamps = [int(line.split()[0].replace(".", "")) for line in swing_file.read_text().splitlines()[1:]]
        path = tmp_path / "data.csv"
        lines = ["#timestamp, p_x, p_y, p_z, q_w, q_x, q_y, q_z, v_x, v_y, v_z"]
        for stamp, (x, y, z, qx, qy, qz, qw) in zip(stamps, rows[:, 1:], strict=True):
            sign = -1.0 if stamp % 3 else 1.0  # q and -q are the same rotation
            lines.append(",".join(map(repr, [stamp, x, y, z, *(sign * q for q in (qw, qx, qy, qz)), 0, 0, 0])))
        path.write_text("\n".join(lines).replace("np.float64(", "").replace(")", "") + "\n")
    sim = simulated(robot, "recorded", path=path)
    rotation, position = swing(sim.truth.seconds)
    shift = sim.truth.position - position
    np.testing.assert_allclose(shift, np.broadcast_to(shift.mean(axis=0), shift.shape), atol=1e-4)
    np.testing.assert_allclose(sim.truth.R_world_imu, rotation, atol=1e-4)
    middle = 0.5 * (sim.truth.position.min(axis=0) + sim.truth.position.max(axis=0))
    np.testing.assert_allclose(middle, [0.0, 0.0, 0.45 * 3.2], atol=2e-2)


@each(
    ("content", "words"),
    [
        ("1 0 0 0 0 0 0 1\n2 0 0 0 0 0 0\n", ":2: the line is not t x y z qx qy qz qw"),
        ("1,0,0,0,0,0,0\n", ":1: the line is not t \\[ns\\], x, y, z, qw, qx, qy, qz"),
        ("\n".join(f"{i} 0 0 0 0 0 0 2" for i in range(9)), "unit quaternions"),
        ("1 0 0 0 0 0 0 1\n", "at least 6 poses"),
        ("\n".join(f"{0.1 * (i % 5)} 0 0 0 0 0 0 1" for i in range(9)), "pose 5 is not later"),
        ("\n".join(f"{0.1 * i} 0 0 0 0 0 0 1" for i in range(9)), "0.8 s long; lower the duration of 4 s"),
        ("\n".join(f"{0.9 * i} 0 0 0 0 0 0 1" for i in range(9)), "gap of 0.9 s"),
        ("\n".join(f"{0.1 * i} {i} 0 0 0 0 0 1" for i in range(60)), "leaves the room"),
    ],
)
def test_a_bad_trajectory_is_refused(robot, tmp_path, content, words):
    (tmp_path / "t.tum").write_text(content)
    with pytest.raises(RecordingError, match=words) as caught:
        simulated(robot, "recorded", path=tmp_path / "t.tum")
    assert str(tmp_path / "t.tum") in str(caught.value)
    with pytest.raises(RecordingError, match="cannot be read"):
        simulated(robot, "recorded", path=tmp_path / "absent.tum")


def test_parts_that_do_not_go_together_are_refused(robot):
    rates = (replace(robot.of(SimWheels)[0], reports="rates"),)
    hilly = replace(robot.room, hills=hills_of_slope(10.0))
    for change, words in (
        ({"room": None}, "need a room"),
        ({"motion": Drive("ramps")}, "needs hills"),
        ({"motion": Drive("planar"), "room": hilly}, "needs a flat floor"),
        ({"sensors": rates}, "cannot roll"),
    ):
        with pytest.raises(RigError, match=words):
            replace(robot, **change)
    with pytest.raises(RigError, match="needs a path"):
        Drive("recorded")
    with pytest.raises(RigError, match="block 0 does not fit"):
        Room((2.0, 2.0, 2.0), robot.room.blocks)
    assert SimWheels("wheel0", np.eye(4)).reports == "rates"


def test_jets_have_the_derivatives_of_what_they_compute():
    t, h = np.linspace(0.3, 2.0, 7), 1e-3

    def made(seconds, order):
        x = Jet.time(seconds, order)
        sine, cosine = (2.0 * x * x + 1.0).sine_cosine()
        return (sine * sine + 2.0).sqrt() / (cosine - x - 3.0), x

    f, x = made(t, 4)
    for k in (0, 1, 2):
        value = f.derivative() if k else f
        assert len(value.c) == len(f.c) - bool(k)
    expected = np.sqrt(np.sin(2 * t * t + 1) ** 2 + 2) / (np.cos(2 * t * t + 1) - t - 3)
    np.testing.assert_allclose(f.at(0), expected, rtol=1e-14)
    up, down = (made(t + s * h, 4)[0] for s in (1, -1))
    for k in (0, 1):
        np.testing.assert_allclose((up.at(k) - down.at(k)) / (2 * h), f.at(k + 1), rtol=1e-3)
        np.testing.assert_allclose(f.derivative().at(k), f.at(k + 1), rtol=1e-13)
    np.testing.assert_array_equal((x - x.constant(1.0)).at(1), np.ones(7))
