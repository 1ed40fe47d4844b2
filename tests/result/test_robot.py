"""LiDARs and wheels in the result: its files, its report, and one sensor seen from another."""

from __future__ import annotations

import dataclasses
import html
import json
import re
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml
from scipy.spatial.transform import Rotation
from tests.pages import figures_of

from icalib.cli.console import print_result
from icalib.errors import CalibrationError
from icalib.export.formats import write_outputs
from icalib.report import report_html
from icalib.result import Calibration, RecordingSpan, SensorFit, load_calibration, relative_pose, relative_poses
from icalib.result.quantities import rows
from icalib.rig import ImuNoise, ImuSensor, Lidar, Rig, Wheels, by_name
from icalib.sensors.lidar import show
from icalib.validation import causes

ROBOT_FIGURES = {"points-0", "distance-0", "wheels-0", "map-before", "map-after"}


def words_of(text: str) -> str:
    body = text[text.index("<body>") : text.index("<script")]
    return html.unescape(re.sub("<[^>]*>", "", body))


@pytest.fixture(params=["robot", "without_cameras"])
def either(request: pytest.FixtureRequest) -> Calibration:
    return request.getfixturevalue(request.param)


def test_round_trip_is_exact(either: Calibration, tmp_path: Path, same: Callable[[Any, Any], bool]):
    either.save(tmp_path)
    assert same(load_calibration(tmp_path), either)


def test_points_on_planes_that_are_not_there_are_refused(robot: Calibration, tmp_path: Path):
    robot.save(tmp_path)
    file = tmp_path / "result.json"
    plain = json.loads(file.read_text())
    file.write_text(json.dumps(plain | {"planes": plain["planes"][:2]}))
    with pytest.raises(CalibrationError, match="lidar0 has points on planes that are not there"):
        load_calibration(tmp_path)


def test_yaml_has_all_sensors(robot: Calibration, tmp_path: Path):
    robot.save(tmp_path)
    data = yaml.safe_load((tmp_path / "calibration.yaml").read_text())
    lidar, wheels = data["sensors"]["lidar0"], data["sensors"]["wheel0"]
    assert (lidar["type"], wheels["type"]) == ("lidar", "wheels")
    np.testing.assert_array_equal(lidar["T_imu_sensor"], robot.T_imu_sensor("lidar0"))
    assert lidar["time_offset"] == -0.01 and lidar["verdict"]["rotation"] == ["determined"] * 3
    assert wheels["parameters"] == {"radius_left": 0.1, "radius_right": 0.102, "baseline": 0.42}
    assert wheels["std"]["parameters"]["radius_right"] == robot.group("wheel0", "radii").std[1]
    assert wheels["verdict"]["parameters"]["baseline"] == "determined"
    assert list(data["relative"]) == [r.name for r in relative_poses(robot)]
    seen = data["relative"]["T_cam0_lidar0"]
    np.testing.assert_allclose(
        robot.T_imu_sensor("cam0") @ np.array(seen["T"]), robot.T_imu_sensor("lidar0"), atol=1e-14
    )
    std = [*seen["std"]["rotation"], *seen["std"]["translation"]]
    np.testing.assert_allclose(np.sqrt(np.diag(seen["covariance"])), std)


def test_which_poses_are_relative(robot: Calibration, without_cameras: Calibration):
    names = [r.name for r in relative_poses(robot)]
    cams = [f"T_{cam}_{x}" for cam in ("cam0", "cam1") for x in ("lidar0", "wheel0")]
    assert names == ["T_cam0_cam1", *cams, "T_lidar0_wheel0"]
    assert [r.name for r in relative_poses(without_cameras)] == ["T_lidar0_wheel0"]


def test_which_sensors_have_a_lens(robot: Calibration, without_cameras: Calibration):
    assert robot.lenses == dict.fromkeys(("cam0", "cam1"), ("intrinsics", "distortion"))
    assert without_cameras.lenses == {}


def moved(c: Calibration, sensor: str, step: np.ndarray) -> np.ndarray:
    """T_imu_sensor moved by (rotation on the right, translation)."""
    T = c.T_imu_sensor(sensor).copy()
    T[:3, :3] = T[:3, :3] @ Rotation.from_rotvec(step[:3]).as_matrix()
    T[:3, 3] += step[3:]
    return T


def test_relative_covariance_is_that_of_samples(robot: Calibration):
    """Both sensors drawn from their joint covariance, factors included; the errors of T_cam0_lidar0 as defined."""
    groups = [robot.group(s, n) for s in ("cam0", "lidar0") for n in ("rotation", "translation")]
    columns = np.concatenate([np.array(g.columns) for g in groups])
    factors = np.concatenate([np.array(g.factor) for g in groups])
    joint = robot.covariance[np.ix_(columns, columns)] * np.outer(factors, factors)
    drawn = np.random.default_rng(3).multivariate_normal(np.zeros(12), joint, 20_000)
    found = relative_pose(robot, "cam0", "lidar0")
    errors = []
    for d in drawn:
        T = np.linalg.solve(moved(robot, "cam0", d[:6]), moved(robot, "lidar0", d[6:]))
        turn = Rotation.from_matrix(found.T[:3, :3].T @ T[:3, :3]).as_rotvec()
        errors.append(np.concatenate([turn, T[:3, 3] - found.T[:3, 3]]))
    scale = found.std
    sampled = np.cov(np.array(errors).T) / np.outer(scale, scale)
    np.testing.assert_allclose(found.covariance / np.outer(scale, scale), sampled, atol=0.04)
    assert np.abs(found.covariance[:3, 3:] / np.outer(scale[:3], scale[3:])).max() > 0.1  # else nothing was seen of it


def test_a_sensor_that_is_fixed_adds_nothing(robot: Calibration):
    lidar = [g for g in robot.groups if g.sensor == "lidar0"]
    held = [dataclasses.replace(g, columns=None) for g in lidar]
    found = relative_pose(
        dataclasses.replace(robot, groups=(*(g for g in robot.groups if g.sensor != "lidar0"), *held)), "lidar0", "cam0"
    )
    own = robot.group("cam0", "rotation")
    np.testing.assert_allclose(found.std[:3], own.std, rtol=1e-12)


def test_report_has_its_figures(either: Calibration):
    text = report_html(either)
    figures = figures_of(text)
    assert set(figures) >= ROBOT_FIGURES
    assert set(re.findall(r'<div class="plot ?[^"]*" id="([^"]*)"', text)) >= set(figures)
    assert all(f["data"] and f["layout"] for f in figures.values())
    assert len(text.encode()) < 3.5e6
    assert any(name.startswith("plane-") for name in figures) == bool(either.cameras)


def test_report_says_it_in_words(robot: Calibration, without_cameras: Calibration):
    words = words_of(report_html(robot))
    for part in ("lidar0 lidar determined", "wheel0 wheels determined", "radius rightdetermined102.00± 0.12 mm"):
        assert part in words, part
    (r,) = robot.lidar_residuals
    first, now = (1e3 * np.sqrt(np.mean(x.astype(float) ** 2)) for x in (r.first_residual, r.residual))
    assert f"40000 of 90000 points used; off their planes {first:.1f} mm RMS at first, {now:.1f} mm now" in words
    assert "150 scans with 40000 points on 3 planes" in words and "T_cam1_wheel0" in words
    bare = words_of(report_html(without_cameras))
    assert "Calibration of imu0 + lidar0 + wheel0" in bare and "corners" not in bare.split("Parameters")[0]


def test_tables_show_radii_in_millimetres(robot: Calibration):
    found = {r.name: (r.value, r.unit) for r in rows(robot) if r.sensor == "wheel0"}
    assert found["radius right"] == ("102.00", "mm")
    assert found["baseline"] == ("420.0", "mm")


def test_points_in_space_are_coloured_by_their_residual(robot: Calibration):
    maps = show.plane_maps(robot)
    r, (before, after) = robot.lidar_residuals[0], (maps[f"map-{x}"]["data"][0] for x in ("before", "after"))
    np.testing.assert_allclose(after["marker"]["color"], np.minimum(1e3 * np.abs(r.residual), 4 * 30.2), atol=0.3)
    assert np.mean(before["marker"]["color"]) > 2.5 * np.mean(after["marker"]["color"])
    np.testing.assert_allclose(after["x"], r.world[:, 0], atol=1e-3)
    assert before["marker"]["cmax"] == after["marker"]["cmax"]


def test_each_recording_has_a_map_of_its_own(robot: Calibration, assert_drawn: Callable[[str, set[str]], None]):
    r = robot.lidar_residuals[0]
    middle = float(np.median(r.seconds))
    first, second = r.seconds <= middle, r.seconds > middle
    spans = tuple(
        RecordingSpan(name, float(r.seconds[own].min()), float(r.seconds[own].max()), 0)
        for name, own in (("hall", first), ("yard", second))
    )
    several = dataclasses.replace(robot, recordings=spans)
    maps = show.plane_maps(several)
    one, other = (t for t in maps["map-after"]["data"] if t["name"] == "points")
    np.testing.assert_allclose(one["x"], r.world[first, 0], atol=1e-3)
    np.testing.assert_allclose(other["x"], r.world[second, 0], atol=1e-3)
    assert [t["visible"] for t in maps["map-after"]["data"]] == [True, True, False, False]
    (menu,) = maps["map-after"]["layout"]["updatemenus"]
    assert [b["label"] for b in menu["buttons"]] == ["hall", "yard"]
    assert menu["buttons"][1]["args"] == ["visible", [False, False, True, True]]
    assert [len(m["data"]) for m in maps.values()] == [2, 4]
    assert "updatemenus" not in show.plane_maps(robot)["map-after"]["layout"]
    assert_drawn(report_html(several), {"map-before", "map-after"})


def test_outlines_lie_in_their_planes_about_their_points(robot: Calibration):
    pen = show.plane_maps(robot)["map-after"]["data"][1]
    corners = np.array([pen[k] for k in "xyz"], dtype=float).T.reshape(-1, 6, 3)[:, :5]
    for plane, rectangle in zip(robot.planes, corners, strict=True):
        np.testing.assert_allclose((rectangle - plane.point) @ plane.normal, 0.0, atol=1e-3)
        centre = rectangle[:4].mean(axis=0)
        np.testing.assert_allclose(centre - plane.point, (centre - plane.point) @ plane.normal * plane.normal, atol=0.1)


def test_means_over_distance_show_a_pattern(robot: Calibration):
    """A range that is 1 % too long."""
    r = robot.lidar_residuals[0]
    long = dataclasses.replace(r, residual=(r.residual + 0.01 * r.distance).astype(np.float32))
    trace = show.residuals_over_distance(long)["data"][2]
    x, y = (np.array(trace[k], dtype=float) for k in "xy")
    slope = np.polyfit(x[np.isfinite(y)], y[np.isfinite(y)], 1)[0]
    assert slope == pytest.approx(10.0, abs=1.0)


def test_walls_of_several_lidars_from_above(robot: Calibration):
    """The first guess is where the points were first; floors are left out."""
    r = robot.lidar_residuals[0]
    second = dataclasses.replace(r, sensor="lidar1", first_world=r.first_world + np.float32(0.5))
    both = dataclasses.replace(robot, residuals=robot.residuals | {("lidar1", "points"): second})
    upright = np.array([abs(p.normal[2]) < 0.5 for p in robot.planes])
    on_wall = r.world[upright[r.plane]]
    before, after = (show.walls(both, first)["data"] for first in (True, False))
    assert [t["name"] for t in after] == ["lidar0", "lidar1"] and 0 < len(after[0]["x"]) <= show.MAX_WALL_POINTS
    assert after[0]["x"] == after[1]["x"] and np.ptp(after[0]["x"]) <= np.ptp(on_wall[:, 0])
    np.testing.assert_allclose(np.subtract(before[1]["x"], before[0]["x"]), 0.5, atol=1e-3)


def test_a_browser_draws_it(without_cameras: Calibration, assert_drawn: Callable[[str, set[str]], None]):
    text = report_html(without_cameras)
    assert_drawn(text, set(figures_of(text)))


def test_files_and_words_without_a_camera(
    without_cameras: Calibration, tmp_path: Path, capsys: pytest.CaptureFixture[str]
):
    write_outputs(without_cameras, tmp_path)
    names = {"calibration.yaml", "imu.yaml", "report.html", "result.json", "result.npz"}
    assert {p.name for p in tmp_path.iterdir()} == names
    print_result(without_cameras, tmp_path)
    shown = " ".join(capsys.readouterr().out.split())
    assert "T_lidar0_wheel0: x, y, z" in shown and "radius left" in shown
    assert "lidar0 points: chi^2 per degree of freedom 1.01 (39900), 30.0 mm RMS" in shown
    assert "camchain" not in shown and "camchain" not in (tmp_path / "calibration.yaml").read_text()


def warnings(
    kind: str,
    ratio: float,
    dof: float = 300.0,
    sensor: str = "wheel0",
    noise: float | None = 0.02,
    white: bool = True,
    **wheels: Any,
) -> str:
    imu = ImuSensor("imu0", "imu0", ImuNoise(1e-4, 1e-5, 1e-3, 1e-4))
    rig = Rig(by_name(imu, Lidar("lidar0", "lidar0", noise), Wheels("wheel0", "wheel0", **wheels)))
    return causes.misfit_words(rig, SensorFit(sensor, kind, 400, dof, ratio * dof), white) or ""


def test_more_slip_than_allowed_is_warned_of():
    words = warnings("lateral slip", 9.0)
    assert "lateral slip residuals of wheel0 are 3x larger than lateral_slip predicts" in words
    assert "write lateral_slip: 0.015 (m/sqrt(s))" in words
    assert "vertical_slip: 0.01 " in warnings("vertical slip", 4.0) and "wheel_noise: 0.06 " in warnings("wheels", 4.0)
    assert "use factor: increments" in warnings("yaw", 4.0) and "yaw residuals of wheel0" in warnings("yaw", 4.0)
    assert warnings("lateral slip", 1.9) == "" and warnings("lateral slip", 5.0, dof=30.0) == ""
    # Few degrees of freedom, which are sampled: 30 of 400 rows may as well be 90.
    assert "at least 1.7x larger" in warnings("lateral slip", 9.0, dof=30.0)


@pytest.mark.parametrize("kind", ["lateral slip", "wheels", "yaw"])
def test_no_other_size_is_advised_where_residuals_are_no_noise(kind: str):
    words = warnings(kind, 9.0, white=False)
    assert "no white noise" in words and "write" not in words


def test_more_noise_of_other_kinds_of_wheels_is_warned_of():
    yaw = warnings("yaw", 4.0, measures="twist")
    assert "yaw rates residuals of wheel0 are 2x larger" in yaw and "yaw_noise: 0.02 (rad/sqrt(s))" in yaw
    assert "speed_noise: 0.004 (m/sqrt(s))" in warnings("speed", 4.0, measures="twist")
    assert "steering_noise: 0.002 (rad/sqrt(Hz))" in warnings("steering", 4.0, drive="ackermann")
    assert "wheel angles residuals of wheel0" in warnings("wheel", 4.0, drive="ackermann")
    assert "tilts against its ground 2x more than tilt_noise predicts" in warnings("ground tilt", 4.0)
    assert "moves up and down over its ground 3x more than bump_noise" in warnings("ground height", 9.0)


def test_more_range_noise_than_given_is_warned_of():
    assert "2x larger than its range_noise predicts" in warnings("points", 4.0, sensor="lidar0")
    assert warnings("points", 4.0, sensor="lidar0", noise=None) == ""
