"""52 stereo pairs of Kalibr's AprilGrid from EuRoC, against the corners that another detector found in them."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from icalib.detection import AprilGridDetector

cv2 = pytest.importorskip("cv2")


@pytest.fixture(scope="module")
def images(aprilgrid_images) -> Path:
    return aprilgrid_images / "images"


@pytest.fixture(scope="module")
def shipped(images) -> dict:
    """(frame, camera) -> {point: (u, v)}."""
    entries = json.loads((images / "detected_corners.json").read_text())["value0"]
    return {
        (e["key"]["first"], e["key"]["second"]): {
            point: (uv["value0"], uv["value1"])
            for point, uv in zip(e["value"]["value1"], e["value"]["value0"], strict=True)
        }
        for e in entries
    }


@pytest.fixture(scope="module")
def found(images, shipped) -> dict:
    detector = AprilGridDetector(6, 6, 0.3)
    names = {key: images / f"{key[0]}_{key[1]}.jpg" for key in shipped}
    return {key: detector.detect(cv2.imread(str(name), cv2.IMREAD_GRAYSCALE)) for key, name in names.items()}


def test_every_tag_is_found(found, shipped):
    assert len(shipped) == 104
    for key, corners in shipped.items():
        assert {p // 4 for p in corners} <= set(found[key].point[found[key].kept] // 4), key


def test_corners_agree_and_hardly_any_is_missing(found, shipped):
    off, missing = [], 0
    for key, corners in shipped.items():
        ours = dict(zip(found[key].point[found[key].kept].tolist(), found[key].uv[found[key].kept], strict=True))
        off += [ours[p] - uv for p, uv in corners.items() if p in ours]
        missing += sum(p not in ours for p in corners)
    distance = np.hypot(*np.array(off).T)
    assert missing <= 12  # of 12442
    assert np.median(distance) < 0.1
    assert np.percentile(distance, 99) < 0.5
    assert np.abs(np.mean(off, axis=0)).max() < 0.02


def test_more_corners_are_found_than_were_shipped(found, shipped):
    assert sum(int(corners.kept.sum()) for corners in found.values()) > 1.07 * sum(map(len, shipped.values()))
