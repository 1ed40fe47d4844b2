"""Fixtures that all tests share."""

from __future__ import annotations

import dataclasses
import gc
import importlib
import os
import re
import shutil
import subprocess
from collections.abc import Callable, Iterator
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np
import pytest
import scipy.linalg  # noqa: F401 its BLAS is another than that of numpy
from tests.remarks import is_pinned
from threadpoolctl import threadpool_limits

from icalib.base.remark import Remark

BENCHMARKS = Path(__file__).parents[1] / "benchmarks"
WHOLE_RUNS = ("acceptance", "consistency")  # folders of tests that calibrate from measurements to the result
IMAGES = "detection"  # folder of tests that find targets, by kernels of their own


@pytest.hookimpl(tryfirst=True)  # before `-m` selects by marker
def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Marks whole runs and studies as slow, and brings files in the order in which workers are to take them."""
    for item in items:
        if item.path.parent.name in WHOLE_RUNS or item.get_closest_marker("full"):
            item.add_marker(pytest.mark.slow)
    slow = {item.path for item in items if item.get_closest_marker("slow")}
    place = {path: k for k, path in enumerate(_in_order(list(dict.fromkeys(item.path for item in items)), slow))}
    items.sort(key=lambda item: place[item.path])


def _in_order(files: list[Path], slow: set[Path]) -> list[Path]:
    """Files with slow tests come first: a long one at the end would leave other workers idle. Of two workers, which are
    handed files in turns, one begins with calibrations, the other with images: else both compile the same kernels."""
    files = sorted(files, key=lambda path: path not in slow)
    images = [path for path in files if path in slow and path.parent.name == IMAGES]
    others = [path for path in files if path not in images]
    begin = [path for pair in zip(others, images, strict=False) for path in pair]
    return begin + [path for path in files if path not in begin]


def pytest_collection_finish() -> None:
    """What was collected stays to the end: the garbage collector need not look through it again and again."""
    gc.collect()
    gc.freeze()


@pytest.fixture(scope="session", autouse=True)
def _one_blas_thread() -> Iterator[None]:
    """As in a calibration: on matrices so small, further threads only wait, which takes most of the processor time."""
    with threadpool_limits(limits=1, user_api="blas"):
        yield


@pytest.fixture(scope="session", autouse=True)
def _own_cache(tmp_path_factory) -> Iterator[None]:
    """Corners that tests find are not kept among the user's."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("ICALIB_CACHE", str(tmp_path_factory.mktemp("cache")))
        yield


@pytest.fixture(scope="session")
def benchmark_program() -> Callable[[str], ModuleType]:
    """Imports a program of benchmarks/, none of which is a part of the package."""

    def imported(name: str) -> ModuleType:
        with pytest.MonkeyPatch.context() as patch:
            patch.syspath_prepend(str(BENCHMARKS))
            return importlib.import_module(name)

    return imported


@pytest.fixture(scope="session", autouse=True)
def _pinned_sentences() -> Iterator[None]:
    """Every remark of every test has the sentence that sentences.yaml pins for its identifier."""
    new = Remark.__new__

    def checked(cls: type[Remark], name: str, sentence: str) -> Remark:
        assert is_pinned(name, sentence), f"{name}: tests/sentences.yaml has another sentence than {sentence!r}"
        return new(cls, name, sentence)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(Remark, "__new__", checked)
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
def camera_lidar_board() -> Path:
    """A checkerboard of 7 x 5 inner corners in 20 places, by a fisheye camera and a LiDAR."""
    return _recording("camera_lidar_board")


@pytest.fixture(scope="session")
def three_lidars_car() -> Path:
    """Clouds of three LiDARs on a standing car, in three scenes."""
    return _recording("three_lidars_car")


@pytest.fixture(scope="session")
def odometry_logs() -> Path:
    """Rates, poses of a LiDAR odometry and IMU readings of two rigs, as LI-Init logged them, and its results."""
    return _recording("lidar_imu_odometry")


@pytest.fixture(scope="session")
def gnss_imu() -> Path:
    """Two recordings of a GNSS antenna beside an IMU, in the hand and on a car."""
    return _recording("gnss_imu")


@pytest.fixture(scope="session")
def wheel_mocap() -> Path:
    """A differential drive: encoder ticks and planar poses by motion capture."""
    return _recording("wheel_mocap")


@pytest.fixture(scope="session", name="same")
def _same_fixture() -> Callable[[Any, Any], bool]:
    return _same


def _same(a: Any, b: Any) -> bool:
    """Equal in type, shape and every bit."""
    if isinstance(a, np.ndarray):
        return isinstance(b, np.ndarray) and a.dtype == b.dtype and a.shape == b.shape and a.tobytes() == b.tobytes()
    if dataclasses.is_dataclass(a):
        return type(a) is type(b) and all(_same(getattr(a, f.name), getattr(b, f.name)) for f in dataclasses.fields(a))
    if isinstance(a, tuple | list):
        return type(a) is type(b) and len(a) == len(b) and all(map(_same, a, b))
    if isinstance(a, dict):
        return type(a) is type(b) and list(a) == list(b) and all(_same(a[key], b[key]) for key in a)
    return type(a) is type(b) and a == b


@pytest.fixture(scope="session", name="tags_on_walls")
def _tags_on_walls_fixture() -> Callable[[tuple[float, float, float], int], np.ndarray]:
    return _tags_on_walls


def _tags_on_walls(room: tuple[float, float, float], a_wall: int) -> np.ndarray:
    """(4 a_wall, 4, 4) T_world_body of a row of tags on each wall of a `room` of that size, at different heights and
    turned in their walls."""
    rng, poses, up = np.random.default_rng(1), [], np.array([0.0, 0.0, 1.0])
    for inwards in np.array([[-1.0, 0, 0], [1, 0, 0], [0, -1, 0], [0, 1, 0]]):
        along = np.cross(up, inwards)
        middle = -inwards * (0.5 * np.abs(inwards) @ np.array(room) - 0.02)
        for k in range(a_wall):
            turn = np.deg2rad(rng.uniform(-30.0, 30.0))
            x, T = np.cos(turn) * along + np.sin(turn) * up, np.eye(4)
            T[:3, :3] = np.stack([x, np.cross(inwards, x), inwards], axis=1)
            place = ((k + 0.5) / a_wall - 0.5) * float(np.abs(along) @ np.array(room))
            T[:3, 3] = middle + place * along + rng.uniform(0.5, 1.9) * up
            poses.append(T)
    return np.stack(poses)


@pytest.fixture
def assert_drawn(tmp_path: Path) -> Callable[..., str]:
    """Fails where a browser finds an error in a page, leaves one of its figures undrawn when it is printed, or an entry
    of its contents leads nowhere. Returns the page as it is printed from a window that is `width` px wide."""
    chromium = next(filter(None, map(shutil.which, ("chromium", "chromium-browser", "google-chrome"))), None)
    if chromium is None:
        pytest.skip("no chromium is installed; install one to have the report drawn")
    file = tmp_path / "page.html"
    printing = "<script>setTimeout(() => dispatchEvent(new Event('beforeprint')), 4000)</script></body>"
    flags = (
        "--headless --no-sandbox --disable-quic --no-first-run --disable-background-networking "
        "--disable-component-update --disable-sync --use-angle=swiftshader --enable-unsafe-swiftshader "
        "--enable-logging=stderr --v=0 --dump-dom --virtual-time-budget=8000"
    )

    def draw(text: str, figures: set[str], width: int = 800) -> str:
        file.write_text(text.replace("</body>", printing), encoding="utf-8")
        command = [
            chromium,
            *flags.split(),
            f"--window-size={width},600",
            f"--user-data-dir={tmp_path / 'profile'}",
            file.as_uri(),
        ]
        found = subprocess.run(command, capture_output=True, text=True, timeout=120, check=True)
        assert not re.findall(r"CONSOLE.*(?:Error|error).*", found.stderr)
        for name in figures:
            assert re.search(rf'<div class="plot [^"]*js-plotly-plot[^"]*" id="{name}"', found.stdout), name
        places = re.findall('<section id="([^"]+)"', text)
        assert re.findall('<a href="#([^"]+)"', text.split("<nav")[1].split("</nav>")[0]) == places
        assert len(re.findall(r'<svg class="main-svg"[^>]* width="[1-9]', found.stdout)) >= len(figures)
        return found.stdout

    return draw
