"""Images a second that one core searches for each target, beside decoding alone: `python benchmarks/throughput.py`.

The images are rendered, 752 x 480, 2 grey levels of noise, the board wholly or partly in sight. Times are those of the
processor, so that other work on the machine hardly disturbs them. Needs icalib[images].
"""

from __future__ import annotations

import argparse
import dataclasses
import time
from collections.abc import Callable

import cv2
import numpy as np

from icalib.detection.detectors import detector_of
from icalib.geometry.targets import AprilGrid, Charuco, Checkerboard, Scene, Target
from icalib.simulation import Motion, film, handheld, tag_map

TARGETS: tuple[Target, ...] = (
    AprilGrid(6, 6, 0.088, 0.3),
    Charuco(8, 6, 0.08, 0.06, "5x5_100"),
    Checkerboard(6, 9, 0.06),
    tag_map().target,
    tag_map(with_grid=True).target,
)
LESS_MOTION = 0.5  # than `handheld`, whose checkerboard is seldom wholly in sight


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--images", type=int, default=60, metavar="N", help="of each target (60)")
    count = parser.parse_args().images
    cv2.setNumThreads(1)
    print(f"{'images/s on one core':<22}{'PNG':>8}{'JPEG':>8}{'search':>8}{'PNG + search':>14}   found in, corners")
    for target in TARGETS:
        images = rendered(target, count)
        png, jpeg = (decoding(images, suffix) for suffix in (".png", ".jpg"))
        detector = detector_of(target)
        found = [detector.detect(image) for image in images]  # compiles, too
        search = seconds(lambda image, d=detector: d.detect(image), images)
        corners = [int(f.kept.sum()) for f in found]
        rates = f"{1 / png:>8.0f}{1 / jpeg:>8.0f}{1 / search:>8.0f}{1 / (png + search):>14.0f}"
        print(f"{target.type:<22}{rates}   {np.count_nonzero(corners)} of {count}, {sum(corners)}", flush=True)


def rendered(target: Target, count: int) -> list[np.ndarray]:
    """Images of the scenario's cam0, four a second."""
    duration_s = count / 4.0 + 0.2
    base = handheld(duration_s)
    motion = Motion(rotation_scale=LESS_MOTION, translation_scale=LESS_MOTION, seed=0)
    scenario = (
        dataclasses.replace(base, target=target, motion=motion)
        if len(target.bodies) == 1
        else tag_map(duration_s, with_grid=isinstance(target, Scene))
    )
    camera = dataclasses.replace(base.cameras[0], rate_hz=4.0)
    scenario = dataclasses.replace(scenario, cameras=(camera,))
    return [shot.pixels for shot in film(scenario, 0).shots()][:count]


def decoding(images: list[np.ndarray], suffix: str) -> float:
    """Seconds of the processor for an image file."""
    files = [cv2.imencode(suffix, image)[1] for image in images]
    return seconds(lambda data: cv2.imdecode(data, cv2.IMREAD_GRAYSCALE), files)


def seconds(work: Callable[[np.ndarray], object], items: list[np.ndarray]) -> float:
    """Of the processor, for each item."""
    started = time.process_time()
    for item in items:
        work(item)
    return (time.process_time() - started) / len(items)


if __name__ == "__main__":
    main()
