"""The EuRoC recording: the whole one, and the excerpt that the repository ships."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import yaml
from tests.typed import not_none

from icalib.data.measurements import CornerStream, ImuStream, Measurements
from icalib.data.recordings import open_recording, read_measurements
from icalib.pipeline import calibrate_measurements
from icalib.result import Calibration
from icalib.rig import Rig
from icalib.rig.file import load_rig

EXAMPLE = Path(__file__).parents[2] / "examples" / "euroc"


@pytest.fixture(scope="session")
def rig() -> Rig:
    """The example's rig: published intrinsics held fixed."""
    return load_rig(EXAMPLE / "rig.yaml")


@pytest.fixture(scope="session")
def rig_from_nothing() -> Rig:
    return load_rig(EXAMPLE / "rig-from-nothing.yaml")


@pytest.fixture(scope="session")
def rig_equidistant() -> Rig:
    return load_rig(EXAMPLE / "rig-equidistant.yaml")


@pytest.fixture(scope="session")
def whole(euroc: Path, rig: Rig) -> Measurements:
    return read_measurements(open_recording(euroc), rig)


@pytest.fixture(scope="session")
def excerpt(rig: Rig) -> Measurements:
    return read_measurements(open_recording(EXAMPLE / "recording"), rig)


@pytest.fixture(scope="session")
def published(euroc: Path) -> dict:
    return yaml.safe_load((euroc / "reference.yaml").read_text())


@pytest.fixture(scope="session")
def whole_fixed(rig: Rig, whole: Measurements) -> Calibration:
    """The example on the whole recording."""
    return calibrate_measurements(rig, whole)


@pytest.fixture(scope="session")
def excerpt_fixed(rig: Rig, excerpt: Measurements) -> Calibration:
    return calibrate_measurements(rig, excerpt)


@pytest.fixture(scope="session")
def cut() -> Callable[[Measurements, float, float], Measurements]:
    """The part of measurements between two shares, 0 to 1, of the IMU's time."""

    def part(measurements: Measurements, low: float, high: float) -> Measurements:
        imu = measurements.imu
        first, length = not_none(imu).stamps_ns[0], not_none(imu).stamps_ns[-1] - not_none(imu).stamps_ns[0]
        begin, end = first + int(length * low), first + int(length * high)
        kept = (not_none(imu).stamps_ns >= begin) & (not_none(imu).stamps_ns <= end)
        cameras = tuple(_images(c, (c.stamps_ns >= begin) & (c.stamps_ns <= end)) for c in measurements.cameras)
        return Measurements.of_streams(
            ImuStream(
                not_none(imu).name, not_none(imu).stamps_ns[kept], not_none(imu).gyro[kept], not_none(imu).accel[kept]
            ),
            *cameras,
        )

    return part


def _images(corners: CornerStream, kept: np.ndarray) -> CornerStream:
    rows = kept[corners.image]
    start = np.concatenate([[0], np.cumsum(np.diff(corners.start)[kept])])
    return CornerStream(corners.name, corners.stamps_ns[kept], start, corners.point[rows], corners.uv[rows])
