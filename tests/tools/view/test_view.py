"""What `icalib view` writes, read back by Rerun's own reader, against the result and against the truth."""

from __future__ import annotations

import dataclasses
from itertools import pairwise
from pathlib import Path

import cv2
import numpy as np
import pytest
from scipy.spatial import KDTree
from scipy.spatial.transform import Rotation

from icalib.cli import main
from icalib.report.rig_figures import ellipsoids, magnification
from icalib.result import Calibration, ParameterGroup, RowResiduals, by_key
from icalib.tools import view as recorded
from icalib.tools.view import view

IMAGE = "world/imu0/cam0/image"
MOST_OFF_M = 0.006  # five sigma of the LiDAR's position; 10 ms of time offset are 10 mm, a scan's 0.1 s are 100 mm


def _saved(c: Calibration, folder: Path, **changes) -> Path:
    dataclasses.replace(c, **changes).save(folder)
    return folder


def _matrix(rows: list, k: int) -> np.ndarray:
    """Rerun keeps matrices column by column."""
    return np.reshape(rows[k], (3, 3)).T


@pytest.fixture(scope="module")
def found(shown, read, tmp_path_factory):
    """The whole result and recording, from the command line."""
    file = tmp_path_factory.mktemp("view") / "a.rrd"
    assert main(["view", str(shown.result), str(shown.recording), "--save", str(file), "--quiet"]) == 0
    assert [p.name for p in file.parent.iterdir()] == ["a.rrd"]
    return read(file)


def test_every_part_of_result_and_recording_is_there(found):
    still = {"world/imu0/lidar0/shape", "world/target/board0/outline", "world/target/board0/points", "summary"}
    still |= {f"world/imu0/uncertainty/{name}" for name in ("cam0", "lidar0")}
    over = {"world/imu0", "world/trajectory", "world/target", "world/planes/lidar0", "world/scans/lidar0"}
    over |= {IMAGE, f"{IMAGE}/corners", "readings/imu0/gyro", "readings/imu0/accel", "motion/velocity"}
    over |= {"residuals/cam0/corners", "residuals/lidar0", "residuals/imu0/rotation", "residuals/imu0/accel_walk"}
    assert all(np.isnan(found[name].seconds).all() for name in still)
    assert all(np.isfinite(found[name].seconds).any() for name in over)


def test_sensors_stand_where_the_result_has_them(found, shown):
    for name in ("cam0", "lidar0"):
        T, rows = shown.calibration.T_imu_sensor(name), found[f"world/imu0/{name}"].values
        np.testing.assert_allclose(rows["Transform3D:translation"][0][0], T[:3, 3], atol=1e-7)
        np.testing.assert_allclose(_matrix(rows["Transform3D:mat3x3"], 0), T[:3, :3], atol=1e-7)


def test_the_body_moves_as_the_trajectory_does(found, shown):
    path, rows = shown.calibration.trajectory, found["world/imu0"]
    moving = np.isfinite(rows.seconds)
    np.testing.assert_allclose(rows.seconds[moving], path.seconds, atol=1e-9)
    assert rows.seconds[moving][0] < 1.0  # the time line is in seconds from the start
    k = len(path.seconds) // 3
    np.testing.assert_allclose(rows.values["Transform3D:translation"][k][0], path.position[k], atol=1e-6)
    np.testing.assert_allclose(_matrix(rows.values["Transform3D:mat3x3"], k), path.rotation[k], atol=1e-6)


def test_a_camera_looks_through_its_lens(found, shown):
    """A point on the axis falls on the principal point, which Rerun counts from the corner of the image."""
    fx, fy, cx, cy = shown.calibration.group("cam0", "intrinsics").value
    K = _matrix(found[IMAGE].values["Pinhole:image_from_camera"], 0)
    np.testing.assert_allclose(K, [[fx, 0.0, cx + 0.5], [0.0, fy, cy + 0.5], [0.0, 0.0, 1.0]], rtol=1e-6)
    assert found[IMAGE].values["Pinhole:resolution"][0][0] == [752.0, 480.0]


def test_images_are_at_their_corrected_times(found, shown):
    imu, camera = shown.simulation.measurements.imu, shown.simulation.measurements.cameras[0]
    offset = float(shown.calibration.group("cam0", "time_offset").value[0])
    stamps = camera.stamps_ns[::4].tolist()
    wanted = [(stamp - int(imu.stamps_ns[0])) / 1e9 + offset for stamp in stamps]
    rows = found[IMAGE]
    np.testing.assert_allclose(rows.seconds[np.isfinite(rows.seconds)], wanted, atol=2e-9)
    for k in (0, 7):
        blob = np.frombuffer(bytes(rows.values["EncodedImage:blob"][k][0]), np.uint8)
        image = cv2.imdecode(blob, cv2.IMREAD_GRAYSCALE)
        assert image is not None
        assert image.shape == (480, 752)
        assert abs(float(image[20:, 20:].mean()) - (20 + k)) < 1.0


def test_corners_are_on_the_pixels_that_were_measured(found, shown):
    r, rows = shown.calibration.corner_residuals[0], found[f"{IMAGE}/corners"]
    k = int(np.argmax(np.diff(r.start) > 3))
    np.testing.assert_allclose(rows.seconds[np.isfinite(rows.seconds)], r.seconds, atol=1e-9)
    uv = r.uv[r.start[k] : r.start[k + 1]]
    np.testing.assert_allclose(rows.values["Points2D:positions"][k], uv + 0.5, atol=1e-4)


def test_the_target_stands_as_the_result_has_it(found, shown):
    """Point 0 is the origin of the world; the truth knows how the board leans, and the world's heading is free."""
    R = _matrix(found["world/target"].values["Transform3D:mat3x3"], 0)
    truth = shown.simulation.truth.T_world_board[:3, :3]
    np.testing.assert_allclose(R[2], truth[2], atol=2e-3)
    points = np.array(found["world/target/board0/points"].values["Points3D:positions"][0])
    np.testing.assert_allclose(points[0], 0.0, atol=1e-6)
    assert len(points) == len(shown.simulation.scenario.target.points)


def _true_points(shown, scan: int) -> tuple[np.ndarray, np.ndarray]:
    """(N, 3) all points of a scan in the simulated world, each from where the LiDAR was at its instant; and (N,) these
    on the clock of the result."""
    truth, m = shown.simulation.truth, shown.simulation.measurements
    stream, T = m.lidars[0], truth.T_imu_sensor["lidar0"]
    own = slice(*stream.start[scan : scan + 2])
    seconds = (int(stream.stamps_ns[scan]) - truth.imu_clock_origin_ns) * 1e-9 + truth.time_offset["lidar0"]
    R, p, _ = truth.pose_at(seconds + stream.offset_s[own].astype(np.float64))
    on_body = stream.xyz[own] @ T[:3, :3].T + T[:3, 3]
    return np.einsum("nij,nj->ni", R, on_body) + p, seconds + stream.offset_s[own]


def test_points_of_scans_lie_where_the_truth_puts_them(found, shown):
    """Up to how well the calibration knows it; the simulated world is turned and shifted as the trajectories say."""
    path, truth = shown.calibration.trajectory, shown.simulation.truth
    first_ns = int(shown.simulation.measurements.imu.stamps_ns[0])
    late = (first_ns - truth.imu_clock_origin_ns) * 1e-9
    R, p, _ = truth.pose_at(path.seconds + late)
    turn = Rotation.from_matrix(path.rotation @ R.transpose(0, 2, 1)).mean()
    shift = (path.position - turn.apply(p)).mean(axis=0)
    rows, offset = found["world/scans/lidar0"], float(shown.calibration.group("lidar0", "time_offset").value[0])
    stamps_ns = shown.simulation.measurements.lidars[0].stamps_ns
    for k in (5, 40, 80):
        scan = int(np.argmin(np.abs((stamps_ns - first_ns) * 1e-9 + offset - rows.seconds[k])))
        points, seconds = _true_points(shown, scan)
        known = (seconds - late >= path.seconds[0]) & (seconds - late <= path.seconds[-1])
        error = np.array(rows.values["Points3D:positions"][k]) - (turn.apply(points) + shift)[known]
        assert np.linalg.norm(error, axis=1).max() < MOST_OFF_M


def _most_off_px(shown, pixels: list, seconds: float, world: np.ndarray) -> float:
    """95th percentile of the distance [px] from pixels of Rerun, which it counts from the corner of the image, to the
    nearest of the points `world` (n, 3) of the simulated world, at an instant of the result."""
    truth, camera = shown.simulation.truth, shown.simulation.scenario.cameras[0]
    late = (int(shown.simulation.measurements.imu.stamps_ns[0]) - truth.imu_clock_origin_ns) * 1e-9
    fx, fy, cx, cy = camera.intrinsics
    (R,), (p,), _ = truth.pose_at(np.array([seconds + late]))
    T, K = truth.T_imu_sensor["cam0"], np.array([[fx, 0.0, cx], [0.0, fy, cy], [0.0, 0.0, 1.0]])
    in_camera = ((world - p) @ R - T[:3, 3]) @ T[:3, :3]
    ahead = in_camera[in_camera[:, 2] > 0.3]
    uv = cv2.projectPoints(ahead, np.zeros(3), np.zeros(3), K, np.array(camera.distortion))[0][:, 0] + 0.5
    return float(np.quantile(KDTree(uv).query(np.array(pixels))[0], 0.95))


def test_points_of_scans_lie_in_images_where_the_truth_has_them(found, shown):
    m, rows = shown.simulation.measurements, found[f"{IMAGE}/lidar0"]
    seconds = (m.lidars[0].stamps_ns - m.imu.stamps_ns[0]) * 1e-9
    for k in (8, 20, 33):
        scan = int(np.argmin(np.abs(seconds - rows.seconds[k])))
        world = np.concatenate([_true_points(shown, s)[0] for s in (scan - 1, scan, scan + 1)])
        pixels = rows.values["Points2D:positions"][k]
        assert len(pixels) > 300
        assert _most_off_px(shown, pixels, rows.seconds[k], world) < 1.5  # 6 mm at 2 m


def test_outlines_of_the_target_lie_in_images_where_the_truth_has_them(found, shown):
    (x0, y0), (x1, y1) = shown.simulation.scenario.target.outlines[0]
    along = np.linspace(0.0, 1.0, 5000)[:, None]
    corners = np.array([[x0, y0, 0.0], [x1, y0, 0.0], [x1, y1, 0.0], [x0, y1, 0.0], [x0, y0, 0.0]])
    sheet = np.concatenate([a + along * (b - a) for a, b in pairwise(corners)])
    T, rows = shown.simulation.truth.T_world_board, found[f"{IMAGE}/target"]
    strips = rows.values["LineStrips2D:strips"]
    drawn = [k for k in range(len(strips)) if strips[k]]
    assert len(drawn) > 10
    for k in drawn[::10]:
        pixels = [uv for strip in strips[k] for uv in strip]
        assert _most_off_px(shown, pixels, rows.seconds[k], sheet @ T[:3, :3].T + T[:3, 3]) < 1.5


def test_lines_hold_what_the_result_holds(found, shown):
    c = shown.calibration
    r, rows = c.corner_residuals[0], found["residuals/cam0/corners"]
    k = int(np.argmax(np.diff(r.start) > 3))
    own = slice(r.start[k], r.start[k + 1])
    rms = np.sqrt(np.mean(r.residual[own][~r.rejected[own]].astype(np.float64) ** 2))
    lines, moments = rows.values["Scalars:scalars"], rows.seconds[np.isfinite(rows.seconds)]
    np.testing.assert_allclose(lines[int(np.argmin(np.abs(moments - r.seconds[k])))], [rms], rtol=1e-12)
    np.testing.assert_allclose(
        found["residuals/imu0/velocity"].values["Scalars:scalars"], c.imu_residuals[0].whitened[:, 3:6], rtol=1e-12
    )
    np.testing.assert_allclose(
        found["readings/imu0/gyro"].values["Scalars:scalars"],
        np.rad2deg(shown.simulation.measurements.imu.gyro),
        atol=1e-5,
    )
    total = np.sum(c.lidar_residuals[0].residual.astype(np.float64) ** 2)
    r = c.lidar_residuals[0]
    counts = np.unique(np.floor(r.seconds / 0.1), return_counts=True)[1]
    rms = np.array(found["residuals/lidar0"].values["Scalars:scalars"])[:, 0]
    np.testing.assert_allclose(np.sum(counts * rms**2) * 1e-6, total, rtol=1e-9)


def test_ellipsoids_are_three_sigma_of_the_covariance_with_its_factor(found, shown):
    c = shown.calibration
    for e in ellipsoids(c):
        g = c.group(e.sensor, "translation")
        P = c.covariance[np.ix_(g.columns, g.columns)] * np.outer(g.factor, g.factor)
        np.testing.assert_allclose(e.axes @ np.diag((e.half_sizes / 3.0) ** 2) @ e.axes.T, P, rtol=1e-9, atol=1e-20)
        assert np.linalg.det(e.axes) == pytest.approx(1.0)
        rows = found[f"world/imu0/uncertainty/{e.sensor}"].values
        turned = Rotation.from_quat(rows["Ellipsoids3D:quaternions"][0][0]).as_matrix()
        half = np.array(rows["Ellipsoids3D:half_sizes"][0][0]) / magnification(c)
        np.testing.assert_allclose(turned @ np.diag(half**2) @ turned.T, 9.0 * P, rtol=1e-4, atol=1e-5 * P.max())


def test_the_summary_says_how_large_ellipsoids_are_drawn(found, shown):
    text = found["summary"].values["TextDocument:text"][0][0]
    assert f"{magnification(shown.calibration):g} times as large" in text
    assert "| cam0 | fx |" in text


def test_a_result_alone_needs_no_recording(shown, read, tmp_path, capsys):
    assert main(["view", str(shown.result / "result.json"), "--save", str(tmp_path / "a.rrd")]) == 0
    found = read(tmp_path / "a.rrd")
    assert "world/imu0" in found
    assert not [name for name in found if name.startswith(("readings", "world/scans"))]
    assert capsys.readouterr().out == f"Wrote {tmp_path / 'a.rrd'}: open it by `rerun {tmp_path / 'a.rrd'}`.\n"


def test_long_recordings_are_thinned_which_is_said(shown, read, tmp_path, monkeypatch, capsys):
    for name, most in (("READINGS", 1000), ("IMAGES", 10), ("SCANS", 20), ("POINTS", 300)):
        monkeypatch.setattr(recorded, f"MOST_{name}", most)
    assert main(["view", str(shown.result), str(shown.recording), "--save", str(tmp_path / "a.rrd")]) == 0
    found, said = read(tmp_path / "a.rrd"), capsys.readouterr().out
    assert 700 < np.isfinite(found["readings/imu0/gyro"].seconds).sum() <= 1000
    assert 7 < np.isfinite(found[IMAGE].seconds).sum() <= 10
    clouds = found["world/scans/lidar0"].values["Points3D:positions"]
    assert 15 < len(clouds) <= 20
    assert 150 < max(map(len, clouds)) <= 300
    for what in ("imu0: one in 4 of its 3601 readings", "cam0: one in ", "points of a scan"):
        assert what in said
    assert "cam0: one in 6 of its 54 images is shown." in found["summary"].values["TextDocument:text"][0][0]


def test_without_an_imu_the_first_camera_is_the_body(shown, read, tmp_path):
    c = shown.calibration
    rig = c.rig | {"sensors": {n: s for n, s in c.rig["sensors"].items() if s["type"] != "imu"}}
    residuals = {key: r for key, r in c.residuals.items() if key[0] in rig["sensors"]}
    view(_saved(c, tmp_path / "out", rig=rig, residuals=residuals), save=tmp_path / "a.rrd")
    found = read(tmp_path / "a.rrd")
    assert np.isfinite(found["world/cam0"].seconds).sum() == len(c.trajectory.seconds)
    assert {"world/cam0/image", "world/cam0/lidar0"} <= set(found)
    assert not [name for name in found if "imu0" in name or name.startswith("motion")]


def test_each_of_several_recordings_has_its_own_world(shown, read, tmp_path):
    """The way, the planes' points and the target are shown from the start of each recording on."""
    c = shown.calibration
    only, middle = c.recordings[0], 6.0
    spans = (
        dataclasses.replace(only, name="monday", end=middle - 0.1),
        dataclasses.replace(only, name="friday", start=middle + 0.1),
    )
    tilt = c.group("board0", "tilt")
    second = dataclasses.replace(
        tilt, sensor="board0-friday", value=tilt.value @ Rotation.from_rotvec([0, 0, 0.3]).as_matrix()
    )
    result = _saved(c, tmp_path / "out", recordings=spans, groups=(*c.groups, second))
    view(result, save=tmp_path / "a.rrd")
    found = read(tmp_path / "a.rrd")
    lines = found["world/trajectory"]
    np.testing.assert_allclose(lines.seconds, [spans[0].start, spans[1].start], atol=1e-9)
    lengths = [len(row[0]) for row in lines.values["LineStrips3D:strips"]]
    assert lengths == [(c.trajectory.seconds < middle).sum(), (c.trajectory.seconds > middle).sum()]
    np.testing.assert_allclose(_matrix(found["world/target"].values["Transform3D:mat3x3"], 1), second.value, atol=1e-6)
    assert len(found["world/planes/lidar0"].seconds) == 2


def test_wheels_are_drawn_and_their_residuals_too(shown, read, tmp_path):
    c = shown.calibration
    values = {"rotation": np.eye(3), "translation": [0, 0, -0.3], "radii": [0.1, 0.11], "baseline": [0.5]}
    groups = tuple(_fixed("wheel0", name, np.array(value, np.float64)) for name, value in values.items())
    rig = c.rig | {"sensors": c.rig["sensors"] | {"wheel0": {"type": "wheels", "path": "wheel0/rates.csv"}}}
    rows = np.arange(12.0).reshape(6, 2)
    wheels = RowResiduals(
        "wheel0", "increments", ("left", "lateral slip"), ("rad", "m"), np.arange(6.0), rows, 2.0 * rows
    )
    result = _saved(c, tmp_path / "out", rig=rig, groups=(*c.groups, *groups), residuals=c.residuals | by_key([wheels]))
    view(result, save=tmp_path / "a.rrd")
    found = read(tmp_path / "a.rrd")
    rims = [s for s in found["world/imu0/wheel0/shape"].values["LineStrips3D:strips"][0] if len(s) == 41]
    assert [np.ptp(np.array(rim)[:, 2]) for rim in rims] == pytest.approx([0.2, 0.22], abs=1e-3)
    lines = found["residuals/wheel0/lateral_slip"].values["Scalars:scalars"]
    assert lines == [[x] for x in (2.0 * rows[:, 1]).tolist()]
    assert "world/imu0/uncertainty/wheel0" not in found  # what is fixed is known


def _fixed(sensor: str, name: str, value: np.ndarray) -> ParameterGroup:
    n = 3 if value.ndim == 2 else len(value)
    zeros = np.zeros(n)
    return ParameterGroup(sensor, name, tuple("xyz")[:n], "m", value, zeros, zeros, ("fixed",) * n, "fixed")
