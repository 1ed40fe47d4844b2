"""Several IMUs: the ones after the first are mounted on it, and their readings count as much as its own."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from tests.cases import each

from icalib.data.measurements import ImuStream, Measurements
from icalib.errors import CalibrationError, RigError
from icalib.export.formats import export
from icalib.geometry import so3
from icalib.pipeline import calibrate_measurements
from icalib.result import Calibration
from icalib.result.saving import load_calibration
from icalib.rig import ImuSensor, Parameter
from icalib.rig.file import lack_of, rig_from_dict, rig_to_dict
from icalib.sensors.imu.simulate import SimImu
from icalib.tools.simulation import Scenario, handheld, rig_for, simulate
from icalib.tools.simulation.scenario import HandheldMotion

SEED = 3


def pose(turn, place):
    T = np.eye(4)
    T[:3, :3], T[:3, 3] = so3.exp(np.array(turn)), place
    return T


def scenario(seconds=6.0, noiseless=False) -> Scenario:
    """A camera in front of a board, and two more IMUs with clocks and rates of their own."""
    made = handheld(seconds, noiseless=noiseless)
    clock, fast = made.imu_clock_origin_ns, 2000.0
    first = SimImu(
        "imu1", pose([0.5, -1.2, 0.8], [0.12, -0.08, 0.05]), 0.0123, fast if noiseless else 333.0, clock_origin_ns=clock
    )
    second = SimImu(
        "imu2", pose([-0.9, 0.4, 2.0], [-0.2, 0.1, 0.15]), -0.0051, fast if noiseless else 500.0, clock_origin_ns=clock
    )
    camera = replace(made.cameras[0], rate_hz=10.0)
    return replace(made, cameras=(camera,), robot_noise_enabled=not noiseless).with_sensors(first, second)


@pytest.fixture(scope="module")
def recorded():
    return simulate(scenario(), seed=SEED)


@pytest.fixture(scope="module")
def result(recorded) -> Calibration:
    return calibrate_measurements(rig_for(recorded.scenario), recorded.measurements)


def errors(result, simulation, name):
    """Errors of rotation [rad], translation [m] and time offset [s]."""
    true = simulation.truth.values[name]
    turn = so3.log(np.ascontiguousarray(true["rotation"].T @ result.group(name, "rotation").value))
    return {"rotation": turn} | {
        key: result.group(name, key).value - true[key] for key in ("translation", "time_offset")
    }


def test_without_noise_the_truth_is_found():
    simulation = simulate(scenario(3.0, noiseless=True), seed=1)
    found = calibrate_measurements(rig_for(simulation.scenario), simulation.measurements)
    for name in ("imu1", "imu2"):
        off = errors(found, simulation, name)
        assert np.abs(off["rotation"]).max() < 1e-6
        assert np.abs(off["translation"]).max() < 1e-5
        assert np.abs(off["time_offset"]).max() < 1e-7


SIZE = (2e-3, -1e-3, 3e-3, -2e-3, 1.5e-3, 1e-3)


@pytest.mark.parametrize("body", ["", "imu1"])
def test_each_axis_of_an_accelerometer_at_a_place_of_its_own(body):
    """Found without noise, whether the IMU is the body or mounted on it; left out, it would move the IMU."""
    made = scenario(3.0, noiseless=True)
    made = made.with_sensors(replace(made.of(SimImu)[0], size_effect=SIZE))
    simulation = simulate(replace(made, sensors=made.sensors[:1]), seed=1)
    rig = replace(rig_for(simulation.scenario), body=body).with_(
        "imu1", size_effect=Parameter("prior", np.zeros(6), np.ones(6))
    )
    found = calibrate_measurements(rig, simulation.measurements)
    np.testing.assert_allclose(found.group("imu1", "size_effect").value, SIZE, rtol=0, atol=1e-5)
    assert found.value("imu1", "size_effect_yx") == found.group("imu1", "size_effect").value[0]
    if not body:
        assert np.abs(errors(found, simulation, "imu1")["translation"]).max() < 1e-5
        assert "scale-misalignment-size-effect" in export(found, "kalibr").files["imu.yaml"]


@pytest.mark.parametrize("apart_m", [0.0, 0.012])
def test_axes_at_different_places_are_named_where_the_rig_file_has_them_at_one(apart_m: float):
    made = scenario(8.0)
    made = made.with_sensors(replace(made.of(SimImu)[0], size_effect=(0.0, apart_m, 0.0, 0.0, 0.0, -apart_m)))
    simulation = simulate(replace(made, sensors=made.sensors[:1]), seed=2)
    rig = rig_for(simulation.scenario)
    found = calibrate_measurements(rig.with_("settings", segments=8), simulation.measurements)
    said = [w for w in found.warnings if w.name == "imu_size_effect"]
    assert [w.split(" of ")[2].split()[0] for w in said] == (["imu1"] if apart_m else [])
    value, std = (np.array(found.effects["imu1.size_effect"][name]) for name in ("value", "std"))
    assert (np.abs(value - [0.0, apart_m, 0.0, 0.0, 0.0, -apart_m]) < 4.0 * std).all()
    farthest = f"{1e3 * float(np.linalg.norm(value[:3] - value[3:])):.2g} mm apart"  # y and z, across the x axis
    assert all(farthest in sentence for sentence in said)


def test_errors_are_within_standard_deviations_and_residuals_as_stated(result, recorded):
    assert result.converged
    for name in ("imu1", "imu2"):
        for key, error in errors(result, recorded, name).items():
            std = result.group(name, key).std
            assert (np.abs(error) < 3.3 * std).all(), (name, key, error, std)
            assert std.max() < {"rotation": 5e-4, "translation": 1e-3, "time_offset": 1e-4}[key]
    fits = {(f.sensor, f.kind): f.chi2 / f.dof for f in result.fits if f.kind in ("gyroscope", "accelerometer")}
    assert {sensor for sensor, _ in fits} == {"imu0", "imu1", "imu2"}
    assert all(0.8 < ratio < 1.2 for ratio in fits.values()), fits


def test_it_does_not_matter_which_imu_is_the_body(result, recorded):
    other = calibrate_measurements(replace(rig_for(recorded.scenario), body="imu1"), recorded.measurements)
    assert other.imu == "imu1" and other.body == "imu1"
    T, back = result.T_imu_sensor("imu1"), np.linalg.inv(result.T_imu_sensor("imu1"))
    for name in ("imu2", "cam0"):
        A, B = back @ result.T_imu_sensor(name), other.T_imu_sensor(name)
        turn = np.abs(so3.log(np.ascontiguousarray(A[:3, :3].T @ B[:3, :3])))
        assert (turn < 0.3 * other.group(name, "rotation").std).all()
        assert (np.abs(A[:3, 3] - B[:3, 3]) < 0.3 * other.group(name, "translation").std).all()
        between = result.group(name, "time_offset").value - result.group("imu1", "time_offset").value
        shift = np.abs(between - other.group(name, "time_offset").value)
        assert shift < 0.3 * other.group(name, "time_offset").std
    back = other.T_imu_sensor("imu0")
    assert np.abs(so3.log(np.ascontiguousarray(T[:3, :3] @ back[:3, :3]))).max() < 1e-4


def test_imus_alone_are_calibrated_to_each_other(recorded, result):
    names = ("imu0", "imu1", "imu2")
    alone = calibrate_measurements(
        rig_for(replace(recorded.scenario, cameras=(), board=False)), recorded.measurements.only(*names)
    )
    assert alone.converged and "imus_alone" in [n.name for n in alone.notes]
    for name in names[1:]:
        for key, error in errors(alone, recorded, name).items():
            assert (np.abs(error) < 3.3 * alone.group(name, key).std).all(), (name, key)
            assert (alone.group(name, key).std < 1.5 * result.group(name, key).std).all()


def test_imus_alone_in_two_recordings_with_a_clock_that_restarts():
    made = scenario(8.0)
    made = replace(made, cameras=(), sensors=made.sensors[:1])
    both = [simulate(made, seed=k).measurements for k in (1, 2)]
    late = both[1].streams["imu1"]
    both[1] = both[1].with_streams(replace(late, stamps_ns=late.stamps_ns - 10**9))
    found = calibrate_measurements(rig_for(made).with_("imu1", clock_restarts=True), both)
    truth = simulate(made, seed=1).truth.values["imu1"]
    assert found.converged
    offset = found.group("imu1", "time_offset")
    assert (np.abs(offset.value - truth["time_offset"] - [0.0, 1.0]) < 3.3 * offset.std).all()
    arm = found.group("imu1", "translation")
    assert (np.abs(arm.value - truth["translation"]) < 3.3 * arm.std).all() and arm.std.max() < 1e-3


def test_turns_about_one_axis_do_not_show_the_lever_arm_along_it():
    """Gravity shows the rotation about the axis."""
    made = replace(handheld(10.0), cameras=(), motion=HandheldMotion("single_axis"))  # about y of the body
    simulation = simulate(made.with_sensors(scenario().of(SimImu)[0]), seed=1)
    found = calibrate_measurements(rig_for(simulation.scenario), simulation.measurements)
    assert found.group("imu1", "translation").verdict == ("determined", "unobservable", "determined")
    assert found.group("imu1", "rotation").verdict == ("determined",) * 3
    assert any("imu1 translation y: not determined by this motion" in reason for reason in found.reasons)


def test_a_second_imu_that_starts_late_and_drops_out(recorded, result):
    stream = recorded.measurements.streams["imu1"]
    kept = np.r_[500:1000, 1300 : len(stream.gyro)]
    part = ImuStream("imu1", stream.stamps_ns[kept], stream.gyro[kept], stream.accel[kept])
    found = calibrate_measurements(rig_for(recorded.scenario), recorded.measurements.with_streams(part))
    assert [n.name for n in found.notes].count("imu_gap") == 1
    for key, error in errors(found, recorded, "imu1").items():
        assert (np.abs(error) < 3.3 * found.group("imu1", key).std).all()
        assert (found.group("imu1", key).std > result.group("imu1", key).std).all()


def changed(measurements: Measurements, **fields) -> Measurements:
    return measurements.with_streams(replace(measurements.streams["imu1"], **fields))


BAD = {
    "mirrored": (lambda s, body: {"gyro": s.gyro * [1, 1, -1]}, "only in left-handed axes; write gyro_axes"),
    "other accelerometer axes": (lambda s, body: {"accel": s.accel * [1, 1, -1]}, "has other axes; correct accel_axes"),
    "in g": (lambda s, body: {"accel": s.accel / 9.81}, "measures 0.1 times as much; correct accel_unit"),
    "in deg/s": (lambda s, body: {"gyro": np.rad2deg(s.gyro)}, "matches imu0 if it is in deg/s; set gyro_unit"),
    "a copy": (
        lambda s, body: {"stamps_ns": body.stamps_ns[1:], "gyro": -body.gyro[1:, [1, 0, 2]], "accel": body.accel[1:]},
        "imu1 and imu0 have the same readings",
    ),
    "of another time": (lambda s, body: {"gyro": s.gyro[::-1].copy(), "accel": s.accel[::-1].copy()}, "does not match"),
}


@each("name", BAD)
def test_imus_that_do_not_match_are_refused_with_the_cause(name, recorded):
    change, words = BAD[name]
    m = recorded.measurements
    with pytest.raises(CalibrationError, match=words):
        calibrate_measurements(rig_for(recorded.scenario), changed(m, **change(m.streams["imu1"], m.streams["imu0"])))


@each(("field", "value"), [("translation", Parameter("free", np.zeros(3))), ("clock_rate", Parameter())])
def test_the_body_has_neither_extrinsics_nor_a_clock(field, value, recorded):
    rig = rig_for(recorded.scenario)
    lack = lack_of(rig.with_("imu0", **{field: value}))
    assert lack is not None and lack.where == ("sensors", "imu0", field)
    assert "make imu1 or imu2 the body with body: imu1" in lack.sentence
    assert lack_of(rig) is None
    again = rig_from_dict(rig_to_dict(rig.with_("imu1", **{field: value})), "rig.yaml")
    assert rig_to_dict(again)["sensors"]["imu1"][field] in ("free", {"guess": [0.0] * 3})


@pytest.mark.parametrize("ppm", [0.0, 100.0])
def test_a_clock_that_drifts_is_found(ppm: float):
    made = scenario(15.0)
    made = made.with_sensors(replace(made.of(SimImu)[0], clock_rate_ppm=ppm))
    simulation = simulate(replace(made, sensors=made.sensors[:1]), seed=2)
    found = calibrate_measurements(rig_for(simulation.scenario).with_("settings", segments=8), simulation.measurements)
    assert [n.name for n in found.notes].count("clock_rate_estimated") == (ppm > 0.0)
    for key, error in errors(found, simulation, "imu1").items():
        assert (np.abs(error) < 4.0 * found.group("imu1", key).std).all(), key
    if ppm:
        rate = found.group("imu1", "clock_rate")
        assert abs(rate.value[0] - ppm) < 4.0 * rate.std[0] < 20.0


def test_the_rig_file_keeps_all_imus(recorded):
    rig = replace(rig_for(recorded.scenario), body="imu2")
    again = rig_from_dict(rig_to_dict(rig), "rig.yaml")
    assert rig_to_dict(again) == rig_to_dict(rig) and again.imu is not None and again.imu.name == "imu2"
    assert [(s.name, s.mounted) for s in again.of(ImuSensor)] == [
        ("imu2", False), ("imu0", True), ("imu1", True),
    ]  # fmt: skip
    with pytest.raises(RigError, match="imu2 is the body"):
        rig_from_dict(rig_to_dict(replace(rig_for(recorded.scenario))) | {"body": "imu2"} | {
            "sensors": rig_to_dict(rig_for(recorded.scenario, translation="start"))["sensors"]
        }, "rig.yaml")  # fmt: skip


def test_saved_and_exported(result, tmp_path):
    result.save(tmp_path / "out")
    again = load_calibration(tmp_path / "out")
    assert [r.sensor for r in again.imu_residuals] == ["imu0", "imu1", "imu2"]
    text = export(result, "kalibr").files["imu.yaml"]
    assert "imu2:" in text and "t_imu0 = t_imu + time_offset [s]" in text
    assert not any("imu1" in sentence for sentence in export(result, "kalibr").sentences)
    assert "imu1:" in export(result, "openvins").files["kalibr_imu_chain.yaml"]
    assert any("imu1" in sentence for sentence in export(result, "mins").sentences)
