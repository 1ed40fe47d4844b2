"""From nothing, the lenses and the board are those that other images of them show, other corners and other code."""

from __future__ import annotations

import importlib.util
import sys
from pathlib import Path

import numpy as np
import pytest

from icalib.pipeline import calibrate_measurements
from icalib.result import Calibration


def _stills_module():
    spec = importlib.util.spec_from_file_location("acceptance_stills", Path(__file__).with_name("stills.py"))
    assert spec is not None and spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    sys.modules[spec.name] = module
    spec.loader.exec_module(module)
    return module


pytestmark = pytest.mark.full


@pytest.fixture(scope="module")
def stills(aprilgrid_images) -> dict:
    return _stills_module().calibrate_stills(aprilgrid_images)


@pytest.fixture(scope="module")
def equidistant(rig_equidistant, whole) -> Calibration:
    return calibrate_measurements(rig_equidistant, whole)


@pytest.mark.parametrize(("camera", "index"), [("cam0", 0), ("cam1", 1)])
def test_focal_lengths_and_principal_points_are_those_of_other_images(equidistant, stills, camera, index):
    found = equidistant.group(camera, "intrinsics")
    assert equidistant.converged, equidistant.status
    error = found.value - stills["lenses"][index, :4]
    assert np.abs(error / np.hypot(found.std, stills["std"][index, :4])).max() < 3.0


def test_the_board_has_the_stretch_and_bends_that_other_images_see(equidistant, stills):
    in_plane = equidistant.group("board0", "shape").value[3:]
    assert in_plane[0] == pytest.approx(stills["shape"][3], rel=0.05)  # 0.50 mm
    np.testing.assert_allclose(in_plane[1:], stills["shape"][4:], atol=0.2e-3)
