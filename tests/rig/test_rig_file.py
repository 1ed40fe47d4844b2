"""Rig files: what they mean, and the sentence for everything that can be wrong with them."""

from __future__ import annotations

import dataclasses
import random
from pathlib import Path

import numpy as np
import pytest
import yaml
from tests.cases import each
from tests.typed import instance, not_none

from icalib.errors import CalibrationError, RigError
from icalib.geometry.targets import AprilGrid, Charuco, Checkerboard
from icalib.rig import (
    Camera,
    ImuNoise,
    ImuSensor,
    Lidar,
    Parameter,
    PoseSensor,
    Rig,
    Settings,
    TwoSources,
    Wheels,
    by_name,
)
from icalib.rig.file import load_rig, rig_from_dict, rig_to_dict
from icalib.sensors.imu.spec import IMU_CLASSES, INTRINSICS_LABELS, class_imperfections, class_noise

VALID = """\
sensors:
  imu0:
    type: imu
    noise: {gyro: 1.7e-4, gyro_walk: 2e-5, accel: 2e-3, accel_walk: 3e-3}
  cam0:
    type: camera
    model: pinhole-radtan
    resolution: [752, 480]
    corner_noise: 0.2
    rotation: {guess: [[0, -1, 0], [1, 0, 0], [0, 0, 1]]}
    translation: {prior: [-0.02, -0.06, 0.01], sigma: 0.05}
    time_offset: free
    intrinsics: {fixed: [458.654, 457.296, 367.215, 248.375]}
    distortion: {fixed: [-0.28, 0.07, 0.0002, 0.00002]}
    bloom: {prior: 0.3, sigma: 0.1}
  cam1:
    type: camera
    path: right/corners.csv.gz
    model: pinhole-equidistant
    resolution: [640, 480]
target: {type: aprilgrid, rows: 6, cols: 7, tag_size: 0.088, tag_spacing: 0.3}
gravity: 9.80665
settings: {scheme: pose, loss: cauchy, segments: 0, bloom: false}
"""


def load(tmp_path: Path, text: str) -> Rig:
    path = tmp_path / "rig.yaml"
    path.write_text(text, encoding="utf-8")
    return load_rig(path)


def edited(old: str, new: str) -> str:
    assert VALID.count(old) == 1, old
    return VALID.replace(old, new)


def complaint(tmp_path: Path, text: str) -> str:
    with pytest.raises(RigError) as error:
        load(tmp_path, text)
    sentence = str(error.value)
    assert sentence.startswith(str(tmp_path)) and sentence.endswith(".") and "\n" not in sentence
    return sentence.removeprefix(f"{tmp_path}/")


def test_everything_is_read(tmp_path):
    rig = load(tmp_path, VALID)
    cam0, cam1 = rig.cameras
    assert (
        not_none(rig.imu).name,
        not_none(rig.imu).path,
        not_none(rig.imu).noise.gyro_walk,
        not_none(rig.imu).noise.source,
    ) == (
        "imu0",
        "imu0/data.csv",
        2e-5,
        "rig file",
    )
    assert not_none(rig.imu).intrinsics.mode == "prior"
    assert (cam0.path, cam0.model, cam0.resolution, cam0.corner_noise_px) == (
        "cam0/corners.csv",
        "pinhole-radtan",
        (752, 480),
        0.2,
    )
    assert cam0.rotation.mode == "free" and np.array_equal(
        not_none(cam0.rotation.value), [[0, -1, 0], [1, 0, 0], [0, 0, 1]]
    )
    assert cam0.translation.mode == "prior" and np.array_equal(not_none(cam0.translation.sigma), [0.05, 0.05, 0.05])
    assert cam0.time_offset.mode == "free" and cam0.time_offset.value is None
    assert cam0.intrinsics.mode == "fixed" and not_none(cam0.intrinsics.value)[2] == 367.215
    assert not_none(cam0.bloom.value).shape == not_none(cam0.bloom.sigma).shape == (1,)
    assert (cam1.path, cam1.model, cam1.distortion.mode, cam1.corner_noise_px) == (
        "right/corners.csv.gz",
        "pinhole-equidistant",
        "free",
        None,
    )
    target = instance(rig.target, AprilGrid)
    assert (target.cols, target.tag_size, rig.gravity, rig.gravity_sigma) == (7, 0.088, 9.80665, 0.0)
    s = rig.settings
    assert (s.scheme, s.loss, s.segments, s.bloom, s.outlier_std) == ("pose", "cauchy", 0, False, 4.0)
    assert rig.path == tmp_path / "rig.yaml"


def test_defaults(tmp_path):
    text = VALID[: VALID.index("gravity")].replace(VALID.splitlines(keepends=True)[3], "")
    rig = load(tmp_path, text)
    assert (rig.gravity, rig.gravity_sigma) == (9.806, 0.02) and rig.settings == Rig.settings
    assert not_none(rig.imu).noise.source == "default for a consumer IMU"


def test_topics_of_a_bag(tmp_path):
    text = edited("    path: right/corners.csv.gz\n", "    topic: /right/image_raw\n")
    rig = load(tmp_path, text.replace("    type: imu\n", "    type: imu\n    topic: /imu/data\n"))
    assert (not_none(rig.imu).topic, [c.topic for c in rig.cameras]) == ("/imu/data", [None, "/right/image_raw"])
    assert rig.cameras[1].path == "cam1/corners.csv"
    again = load(tmp_path, yaml.safe_dump(rig_to_dict(rig)))
    assert (not_none(again.imu).topic, [c.topic for c in again.cameras]) == ("/imu/data", [None, "/right/image_raw"])


def test_units_axes_and_sources_of_an_imu(tmp_path):
    extra = """    topic: {gyro: /a, accel: /b}
    accel_unit: g
    gyro_unit: deg/s
    accel_axes: [x, -y, -z]
    gyro_axes: [z, x, y]
"""
    rig = load(tmp_path, edited("    type: imu\n", "    type: imu\n" + extra))
    assert not_none(rig.imu).topic == TwoSources("/a", "/b")
    assert (not_none(rig.imu).accel_unit, not_none(rig.imu).gyro_unit) == ("g", "deg/s")
    assert (not_none(rig.imu).accel_axes, not_none(rig.imu).gyro_axes) == (("x", "-y", "-z"), ("z", "x", "y"))
    again, ideal = rig_from_dict(rig_to_dict(rig), "again").imu, Parameter("fixed")
    assert dataclasses.replace(not_none(again), intrinsics=ideal) == dataclasses.replace(
        not_none(rig.imu), intrinsics=ideal
    )


@each(
    ("line", "words"),
    [
        ("accel_unit: mg", "there is no such unit as 'mg'"),
        ("gyro_axes: [x, x, z]", "gyro_axes: must name the columns"),
        ("accel_axes: [x, y]", "accel_axes: must name the columns"),
        ("topic: {gyro: /a}", "accel is missing"),
    ],
)
def test_wrong_units_axes_and_sources_of_an_imu(tmp_path, line, words):
    assert words in complaint(tmp_path, edited("    type: imu\n", f"    type: imu\n    {line}\n"))


@each("name", IMU_CLASSES)
def test_imu_classes(tmp_path, name):
    noise = not_none(
        load(tmp_path, edited("{gyro: 1.7e-4, gyro_walk: 2e-5, accel: 2e-3, accel_walk: 3e-3}", name)).imu
    ).noise
    assert name in noise.source and noise.source.startswith("default for a")
    assert noise.gyro > noise.gyro_walk > 0 and noise.accel > 0 and noise.accel_walk > 0


TURN = "{guess: [[0, -1, 0], [1, 0, 0], [0, 0, 1]]}"


@each(
    ("value", "expected"),
    [
        ("{xyzw: [0, 0, 0.70710678, 0.70710678]}", [[0, -1, 0], [1, 0, 0], [0, 0, 1]]),
        ("{rpy_deg: [0, 0, 90]}", [[0, -1, 0], [1, 0, 0], [0, 0, 1]]),
        ("{rpy_deg: [90, 0, 90]}", [[0, 0, 1], [1, 0, 0], [0, 1, 0]]),
        ("{rpy_deg: [0, 90, 0]}", [[0, 0, 1], [0, 1, 0], [-1, 0, 0]]),
        ("{xyzw: [0.5, 0.5, 0.5, 0.5]}", [[0, 0, 1], [1, 0, 0], [0, 1, 0]]),
    ],
)
def test_rotations(tmp_path, value, expected):
    rotation = load(tmp_path, edited(TURN, f"{{fixed: {value}}}")).cameras[0].rotation
    np.testing.assert_allclose(not_none(rotation.value), expected, atol=1e-8)
    np.testing.assert_allclose(not_none(rotation.value) @ not_none(rotation.value).T, np.eye(3), atol=1e-15)


def test_rounded_rotation_is_made_orthonormal(tmp_path):
    rows = "[[0.0149, -0.9999, 0.0041], [0.9996, 0.0150, 0.0257], [-0.0258, 0.0038, 0.9997]]"
    value = load(tmp_path, edited(TURN, f"{{fixed: {rows}}}")).cameras[0].rotation.value
    np.testing.assert_allclose(value @ not_none(value).T, np.eye(3), atol=1e-14)
    np.testing.assert_allclose(not_none(value), yaml.safe_load(rows), atol=2e-4)


@pytest.mark.parametrize(("sigma", "expected"), [("sigma_deg: 180", [np.pi] * 3), ("sigma: [1, 2, 3]", [1, 2, 3])])
def test_rotation_sigma(tmp_path, sigma, expected):
    text = edited(TURN, f"{{prior: {{rpy_deg: [0, 0, 90]}}, {sigma}}}")
    np.testing.assert_allclose(not_none(load(tmp_path, text).cameras[0].rotation.sigma), expected)


NOISE = "{gyro: 1.7e-4, gyro_walk: 2e-5, accel: 2e-3, accel_walk: 3e-3}"


def with_intrinsics(tmp_path, value, noise=None):
    """IMU intrinsics of a rig file that says `value` of them, or nothing."""
    text = edited("    type: imu\n", "    type: imu\n" + (f"    intrinsics: {value}\n" if value else ""))
    return not_none(load(tmp_path, text.replace(NOISE, noise) if noise else text).imu).intrinsics


def test_free_imu_intrinsics_are_broad_priors(tmp_path):
    intrinsics = with_intrinsics(tmp_path, "free")
    assert intrinsics.mode == "prior" and np.array_equal(not_none(intrinsics.value), np.zeros(24))
    assert not_none(intrinsics.sigma).tolist() == [0.05] * 15 + [0.01] * 9


@each(
    ("noise", "name"),
    [
        *((name, name) for name in IMU_CLASSES),
        (NOISE, "consumer"),  # an ADIS16448 in the figures, but a consumer IMU may have the same
        ("{gyro: 3e-5, gyro_walk: 1e-7, accel: 3e-4, accel_walk: 1e-4}", "tactical"),
        ("{gyro: 3e-5, gyro_walk: 1e-7, accel: 3e-4, accel_walk: 1e-3}", "consumer"),
    ],
)
def test_by_default_imu_intrinsics_have_the_prior_of_the_class(tmp_path, noise, name):
    found = with_intrinsics(tmp_path, None, noise)
    assert found.mode == "prior" and np.array_equal(not_none(found.value), np.zeros(24))
    np.testing.assert_array_equal(found.sigma, with_intrinsics(tmp_path, name).sigma)
    np.testing.assert_array_equal(found.sigma, class_imperfections(name).sigma)


def test_figures_of_a_consumer_imu_as_its_data_sheet_has_them():
    """MPU-6050: scales 3 % and cross-axis 2 % at two sigma, 0.1 deg/s/g at one."""
    sigma = dict(zip(INTRINSICS_LABELS, class_imperfections("consumer").sigma, strict=True))
    for sensor in ("accel", "gyro"):
        assert [sigma[f"{sensor}_{a}"] for a in ("xx", "yy", "zz")] == [0.015] * 3
        assert [sigma[f"{sensor}_{a}"] for a in ("yx", "zx", "zy")] == [0.01] * 3
    assert sigma["g_sensitivity_xy"] == pytest.approx(np.deg2rad(0.1) / 9.81, rel=0.02)


def test_an_ideal_imu_is_fixed(tmp_path):
    found = with_intrinsics(tmp_path, "fixed")
    assert found.mode == "fixed" and found.value is None


def test_imu_intrinsics_with_own_values(tmp_path):
    values = [round(0.001 * k, 3) for k in range(24)]
    for form, mode, sigma in (("fixed: {}", "fixed", None), ("prior: {}, sigma: 0.1", "prior", [0.1] * 24)):
        text = edited("    type: imu\n", f"    type: imu\n    intrinsics: {{{form.format(values)}}}\n")
        intrinsics = not_none(load(tmp_path, text).imu).intrinsics
        assert intrinsics.mode == mode and not_none(intrinsics.value).tolist() == values
        assert (intrinsics.sigma if sigma is None else not_none(intrinsics.sigma).tolist()) == sigma


@each("extra", ["", "    intrinsics: free\n", "    intrinsics: fixed\n"])
@each("noise", ["noise: {gyro: 1.7e-4, gyro_walk: 2e-5, accel: 2e-3, accel_walk: 3e-3}", "path: i.csv"])
def test_plain_data_load_back_as_the_same_rig(tmp_path, extra, noise):
    text = edited("noise: {gyro: 1.7e-4, gyro_walk: 2e-5, accel: 2e-3, accel_walk: 3e-3}", noise)
    rig = load(tmp_path, text.replace("    type: imu\n", "    type: imu\n" + extra))
    plain = rig_to_dict(rig)
    again = load(tmp_path, yaml.safe_dump(plain, sort_keys=False))
    assert rig_to_dict(again) == plain
    assert (not_none(again.imu).noise, again.settings, again.target) == (
        not_none(rig.imu).noise,
        rig.settings,
        rig.target,
    )
    for a, b in zip(again.cameras, rig.cameras, strict=True):
        for group in ("rotation", "translation", "time_offset", "intrinsics", "distortion", "bloom"):
            p, q = getattr(a, group), getattr(b, group)
            assert p.mode == q.mode and np.array_equal(p.value, q.value) and np.array_equal(p.sigma, q.sigma)


INTRINSICS = "{fixed: [458.654, 457.296, 367.215, 248.375]}"
PRIOR = "{prior: [-0.02, -0.06, 0.01], sigma: 0.05}"
TARGET = "{type: aprilgrid, rows: 6, cols: 7, tag_size: 0.088, tag_spacing: 0.3}"
CHARUCO = "{type: charuco, squares_x: 7, squares_y: 5, square_size: 0.04, marker_size: 0.03, dictionary: 5x5_100}"


@each(
    ("old", "new", "words"),
    [
        (
            "type: imu",
            "type: sonar",
            "rig.yaml:3: sensors.imu0.type: there is no sensor type 'sonar'; available are imu, camera, lidar, wheels",
        ),
        ("type: imu", "type: camra", "did you mean 'camera'"),
        ("    type: imu\n", "", "rig.yaml:3: sensors.imu0: type is missing"),
        ("    type: imu\n", "    type:\n", "rig.yaml:3: sensors.imu0.type: must be text, but is empty"),
        ("  imu0:", "  cam 2:", "sensors.cam 2: a sensor's name is a letter"),
        ("  cam1:", "  cam0:", "rig.yaml:16: sensors: 'cam0' is given twice, first in line"),
        ("    corner_noise: 0.2", "    resolution: [1, 1]", "sensors.cam0: 'resolution' is given twice"),
        (
            "model: pinhole-radtan",
            "model: pinhole-radtam",
            "no camera model 'pinhole-radtam', did you mean 'pinhole-radtan'",
        ),
        ("    model: pinhole-radtan\n", "", "rig.yaml:6: sensors.cam0: model is missing"),
        ("    resolution: [752, 480]\n", "", "sensors.cam0: resolution is missing"),
        ("[752, 480]", "[752]", "rig.yaml:8: sensors.cam0.resolution: must be [width, height]"),
        ("[752, 480]", "[752, 480.5]", "sensors.cam0.resolution[1]: must be a whole number of at least 1"),
        ("[752, 480]", "[752, 0]", "sensors.cam0.resolution[1]: must be a whole number of at least 1"),
        ("[752, 480]", "big", "sensors.cam0.resolution: must be a list in brackets, but is 'big'"),
        (
            "corner_noise: 0.2",
            "corner_noise: small",
            "rig.yaml:9: sensors.cam0.corner_noise: must be a number, but is 'small'",
        ),
        ("corner_noise: 0.2", "corner_noise: '0.2'", "sensors.cam0.corner_noise: must be a number"),
        ("corner_noise: 0.2", "corner_noise: -0.2", "must be above 0, but is -0.2"),
        ("corner_noise: 0.2", "corner_noise: .nan", "must be a finite number"),
        ("corner_noise: 0.2", "corner_noise: inf", "must be a finite number"),
        ("corner_noise: 0.2", "corner_noise: 1e999", "is too large a number"),
        ("corner_noise: 0.2", "corner_noise: true", "must be a number, but is 'true'"),
        ("corner_noise: 0.2", "corner_noise: {a: 1}", "must be a number, but is a mapping"),
        (
            "corner_noise: 0.2",
            "cornernoise: 0.2",
            "sensors.cam0.cornernoise: there is no such field, did you mean 'corner_noise'",
        ),
        (
            "corner_noise: 0.2",
            "shutter: rolling",
            "cam0.shutter: must be a mapping (name: value), but is 'rolling'",
        ),
        ("corner_noise: 0.2", "shutter: {readout: free}", "sensors.cam0.shutter: rolling is missing; add rolling"),
        ("corner_noise: 0.2", "shutter: {rolling: row}", "shutter.rolling: there is no such choice as 'row', did you"),
        (
            "corner_noise: 0.2",
            "shutter: {rolling: rows, line_delay: 1}",
            "sensors.cam0.shutter.line_delay: there is no such field; available are rolling, readout",
        ),
        (
            "corner_noise: 0.2",
            "shutter: {rolling: rows, readout: {guess: 16.5}}",
            "sensors.cam0.shutter.readout: is in s, and at most 0.5 s; correct it.",
        ),
        ("corner_noise: 0.2", "shutter: {rolling: rows, readout: 0.01}", "shutter.readout: must be free or a mapping"),
        ("corner_noise: 0.2", "readout: free", "sensors.cam0.readout: there is no such field"),
        ("path: right/corners.csv.gz", "path: [a]", "sensors.cam1.path: must be text, but is a list"),
        (
            NOISE,
            "fancy",
            "rig.yaml:4: sensors.imu0.noise: there is no IMU class 'fancy'; available are consumer, industrial",
        ),
        (NOISE, "{gyro: 1.7e-4}", "sensors.imu0.noise: gyro_walk, accel, accel_walk are missing"),
        (NOISE, NOISE.replace("2e-3", "0"), "sensors.imu0.noise.accel: must be above 0"),
        (NOISE, NOISE.replace("gyro:", "gyroscope:"), "no such field, did you mean 'gyro'"),
        (INTRINSICS, "fixed", "sensors.cam0.intrinsics: must be free or a mapping, but is 'fixed'; write free"),
        (INTRINSICS, "[1, 2, 3, 4]", "must be free or a mapping, but is a list"),
        (INTRINSICS, "{fixed: [1, 2, 3]}", "sensors.cam0.intrinsics.fixed: must be a list of 4 numbers, but has 3"),
        (INTRINSICS, "{fixed: [1, 2, x, 4]}", "sensors.cam0.intrinsics.fixed[2]: must be a number, but is 'x'"),
        (INTRINSICS, "{fixed: [-1, 2, 3, 4]}", "fx and fy of [fx, fy, cx, cy] must be above 0"),
        (INTRINSICS, "{guess: [1, 2, 3, 4], sigma: 1}", "intrinsics.sigma: belongs to a prior, not to guess"),
        (INTRINSICS, "{guess: [1, 2, 3, 4], fixed: [1, 2, 3, 4]}", "exactly one of guess, fixed and prior"),
        (INTRINSICS, "{}", "needs exactly one of guess, fixed and prior, but has none"),
        (PRIOR, "{prior: [0, 0, 0]}", "sensors.cam0.translation: a prior needs exactly one of sigma"),
        (PRIOR, "{prior: [0, 0, 0], sigma: -1}", "translation.sigma: a standard deviation must be above 0, but is -1"),
        (PRIOR, "{prior: [0, 0, 0], sigma: [1, 2]}", "translation.sigma: must be a list of 3 numbers"),
        (PRIOR, "{prior: [0, 0, 0], sigma_deg: 1}", "there is no such field, did you mean 'sigma'"),
        (TURN, "{fixed: [[1, 0, 0], [0, 1, 0], [0, 0, 2]]}", "cam0.rotation.fixed: is not a rotation matrix"),
        (TURN, "{fixed: [[1, 0, 0], [0, 1, 0], [0, 0, -1]]}", "is a reflection"),
        (TURN, "{fixed: [[1, 0, 0], [0, 1, 0]]}", "a rotation matrix has 3 rows"),
        (TURN, "{fixed: [[1, 0, 0], [0, 1, 0], 3]}", "rotation.fixed[2]: must be a list in brackets"),
        (TURN, "{fixed: 3}", "must be a rotation, a 3x3 matrix"),
        (TURN, "{fixed: {xyzw: [0, 0, 0, 2]}}", "has norm 1, but this has 2"),
        (TURN, "{fixed: {wxyz: [0, 0, 0, 1]}}", "there is no such field, did you mean 'xyzw'"),
        (TURN, "{fixed: {}}", "must be one rotation"),
        (TURN, "{prior: {rpy_deg: [0, 0, 0]}, sigma: 1, sigma_deg: 1}", "exactly one of sigma and sigma_deg"),
        (
            "type: imu",
            "type: imu\n    intrinsics: {prior: wide}",
            "sensors.imu0.intrinsics: a prior needs exactly one of sigma",
        ),
        (
            "type: aprilgrid",
            "type: chessboard",
            "target.type: there is no target type 'chessboard', did you mean 'checkerboard'; available are aprilgrid, "
            "charuco, checkerboard",
        ),
        ("type: aprilgrid, ", "", "target: type is missing; add type: aprilgrid"),
        (TARGET, "{type: charuco, rows: 5}", "target.rows: there is no such field; available are type, squares_x"),
        (TARGET, CHARUCO.replace("0.03", "0.05"), "target: marker_size 0.05 does not fit a square of 0.04"),
        (TARGET, CHARUCO.replace("5x5_100", "5x5_101"), "target.dictionary: there is no tag family '5x5_101', did"),
        (TARGET, CHARUCO.replace("7", "70"), "target: needs 175 tags, but 5x5_100 has 100"),
        (TARGET, CHARUCO.replace("7", "7.5"), "target.squares_x: must be a whole number of at least 1"),
        (TARGET, CHARUCO.replace("0.04", "40"), "target.square_size: is in metres, and 40 m is too large for a square"),
        (TARGET, "{type: checkerboard, rows: 1, cols: 8, square_size: 0.03}", "target: a checkerboard of 1 x 8 inner"),
        (
            TARGET,
            "{type: checkerboard, rows: 600, cols: 800, square_size: 0.03}",
            "target: 600 x 800 corners exceed the limit",
        ),
        ("rows: 6", "rows: six", "target.rows: must be a number, but is 'six'"),
        ("rows: 6", "rows: 6.0", "target.rows: must be a whole number of at least 1"),
        ("rows: 6", "rows: 100000000000", "target: 100000000000 x 7 tags exceed the limit of 10000"),
        ("tag_size: 0.088", "tag_size: 88", "target.tag_size: is in metres"),
        ("tag_size: 0.088", "tagSize: 0.088", "target.tagSize: there is no such field, did you mean 'tag_size'"),
        (TARGET, "", "target: must be a mapping (name: value), but is empty"),
        (f"target: {TARGET}\n", "", "rig.yaml:1: target is missing; add target"),
        ("gravity: 9.80665", "gravity: 0", "rig.yaml:22: gravity: must be above 0"),
        (
            "gravity:",
            "gravty:",
            "rig.yaml:22: gravty: there is no such field, did you mean 'gravity'; available are sensors",
        ),
        ("scheme: pose", "scheme: poses", "settings.scheme: there is no such choice as 'poses', did you mean 'pose'"),
        ("segments: 0", "splits: 0", "settings.splits: this field is now called segments; rename it."),
        ("segments: 0", "nodes: every-image", "settings.nodes: this field is now called keyframes; rename it."),
        ("segments: 0", "segments: -1", "settings.segments: must be a whole number of at least 0"),
        ("bloom: false", "bloom: 0", "settings.bloom: must be true or false, but is '0'"),
        ("bloom: false", "loss_scale: 0", "settings.loss_scale: must be above 0"),
        ("bloom: false", "outlier_std: -1", "settings.outlier_std: must be 0 or above, but is -1"),
        ("gravity: 9.80665", "gravity: [", "this is not valid YAML"),
        ("gravity: 9.80665", "[1]: 9.8", "a name must be plain text"),
        ("type: imu", '"\\U99999999": 1', "is not valid YAML"),
    ],
)
def test_what_is_wrong_is_named(tmp_path, old, new, words):
    assert words in complaint(tmp_path, edited(old, new))


@pytest.mark.parametrize(
    ("text", "target"),
    [
        (CHARUCO, Charuco(7, 5, 0.04, 0.03, "5x5_100")),
        ("{type: checkerboard, rows: 6, cols: 8, square_size: 0.03}", Checkerboard(6, 8, 0.03)),
    ],
)
def test_other_targets_are_read_and_written(tmp_path, text, target):
    path = tmp_path / "rig.yaml"
    path.write_text(edited(TARGET, text))
    rig = load_rig(path)
    assert rig.target == target and not rig.blooms
    path.write_text(yaml.safe_dump(rig_to_dict(rig)))
    assert load_rig(path).target == target


def test_imus_without_a_camera(tmp_path):
    imu, rest = "  imu0: {type: imu}\n", f"target: {TARGET}\n"
    camera = "  cam0: {type: camera, model: pinhole-radtan, resolution: [752, 480]}\n"
    assert "there is no camera, no LiDAR, no pose sensor and no position sensor" in complaint(
        tmp_path, "sensors:\n" + imu + rest
    )
    wheels = "  wheel0: {type: wheels}\n"
    assert "there is no camera, no LiDAR, no pose sensor and no position sensor" in complaint(
        tmp_path, "sensors:\n" + imu + wheels + rest
    )
    placed = "  imu0: {type: imu, time_offset: {fixed: 0}}\n"
    second = complaint(tmp_path, "sensors:\n" + placed + "  imu1: {type: imu}\n" + camera + rest)
    assert "rig.yaml:2: sensors.imu0.time_offset: imu0 is the body" in second


def test_without_an_imu_the_first_camera_is_the_body(tmp_path):
    path = tmp_path / "rig.yaml"
    cameras = "".join(f"  {n}: {{type: camera, model: eucm, resolution: [752, 480]}}\n" for n in ("left", "right"))
    path.write_text("sensors:\n" + cameras + f"target: {TARGET}\n")
    rig = load_rig(path)
    assert rig.imu is None and rig.reference == "left"
    again = tmp_path / "again.yaml"
    again.write_text(yaml.safe_dump(rig_to_dict(rig)))
    assert dataclasses.replace(load_rig(again), path=path) == rig


@pytest.mark.parametrize("border", [1, 2])
def test_an_aprilgrid_of_plain_tags(tmp_path, border):
    path = tmp_path / "rig.yaml"
    camera = "  cam0: {type: camera, model: eucm, resolution: [752, 480]}\n"
    target = TARGET.replace("}", f", border_bits: {border}, squares: false}}")
    path.write_text("sensors:\n" + camera + f"target: {target}\n")
    assert load_rig(path).target == AprilGrid(6, 7, 0.088, 0.3, border, squares=False)
    path.write_text(path.read_text().replace(f"border_bits: {border}", "border_bits: 3"))
    with pytest.raises(RigError, match="target.border_bits"):
        load_rig(path)


@each("text", ["", "# nothing\n", "---\n"])
def test_empty_file(tmp_path, text):
    sentence = complaint(tmp_path, text)
    assert "is empty" in sentence


@each("text", ["3", "[1, 2]", "a: 1\n---\nb: 2\n", "[" * 5000, "a: \x07", "a: !!python/object:os.x {}"])
def test_not_a_rig_at_all(tmp_path, text):
    complaint(tmp_path, text)


def test_missing_folder_and_binary_file(tmp_path):
    with pytest.raises(RigError, match=r"none\.yaml does not exist"):
        load_rig(tmp_path / "none.yaml")
    with pytest.raises(RigError, match="cannot be read"):
        load_rig(tmp_path)
    (tmp_path / "binary.yaml").write_bytes(b"\xff\xfe\x00\x81")
    with pytest.raises(RigError, match="not a text file in UTF-8"):
        load_rig(tmp_path / "binary.yaml")


def mutated(text: str, rng: random.Random) -> str:
    """`text` cut, with characters changed, or with lines and values moved about."""
    kind = rng.randrange(4)
    at = rng.randrange(len(text))
    if kind == 0:
        return text[:at]
    if kind == 1:
        return text[:at] + rng.choice("{}[]:,-#&*!|>'\"%@`\t\n 0aé\x00.<?~") + text[at + rng.randrange(2) :]
    lines = text.splitlines(keepends=True)
    if kind == 2:
        rng.shuffle(lines)
        return "".join(lines[: rng.randrange(1, len(lines) + 1)])
    words = text.split(" ")
    words[rng.randrange(len(words))] = rng.choice(
        ["null", "1e400", ".inf", "[]", "{}", "*a", "&a", "yes", "-1", "''", "<<:"]
    )
    return " ".join(words)


@each("seed", range(10))
def test_no_mutation_escapes_as_another_error(tmp_path, seed):
    rng = random.Random(seed)
    refused = 0
    for _ in range(40):
        text = mutated(VALID, rng)
        try:
            load(tmp_path, text)
        except CalibrationError as error:
            refused += 1
            assert "\n" not in str(error), text
    assert refused > 0


def test_the_page_about_rig_files_is_right(tmp_path):
    page = (Path(__file__).parents[2] / "docs/rig-file.md").read_text(encoding="utf-8")
    rig = load(tmp_path, page.split("```yaml\n")[1].split("```")[0])
    assert rig.cameras[0].translation.mode == "prior"
    for name in IMU_CLASSES:
        row = next(line for line in page.splitlines() if line.startswith(f"| `{name}`")).split("|")
        noise = class_noise(name)
        assert [float(x) for x in row[2:6]] == [noise.gyro, noise.gyro_walk, noise.accel, noise.accel_walk]
    for field in dataclasses.fields(Settings):
        default = str(field.default).lower() if isinstance(field.default, bool) else str(field.default)
        assert f"| `{field.name}` | {default} |" in page.replace(f"`{default}`", default), field.name


def test_a_rig_for_arrays_needs_no_paths(tmp_path: Path):
    rig = Rig(
        by_name(
            ImuSensor("imu0", "", ImuNoise(1e-3, 1e-4, 1e-2, 1e-3)),
            Camera("cam0", "", "eucm", (640, 480)),
            Lidar("lidar0", ""),
            Wheels("wheel0", ""),
            PoseSensor("mocap0", ""),
        ),
        AprilGrid(6, 6, 0.088, 0.3),
    )
    (tmp_path / "rig.yaml").write_text(yaml.safe_dump(rig_to_dict(rig)))
    loaded = load_rig(tmp_path / "rig.yaml")
    assert loaded.imu is not None and loaded.imu.path == "imu0/data.csv" and loaded.cameras[0].path
    assert rig_to_dict(loaded)["sensors"].keys() == rig_to_dict(rig)["sensors"].keys()


def test_the_body_is_a_sensor_of_the_rig(tmp_path: Path):
    text = "sensors:\n  imu0: {type: imu}\n  lidar0: {type: lidar}\nbody: lidar0\n"
    rig = load(tmp_path, text)
    assert (rig.body, rig.reference) == ("lidar0", "imu0") and rig_to_dict(rig)["body"] == "lidar0"
    with pytest.raises(CalibrationError, match=r"rig\.yaml:4: body: there is no sensor lidar1, did you mean 'lidar0'"):
        load(tmp_path, text.replace("body: lidar0", "body: lidar1"))
    assert "body" not in rig_to_dict(load(tmp_path, text.replace("body: lidar0\n", "")))


@each(
    "readout",
    [Parameter(), Parameter("prior", np.array([0.016]), np.array([1e-3])), Parameter("fixed", -np.ones(1) / 50)],
)
def test_a_rolling_shutter_is_written_as_it_is_read(readout):
    camera = Camera("cam0", "a.csv", "pinhole-radtan", (752, 480), rolling="columns", readout=readout)
    rig = Rig(by_name(ImuSensor("imu0", "i.csv", class_noise("consumer")), camera), AprilGrid(6, 6, 0.088, 0.3))
    (again,) = rig_from_dict(rig_to_dict(rig), "rig.yaml").cameras
    assert again.shutter == (0, 752) and repr(again.readout) == repr(readout)
    assert "shutter" not in dataclasses.replace(camera, rolling=None).plain()
