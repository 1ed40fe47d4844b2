"""Kalibr's files beside a recording, and those that cannot be used."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np
import pytest
import yaml

from icalib.export import kalibr as export
from icalib.export.common import CameraParameters
from icalib.geometry.cameras import camera_model
from icalib.geometry.targets import AprilGrid, Checkerboard
from icalib.tools.inspection.kalibr import MODELS, find_kalibr_files

CAMCHAIN = """\
cam0:
  cam_overlaps: [1]
  camera_model: pinhole
  distortion_coeffs: [-0.28, 0.07, 0.0002, 1.8e-05]
  distortion_model: radtan
  intrinsics: [458.654, 457.296, 367.215, 248.375]
  resolution: [752, 480]
  rostopic: /cam0/image_raw
cam1:
  camera_model: ds
  distortion_coeffs: []
  distortion_model: none
  intrinsics: [-0.2, 0.59, 180.0, 181.0, 376.0, 240.0]
  resolution: [752, 480]
  rostopic: /cam1/image_raw
"""
IMU = """\
#Accelerometers
accelerometer_noise_density: 1.86e-03   #Noise density (continuous-time)
accelerometer_random_walk:   4.33e-04   #Bias random walk
gyroscope_noise_density:     1.87e-04
gyroscope_random_walk:       2.66e-05
rostopic:                    /imu0      #the IMU ROS topic
update_rate:                 200.0      #Hz
"""
APRILGRID = """\
target_type: 'aprilgrid' #gridtype
tagCols: 6               #number of apriltags
tagRows: 7               #number of apriltags
tagSize: 0.088           #size of apriltag, edge to edge [m]
tagSpacing: 0.3          #ratio of space between tags to tagSize
"""


def found_with(folder: Path, **files: str):
    for name, text in files.items():
        (folder / f"{name}.yaml").write_text(text)
    return find_kalibr_files(folder / "run.bag")


def test_all_three(tmp_path):
    found = found_with(tmp_path, camchain=CAMCHAIN, imu=IMU, aprilgrid=APRILGRID, metadata="rosbag2: {version: 9}")
    assert found.notes == ()
    first, second = found.cameras
    assert (first.name, first.topic, first.model, first.resolution) == (
        "cam0",
        "/cam0/image_raw",
        "pinhole-radtan",
        (752, 480),
    )
    assert first.intrinsics == (458.654, 457.296, 367.215, 248.375)
    assert first.distortion == (-0.28, 0.07, 0.0002, 1.8e-05)
    assert (second.model, second.distortion) == ("double-sphere", (-0.2, 0.59))
    assert second.intrinsics == (180.0, 181.0, 376.0, 240.0)
    (imu,) = found.imus
    assert imu.topic == "/imu0"
    assert imu.densities == {"gyro": 1.87e-4, "gyro_walk": 2.66e-5, "accel": 1.86e-3, "accel_walk": 4.33e-4}
    assert (found.target, found.target_file) == (AprilGrid(7, 6, 0.088, 0.3), "aprilgrid.yaml")


@pytest.mark.parametrize("model", export.KALIBR_MODELS)
def test_what_is_exported_is_read_back(model, tmp_path):
    """Both tables of models are the same one."""
    params = np.linspace(1.0, 2.0, len(camera_model(model).parameter_names))
    lens = CameraParameters(model, params[:4].tolist(), params[4:].tolist(), (64, 48), "")
    fields = export._lens_fields(lens)
    (camera,) = found_with(tmp_path, camchain=yaml.safe_dump({"cam0": fields})).cameras
    assert camera.model == model
    np.testing.assert_array_equal((*camera.intrinsics, *camera.distortion), params)
    assert {m for m, _ in MODELS.values()} == set(export.KALIBR_MODELS)


def test_imu_of_kalibrs_result(tmp_path):
    """imu-....yaml has it one level deeper."""
    deeper = yaml.safe_dump({"imu0": yaml.safe_load(IMU)})
    assert found_with(tmp_path, result=deeper).imus[0].densities["gyro"] == 1.87e-4


def test_files_above_a_folder_are_found(tmp_path):
    (tmp_path / "run").mkdir()
    (tmp_path / "target.yaml").write_text(APRILGRID)
    assert find_kalibr_files(tmp_path / "run").target == AprilGrid(7, 6, 0.088, 0.3)


def test_checkerboard(tmp_path):
    board = "{target_type: checkerboard, targetRows: 6, targetCols: 7, rowSpacingMeters: 0.06, colSpacingMeters: 0.06}"
    assert found_with(tmp_path, board=board).target == Checkerboard(6, 7, 0.06)


@pytest.mark.parametrize(
    ("name", "text", "words"),
    [
        ("camchain", CAMCHAIN.replace("radtan", "fov"), r"camchain\.yaml: cam0: icalib has no pinhole-fov"),
        ("camchain", CAMCHAIN.replace("458.654, ", ""), r"camchain\.yaml: intrinsics must be 4 finite numbers"),
        ("imu", IMU.replace("1.87e-04", "'none'"), r"imu\.yaml: gyroscope_noise_density must be a number above 0"),
        ("grid", APRILGRID.replace("0.088", "-1"), r"grid\.yaml: tagSize must be a number above 0"),
        ("grid", APRILGRID.replace("6  ", "6.5"), r"grid\.yaml: tagCols must be a whole number"),
        (
            "board",
            "{target_type: checkerboard, targetRows: 6, targetCols: 7, rowSpacingMeters: 0.06, colSpacingMeters: 0.05}",
            r"board\.yaml: rowSpacingMeters and colSpacingMeters differ",
        ),
        ("grid", APRILGRID.replace("aprilgrid'", "starfield'"), r"does not know the target_type 'starfield'"),
        (
            "grid",
            "{target_type: circlegrid, targetRows: 6, targetCols: 7, spacingMeters: 0.06, asymmetricGrid: false}",
            r"file has no diameter.*\{type: circles, rows: 6, cols: 7, spacing: 0.06, diameter: ...\}` in the",
        ),
    ],
)
def test_what_cannot_be_used_is_noted(name, text, words, tmp_path):
    found = found_with(tmp_path, **{name: text})
    assert not found.imus and found.target is None
    assert len(found.notes) == 1 and re.search(words, found.notes[0])


def test_two_targets(tmp_path):
    found = found_with(tmp_path, a=APRILGRID, b=APRILGRID.replace("0.088", "0.05"))
    assert found.target is None
    assert re.search(r"a\.yaml, \S*b\.yaml beside the recording differ; give the right one", found.notes[0])
    assert found_with(tmp_path, b=APRILGRID).target is not None


@pytest.mark.parametrize("text", ["{", "\x00", "- 1", "!!python/object:os.system {}", "", "a: &a [*a]"])
def test_files_of_others(text, tmp_path):
    assert found_with(tmp_path, other=text).notes == ()
