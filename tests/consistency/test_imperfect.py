"""Imperfect sensors and targets: errors within printed standard deviations, which include what nothing shows."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from types import ModuleType
from typing import Literal

import numpy as np
import pytest
from scipy import stats
from tests.typed import not_none

from icalib.pipeline import calibrate_measurements
from icalib.rig import Parameter
from icalib.sensors.imu.spec import class_imperfections
from icalib.sensors.lidar.simulate import SimLidar
from icalib.sensors.lidar.spec import RING_AZIMUTHS
from icalib.sensors.pose.simulate import SimPoses
from icalib.tools.simulation import Scenario, handheld, rig_for, simulate


@pytest.fixture(scope="module")
def program(benchmark_program: Callable[[str], ModuleType]) -> ModuleType:
    """Its table has all effects on all kinds of rigs."""
    return benchmark_program("effects")


IN_CI = [
    ("camera + IMU", "accelerometer rotation"),
    ("poses + IMU", "scale of poses"),
]
OTHERS = [
    ("camera + IMU", "target size"),
    ("poses + IMU", "g-sensitivity"),
    ("camera + IMU", "accelerometer scale"),
    ("camera + IMU", "accelerometer misalignment"),
    ("camera + IMU", "gyroscope scale"),
    ("poses + IMU", "gyroscope misalignment"),
    ("camera + wheels", "target size"),  # one image, then none for 14 s
]


@pytest.mark.parametrize(("kind", "effect"), [*IN_CI, *(pytest.param(*x, marks=pytest.mark.full) for x in OTHERS)])
def test_effects_of_two_sigma_are_within_four_printed_ones(program: ModuleType, kind: str, effect: str):
    row = program.row_of(program.KINDS[kind], effect, 2.0, [0])
    assert (row.converged, row.failures, row.far) == (1, (), False), row


@pytest.mark.parametrize(
    ("kind", "effect", "largest"),
    [
        ("camera + IMU", "gyroscope scale", "gyro_zz"),
        ("poses + IMU", "accelerometer rotation", "accel_rotation_z"),
        ("poses + IMU", "none", ""),
        pytest.param("tracks + IMU", "gyroscope misalignment", "gyro_yx", marks=pytest.mark.full),
        pytest.param("LiDAR + IMU", "gyroscope scale", "gyro_xx", marks=pytest.mark.full),
        pytest.param("LiDAR + IMU", "none", "", marks=pytest.mark.full),
        pytest.param("wheels + poses + IMU", "accelerometer misalignment", "accel_yx", marks=pytest.mark.full),
        pytest.param("wheels + poses + IMU", "none", "", marks=pytest.mark.full),
    ],
)
def test_an_imu_that_is_wrongly_called_ideal_is_named(program: ModuleType, kind: str, effect: str, largest: str):
    """At one standard deviation of its class. A LiDAR does not show the scale of an accelerometer well enough."""
    scenario = program.with_effect(program.KINDS[kind].scenario(), effect, 1.0, 1)
    rig = program.rig_of(scenario, program.KINDS[kind])
    rig = rig.with_(imu=replace(rig.imu, intrinsics=Parameter("fixed")))
    result = calibrate_measurements(rig, simulate(scenario, 1).measurements.unassociated())
    reasons, tested = result.reasons, result.effects["imu0.intrinsics"]
    assert (len(tested["value"]), tested["unit"]) == (24, "")
    if largest:
        assert reasons[0].name == "imu_not_ideal"
        assert f"and it is not: {largest} is" in reasons[0]
    assert not [r for r in reasons if r.name == "residuals_unexplained" or (not largest and r.name == "imu_not_ideal")]


@pytest.mark.parametrize("delay_s", [0.0, pytest.param(-0.02, marks=pytest.mark.full), 0.006])
def test_an_accelerometer_that_is_late_is_found(program: ModuleType, delay_s: float):
    scenario = replace(program.camera_imu(), imu_accel_delay_s=delay_s)
    simulation = simulate(scenario, 1)
    result = calibrate_measurements(program.rig_of(scenario, program.KINDS["camera + IMU"]), simulation.measurements)
    said = [note.name for note in result.notes if note.name == "accel_delay_estimated"]
    assert result.verdict == "usable" and len(said) == (delay_s != 0.0)
    if said:
        group = result.group("imu0", "accel_delay")
        assert abs(group.value[0] - delay_s) < 4.0 * group.std[0] < 4e-4
    assert max(off for _, verdict, off in program.errors(result, simulation) if verdict == "determined") < 4.0


STATED = [
    ("accel_delay", Parameter("fixed", np.array([0.005])), False),
    ("accel_delay", Parameter("fixed", np.zeros(1)), True),
    ("accel_delay", Parameter("free", np.array([0.02])), False),
    ("size_effect", Parameter("prior", np.full(6, 0.02), np.full(6, 1e-4)), True),
]


@pytest.mark.parametrize(("name", "stated", "wrong"), STATED)
def test_a_stated_effect_of_the_imu_is_tested(program: ModuleType, name: str, stated: Parameter, wrong: bool):
    """The accelerometer is 5 ms late, and its axes are at one place. A guess has no weight."""
    scenario = replace(program.camera_imu(), imu_accel_delay_s=0.005 if name == "accel_delay" else 0.0)
    rig = program.rig_of(scenario, program.KINDS["camera + IMU"])
    rig = rig.with_("imu0", **{name: stated})
    result = calibrate_measurements(rig, simulate(scenario, 1).measurements)
    against = [w for w in result.warnings if w.name in ("fixed_value_contradicted", "prior_contradicted")]
    assert [f"{name.replace('_', ' ')}" in w and "imu0" in w for w in against] == [True] * wrong
    if stated.mode == "free":
        free = calibrate_measurements(rig.with_("imu0", **{name: Parameter()}), simulate(scenario, 1).measurements)
        estimate, unguessed = (x.group("imu0", name) for x in (result, free))
        np.testing.assert_allclose(estimate.value, unguessed.value, rtol=0, atol=0.05 * unguessed.std[0])
        assert [n.name for n in result.notes if n.name == "guess_contradicted"]


@pytest.mark.parametrize("cutoff_hz", [8.0, pytest.param(50.0, marks=pytest.mark.full)])
def test_a_filter_in_the_imu_is_named_where_it_smooths_the_motion(program: ModuleType, cutoff_hz: float):
    scenario = replace(program.camera_imu(), imu_cutoff_hz=cutoff_hz)
    measured = simulate(scenario, 1).measurements
    result = calibrate_measurements(program.rig_of(scenario, program.KINDS["camera + IMU"]), measured)
    assert [r.name for r in result.reasons[:1]] == (["imu_filtered"] if cutoff_hz < 10.0 else [])
    if cutoff_hz < 10.0:
        said = float(result.reasons[0].split("as if of ")[1].split()[0])
        assert said == pytest.approx(cutoff_hz, rel=0.2)


def poses_and_lidar(program: ModuleType, scale: float) -> Scenario:
    """Of `scale`, the ratio of true to reported ranges."""
    scenario = program.lidar_poses_imu()
    return scenario.with_sensors(*(replace(x, azimuth_steps=225, scale=scale) for x in scenario.of(SimLidar)))


@pytest.mark.parametrize("exact", [False, True])
def test_lengths_carry_the_uncertainty_of_ranges(program: ModuleType, exact: bool):
    """The scale of motion capture follows from ranges that are 0.3 % too long."""
    scenario = poses_and_lidar(program, 1.0 / 1.003)
    rig = program.rig_of(scenario, program.Kind(lambda: scenario, True, ()))
    if exact:
        rig = rig.with_(lidars=tuple(replace(x, range_scale=Parameter("fixed", np.zeros(1))) for x in rig.lidars))
    result = calibrate_measurements(rig, simulate(scenario, 1).measurements.unassociated())
    scale = result.group("mocap0", "scale")
    off = abs(float(scale.value[0]) - 1.0) / float(scale.std[0])
    assert off > 30.0 if exact else off < 4.0


def test_what_ranges_may_be_off_adds_the_response_of_the_estimate(program: ModuleType):
    """The covariance grows by r r^T, and r is what the estimate changes by with another scale: all by the same factor,
    at most the prior."""
    scenario = poses_and_lidar(program, 1.0)
    rig = program.rig_of(scenario, program.Kind(lambda: scenario, True, ()))
    measured = simulate(scenario, 1).measurements.unassociated()
    scales = {"considered": Parameter("fixed")} | {x: Parameter("fixed", np.array([x])) for x in (0.0, 1e-3)}
    found = {
        key: calibrate_measurements(rig.with_(lidars=tuple(replace(x, range_scale=p) for x in rig.lidars)), measured)
        for key, p in scales.items()
    }
    considered, exact, longer = found.values()
    columns = not_none(exact.group("mocap0", "scale").columns)
    grown = np.sqrt(considered.covariance[columns, columns] - exact.covariance[columns, columns])
    moved = longer.group("mocap0", "scale").value - exact.group("mocap0", "scale").value
    share = grown / np.abs(moved)
    assert 0.3 < share < 1.1  # of the prior: the data alone know the scale to about the same


def test_a_scale_of_ranges_is_found(program: ModuleType):
    scenario = poses_and_lidar(program, 1.01)
    rig = program.rig_of(scenario, program.Kind(lambda: scenario, True, ()))
    simulation = simulate(scenario, 1)
    result = calibrate_measurements(rig, simulation.measurements.unassociated())
    scale = result.group("lidar0", "range_scale")
    assert abs(scale.value[0] - (1.0 / 1.01 - 1.0)) < 3.0 * scale.std[0] < 4e-3
    assert "range_scale_estimated" in [note.name for note in result.notes]
    assert max(off for _, verdict, off in program.errors(result, simulation) if verdict == "determined") < 4.0


@pytest.mark.parametrize("offset_m", [0.0, 0.02])
def test_an_offset_of_ranges_is_found(program: ModuleType, offset_m: float):
    """Walls that are seen at a slant show it: with motion capture, and with an IMU alone."""
    scenario = program.lidar_imu()
    lidars = (replace(x, azimuth_steps=225, range_offset_m=offset_m) for x in scenario.of(SimLidar))
    scenario = scenario.with_sensors(*lidars)
    rig = program.rig_of(scenario, program.KINDS["LiDAR + IMU"])
    simulation = simulate(scenario, 1)
    result = calibrate_measurements(rig, simulation.measurements.unassociated())
    assert [n.name for n in result.notes].count("ranges_offset") == (offset_m > 0.0)
    if offset_m:
        offset = result.group("lidar0", "range_offset")
        assert abs(offset.value[0] - offset_m) < 4.0 * offset.std[0] < 0.01
    else:
        tested = result.effects["lidar0.range_offset"]
        assert abs(tested["value"][0]) < 5.0 * tested["std"][0] < 0.01
    assert max(off for _, verdict, off in program.errors(result, simulation) if verdict == "determined") < 4.0


@pytest.mark.parametrize(("rig_type", "mode"), [("LiDAR + IMU", "free"), ("LiDAR + poses + IMU", "fixed")])
def test_elevations_of_rings_are_found(program: ModuleType, rig_type: str, mode: Literal["free", "fixed"]):
    """0.2 deg RMS, whether the rig file asks for them or not. A mount that moves was named, and the result was not
    usable."""
    kind, off = program.KINDS[rig_type], 0.2 * np.random.default_rng(6).standard_normal(16)
    scenario = kind.scenario()
    lidars = (replace(x, azimuth_steps=225, elevation_errors_deg=tuple(off)) for x in scenario.of(SimLidar))
    scenario = scenario.with_sensors(*lidars)
    simulation = simulate(scenario, 1)
    rig = program.rig_of(scenario, kind)
    rig = rig.with_(lidars=tuple(replace(x, ring_elevations=Parameter(mode)) for x in rig.lidars))
    result = calibrate_measurements(rig, simulation.measurements.unassociated())
    assert result.verdict.startswith("usable")
    assert [str(note)[:15] for note in result.notes if note.name == "ring_errors_estimated"] == ["ring elevations"]
    rings = result.group("lidar0", "ring_elevations")
    error = rings.value - np.deg2rad(off)
    covariance = result.covariance[np.ix_(not_none(rings.columns), not_none(rings.columns))]
    assert stats.chi2.sf(error @ np.linalg.solve(covariance, error), 16) > 1e-3
    assert rings.std.max() < np.deg2rad(0.01)
    assert max(x for _, verdict, x in program.errors(result, simulation) if verdict == "determined") < 4.0


def test_offsets_of_rings_are_found(program: ModuleType):
    """2 cm RMS, together with the offset of the ring that has none of its own; elevations are right."""
    kind, off = program.KINDS["LiDAR + IMU"], 0.02 * np.random.default_rng(7).standard_normal(16) + 0.01
    scenario = kind.scenario()
    lidars = (replace(x, azimuth_steps=225, ring_offsets_m=tuple(off)) for x in scenario.of(SimLidar))
    scenario = scenario.with_sensors(*lidars)
    simulation = simulate(scenario, 1)
    result = calibrate_measurements(program.rig_of(scenario, kind), simulation.measurements.unassociated())
    assert result.verdict.startswith("usable")
    assert [str(note)[:12] for note in result.notes if note.name == "ring_errors_estimated"] == ["ring offsets"]
    rings, offset = result.group("lidar0", "ring_offsets"), result.group("lidar0", "range_offset")
    assert np.abs(rings.value + offset.value - off).max() < 4e-3
    assert max(x for _, verdict, x in program.errors(result, simulation) if verdict == "determined") < 4.0


def test_azimuths_of_rings_are_found(program: ModuleType):
    """0.2 deg RMS. Their mean is a rotation of the LiDAR, whose standard deviation has that of the prior."""
    kind, off = program.KINDS["LiDAR + IMU"], 0.2 * np.random.default_rng(8).standard_normal(16)
    scenario = kind.scenario()
    lidars = (replace(x, azimuth_steps=225, azimuth_errors_deg=tuple(off)) for x in scenario.of(SimLidar))
    simulation = simulate(scenario.with_sensors(*lidars), 1)
    result = calibrate_measurements(program.rig_of(scenario, kind), simulation.measurements.unassociated())
    assert result.verdict.startswith("usable")
    assert [str(note)[:13] for note in result.notes if note.name == "ring_errors_estimated"] == ["ring azimuths"]
    rings = result.group("lidar0", "ring_azimuths").value
    assert np.abs(rings - rings.mean() - np.deg2rad(off - off.mean())).max() < np.deg2rad(0.02)
    yaw = result.group("lidar0", "rotation").std
    assert 0.9 < 4.0 * yaw.max() / max(RING_AZIMUTHS.prior_sigma, 0.5 * np.abs(rings).max()) < 1.5


@pytest.mark.parametrize("rig_type", ["LiDAR + IMU", "LiDAR + poses + IMU"])
def test_right_rings_are_left_alone(program: ModuleType, rig_type: str):
    kind = program.KINDS[rig_type]
    scenario = kind.scenario()
    scenario = scenario.with_sensors(*(replace(x, azimuth_steps=225) for x in scenario.of(SimLidar)))
    measured = simulate(scenario, 1).measurements.unassociated()
    result = calibrate_measurements(program.rig_of(scenario, kind), measured)
    for name, most in (
        ("ring_elevations", np.deg2rad(0.01)),
        ("ring_offsets", 2e-3),
        ("ring_azimuths", np.deg2rad(0.03)),
    ):
        tested = result.effects[f"lidar0.{name}"]
        assert (np.abs(tested["value"]) < 4.0 * np.array(tested["std"])).all()
        assert sorted(tested["std"])[-2] < most  # one ring has no offset of its own
    assert not any("ring" in remark.name for remark in (*result.reasons, *result.notes))


@pytest.mark.full
def test_taken_for_ideal_such_an_imu_is_far_off(program: ModuleType):
    """Or the test above could not fail."""
    kind = program.KINDS["camera + IMU"]
    scenario = program.with_effect(kind.scenario(), "accelerometer rotation", 2.0, 0)
    simulation = simulate(scenario, 0)
    rig = rig_for(scenario, intrinsics="free", distortion="free", imu_intrinsics=Parameter("fixed"))
    found = calibrate_measurements(rig, simulation.measurements)
    assert max(off for _, verdict, off in program.errors(found, simulation) if verdict == "determined") > 20.0


def test_a_baseline_carries_the_uncertainty_of_the_target():
    """Cameras alone: what is 0.2 % of the target is 0.2 % of the baseline."""
    scenario = handheld(6.0)
    scenario = replace(scenario, cameras=tuple(replace(c, time_offset_s=0.0, rate_hz=4.0) for c in scenario.cameras))
    measured = simulate(scenario, 1).measurements.without("imu0")
    sizes = {}
    for sigma in (0.0, 0.002):
        rig = rig_for(scenario).with_(imu=None, target=replace(scenario.target, size_sigma=sigma))
        found = calibrate_measurements(rig, measured)
        group = found.group("cam1", "translation")
        along = group.value / np.linalg.norm(group.value)
        covariance = found.covariance[np.ix_(not_none(group.columns), not_none(group.columns))]
        sizes[sigma] = float(np.sqrt(along @ covariance @ along)) / float(np.linalg.norm(group.value))
    assert np.hypot(sizes[0.0], 0.002) == pytest.approx(sizes[0.002], rel=0.02)


def test_size_and_scale_are_found_where_an_ideal_imu_shows_them():
    """Without noise, and with priors so wide that they do not pull."""
    poses = (SimPoses("mocap0", np.eye(4), rate_hz=50.0, scale=0.99),)
    scenario = replace(handheld(6.0, noiseless=True), target_size=1.02, sensors=poses, robot_noise_enabled=False)
    scenario = replace(scenario, cameras=tuple(replace(c, rate_hz=10.0) for c in scenario.cameras[:1]))
    rig = rig_for(scenario)
    rig = rig.with_(
        target=replace(scenario.target, size_sigma=0.1),
        poses=tuple(replace(p, scale_sigma=0.1) for p in rig.poses),
    )
    found = calibrate_measurements(rig, simulate(scenario, 1).measurements)
    assert found.group("board0", "size").value[0] == pytest.approx(1.02, abs=2e-5)
    assert found.group("mocap0", "scale").value[0] == pytest.approx(0.99, abs=2e-5)


def test_what_the_recording_does_not_show_of_an_imu_is_as_the_prior_says():
    """Nothing of it moves, and other parameters by less than 0.2 of their standard deviations."""
    scenario = replace(handheld(4.0), cameras=tuple(replace(c, rate_hz=10.0) for c in handheld().cameras))
    sigma = class_imperfections("tactical").sigma
    measured = simulate(scenario, 2).measurements
    ideal = calibrate_measurements(rig_for(scenario), measured)
    rig = rig_for(scenario, imu_intrinsics=Parameter("prior", np.zeros(24), sigma))
    found = calibrate_measurements(rig, measured)
    group = found.group("imu0", "intrinsics")
    unknown = group.std > 0.98 * sigma
    assert unknown.sum() >= 9  # g-sensitivity at least
    assert np.abs(group.value / sigma)[unknown].max() < 0.2
    rotation, C = found.group("cam0", "rotation"), found.covariance
    by_prior = C[np.ix_(not_none(rotation.columns), not_none(group.columns))] / sigma
    np.testing.assert_allclose(rotation.std_by["imu0.intrinsics"], np.linalg.norm(by_prior, axis=1), rtol=2e-3)
    for camera in ("cam0", "cam1"):
        for name in ("translation", "time_offset"):
            a, b = found.group(camera, name), ideal.group(camera, name)
            assert (np.abs(a.value - b.value) < 0.2 * a.std + 3.0 * np.sqrt(np.maximum(a.std**2 - b.std**2, 0.0))).all()
