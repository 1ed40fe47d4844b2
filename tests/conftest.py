"""Fixtures that all tests share."""

from __future__ import annotations

import os
from collections.abc import Iterator
from pathlib import Path

import pytest


@pytest.fixture(scope="session", autouse=True)
def _own_cache(tmp_path_factory) -> Iterator[None]:
    """Corners that tests find are not kept among the user's."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("ICALIB_CACHE", str(tmp_path_factory.mktemp("cache")))
        yield


def _recording(name: str) -> Path:
    """A real recording; ICALIB_DATA names its parent, ICALIB_REQUIRE_DATA=1 forbids to skip."""
    default = Path(__file__).parents[2] / "shared" / "data"
    path = Path(os.environ.get("ICALIB_DATA", default)) / name
    if path.is_dir():
        return path
    sentence = f"the recording {path} is absent; set ICALIB_DATA to the folder that holds {name}"
    if os.environ.get("ICALIB_REQUIRE_DATA") == "1":
        pytest.fail(sentence)
    pytest.skip(sentence)


@pytest.fixture(scope="session")
def euroc() -> Path:
    """The whole EuRoC calibration recording."""
    return _recording("euroc_imu_april")


@pytest.fixture(scope="session")
def aprilgrid_images() -> Path:
    """Stereo stills of the same board by the same cameras, with another detector's corners."""
    return _recording("aprilgrid_images")


@pytest.fixture(scope="session")
def odometry_logs() -> Path:
    """Rates, poses of a LiDAR odometry and IMU readings of two rigs, as LI-Init logged them, and its results."""
    return _recording("lidar_imu_odometry")


@pytest.fixture(scope="session")
def wheel_mocap() -> Path:
    """A differential drive: encoder ticks and planar poses by motion capture."""
    return _recording("wheel_mocap")
