"""Features that two cameras share, where the place in the other image is known exactly."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
import pytest
from tests.typed import StandIn

from icalib.data.recordings import Payload, TopicInfo
from icalib.rig import Camera
from icalib.sensors.camera.read.image_tracks import find_all_tracks

from .conftest import SIZE, Turning, turning, wall

# Half a degree about each axis, and what a baseline does to a wall: 12 px to the left.
BESIDE = np.array([[1.001, -0.01, -12.0], [0.01, 0.999, 3.0], [1e-5, -1e-5, 1.0]])
CAMERAS = [Camera(name, "", "pinhole-radtan", SIZE, tracks="images") for name in ("cam0", "cam1")]
PERIOD_NS = 100_000_000


class TwoCameras(StandIn):
    """Images of both, those of the second 4 ms later on its clock."""

    def __init__(self, first: Turning, second: Turning) -> None:
        self.scenes = {"cam0": first, "cam1": second}

    def image_topic(self, sensor: str, given: str | None) -> str:
        return sensor

    def where(self, sensor: Camera) -> str:
        return f"rec/{sensor.name}"

    def topics(self) -> tuple[TopicInfo, ...]:
        return ()

    def payloads(self, topic: str) -> Iterator[Payload]:
        late = 4_000_000 if topic == "cam1" else 0
        for k, image in enumerate(self.scenes[topic].images):
            yield Payload(k * PERIOD_NS + late, f"rec/{topic}", "mono8", image.tobytes(), *image.shape[::-1])


@pytest.fixture(autouse=True)
def cache(tmp_path, monkeypatch):
    monkeypatch.setenv("ICALIB_CACHE", str(tmp_path / "cache"))


def test_cameras_that_look_the_same_way_share_features(scene):
    second = turning(wall(3), BESIDE, seed=6)
    (a, _), (b, _) = find_all_tracks(TwoCameras(scene, second), CAMERAS)
    shared = np.intersect1d(a.feature, b.feature)
    assert len(shared) > 100
    error = []
    for j in np.flatnonzero(np.isin(b.feature, shared)):
        k = b.image[j]
        own = np.flatnonzero((a.feature == b.feature[j]) & (a.image == k))
        assert len(own) == 1 and b.views[j] == a.views[own[0]] and b.spread[j] == a.spread[own[0]]
        place = BESIDE @ np.append(a.uv[own[0]], 1.0)
        error.append(b.uv[j] - place[:2] / place[2])
    size = np.linalg.norm(error, axis=1)
    assert np.median(size) < 0.06 and np.quantile(size, 0.99) < 0.3
    assert (np.diff(b.start) >= 0).all() and b.start[-1] == len(b.uv)
    for k in range(len(b.stamps_ns)):
        own = b.feature[b.start[k] : b.start[k + 1]]
        assert len(np.unique(own)) == len(own)


def test_cameras_that_see_different_things_share_none(scene):
    (a, _), (b, _) = find_all_tracks(TwoCameras(scene, turning(wall(4), BESIDE)), CAMERAS)
    assert not np.intersect1d(a.feature, b.feature).size
