"""Speed and yaw rate, and front wheels that steer: what is simulated, against the path, and written and read again."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from tests.cases import each
from tests.typed import instance

from icalib.data.measurements import WheelStream
from icalib.data.recordings import open_recording, read_measurements
from icalib.errors import RigError
from icalib.rig.file import load_rig
from icalib.sensors.wheels.simulate import SimWheels
from icalib.tools.simulation import simulate
from icalib.tools.simulation.trajectory import DriveKind
from icalib.tools.simulation.writing import write_sensors, write_tables

from .conftest import alone, on_ground, wheel_path

SCALES, OFFSET, BASE, RADIUS = (1.1, 0.9), 0.05, 0.6, 0.12


def reporting(robot, reports, sampling="interval-mean", kind: DriveKind = "planar", **changes):
    scenario = alone(on_ground(robot, kind))
    wheels = replace(
        scenario.of(SimWheels)[0],
        reports=reports,
        sampling=sampling,
        scales=SCALES,
        radius=RADIUS,
        wheelbase=BASE,
        steering_offset=OFFSET,
        **changes,
    )
    return replace(scenario.with_sensors(wheels), cameras=())


def instants(sim):
    stream, truth = sim.measurements.wheels[0], sim.truth
    return (stream.stamps_ns - truth.imu_clock_origin_ns) * 1e-9 + truth.time_offset[stream.name]


def moved(sim, begin, end, parts=400):
    """Path [m] and yaw [rad], by summing up the small moves of the wheel frame."""
    at = np.linspace(begin, end, parts + 1)
    R, p = wheel_path(sim.truth, sim.scenario.of(SimWheels)[0].T_imu_sensor, at)
    middle, _ = wheel_path(sim.truth, sim.scenario.of(SimWheels)[0].T_imu_sensor, 0.5 * (at[1:] + at[:-1]))
    small = np.einsum("nji,njk->nik", R[:-1], R[1:])
    path = np.einsum("ni,ni->n", middle[:, :, 0], np.diff(p, axis=0)).sum()
    return np.array([path, 0.5 * (small[:, 1, 0] - small[:, 0, 1]).sum()])


@each("kind", ["planar", "ramps"])
@each("sampling", ["interval-mean", "instantaneous"])
def test_speed_and_yaw_rate_are_those_of_the_path_over_their_scales(robot, kind, sampling):
    sim = simulate(replace(reporting(robot, "twist", sampling, kind), robot_noise_enabled=False), 3)
    stream, t = sim.measurements.wheels[0], instants(sim)
    assert (instance(stream, WheelStream).kind, instance(stream, WheelStream).sampling) == ("twist", sampling)
    for i in (1, 80, 200):
        a, b = (t[i - 1], t[i]) if sampling == "interval-mean" else (t[i] - 1e-4, t[i] + 1e-4)
        np.testing.assert_allclose(
            instance(stream, WheelStream).rate[i], moved(sim, a, b) / (b - a) / SCALES, rtol=1e-4, atol=1e-5
        )


@pytest.mark.parametrize("sampling", ["interval-mean", "instantaneous"])
def test_a_point_ahead_moves_where_the_front_wheels_point(robot, sampling):
    sim = simulate(replace(reporting(robot, "steering", sampling), robot_noise_enabled=False), 3)
    stream, t = sim.measurements.wheels[0], instants(sim)
    assert (instance(stream, WheelStream).kind, instance(stream, WheelStream).sampling) == (
        "steered",
        sampling,
    ) and np.ptp(instance(stream, WheelStream).rate[:, 1]) > 0.2
    for i in (1, 80, 200):
        R, p = wheel_path(sim.truth, sim.scenario.of(SimWheels)[0].T_imu_sensor, t[i] + np.array([-1e-4, 0.0, 1e-4]))
        front = p + BASE * R[:, :, 0]
        ahead, left, _ = R[1].T @ (front[2] - front[0])
        assert instance(stream, WheelStream).rate[i, 1] + OFFSET == pytest.approx(np.arctan(left / ahead), abs=1e-5)
        a, b = (t[i - 1], t[i]) if sampling == "interval-mean" else (t[i] - 1e-4, t[i] + 1e-4)
        assert instance(stream, WheelStream).rate[i, 0] == pytest.approx(
            moved(sim, a, b)[0] / (b - a) / RADIUS, rel=1e-4
        )


@pytest.mark.parametrize(
    ("reports", "noise", "density"),
    [
        ("twist", {"speed_noise": 0.02, "yaw_noise": 0.05}, (0.02, 0.05)),
        ("steering", {"noise": 0.3, "steering_noise": 0.01}, (0.3, 0.01)),
    ],
)
def test_noise_is_a_density(robot, reports, noise, density):
    scenario = reporting(robot, reports, **noise)
    sim, quiet = simulate(scenario, 3), simulate(replace(scenario, robot_noise_enabled=False), 3)
    off = (
        instance(sim.measurements.wheels[0], WheelStream).rate
        - instance(quiet.measurements.wheels[0], WheelStream).rate
    )
    expected = np.array(density) * np.sqrt(scenario.of(SimWheels)[0].rate_hz)
    np.testing.assert_allclose(off.std(axis=0), expected, rtol=0.15)
    assert instance(quiet.measurements.wheels[0], WheelStream).rate == pytest.approx(
        quiet.truth.reported["wheel0"].value, abs=1e-12
    )


def test_front_wheels_that_would_have_to_stand_across_are_refused(robot):
    with pytest.raises(RigError, match="wheel0 would have to steer by .* deg; choose a motion with wider curves"):
        simulate(reporting(robot, "steering", kind="spin"), 0)


RIG = "sensors:\n  imu0: {type: imu}\n  mocap0: {type: pose}\n  wheel0: {type: wheels, WHAT}\n"


@each("write", [write_tables, write_sensors])
@each(("reports", "what"), [("twist", "measures: twist"), ("steering", "drive: ackermann")])
def test_what_is_written_is_read_again(tmp_path, robot, write, reports, what):
    sim = simulate(reporting(robot, reports), 3)
    write(sim, 3, tmp_path / "run")
    (tmp_path / "rig.yaml").write_text(RIG.replace("WHAT", what))
    rig = load_rig(tmp_path / "rig.yaml").with_(poses=())
    (found,), (written,) = read_measurements(open_recording(tmp_path / "run"), rig).wheels, sim.measurements.wheels
    assert (instance(found, WheelStream).kind, instance(found, WheelStream).sampling) == (
        instance(written, WheelStream).kind,
        "interval-mean",
    )
    np.testing.assert_array_equal(found.stamps_ns, written.stamps_ns)
    np.testing.assert_allclose(instance(found, WheelStream).rate, instance(written, WheelStream).rate, rtol=1e-15)
    topics = {t.name: t.kind for t in open_recording(tmp_path / "run").topics()}
    own = {name: kind for name, kind in topics.items() if "wheel0" in name}
    bagged = "twist" if reports == "twist" else "joints"
    assert list(own.values()) == ["wheels" if write is write_tables else bagged]
    assert len(open_recording(tmp_path / "run").stamps(next(iter(own)))) == len(found.stamps_ns)
