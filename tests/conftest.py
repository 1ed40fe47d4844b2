"""Fixtures that all tests share."""

from __future__ import annotations

import os
from pathlib import Path

import pytest


@pytest.fixture(scope="session")
def euroc() -> Path:
    """The whole EuRoC calibration recording; ICALIB_DATA names its parent, ICALIB_REQUIRE_DATA=1 forbids to skip."""
    default = Path(__file__).parents[2] / "shared" / "data"
    path = Path(os.environ.get("ICALIB_DATA", default)) / "euroc_imu_april"
    if path.is_dir():
        return path
    sentence = f"the recording {path} is absent; set ICALIB_DATA to the folder that holds euroc_imu_april"
    if os.environ.get("ICALIB_REQUIRE_DATA") == "1":
        pytest.fail(sentence)
    pytest.skip(sentence)
