"""A resolution that is larger than the images is the first reason of a result."""

from __future__ import annotations

import numpy as np
import pytest

from icalib.sensors.camera.assess.lenses import smaller_image

CENTRE = np.array([375.5, 239.5])  # of images of 752 x 480 px
STD = np.array([1.0, 1.0])
UV = np.array([[3.0, 2.0], [748.0, 470.0], [300.0, 200.0]])


@pytest.mark.parametrize(
    ("resolution", "found"),
    [
        ((752, 480), None),
        ((800, 512), None),  # a lens that is off-centre by 6 %
        ((1504, 960), (752, 480)),
        ((1280, 1024), (752, 480)),
        ((752, 960), (752, 480)),
    ],
)
def test_images_are_smaller_than_stated(resolution: tuple[int, int], found: tuple[int, int] | None):
    assert smaller_image(resolution, CENTRE, STD, UV) == found


def test_a_cropped_image_and_an_unknown_centre_are_no_wrong_resolution():
    beyond = np.append(UV, [[1100.0, 700.0]], axis=0)
    assert smaller_image((1504, 960), CENTRE, STD, beyond) is None
    assert smaller_image((1504, 960), CENTRE, 100.0 * STD, UV) is None
