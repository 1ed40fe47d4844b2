"""Boards found by icalib and by OpenCV: `boards.py FOLDER ROWS COLS [--every N]`.

Counts the images of FOLDER in which the checkerboard of ROWS x COLS inner corners is found, and the time per image on
one core: by icalib, `findChessboardCornersSB`, the same with CALIB_CB_EXHAUSTIVE, and `findChessboardCorners`. An image
counts for icalib where at least half of the corners are kept.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np

from icalib.detection import CheckerboardDetector

SUFFIXES = (".jpg", ".jpeg", ".png", ".bmp", ".pgm", ".tif", ".tiff")
QUICK = cv2.CALIB_CB_ADAPTIVE_THRESH | cv2.CALIB_CB_NORMALIZE_IMAGE
PLAIN = cv2.CALIB_CB_NORMALIZE_IMAGE


def main() -> None:
    options = _options()
    cv2.setNumThreads(1)
    files = sorted(p for p in options.folder.iterdir() if p.suffix.lower() in SUFFIXES)[:: options.every]
    images = [_grey(path) for path in files]
    detector, size = CheckerboardDetector(options.rows, options.cols), (options.cols, options.rows)
    detector.detect(images[0])  # compiles
    detectors: dict[str, Callable[[np.ndarray], bool]] = {
        "icalib": lambda i: int(detector.detect(i).kept.sum()) >= 0.5 * options.rows * options.cols,
        "SB": lambda i: cv2.findChessboardCornersSB(i, size, flags=PLAIN)[0],
        "SB exhaustive": lambda i: cv2.findChessboardCornersSB(i, size, flags=PLAIN | cv2.CALIB_CB_EXHAUSTIVE)[0],
        "classic": lambda i: cv2.findChessboardCorners(i, size, flags=QUICK)[0],
    }
    print(f"{options.folder.name}: {len(images)} images, {images[0].shape[1]} x {images[0].shape[0]} px")
    counts = {name: _counted(detect, images) for name, detect in detectors.items()}
    theirs = np.any([hits for name, (hits, _) in counts.items() if name != "icalib"], axis=0)
    for name, (hits, seconds) in counts.items():
        print(f"  {name:<14}{sum(hits):>5}{1e3 * seconds / len(images):>9.0f} ms an image")
    print(f"  {'any of OpenCV':<14}{theirs.sum():>5}")
    print(f"  {'by it alone':<14}{(theirs & ~np.array(counts['icalib'][0])).sum():>5}")


def _counted(detect: Callable[[np.ndarray], bool], images: list[np.ndarray]) -> tuple[list[bool], float]:
    """Whether each image shows the board, and processor seconds."""
    began = time.process_time()
    hits = [bool(detect(image)) for image in images]
    return hits, time.process_time() - began


def _grey(path: Path) -> np.ndarray:
    image = cv2.imread(str(path), cv2.IMREAD_GRAYSCALE)
    assert image is not None, f"{path} is no image"
    return image


def _options() -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folder", type=Path, metavar="FOLDER")
    parser.add_argument("rows", type=int, metavar="ROWS")
    parser.add_argument("cols", type=int, metavar="COLS")
    parser.add_argument("--every", type=int, default=1, metavar="N", help="every Nth image only (1)")
    return parser.parse_args()


if __name__ == "__main__":
    main()
