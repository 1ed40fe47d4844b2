"""A calibration at Python's prompt: short repr, summary, HTML, values, and poses between any two sensors."""

from __future__ import annotations

import dataclasses
import re
import sys
from html.parser import HTMLParser
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from tests.remarks import remark

import icalib
from icalib.geometry import so3
from icalib.result import Calibration, relative_pose


def test_the_repr_is_one_short_line(robot: Calibration):
    assert (
        repr(robot) == f"<Calibration of imu0, cam0, cam1, lidar0, wheel0: {robot.verdict}, 3 reasons; see .summary()>"
    )
    good = dataclasses.replace(robot, warnings=(), unobservable=(), groups=robot.groups[:1])
    assert repr(good) == "<Calibration of imu0, cam0, cam1, lidar0, wheel0: usable; see .summary()>"


def test_the_summary_has_verdict_reasons_and_every_parameter(robot: Calibration):
    lines = robot.summary().splitlines()
    assert lines[0] == f"Verdict: {robot.verdict}"
    assert lines[1 : 1 + len(robot.reasons)] == [f"Reason {k}: {r}" for k, r in enumerate(robot.reasons, 1)]
    table = lines[2 + len(robot.reasons) :]
    assert table[0].split() == ["sensor", "parameter", "value", "std", "unit", "verdict"]
    group = robot.group("cam1", "translation")
    (row,) = (line.split() for line in table if re.match(r"cam1 +translation y ", line))
    assert row[-1] == "unobservable" and row[-2] == "mm"
    assert float(row[-4]) == pytest.approx(1e3 * group.value[1], abs=0.05)
    assert float(row[-3]) == pytest.approx(1e3 * group.std[1], rel=0.05)
    assert max(map(len, table)) < 100


class Cells(HTMLParser):
    def __init__(self, text: str) -> None:
        super().__init__()
        self.texts: list[str] = []
        self.open: list[str] = []
        self.feed(text)

    def handle_starttag(self, tag: str, attrs: object) -> None:
        self.open.append(tag)

    def handle_endtag(self, tag: str) -> None:
        assert self.open.pop() == tag

    def handle_data(self, data: str) -> None:
        self.texts += [data] if data.strip() else []


def test_notebooks_show_the_same_as_html(robot: Calibration):
    sharp = dataclasses.replace(robot, warnings=(remark("cam0 < cam1 & more."),))
    found = Cells(sharp._repr_html_())
    assert found.open == [] and found.texts[0] == f"Verdict: {sharp.verdict}"
    assert "cam0 < cam1 & more." in found.texts and "unobservable" in found.texts
    words = " ".join(sharp.summary().split("\n\n")[1].split())
    assert " ".join(" ".join(t.split()) for t in found.texts[1 + len(sharp.reasons) :] if t) == words


def test_figures_for_notebooks(robot: Calibration):
    """They are those of the report, as objects of plotly."""
    assert {t.name for t in robot.plot_rig().data} >= {"sensors", "cam0", "lidar0"}
    assert {t.name for t in robot.plot_trajectory().data} >= {"imu0", "ends", "board0"}
    for sensor in ("imu0", "cam0", "lidar0", "wheel0"):
        figure = robot.plot_residuals(sensor)
        assert figure.layout.xaxis.title.text == "time [s]" and len(figure.data[0].x) > 50
    (count,) = robot.plot_coverage("cam0").data
    used = next(r for r in robot.corner_residuals if r.sensor == "cam0").used
    assert np.nansum(np.array(count.z, float)) == used.sum()
    with pytest.raises(KeyError, match="no residuals of lidar9; there are .*corners of cam0"):
        robot.plot_residuals("lidar9")
    with pytest.raises(KeyError, match="no images of lidar0; there are cam0, cam1"):
        robot.plot_coverage("lidar0")


def test_values_and_standard_deviations(robot: Calibration):
    assert robot.value("wheel0", "radii").tolist() == [0.1, 0.102]
    np.testing.assert_array_equal(robot.std("cam0", "rotation"), robot.group("cam0", "rotation").std)
    with pytest.raises(KeyError, match="no radius of wheel0; there are .*wheel0.radii"):
        robot.std("wheel0", "radius")


def test_the_pose_of_any_sensor_in_any_other(robot: Calibration):
    T = robot.T("cam0", "lidar0")
    np.testing.assert_array_equal(np.asarray(T), T.T)
    np.testing.assert_allclose(np.asarray(robot.T("lidar0", "cam0")) @ T, np.eye(4), atol=1e-12)
    np.testing.assert_allclose(robot.T("imu0", "cam1"), robot.T_imu_sensor("cam1"), atol=1e-15)
    np.testing.assert_allclose(robot.T("cam1", "imu0"), np.linalg.inv(robot.T_imu_sensor("cam1")), atol=1e-12)
    np.testing.assert_allclose(robot.T("cam0", "cam0").covariance, np.zeros((6, 6)), atol=1e-16)
    assert robot.T("cam0", "lidar0").std.tolist() == relative_pose(robot, "cam0", "lidar0").std.tolist()
    with pytest.raises(KeyError, match="no sensor lidar1; there are imu0, cam0, cam1, lidar0, wheel0"):
        robot.T("cam0", "lidar1")


def test_the_covariance_of_the_imu_in_a_camera(robot: Calibration):
    """By draws of the camera's pose: T_cam_imu is the inverse of T_imu_cam."""
    rng, R, p = np.random.default_rng(1), robot.value("cam1", "rotation"), robot.value("cam1", "translation")
    columns = [k for name in ("rotation", "translation") for k in robot.group("cam1", name).columns or ()]
    factor = np.concatenate([robot.group("cam1", name).factor for name in ("rotation", "translation")])  # type: ignore[arg-type]
    covariance = robot.covariance[np.ix_(columns, columns)] * np.outer(factor, factor)
    draws = rng.multivariate_normal(np.zeros(6), covariance, 20_000)
    found = robot.T("cam1", "imu0")
    off = np.empty((len(draws), 6))
    turned = R @ Rotation.from_rotvec(draws[:, :3]).as_matrix()
    for k, (Q, q) in enumerate(zip(turned, p + draws[:, 3:], strict=True)):
        off[k, :3] = so3.log(np.ascontiguousarray(found.T[:3, :3].T @ Q.T))
        off[k, 3:] = -Q.T @ q - found.T[:3, 3]
    np.testing.assert_allclose(np.cov(off.T), found.covariance, atol=0.03 * found.covariance.diagonal().max())
    np.testing.assert_allclose(off.std(axis=0), found.std, rtol=0.03)


def test_load_calibration_is_at_hand(robot: Calibration, tmp_path):
    robot.save(tmp_path)
    assert repr(icalib.load_calibration(tmp_path)) == repr(robot)


def test_one_parameter_by_its_name(robot: Calibration):
    assert robot.value("cam0", "fx") == robot.value("cam0", "intrinsics")[0]
    assert robot.std("wheel0", "radius_right") == robot.std("wheel0", "radii")[1]
    with pytest.raises(KeyError, match="no fz of cam0; there are .*cam0.intrinsics"):
        robot.value("cam0", "fz")


def test_a_data_frame_has_a_row_for_each_entry(robot: Calibration, monkeypatch: pytest.MonkeyPatch):
    """pandas is no dependency: a module of that name stands for it."""
    monkeypatch.setitem(sys.modules, "pandas", SimpleNamespace(DataFrame=list))
    rows = {(r["sensor"], r["group"], r["entry"]): r for r in robot.to_dataframe()}
    row = rows["cam1", "translation", "y"]
    group = robot.group("cam1", "translation")
    assert (row["value"], row["std"], row["unit"], row["verdict"]) == (
        group.value[1], group.std[1], "m", "unobservable",
    )  # fmt: skip
    assert {("cam0", "rotation", turn) for turn in ("roll", "pitch", "yaw")} <= rows.keys()
    monkeypatch.setitem(sys.modules, "pandas", None)
    with pytest.raises(icalib.CalibrationError, match="need the package pandas, .*run pip install"):
        robot.to_dataframe()


def test_a_calibration_writes_exports_and_its_report(robot: Calibration, tmp_path: Path):
    sentences = robot.export("kalibr", tmp_path / "kalibr")
    assert (tmp_path / "kalibr" / "camchain-imucam.yaml").exists()
    assert "Kalibr has no place for lidar0, wheel0; see calibration.yaml." in sentences
    robot.report(tmp_path / "report.html")
    assert "<title>Calibration of imu0" in (tmp_path / "report.html").read_text()
    (tmp_path / "report.html").write_text("mine")
    with pytest.raises(icalib.CalibrationError, match="was not written by icalib"):
        robot.report(tmp_path / "report.html")


def test_commands_are_functions_of_the_package(robot: Calibration, tmp_path: Path):
    robot.save(tmp_path / "out")
    assert icalib.compare(robot, str(tmp_path / "out")).same
    assert icalib.check.__name__ == "check_calibration" and icalib.inspect.__name__ == "inspect_recording"
