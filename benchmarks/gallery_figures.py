"""docs/gallery/*.jpg, the pictures of simulated recordings in docs/gallery.md: python benchmarks/gallery_figures.py

Needs the extra `images`. What the simulator renders is shown with what icalib finds in it.
"""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np

from icalib.detection import AprilGridDetector
from icalib.detection.tracker import Tracker
from icalib.geometry.targets import NoTarget
from icalib.tools.simulation import Scenario, film, handheld, load_scenario

ROOT = Path(__file__).resolve().parents[1]
FOLDER = ROOT / "docs" / "gallery"
GREEN, RED, BLUE = (80, 200, 60), (60, 60, 230), (230, 140, 40)  # BGR
SCALE, SHIFT = 16, 4  # of what OpenCV draws between pixels


def main() -> None:
    FOLDER.mkdir(exist_ok=True)
    for name, picture in (("corners", corners()), ("tracks", tracks())):
        cv2.imwrite(str(FOLDER / f"{name}.jpg"), picture, [cv2.IMWRITE_JPEG_QUALITY, 72])


def corners() -> np.ndarray:
    """An oblique view of an AprilGrid; kept corners in green, dropped ones in red."""
    images = _images(handheld(2.0), 40)
    found = AprilGridDetector(6, 6, 0.3).detect(images[30])
    picture = cv2.cvtColor(images[30], cv2.COLOR_GRAY2BGR)
    for uv, kept in zip(found.uv, found.kept, strict=True):
        cv2.circle(picture, _place(uv), 4 * SCALE, GREEN if kept else RED, 1, cv2.LINE_AA, SHIFT)
    return picture


def tracks() -> np.ndarray:
    """An image of a room with the paths of its feature tracks over the last images."""
    scenario = load_scenario(ROOT / "examples" / "paper" / "table2-3d.yaml")
    camera = replace(scenario.cameras[0], rate_hz=15.0)
    scenario = replace(
        scenario,
        cameras=(camera,),
        sensors=(),
        features=None,
        target=NoTarget(),
        T_world_bodies=np.zeros((0, 4, 4)),
        duration_s=1.5,
    )
    images, tracker, paths = _images(scenario, 18), Tracker(), {}
    for k, image in enumerate(images):
        seen = tracker.add(image)
        for feature, uv in zip(seen.feature.tolist(), seen.uv, strict=True):
            paths.setdefault(feature, []).append((k, uv))
    picture = cv2.cvtColor(images[-1], cv2.COLOR_GRAY2BGR)
    for path in (path for path in paths.values() if path[-1][0] == len(images) - 1):
        places = np.array([_place(uv) for _, uv in path[-12:]], np.int32)
        cv2.polylines(picture, [places], False, BLUE, 1, cv2.LINE_AA, SHIFT)
        cv2.circle(picture, tuple(map(int, places[-1])), 3 * SCALE, GREEN, 1, cv2.LINE_AA, SHIFT)
    return picture


def _images(scenario: Scenario, count: int) -> list[np.ndarray]:
    """The first images (H, W) uint8 of the first camera."""
    scenario = replace(scenario, cameras=scenario.cameras[:1])
    return [shot.pixels for shot, _ in zip(film(scenario, 2).shots(), range(count), strict=False)]


def _place(uv: np.ndarray) -> tuple[int, int]:
    return int(round(SCALE * uv[0])), int(round(SCALE * uv[1]))


if __name__ == "__main__":
    main()
