"""The stills of `aprilgrid_images`, from pictures to lenses: no IMU, no clock, no first guess."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from icalib.pipeline import calibrate
from icalib.result import Calibration
from icalib.rig.file import load_rig

SHIPPED_RMS_PX = 0.11  # of the solutions that come with the pictures, on the corners that come with them
BASELINE_M = 0.1100
RIG = """\
sensors:
  cam0: {{type: camera, topic: images/*_0.jpg, model: {model}, resolution: [752, 480]}}
  cam1: {{type: camera, topic: images/*_1.jpg, model: {model}, resolution: [752, 480]}}
target: {{type: aprilgrid, rows: 6, cols: 6, tag_size: 0.088, tag_spacing: 0.3}}
"""


@pytest.fixture(scope="module")
def folder(tmp_path_factory) -> Path:
    return tmp_path_factory.mktemp("pictures")


def calibrated(model: str, folder: Path, pictures: Path) -> Calibration:
    rig = folder / f"{model}.yaml"
    rig.write_text(RIG.format(model=model))
    return calibrate(load_rig(rig), pictures)


@pytest.mark.parametrize(
    "model",
    [
        "pinhole-equidistant",
        *(pytest.param(m, marks=pytest.mark.full) for m in ("eucm", "double-sphere", "pinhole-radtan5")),
    ],
)
def test_lenses_that_fit_leave_less_than_the_shipped_solutions(folder, aprilgrid_images, model):
    result = calibrated(model, folder, aprilgrid_images)
    assert result.converged, result.status
    for fit in result.fits:
        assert fit.rms is not None and fit.rms < SHIPPED_RMS_PX
        assert fit.count > 2 * 6000
    T = result.T_imu_sensor("cam1")
    assert abs(np.linalg.norm(T[:3, 3]) - BASELINE_M) < 0.3e-3


def test_the_corners_in_the_image_are_more_than_two_radial_coefficients_follow(folder, aprilgrid_images):
    """The pictures reach further into the corners of the image than the shipped detections; the model says so by its
    standard deviations."""
    result = calibrated("pinhole-radtan", folder, aprilgrid_images)
    T, std = result.T_imu_sensor("cam1"), result.group("cam1", "translation").std
    assert abs(np.linalg.norm(T[:3, 3]) - BASELINE_M) < 0.3e-3
    assert std[0] > 0.2e-3
    assert min(f.rms or 0.0 for f in result.fits) > SHIPPED_RMS_PX
    # No corner is rejected for its place near the border, and the plainest model that follows the lenses is named.
    assert all(r.rejected.sum() <= 3 for r in result.corner_residuals)
    for camera in ("cam0", "cam1"):
        (words,) = [w for w in result.warnings if w.name == "lens_model_wrong" and f" {camera} " in w]
        assert words.endswith("`model: eucm`.")
