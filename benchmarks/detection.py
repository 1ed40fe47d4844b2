"""Time per image, on one core, to read JPEGs of Kalibr's AprilGrid and to find its corners: `detection.py FOLDER`."""

from __future__ import annotations

import sys
import time
from pathlib import Path

import cv2
import numpy as np

from icalib.detection import AprilGridDetector


def main(folder: Path) -> None:
    cv2.setNumThreads(1)
    data = [np.frombuffer(path.read_bytes(), dtype=np.uint8) for path in sorted(folder.glob("*.jpg"))]
    detector = AprilGridDetector(rows=6, cols=6, tag_spacing=0.3)
    detector.detect(_image(data[0]))  # compiles
    began = time.process_time()
    images = [_image(one) for one in data]
    read = time.process_time()
    corners = [detector.detect(image) for image in images]
    ended = time.process_time()
    print(f"{len(images)} images of {images[0].shape[1]} x {images[0].shape[0]} px")
    print(f"reading   {1e3 * (read - began) / len(images):6.2f} ms")
    print(f"detection {1e3 * (ended - read) / len(images):6.2f} ms")
    print(f"corners   {sum(int(one.kept.sum()) for one in corners)} kept of {sum(len(one.point) for one in corners)}")


def _image(data: np.ndarray) -> np.ndarray:
    image = cv2.imdecode(data, cv2.IMREAD_GRAYSCALE)
    assert image is not None, "not an image"
    return image


if __name__ == "__main__":
    main(Path(sys.argv[1]))
