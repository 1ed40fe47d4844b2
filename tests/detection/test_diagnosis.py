"""What is seen instead of the target, in one sentence."""

from __future__ import annotations

import re

import numpy as np
import pytest
from tests.cases import each

from icalib.detection import what_is_seen

pytest.importorskip("cv2")


@pytest.fixture(scope="module")
def scene(rendering):
    def image(kind, *arguments, y_up=True):
        pattern = getattr(rendering, kind)(*arguments)
        return rendering.render(pattern, rendering.homography(pattern, 0.8, 20.0, 30.0, 10.0, (0.0, 0.0), y_up))

    return image


@each(
    ("pattern", "target", "sentence"),
    [
        (
            ("aprilgrid", 6, 6),
            ("tag36h11", 1),
            r"36 tags of tag36h11 \(ids 0 to 35\) with border_bits 2, not 1",
        ),
        (("aprilgrid", 4, 4, 1, 2), ("tag36h11", 2), r"16 tags .* with border_bits 1, not 2; correct border_bits"),
        (("aprilgrid", 6, 6), ("4x4_50", 1), "36 tags of tag36h11 .*, none of 4x4_50; correct the target's family"),
        (("charuco", 6, 9), ("tag36h11", 2), r"27 tags of 4x4_50 \(ids 0 to 26\), none of tag36h11; correct"),
        (
            ("markers", "APRILTAG_36H11", (40, 41), 1),
            ("tag36h11", 1),
            "2 tags .*, none of those of the target",
        ),
        (("aprilgrid", 6, 6), ("tag36h11", 2), "check that rows, cols and spacing are those of the target"),
    ],
)
def test_what_is_there_is_named(scene, pattern, target: tuple[str, int], sentence):
    image = scene(*pattern, y_up=pattern[0] != "charuco")
    assert re.search(sentence, what_is_seen([image], *target, range(36)))


def test_mirrored_images_and_empty_ones(scene):
    mirrored = scene("aprilgrid", 6, 6)[:, ::-1]
    assert "the images are mirrored" in what_is_seen([mirrored], "tag36h11", 2, range(36))
    empty = np.full((480, 752), 90, dtype=np.uint8)
    assert "no tags of any known family; check" in what_is_seen([empty], "tag36h11", 2, range(36))
    assert "no tags of any known family; check" in what_is_seen([], "tag36h11", 2, range(36))
