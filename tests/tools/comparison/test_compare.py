"""`icalib compare`: what changed is found with its sign and significance, whatever file the other side is."""

from __future__ import annotations

import dataclasses
import json
import re
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml
from markupsafe import escape
from scipy.spatial.transform import Rotation
from scipy.stats import chi2, norm
from tests.pages import figures_of

from icalib.cli import main
from icalib.export.formats import export
from icalib.result import Calibration, ParameterGroup, Verdict, relative_pose
from icalib.sensors.fields import parameter_to_plain
from icalib.sensors.parameter import fixed
from icalib.tools.comparison.compare import (
    Comparison,
    ComparisonTolerances,
    Difference,
    Side,
    chi2_above,
    compare_sides,
    lines,
    sentence,
    side_of_result,
    sigmas,
)
from icalib.tools.comparison.reading import compare_files

NOISE = {"gyro": 1.6e-4, "gyro_walk": 2.2e-5, "accel": 2.8e-3, "accel_walk": 8.6e-4}


def changed(c: Calibration, changes: dict[tuple[str, str], np.ndarray]) -> Calibration:
    """`c` with tangent steps added to groups: rotations turned on the right."""
    groups = []
    for g in c.groups:
        step = changes.get((g.sensor, g.name))
        if step is not None:
            value = g.value @ Rotation.from_rotvec(step).as_matrix() if g.value.ndim == 2 else g.value + step
            g = dataclasses.replace(g, value=value)
        groups.append(g)
    return dataclasses.replace(c, groups=tuple(groups))


def compared(a: Calibration, b: Calibration, **options: Any) -> Comparison:
    return compare_sides(side_of_result(a, "a"), side_of_result(b, "b"), **options)


def only(found: Comparison, sensor: str, what: str, frame: str | None = None) -> Difference:
    matches = [d for d in found.differences if (d.sensor, d.what) == (sensor, what) and frame in (None, d.frame)]
    assert len(matches) == 1, matches
    return matches[0]


@pytest.fixture
def folders(robot: Calibration, tmp_path: Path) -> tuple[Path, Path]:
    """A result, and the same with cam1 turned by 0.2 deg about its x axis."""
    robot.save(tmp_path / "a")
    changed(robot, {("cam1", "rotation"): np.deg2rad([0.2, 0.0, 0.0])}).save(tmp_path / "b")
    return tmp_path / "a", tmp_path / "b"


def test_a_result_is_the_same_as_itself(robot: Calibration, without_cameras: Calibration):
    for c in (robot, without_cameras):
        found = compared(c, c)
        assert found.same and found.notes == () and all(d.size < 1e-9 for d in found.differences)
        assert lines(found)[-1] == f"The same in all {len(found.differences)} that were compared."
    blocks = {(d.sensor, d.frame, d.what) for d in compared(robot, robot).differences}
    assert {("cam1", "imu0", "rotation"), ("cam1", "cam0", "translation"), ("lidar0", "imu0", "translation")} <= blocks
    assert {
        ("wheel0", "imu0", "radius"),
        ("cam0", "cam0", "lens"),
        ("imu0", "imu0", "bias walk of the gyroscope"),
    } <= blocks


def test_nothing_is_said_of_rounding_errors(robot: Calibration):
    """No "+0 %" and no 3e-14 px: a block that is the same did not change."""
    found = compared(robot, changed(robot, {("cam0", "intrinsics"): np.full(4, 1e-11)}))
    assert 0.0 < only(found, "cam0", "lens").size < 1e-9
    words = [sentence(d, found) for d in found.differences]
    assert all("did not change" in one and not re.search(r"\d e|\de-\d|[+] ?0|sigma", one) for one in words)
    assert "the lens of cam0 did not change" in words


def test_what_changed_is_said_in_words(robot: Calibration):
    steps = {
        ("cam1", "rotation"): np.deg2rad([0.3, 0.0, 0.0]),
        ("lidar0", "translation"): np.array([0.0, -0.02, 0.0]),
        ("cam0", "time_offset"): np.array([5e-4]),
        ("wheel0", "radii"): np.array([0.0, 1e-3]),
        ("cam0", "intrinsics"): np.array([3.0, 3.0, 0.0, 0.0]),
    }
    found = compared(robot, changed(robot, steps))
    text = "\n".join(lines(found))
    assert re.search(r"DIFFERS  cam1 turned by 0\.30 deg about its x axis, \d+\.\d sigma", text)
    assert re.search(r"DIFFERS  cam1 turned by 0\.30 deg about its x axis relative to cam0, \d+\.\d sigma", text)
    assert re.search(r"DIFFERS  lidar0 moved by -20 mm along y of imu0, \d+\.\d sigma", text)
    assert re.search(r"DIFFERS  the time offset of cam0 changed by \+0\.50 ms, \d+\.\d sigma", text)
    assert re.search(r"DIFFERS  the right radius of wheel0 changed by \+0\.98 %, \d+\.\d sigma", text)
    assert re.search(r"DIFFERS  the lens of cam0 moved points by 1\.\d px RMS, \d\.\d px at most, \d+\.\d sigma", text)
    assert re.search(r"same     the rotation of lidar0 did not change", text)
    assert "unobservable or too uncertain in A and B" in sentence(only(found, "cam1", "translation", "imu0"), found)
    assert re.search(r"\d+ of \d+ differ\.$", text)


def test_an_axis_between_the_coordinates_is_named(robot: Calibration):
    found = compared(robot, changed(robot, {("lidar0", "translation"): np.array([0.03, 0.0, -0.04])}))
    words = sentence(only(found, "lidar0", "translation"), found)
    assert words.startswith("lidar0 moved by 50 mm along [0.60, 0.00, -0.80] of imu0, ")


def test_directions_are_from_a_to_b(robot: Calibration):
    """The vector moves A's pose onto B's, as seen from either sensor."""
    step = {
        ("cam0", "rotation"): np.array([0.01, -0.02, 0.005]),
        ("cam0", "translation"): np.array([0.02, 0.01, -0.03]),
    }
    other = changed(robot, step)
    found = compared(robot, other)
    for frame, sensor in (("imu0", "cam0"), ("cam0", "cam1")):
        A, B = (relative_pose(c, frame, sensor).T for c in (robot, other))
        turn = np.deg2rad(only(found, sensor, "rotation", frame).vector)
        np.testing.assert_allclose(A[:3, :3] @ Rotation.from_rotvec(turn).as_matrix(), B[:3, :3], atol=1e-12)
        move = 1e-3 * np.array(only(found, sensor, "translation", frame).vector)
        np.testing.assert_allclose(A[:3, 3] + move, B[:3, 3], atol=1e-12)


def test_sigmas_use_the_joint_covariance(robot: Calibration):
    """Of samples of the joint covariance of one side, seen from the camera before, as many are beyond as should be."""
    rng = np.random.default_rng(4)
    scale = np.concatenate([g.factor for g in robot.groups if g.columns is not None and g.factor is not None])
    joint = robot.covariance * np.outer(scale, scale)
    root = np.linalg.cholesky(joint + 1e-18 * np.eye(len(joint)))
    counts: dict[tuple[str, str, str], list[float]] = {}
    for _ in range(400):
        step = root @ rng.normal(size=len(root))
        moves = {
            (g.sensor, g.name): step[list(g.columns)]
            for g in robot.groups
            if g.columns is not None and g.sensor != "board0"
        }
        for d in compared(robot, changed(robot, moves)).differences:
            if d.sigmas is not None:
                counts.setdefault((d.sensor, d.frame, d.what), []).append(d.sigmas)
    # Back to chi^2. Half of the difference's variance is of the other side, which stays.
    for key, found in counts.items():
        dof = {"rotation": 3, "translation": 3, "radius": 2, "lens": 4}.get(key[2], 1)
        distance = 2.0 * chi2.isf(2.0 * norm.sf(np.array(found)), dof)
        assert distance.mean() == pytest.approx(dof, abs=4.5 * np.sqrt(2.0 * dof / 400)), key
    assert ("cam1", "cam0", "translation") in counts and ("wheel0", "imu0", "radius") in counts


def test_significance_is_that_of_chi2():
    rng = np.random.default_rng(2)
    for n in (1, 2, 3, 4, 8, 9):
        for x in (0.01, 1.0, 7.0, 40.0):
            assert chi2_above(x, n) == pytest.approx(chi2.sf(x, n), rel=1e-10)
        J = rng.normal(size=(n, n)) * np.geomspace(1e-6, 1e3, n)[:, None]
        d = J @ (rng.normal(size=n) + 1.0)
        distance = d @ np.linalg.solve(J @ J.T, d) if n == 1 else np.sum(np.linalg.solve(J, d) ** 2)
        found = sigmas(d, J @ J.T)
        assert found == pytest.approx(norm.isf(0.5 * chi2.sf(distance, n)), rel=1e-6)
    assert sigmas(np.array([3.0]), np.eye(1)) == pytest.approx(3.0, rel=1e-12)
    assert sigmas(np.array([100.0, 0.0]), np.eye(2)) == 100.0  # far out, the distance itself
    assert sigmas(np.zeros(2), np.diag([1.0, 0.0])) == 0.0
    assert sigmas(np.array([0.0, 1.0]), np.diag([1.0, 0.0])) is None
    assert sigmas(np.ones(1), np.full((1, 1), np.nan)) is None


def test_what_counts_is_a_matter_of_tolerance_and_sigma(robot: Calibration):
    other = changed(robot, {("cam1", "rotation"): np.deg2rad([0.2, 0.0, 0.0])})
    turned = only(compared(robot, other), "cam1", "rotation", "imu0")
    assert turned.sigmas is not None and turned.sigmas > 3.0 and turned.differs and turned.given_by == "both"
    assert not only(
        compared(robot, other, tolerances=ComparisonTolerances(deg=0.25)), "cam1", "rotation", "imu0"
    ).differs
    assert only(compared(robot, other, tolerances=ComparisonTolerances(deg=0.15)), "cam1", "rotation", "imu0").differs
    assert not only(compared(robot, other, limit=turned.sigmas + 0.1), "cam1", "rotation", "imu0").differs


def test_kalibr_files(robot: Calibration, tmp_path: Path):
    """Ours of the same result: the same; and of another one, with sigma of one side alone."""
    robot.save(tmp_path / "out")
    for name, text in export(robot, "kalibr").files.items():
        (tmp_path / name).write_text(text)
    chain, imu = tmp_path / "camchain-imucam.yaml", tmp_path / "imu.yaml"
    found = compare_files(tmp_path / "out", chain)
    assert found.same and found.reference == "imu0"
    blocks = {(d.sensor, d.what) for d in found.differences}
    assert {("cam1", "rotation"), ("cam1", "lens"), ("cam1", "time offset")} <= blocks
    assert f"only {tmp_path / 'out'} has lidar0, wheel0." in found.notes
    assert only(found, "cam1", "rotation", "imu0").given_by == "A"
    noise = compare_files(imu, tmp_path / "out")
    assert noise.same and len(noise.differences) == 4
    imu.write_text(imu.read_text().replace("gyroscope_noise_density: 0.00016", "gyroscope_noise_density: 0.0002"))
    changed_noise = only(compare_files(tmp_path / "out", imu), "imu0", "noise density of the gyroscope")
    assert changed_noise.differs and changed_noise.vector[0] == pytest.approx(25.0)
    data = yaml.safe_load(chain.read_text())
    data["cam1"]["T_cam_imu"][0][3] += 0.01
    chain.write_text(yaml.safe_dump(data))
    moved = compare_files(tmp_path / "out", chain)
    assert not moved.same and only(moved, "cam1", "translation", "imu0").size == pytest.approx(10.0)


def test_effects_on_the_imu_of_the_body_are_compared(robot: Calibration, tmp_path: Path):
    one, sides = np.ones(1), []
    for delay_s in (1e-3, 3e-3):
        label, value = ("accel_delay",), delay_s * one
        group = ParameterGroup("imu0", "accel_delay", label, "s", value, one, one, ("determined",), "prior")
        sides.append(dataclasses.replace(robot, groups=(*robot.groups, group)))
    assert only(compared(*sides), "imu0", "accel delay").size == pytest.approx(2.0)
    assert not [d for d in compared(robot, sides[0]).differences if d.what == "accel delay"]


def test_kalibrs_imu_frame_is_turned_to_the_gyroscope(robot: Calibration, tmp_path: Path):
    """Kalibr's poses are in the axes of the accelerometer, which its imu file beside the camchain turns."""
    intrinsics, turn = robot.group("imu0", "intrinsics"), np.array([0.01, -0.02, 0.015])
    value = np.concatenate([np.zeros(12), turn, np.zeros(9)])
    groups = tuple(dataclasses.replace(g, value=value) if g is intrinsics else g for g in robot.groups)
    robot = dataclasses.replace(robot, groups=groups)
    robot.save(tmp_path / "out")
    for name, text in export(robot, "kalibr").files.items():
        (tmp_path / name).write_text(text)
    assert compare_files(tmp_path / "out", tmp_path / "camchain-imucam.yaml").same
    (tmp_path / "imu.yaml").unlink()
    found = compare_files(tmp_path / "out", tmp_path / "camchain-imucam.yaml")
    assert only(found, "cam1", "rotation", "imu0").size == pytest.approx(np.rad2deg(np.linalg.norm(turn)))


def test_cameras_alone_are_seen_from_each_other(robot: Calibration, tmp_path: Path):
    """Kalibr's camchain without an IMU: a chain of T_cn_cnm1, here of three cameras."""
    robot.save(tmp_path / "out")
    data = yaml.safe_load(export(robot, "kalibr").files["camchain-imucam.yaml"])
    for camera in data.values():
        del camera["T_cam_imu"], camera["timeshift_cam_imu"]
    data["cam2"] = data["cam1"] | {"T_cn_cnm1": np.linalg.inv(data["cam1"]["T_cn_cnm1"]).tolist()}
    (tmp_path / "camchain.yaml").write_text(yaml.safe_dump(data))
    found = compare_files(tmp_path / "out", tmp_path / "camchain.yaml")
    assert found.same and found.reference == "cam0"
    assert {d.frame for d in found.differences if d.what == "rotation"} == {"cam0"}
    assert "only one side has an IMU" in " ".join(found.notes)
    # cam2 is back where cam0 is.
    (tmp_path / "other.yaml").write_text(
        yaml.safe_dump({"cam0": data["cam0"], "cam2": data["cam0"] | {"T_cn_cnm1": np.eye(4).tolist()}})
    )
    back = compare_files(tmp_path / "camchain.yaml", tmp_path / "other.yaml")
    assert only(back, "cam2", "translation").size < 1e-9


def test_a_urdf(robot: Calibration, tmp_path: Path):
    robot.save(tmp_path / "out")
    file = tmp_path / "robot.urdf"
    names = {"imu0": "imu_link", "lidar0": "velodyne"}
    file.write_text(export(robot, "urdf", names).files["sensors.urdf"])
    found = compare_files(tmp_path / "out", file, names)
    assert found.same and {d.sensor for d in found.differences} == {"cam0", "cam1", "lidar0", "wheel0"}
    rotated = changed(robot, {("lidar0", "rotation"): np.deg2rad([0.0, 0.0, 1.0])})
    (tmp_path / "new.urdf").write_text(export(rotated, "urdf", names).files["sensors.urdf"])
    for a, b, frames in ((tmp_path / "out", tmp_path / "new.urdf", names), (file, tmp_path / "new.urdf", None)):
        turned = compare_files(a, b, frames)
        link = "lidar0" if frames else "velodyne"
        assert [(d.sensor, d.what) for d in turned.differences if d.differs][-1] == (link, "rotation")
        assert only(turned, link, "rotation").size == pytest.approx(1.0)
    reverse = compare_files(tmp_path / "new.urdf", tmp_path / "out", names)
    assert only(reverse, "lidar0", "rotation").vector[2] == pytest.approx(-1.0)


def test_values_typed_into_a_rig_file(robot: Calibration, tmp_path: Path):
    """CAD's pose of the LiDAR with its tolerances, a translation of the camera alone, and a data sheet's wheels."""
    robot.save(tmp_path / "out")
    lidar: dict[str, Any] = {"type": "lidar"}
    lidar |= {"rotation": {"prior": robot.group("lidar0", "rotation").value.tolist(), "sigma_deg": 0.5}}
    lidar |= {
        "translation": {
            "prior": (robot.group("lidar0", "translation").value + [0.0, 0.0, 0.05]).tolist(),
            "sigma": 0.005,
        }
    }
    camera = {"type": "camera", "model": "pinhole-radtan", "resolution": [752, 480]}
    camera |= {"translation": parameter_to_plain(fixed(robot.group("cam0", "translation").value))}
    wheels = {"type": "wheels", "radii": {"guess": [0.1, 0.102]}, "baseline": {"guess": [0.5]}}
    sensors = {"imu": {"type": "imu", "noise": NOISE}, "cam0": camera, "lidar0": lidar, "wheel0": wheels}
    target = {"type": "aprilgrid", "rows": 6, "cols": 6, "tag_size": 0.088, "tag_spacing": 0.3}
    (tmp_path / "cad.yaml").write_text(yaml.safe_dump({"sensors": sensors, "target": target}))
    found = compare_files(tmp_path / "out", tmp_path / "cad.yaml")
    assert not only(found, "lidar0", "rotation").differs and only(found, "lidar0", "rotation").given_by == "both"
    moved = only(found, "lidar0", "translation")
    assert moved.differs and moved.vector[2] == pytest.approx(50.0)
    std = np.hypot(1e3 * robot.group("lidar0", "translation").std[2], 5.0)
    assert moved.std is not None and moved.std[2] == pytest.approx(std)
    assert not only(found, "cam0", "translation").differs
    assert not any((d.sensor, d.what) == ("cam0", "rotation") for d in found.differences)
    assert only(found, "wheel0", "baseline").vector[0] == pytest.approx(100 * (0.5 / 0.42 - 1))
    assert not only(found, "wheel0", "radius").differs
    assert f"{tmp_path / 'cad.yaml'} gives only a part of the pose of cam0, wheel0." in found.notes


def test_a_sensor_without_a_rotation_is_compared_by_its_position():
    antenna = np.eye(4)
    antenna[:3, :3] = np.nan
    moved = antenna.copy()
    moved[0, 3] = 0.02
    a, b = (Side("", "result", "imu0", True, {"imu0": np.eye(4), "gnss0": T}) for T in (antenna, moved))
    found = compare_sides(a, b)
    (difference,) = found.differences
    assert (difference.what, difference.size) == ("translation", pytest.approx(20.0)) and found.notes == ()


def test_what_has_no_standard_deviation_is_held_to_the_tolerance(robot: Calibration, tmp_path: Path):
    names = ("one.urdf", "two.urdf")
    other = changed(
        robot, {("cam0", "rotation"): np.deg2rad([0.05, 0, 0]), ("cam1", "rotation"): np.deg2rad([0, 0.15, 0])}
    )
    for name, c in zip(names, (robot, other), strict=True):
        (tmp_path / name).write_text(export(c, "urdf").files["sensors.urdf"])
    found = compare_files(tmp_path / names[0], tmp_path / names[1])
    turns = {(d.sensor, d.frame): d for d in found.differences if d.what == "rotation"}
    differing = [d.sensor for d in found.differences if d.differs and d.what == "rotation"]
    assert "cam1" in differing and all(d.sigmas is None for d in turns.values())
    assert "no standard deviation is known (tolerance 0.1 deg)" in "\n".join(lines(found))


def test_lenses_of_other_models_are_compared_by_pixels(robot: Calibration):
    sensors = {n: s | ({"model": "pinhole-radtan5"} if n == "cam1" else {}) for n, s in robot.rig["sensors"].items()}
    fixed_: Verdict = "fixed"
    groups = tuple(
        dataclasses.replace(
            g,
            value=np.append(g.value, 0.0),
            labels=(*g.labels, "k3"),
            std=np.zeros(5),
            std_formal=np.zeros(5),
            verdict=(fixed_, fixed_, fixed_, fixed_, fixed_),
        )
        if (g.sensor, g.name) == ("cam1", "distortion")
        else g
        for g in robot.groups
    )
    other = dataclasses.replace(robot, rig=robot.rig | {"sensors": sensors}, groups=groups)
    lens = only(compared(robot, other), "cam1", "lens")
    assert lens.size < 1e-6 and lens.sigmas is None and not lens.differs
    shifted = changed(other, {("cam1", "intrinsics"): np.array([0.0, 0.0, 3.0, -4.0])})
    lens = only(compared(robot, shifted), "cam1", "lens")
    assert lens.size == pytest.approx(5.0, rel=1e-6) == lens.most and lens.differs


@pytest.mark.parametrize(("target", "code"), [("a", 0), ("b", 1)])
def test_exit_codes(folders: tuple[Path, Path], capsys: pytest.CaptureFixture[str], target: str, code: int):
    a, b = folders
    found = b.parent / "found.json"
    page = b.parent / "found.html"
    assert main(["compare", str(a), str(b.parent / target), "--json", str(found), "--html", str(page)]) == code
    printed = capsys.readouterr().out
    assert ("DIFFERS" in printed) == bool(code)
    data = json.loads(found.read_text())
    assert data["same"] is not bool(code) and data["a"] == {"path": str(a), "kind": "result"}
    assert all(d["sentence"] in printed for d in data["differences"])
    text = page.read_text()
    assert all(escape(d["sentence"]) in text for d in data["differences"])
    assert text.count(">changed</span>") == sum(d["differs"] for d in data["differences"])
    assert f'<p class="answer">{printed.splitlines()[-1]}</p>' in text
    if code:
        worst = next(d for d in data["differences"] if d["differs"])
        assert (worst["sensor"], worst["what"]) == ("cam1", "rotation")
        assert worst["vector"][0] == pytest.approx(0.2) and worst["sigmas"] > 3.0
    assert (
        main(["compare", str(a), str(b / "calibration.yaml"), "--tolerance", "deg=0.5", "--tolerance", "mm=5", "-q"])
        == 0
    )
    assert capsys.readouterr().out == ""


def test_a_page_shows_what_differs_first(
    folders: tuple[Path, Path], capsys: pytest.CaptureFixture[str], assert_drawn: Callable[[str, set[str]], None]
):
    page = folders[1].parent / "page.html"
    assert main(["compare", *map(str, folders), "--html", str(page)]) == 1
    text = page.read_text()
    bars = figures_of(text)["changes-in-sigma"]["data"][0]
    assert bars["y"][0] == "cam1 rotation from imu0" and bars["x"][0] > 3.0
    assert len(bars["y"]) == len(set(bars["y"])) == len(bars["marker"]["color"])
    capsys.readouterr()
    assert main(["compare", *map(str, folders), "--html", str(folders[0] / "result.json"), "-q"]) == 2
    assert "result.json is an input of this command" in capsys.readouterr().err
    for kind in ("json", "html"):
        away = str(page.parent / "away" / f"f.{kind}")
        assert main(["compare", *map(str, folders), f"--{kind}", away, "-q"]) == 2
        assert f"f.{kind} cannot be written (its folder does not exist)" in capsys.readouterr().err
    assert_drawn(text, {"changes-in-sigma"})


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (
            ["a", "nowhere"],
            "nowhere does not exist; check the path of the result's folder, Kalibr file, URDF or rig file",
        ),
        (["a", "empty"], "empty holds no result.json"),
        (["a", "list.yaml"], "list.yaml:1: must be a mapping"),
        (["a", "other.yaml"], "other.yaml is neither a Kalibr file nor a rig file"),
        (["a", "bad.urdf"], "bad.urdf:1: this is not XML"),
        (["a", "few.urdf"], "there is no link imu0; it has base; say which is imu0: --frame imu0=LINK"),
        (["few.urdf", "none.urdf"], "few.urdf and none.urdf share no link"),
        (["a", "chain.yaml"], "chain.yaml:1: cam0.T_cam_imu: a transform has 4 rows of 4 numbers, but this has 3"),
        (["a", "turned.yaml"], "turned.yaml:1: cam0.T_cam_imu: is not a transform"),
        (["a", "lens.yaml"], "lens.yaml:1: cam0.distortion_model: needs distortion_coeffs beside it"),
        (["a", "lone.yaml"], "have nothing in common to compare"),
        (
            ["a", "imu.yaml"],
            "imu.yaml:1: gyroscope_random_walk, accelerometer_noise_density, accelerometer_random_walk are",
        ),
        (["a", "b", "--frame", "cam9=cam0"], "there is no sensor cam9 in a, did you mean 'cam1'; it has cam0"),
        (["a", "b", "--frame", "cam0=left"], "there is no sensor left in b; it has cam0"),
        (["a", "few.urdf", "--frame", "cam9=left"], "there is no sensor cam9 in a, did you mean 'cam1'; it has cam0"),
        (["a", "few.urdf", "--frame", "imu0=base", "--frame", "cam0=eye"], "there is no link eye; it has base"),
        (["a", "few.urdf", "--frame", "imu0=base"], "have nothing in common"),
    ],
)
def test_bad_input_is_one_sentence_and_code_2(
    folders: tuple[Path, Path],
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
    arguments: list[str],
    words: str,
):
    monkeypatch.chdir(folders[0].parent)
    Path("empty").mkdir()
    files = {
        "list.yaml": "[1, 2]",
        "other.yaml": "a: {b: 1}",
        "bad.urdf": "<robot",
        "few.urdf": '<robot name="r"><link name="base"/></robot>',
        "none.urdf": '<robot name="r"><link name="other"/></robot>',
        "chain.yaml": "cam0: {camera_model: pinhole, T_cam_imu: [[1, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, 0]]}",
        "turned.yaml": "cam0: {camera_model: pinhole, T_cam_imu: "
        "[[1, 0, 0, 0], [0, 2, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]]}",
        "lens.yaml": "cam0: {camera_model: pinhole, distortion_model: radtan, intrinsics: [400, 400, 300, 200], "
        "resolution: [752, 480]}",
        "lone.yaml": "eye: {camera_model: pinhole}",
        "imu.yaml": "gyroscope_noise_density: 1.0e-3",
    }
    for name, text in files.items():
        Path(name).write_text(text)
    assert main(["compare", *arguments]) == 2
    error = capsys.readouterr().err
    assert words in error and error.count("\n") == 1 and "Traceback" not in error


@pytest.mark.parametrize("text", ["deg", "deg=x", "deg=-1", "rad=1", "deg=inf"])
def test_a_tolerance_that_is_none_is_wrong_usage(capsys: pytest.CaptureFixture[str], text: str):
    with pytest.raises(SystemExit):
        main(["compare", "a", "b", "--tolerance", text])
    assert "must be UNIT=VALUE with a unit of deg, mm, ms, px, percent" in capsys.readouterr().err


def test_sensors_of_other_names_and_openvins_files(robot: Calibration, tmp_path: Path):
    """Kalibr numbers the cameras anew; OpenVINS turns the transform around, and OpenCV heads the file."""
    robot.save(tmp_path / "out")
    files = export(robot, "openvins").files
    chain = tmp_path / "chain.yaml"
    chain.write_text(files["kalibr_imucam_chain.yaml"].replace("\ncam0:", "\nleft:").replace("\ncam1:", "\nright:"))
    found = compare_files(tmp_path / "out", chain, {"cam0": "left", "cam1": "right"})
    assert found.same and {d.sensor for d in found.differences} == {"cam0", "cam1"}
    turned = changed(robot, {("cam1", "rotation"): np.deg2rad([0.0, 0.0, 0.5])})
    turned.save(tmp_path / "turned")
    found = compare_files(chain, tmp_path / "turned", {"left": "cam0", "right": "cam1"})
    assert only(found, "right", "rotation", "imu").vector[2] == pytest.approx(0.5)
    assert only(found, "right", "rotation", "imu").given_by == "B"
    chain.write_text(files["kalibr_imu_chain.yaml"])
    assert len(compare_files(tmp_path / "out", chain).differences) == 4


def test_entries_that_say_the_same_count_once():
    """A correlation of 1: three times the same number is one degree of freedom."""
    assert sigmas(np.full(3, 2.0), np.ones((3, 3))) == pytest.approx(2.0, rel=1e-9)


def test_what_is_unobservable_of_the_camera_seen_from_is_marked(robot: Calibration):
    groups = tuple(
        dataclasses.replace(g, verdict=("unobservable", "determined", "determined"))
        if (g.sensor, g.name) == ("cam0", "rotation")
        else g
        for g in robot.groups
    )
    found = compared(robot, dataclasses.replace(robot, groups=groups))
    assert only(found, "cam1", "rotation", "cam0").open == ("B",)
    assert only(found, "cam1", "rotation", "imu0").open == ()
