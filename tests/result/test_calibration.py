"""A calibration survives its files bit for bit, and damaged files are refused in a sentence."""

from __future__ import annotations

import dataclasses
import hashlib
import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml
from tests.remarks import names, remark

from icalib.base.remark import Remark
from icalib.errors import CalibrationError
from icalib.result import Calibration, ParameterGroup, by_key, load_calibration
from icalib.result.calibration import RecordingSpan
from icalib.result.saving import calibration_yaml
from icalib.validation.causes import scatter_warnings


@pytest.fixture
def saved(calibration: Calibration, tmp_path: Path) -> Path:
    folder = tmp_path / "made" / "for" / "it"
    calibration.save(folder)
    return folder


def test_round_trip_is_exact(calibration: Calibration, saved: Path, same: Callable[[Any, Any], bool]):
    assert same(load_calibration(saved), calibration)


def test_round_trip_of_what_is_not_finite_or_empty(
    calibration: Calibration, tmp_path: Path, same: Callable[[Any, Any], bool]
):
    g = calibration.groups[0]
    groups = (dataclasses.replace(g, std=np.array([np.inf, np.nan, 5e-324])), *calibration.groups[1:])
    odd = dataclasses.replace(calibration, groups=groups, iterations=(), warnings=())
    odd.save(tmp_path)
    found = load_calibration(tmp_path)
    assert same(found, odd)


def test_identifiers_are_loaded_and_those_of_earlier_results_are_unknown(calibration: Calibration, tmp_path: Path):
    gap, drift = Remark("imu_gap", "imu0 has a gap of 1.000 s at 2.000 s, bridged."), remark("it drifts.")
    dataclasses.replace(calibration, notes=(gap, drift), warnings=(gap,), wrong=(gap,)).save(tmp_path)
    again = load_calibration(tmp_path)
    assert [names(x) for x in (again.notes, again.wrong)] == [["imu_gap", "unknown"], ["imu_gap"]]
    path = tmp_path / "result.json"
    plain = json.loads(path.read_text(encoding="utf-8"))
    assert plain["identifiers"]["reasons"] == names(again.reasons) and names(again.reasons)[0] == "imu_gap"
    path.write_text(json.dumps({key: x for key, x in plain.items() if key != "identifiers"}), encoding="utf-8")
    old = load_calibration(tmp_path)
    assert old.notes == again.notes and names(old.notes) == ["unknown", "unknown"]
    path.write_text(json.dumps(plain | {"identifiers": plain["identifiers"] | {"notes": []}}), encoding="utf-8")
    with pytest.raises(CalibrationError, match="damaged"):
        load_calibration(tmp_path)


def test_arrays_need_no_pickle(saved: Path):
    with np.load(saved / "result.npz", allow_pickle=False) as file:
        assert all(file[name].dtype.kind in "fibU" for name in file.files)


def test_yaml_says_when_and_from_what_it_was_made(calibration: Calibration):
    span = RecordingSpan("run.bag", np.float64(0.5), np.float64(20.75), 1_700_000_000_000_000_000)
    made = dataclasses.replace(calibration, made="2026-03-01T12:00:00+00:00", recordings=(span,))
    data = yaml.safe_load(calibration_yaml(made))
    assert data["date"] == "2026-03-01T12:00:00+00:00" and data["sha256"] == calibration.inputs
    assert data["recordings"] == [{"name": "run.bag", "seconds": 20.25, "first_stamp_ns": span.origin_ns}]
    assert yaml.safe_load(calibration_yaml(calibration))["date"] is None


def test_yaml_has_no_zeros_of_an_ideal_imu(calibration: Calibration):
    group = calibration.group_or_none("imu0", "intrinsics")
    zeros = np.zeros(2)
    ideal = ParameterGroup("imu0", "intrinsics", ("a", "b"), "", zeros, zeros, zeros, ("fixed",) * 2, "fixed")
    groups = (*(g for g in calibration.groups if g is not group), ideal)
    imu = yaml.safe_load(calibration_yaml(dataclasses.replace(calibration, groups=groups)))["sensors"]["imu0"]
    assert imu["parameters"] == imu["std"]["parameters"] == imu["verdict"]["parameters"] == {}


def test_yaml_is_what_the_design_says(calibration: Calibration, saved: Path):
    data = yaml.safe_load((saved / "calibration.yaml").read_text())
    cam = data["sensors"]["cam1"]
    assert cam["type"] == "camera"
    np.testing.assert_array_equal(cam["T_imu_sensor"], calibration.T_imu_sensor("cam1"))
    assert cam["time_offset"] == calibration.group("cam1", "time_offset").value[0]
    assert list(cam["parameters"]) == ["fx", "fy", "cx", "cy", "k1", "k2", "p1", "p2", "bloom"]
    assert cam["parameters"]["fy"] == 456.134
    assert cam["std"]["rotation"] == calibration.group("cam1", "rotation").std.tolist()
    assert "k1" not in cam["std"]["parameters"]  # fixed
    assert cam["verdict"]["translation"] == ["determined", "unobservable", "weak"]
    assert cam["verdict"]["parameters"]["k1"] == "fixed"
    assert cam["verdict"]["time_offset"] == "determined"
    assert cam["empirical_factor"]["translation"] == [2.7] * 3
    assert "k1" not in cam["empirical_factor"]["parameters"]
    assert data["sensors"]["imu0"]["T_imu_sensor"] == np.eye(4).tolist()
    assert "time_offset" not in data["sensors"]["imu0"] and "translation" not in data["sensors"]["imu0"]["std"]
    assert np.shape(data["targets"]["board0"]["tilt"]) == (3, 3)
    assert data["fits"][0]["chi2_per_dof"] == pytest.approx(20011.2 / 19800.5)
    assert data["fits"][-1]["chi2_per_dof"] is None
    assert data["warnings"] == [{w.name: w} for w in calibration.warnings]


def test_yaml_says_direction_sign_and_units_at_its_top(saved: Path):
    head = (saved / "calibration.yaml").read_text().split("status:")[0]
    for words in ("p_imu = T_imu_sensor p_sensor", "t_imu = t_sensor + time_offset", "angles in rad", "in m", "in s"):
        assert words in head


def test_parameters_that_share_a_label_keep_apart(calibration: Calibration, tmp_path: Path):
    k = next(i for i, g in enumerate(calibration.groups) if g.name == "bloom")
    twin = dataclasses.replace(calibration.groups[k], labels=("fx",))
    dataclasses.replace(calibration, groups=(*calibration.groups[:k], twin, *calibration.groups[k + 1 :])).save(
        tmp_path
    )
    found = yaml.safe_load((tmp_path / "calibration.yaml").read_text())["sensors"]["cam0"]["parameters"]
    assert found["intrinsics_fx"] == 458.654
    assert found["bloom_fx"] == 0.27


def sentence_of(folder: Path) -> str:
    with pytest.raises(CalibrationError) as caught:
        load_calibration(folder)
    sentence = str(caught.value)
    assert sentence.endswith(".") and "\n" not in sentence and str(folder) in sentence
    return sentence


def test_absent_folder_and_absent_files(saved: Path):
    assert "not a folder" in sentence_of(saved / "nothing")
    (saved / "result.npz").unlink()
    assert "result.npz" in sentence_of(saved)
    (saved / "result.json").unlink()
    assert "result.json" in sentence_of(saved)


@pytest.mark.parametrize("size", [0, 1, 100, -1])
def test_truncated_files(saved: Path, size: int):
    for name in ("result.npz", "result.json"):
        content = (saved / name).read_bytes()
        (saved / name).write_bytes(content[:size])
        assert name in sentence_of(saved)
        (saved / name).write_bytes(content)


@pytest.mark.parametrize("content", [b"[]", b'"text"', b"{}", b"\xff\xfe", b"[" * 100_000, b'{"format": "other"}'])
def test_foreign_json(saved: Path, content: bytes):
    (saved / "result.json").write_bytes(content)
    assert "result.json" in sentence_of(saved)


def change(folder: Path, **changes: Any) -> None:
    file = folder / "result.json"
    file.write_text(json.dumps(json.loads(file.read_text()) | changes))


def test_arrays_of_another_run(calibration: Calibration, saved: Path, tmp_path: Path):
    dataclasses.replace(calibration, covariance=2.0 * calibration.covariance).save(tmp_path / "other")
    (saved / "result.npz").write_bytes((tmp_path / "other" / "result.npz").read_bytes())
    assert "another run" in sentence_of(saved)


def test_arrays_that_would_run_code(saved: Path):
    np.savez(saved / "result.npz", covariance=np.array([print], dtype=object))
    change(saved, npz_sha256=hashlib.sha256((saved / "result.npz").read_bytes()).hexdigest())
    assert "cannot be read" in sentence_of(saved)


@pytest.mark.parametrize(
    "changes",
    [
        {"format_version": 3},
        {"groups": 3},
        {"groups": [{}]},
        {"groups": [{"sensor": "cam0"}]},
        {"fits": [{"sensors": 1}]},
        {"residuals": [{"sensor": "cam7", "kind": "corners"}]},
        {"residuals": [{"kind": "corners"}]},
        {"rig": {}},
        {"rig": {"sensors": {}}},
        {"rig": []},
        {"cross_validation": {"segments": 8}},
        {"cross_validation": 3},
    ],
)
def test_changed_json(saved: Path, changes: dict[str, Any]):
    change(saved, **changes)
    sentence_of(saved)


def test_parts_that_do_not_fit_the_covariance(saved: Path):
    plain = json.loads((saved / "result.json").read_text())["cross_validation"]
    change(saved, cross_validation=plain | {"segments": 7})
    assert "7 segments" in sentence_of(saved)


@pytest.mark.parametrize(
    ("field", "value"), [("std", [1.0]), ("columns", [0, 1, 999]), ("value", "text"), ("labels", 1)]
)
def test_changed_group(saved: Path, field: str, value: Any):
    groups = json.loads((saved / "result.json").read_text())["groups"]
    groups[0][field] = value
    change(saved, groups=groups)
    sentence_of(saved)


def test_a_warning_where_halves_disagree_by_more_than_is_printed(calibration: Calibration):
    """Excess 900 for 100: the factor is 3, and 1.9 would do."""
    held = calibration.cross_validation
    assert held is not None and held.optimistic and held.factor == pytest.approx(3.0)
    (sentence,) = scatter_warnings(np.array([1.5, 1.9]), True, held)
    assert "predicts the other 3.0x worse" in sentence and "only 1.9x the formal ones" in sentence
    by_chance = dataclasses.replace(held, spread=300.0)
    assert not by_chance.optimistic
    for factors, other in ((np.array([1.5, 2.1]), held), (np.array([1.9]), by_chance), (np.array([1.9]), None)):
        assert not list(scatter_warnings(factors, True, other))


def test_group_lists_what_there_is(calibration: Calibration):
    with pytest.raises(KeyError, match="cam0.rotation"):
        calibration.group("cam0", "focus")


SPOILT: dict[str, Callable[[np.ndarray], np.ndarray]] = {
    "short": lambda a: a[: len(a) // 2],
    "flat": lambda a: a.ravel(),
    "long": lambda a: np.concatenate([a, a]),
    "axis": lambda a: a[..., None],
    "text": lambda a: a.astype(np.str_),
    "complex": lambda a: a.astype(complex),
}
ARRAYS = ("trajectory/position", "residuals/imu0/intervals/whitened", "residuals/wheel0/increments/whitened")


@pytest.mark.parametrize("how", SPOILT)
@pytest.mark.parametrize(
    "name",
    [
        *ARRAYS,
        *(f"residuals/{r}" for r in ("lidar0/points/world", "cam0/corners/uv", "cam0/corners/start")),
        "covariance",
        "null_space",
    ],
)
def test_arrays_that_do_not_fit_the_others(robot: Calibration, tmp_path: Path, name: str, how: str):
    robot.save(tmp_path)
    with np.load(tmp_path / "result.npz") as file:
        arrays = {key: file[key] for key in file.files}
    spoilt = SPOILT[how](arrays[name])
    same = spoilt.shape == arrays[name].shape and spoilt.dtype == arrays[name].dtype  # what is flat stays so
    written: dict[str, Any] = arrays | {name: spoilt}
    np.savez(tmp_path / "result.npz", **written)
    change(tmp_path, npz_sha256=hashlib.sha256((tmp_path / "result.npz").read_bytes()).hexdigest())
    if same:
        load_calibration(tmp_path)
    else:
        sentence_of(tmp_path)


@pytest.mark.parametrize("at", [0, 3, -1])
def test_images_that_do_not_divide_their_corners(calibration: Calibration, tmp_path: Path, at: int):
    r = calibration.corner_residuals[0]
    start = r.start.copy()
    start[at] += 10**6
    dataclasses.replace(calibration, residuals=by_key([dataclasses.replace(r, start=start)])).save(tmp_path)
    assert "start of cam0 does not divide its points among its images" in sentence_of(tmp_path)
