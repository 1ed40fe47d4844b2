"""Images a second that one core searches for each target, beside decoding alone: `python benchmarks/throughput.py`.

The images are rendered, 752 x 480, 20 a second, 2 grey levels of noise, the board wholly or partly in sight. They are
searched alone and in turn, as those of a recording are: each where the ones before lead to expect the target. Corners
that the latter lacks are lost; those that both have lie apart. Times are those of the processor, so that other
work on the machine hardly disturbs them. Needs icalib[images].
"""

from __future__ import annotations

import argparse
import dataclasses
import time
from collections.abc import Callable
from typing import TypeVar

import cv2
import numpy as np

from icalib.detection.decoding import ImageCorners
from icalib.detection.detectors import Detector, detector_of
from icalib.detection.growth import MOTION_IMAGES
from icalib.geometry.targets import AprilGrid, Charuco, Checkerboard, Scene, Target
from icalib.sensors.camera.read.detected_corners import IN_TURN
from icalib.tools.simulation import HandheldMotion, film, handheld, tag_map

TARGETS: tuple[Target, ...] = (
    AprilGrid(6, 6, 0.088, 0.3),
    Charuco(8, 6, 0.08, 0.06, "5x5_100"),
    Checkerboard(6, 9, 0.06),
    tag_map().target,
    tag_map(with_grid=True).target,
)
RATE_HZ = 20.0
LESS_MOTION = 0.5  # than `handheld`, whose checkerboard is seldom wholly in sight

Done = TypeVar("Done")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--images", type=int, default=72, metavar="N", help="of each target (72)")
    count = parser.parse_args().images
    cv2.setNumThreads(1)
    print(
        f"{'images/s on one core':<22}{'PNG':>8}{'JPEG':>8}{'alone':>8}{'in turn':>8}   corners, lost, RMS apart, most"
    )
    for target in TARGETS:
        images = rendered(target, count)
        png, jpeg = (decoding(images, suffix) for suffix in (".png", ".jpg"))
        detector = detector_of(target)
        in_turn(detector, images[:6])  # compiles
        alone, corners = timed(lambda d=detector, i=images: [d.detect(image) for image in i])
        turns, also = timed(lambda d=detector, i=images: in_turn(d, i))
        rates = f"{1 / png:>8.0f}{1 / jpeg:>8.0f}{count / alone:>8.0f}{count / turns:>8.0f}"
        print(f"{target.type:<22}{rates}   {differences(corners, also)}", flush=True)


def in_turn(detector: Detector, images: list[np.ndarray]) -> list[ImageCorners]:
    """As `find_corners` searches a recording."""
    corners: list[ImageCorners] = []
    for k, image in enumerate(images):
        corners.append(detector.detect(image, corners[k - min(k % IN_TURN, MOTION_IMAGES) :]))
    return corners


def differences(corners: list[ImageCorners], also: list[ImageCorners]) -> str:
    """How many corners are found, and lost, and how far apart [px] those of both are."""
    lost, apart = 0, [np.zeros(0)]
    for a, b in zip(corners, also, strict=True):
        common, i, j = np.intersect1d(a.point[a.kept], b.point[b.kept], return_indices=True)
        lost += int(a.kept.sum()) - len(common)
        apart.append(np.abs(a.uv[a.kept][i] - b.uv[b.kept][j]).ravel())
    off = np.concatenate(apart)
    return f"{sum(int(f.kept.sum()) for f in corners)}, {lost}, {np.sqrt(np.mean(off**2)):.5f} px, {off.max():.4f} px"


def rendered(target: Target, count: int) -> list[np.ndarray]:
    """Images of the scenario's cam0."""
    duration_s = count / RATE_HZ + 0.3
    base = handheld(duration_s)
    motion = HandheldMotion(rotation_scale=LESS_MOTION, translation_scale=LESS_MOTION, seed=0)
    scenario = (
        dataclasses.replace(base, target=target, motion=motion)
        if len(target.bodies) == 1
        else tag_map(duration_s, with_grid=isinstance(target, Scene))
    )
    camera = dataclasses.replace(base.cameras[0], rate_hz=RATE_HZ)
    scenario = dataclasses.replace(scenario, cameras=(camera,))
    return [shot.pixels for shot in film(scenario, 0).shots()][:count]


def decoding(images: list[np.ndarray], suffix: str) -> float:
    """Seconds of the processor for an image file."""
    files = [cv2.imencode(suffix, image)[1] for image in images]
    return seconds(lambda data: cv2.imdecode(data, cv2.IMREAD_GRAYSCALE), files)


def seconds(work: Callable[[np.ndarray], object], items: list[np.ndarray]) -> float:
    """Of the processor, for each item."""
    return timed(lambda: [work(item) for item in items])[0] / len(items)


def timed(work: Callable[[], Done]) -> tuple[float, Done]:
    """Seconds of the processor, and what comes of them."""
    started = time.process_time()
    done = work()
    return time.process_time() - started, done


if __name__ == "__main__":
    main()
