"""Images of a recording, worked on by all cores; results kept on disk.

Processes all images of a stream on all cores, in order, with a few batches in memory at a time.

Cache of detected corners: one file for each stream of images, named by its content and the settings.

The folder is $ICALIB_CACHE, or the user's cache folder. A file that is damaged or of another format counts as absent.
"""

from __future__ import annotations

import dataclasses
import hashlib
import os
from collections import deque
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import contextmanager, suppress
from itertools import islice
from math import ceil
from pathlib import Path
from typing import Any, TypeVar

import numpy as np

from icalib.base.extras import load_cv2
from icalib.base.files import load_arrays, staged
from icalib.base.remark import Remark
from icalib.data.recordings import DamagedImageError, Payload, Recording, decode
from icalib.detection.decoding import KEPT, VERDICTS, ImageCorners
from icalib.geometry.targets import Markers, Scene, Target
from icalib.sensors.stream import which_image

T = TypeVar("T")
R = TypeVar("R")
SPREAD = 5  # images that represent a recording if all of them would take too long
Progress = Callable[[float], None]  # called with the share of processed images, 0 to 1


def on_all_cores(batches: Iterable[T], work: Callable[[T], R]) -> Iterator[R]:
    """work(batch) for each batch, in order, on threads: OpenCV and compiled code release the GIL. At most one batch
    more than there are cores is in memory."""
    with _one_thread_in_opencv(), _pool() as pool:
        waiting: deque[Future[R]] = deque()
        for batch in batches:
            waiting.append(pool.submit(work, batch))
            if len(waiting) > core_count():
                yield waiting.popleft().result()
        while waiting:
            yield waiting.popleft().result()


def batches_of(payloads: Iterable[Payload], images: int, most_bytes: int) -> Iterator[list[Payload]]:
    """Groups of `images` payloads, or of fewer if these reach `most_bytes`."""
    batch: list[Payload] = []
    for p in payloads:
        batch.append(p)
        if len(batch) == images or sum(len(one.data) for one in batch) >= most_bytes:
            yield batch
            batch = []
    if batch:
        yield batch


def image_count(recording: Recording, topic: str) -> int:
    """About the number of images; 0 if unknown."""
    return next((t.count for t in recording.topics() if t.name == topic), 0)


def spread_images(recording: Recording, topic: str) -> Iterator[np.ndarray]:
    """Up to SPREAD images, evenly spread over the recording where its number of images is known."""
    every = max(image_count(recording, topic) // SPREAD, 1)
    for payload in islice(recording.payloads(topic), 0, 2 * SPREAD * every, every):
        with suppress(DamagedImageError):
            yield decode(payload)


def words_on_damaged(damaged_ns: Sequence[int], files: Mapping[int, str]) -> tuple[Remark, ...]:
    """A sentence on damaged images with these stamps; empty without any. files: names by stamp."""
    if not len(damaged_ns):
        return ()
    first = which_image(files.get(damaged_ns[0], ""), damaged_ns[0])
    return (Remark("images_damaged", f"{len(damaged_ns)} damaged images were ignored, the first {first}."),)


# Images that a report shows. They are taken while the stream is read, as nobody reads it again for them.

MOST_PICTURES = 64  # of a camera: 6.4 MB at most; the worst of them is the 98th percentile of a long recording
PICTURE_SIZE, PICTURE_QUALITY = 800, 60  # px of the longer side, and percent of JPEG: some 50 kB each
MOST_BYTES = 100_000  # of a picture, which bounds the report; only noise all over the image has more, and is shrunk


class SeenImages:
    """Notes on the images of a stream that is read. files: name of the file of each by stamp, "" if it is from no file.
    pictures: the same name and a small JPEG, by stamp, of at most `most` images evenly spread over about `count`."""

    def __init__(self, count: int, most: int) -> None:
        self.files: dict[int, str] = {}
        self.pictures: dict[int, tuple[str, bytes]] = {}
        self._every, self._most = max(1, ceil(count / max(most, 1))), most

    def add(self, payload: Payload) -> None:
        """Notes an image, unless the stream is read once more."""
        if payload.stamp_ns in self.files:
            return
        if self._most and len(self.files) % self._every == 0:
            with suppress(DamagedImageError):
                self.pictures[payload.stamp_ns] = payload.name, _small_jpeg(decode(payload))
        self.files[payload.stamp_ns] = payload.name
        if len(self.pictures) > self._most:
            self.pictures = dict(list(self.pictures.items())[::2])
            self._every *= 2


def _small_jpeg(image: np.ndarray) -> bytes:
    cv2 = load_cv2()
    share, jpeg = min(1.0, PICTURE_SIZE / max(image.shape)), b""
    while not jpeg or len(jpeg) > MOST_BYTES:
        width, height = (max(1, round(share * side)) for side in reversed(image.shape))
        small = cv2.resize(image, (width, height), interpolation=cv2.INTER_AREA)
        jpeg = cv2.imencode(".jpg", small, [cv2.IMWRITE_JPEG_QUALITY, PICTURE_QUALITY])[1].tobytes()
        share *= 0.7
    return jpeg


def core_count() -> int:
    """Number of processor cores that this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


@contextmanager
def _pool() -> Iterator[ThreadPoolExecutor]:
    """A pool of threads that drops waiting work if it is interrupted."""
    pool = ThreadPoolExecutor(core_count(), thread_name_prefix="icalib-images")
    try:
        yield pool
    finally:
        pool.shutdown(wait=True, cancel_futures=True)


@contextmanager
def _one_thread_in_opencv() -> Iterator[None]:
    """Limits OpenCV to one thread within the context: its threads and those of `on_all_cores` would compete for the
    cores."""
    cv2 = load_cv2()
    before = cv2.getNumThreads()
    cv2.setNumThreads(1)
    try:
        yield
    finally:
        cv2.setNumThreads(before)


DETECTOR_VERSION = 9  # of the detectors and of the file format; raise it with each change that changes corners
_FIELDS = ("point", "uv", "sigma", "blur", "verdict", "edges")


def cache_folder() -> Path:
    """The folder of the cache."""
    if given := os.environ.get("ICALIB_CACHE"):
        return Path(given)
    from platformdirs import user_cache_path

    return user_cache_path("icalib", appauthor=False) / "corners"


def stream_key(payloads: Iterable[Payload], settings: str) -> str:
    """Cache key of a stream of images: a hash of all its bytes and of the settings of the search."""
    digest = hashlib.blake2b(f"{DETECTOR_VERSION} {settings}".encode(), digest_size=20)
    for p in payloads:
        digest.update(f"{p.stamp_ns} {p.encoding} {p.width} {p.height} {p.step} {p.big_endian} {len(p.data)} ".encode())
        digest.update(p.data)
    return digest.hexdigest()


def load_corners(key: str) -> tuple[np.ndarray, list[ImageCorners]] | None:
    """Stamps (M,) and corners of the images cached under `key`, or None."""
    arrays = load_kept(key, ("stamps_ns", "start", *_FIELDS))
    if arrays is None:
        return None
    start = arrays["start"]
    images = [
        ImageCorners(*(arrays[name][a:b] for name in _FIELDS)) for a, b in zip(start[:-1], start[1:], strict=True)
    ]
    return arrays["stamps_ns"], images


def keep_corners(key: str, stamps_ns: np.ndarray, images: list[ImageCorners]) -> None:
    """Caches stamps (M,) and corners of the images under `key`."""
    arrays: dict[str, Any] = {name: np.concatenate([getattr(i, name) for i in images]) for name in _FIELDS}
    arrays |= {"stamps_ns": stamps_ns, "start": np.concatenate([[0], np.cumsum([len(i.point) for i in images])])}
    keep_arrays(key, arrays)


def load_kept(key: str, names: Iterable[str]) -> dict[str, np.ndarray] | None:
    """The arrays cached under `key`; None if there are none, or if one of `names` is missing."""
    try:
        arrays = load_arrays((cache_folder() / f"{key}.npz").read_bytes())
    except (OSError, ValueError, KeyError):
        return None
    return dict(arrays) if set(names) <= arrays.keys() else None


def keep_arrays(key: str, arrays: Mapping[str, np.ndarray]) -> None:
    """Caches arrays under `key`. If the folder cannot be written, nothing is cached and the next run searches again."""
    folder = cache_folder()
    try:
        folder.mkdir(parents=True, exist_ok=True)
        with staged(folder) as place:
            part = place / f"{key}.npz"
            np.savez_compressed(part, **dict[str, Any](arrays))
            part.replace(folder / part.name)
    except OSError:
        return


# Summaries of the detections of a target, and removal of tags that are seen too rarely to be real.
#
# Numbers the points of rotationally symmetric targets consistently over all images of a camera.
#
# One image does not show which of several rotations of the target it sees. The preceding image does, if the target
# moved little in between.

LEAST_IMAGES = 3  # least number of images with a tag whose id is not listed; fewer may be false detections
LEAST_IMAGE_SHARE = 0.01  # the same, as a share of all images
_MOST_IDS = 10  # ids in a sentence, at most
Part = tuple[str, Target, int]  # name, target, number of its first point


def parts_of(target: Target) -> list[Part]:
    """The targets of a scene, or the target itself without a name."""
    if not isinstance(target, Scene):
        return [("", target, 0)]
    return list(zip(target.names, target.targets, target.first_points[:-1].tolist(), strict=True))


def n_images_with(images: list[ImageCorners], part: Part) -> int:
    """Number of images with kept corners of the part."""
    _, target, first = part
    return sum(bool((i.kept & (i.point >= first) & (i.point < first + len(target.points))).any()) for i in images)


def without_rare_tags(target: Target, images: list[ImageCorners]) -> tuple[list[ImageCorners], tuple[Remark, ...]]:
    """The images without free tags that fewer than LEAST_IMAGES or LEAST_IMAGE_SHARE of them show, and sentences that
    name these tags.

    Small families have false detections, and a false tag would get a pose in the map. Tags whose ids are listed are
    kept.
    """
    least = max(LEAST_IMAGES, ceil(LEAST_IMAGE_SHARE * len(images)))
    notes: list[Remark] = []
    for name, part, first in parts_of(target):
        if not isinstance(part, Markers) or part.ids:
            continue
        count = np.zeros(len(part.known), dtype=np.int64)
        for i in images:
            tags = (i.point[i.kept] - first) // 4
            count[np.unique(tags[(tags >= 0) & (tags < len(count))])] += 1
        rare = np.flatnonzero((count > 0) & (count < least))
        if not len(rare):
            continue
        images = [_without(i, first, rare) for i in images]
        ids = ", ".join(str(k) for k in part.known[rare[:_MOST_IDS]]) + (", ..." if len(rare) > _MOST_IDS else "")
        sentence = (
            f"{len(rare)} tags of {part.family} (ids {ids}) are in fewer than {least} of {len(images)} images "
            f"and were ignored; list the ids{' of ' + name if name else ''} in the rig file if they exist."
        )
        notes.append(Remark("tags_seen_rarely", sentence))
    return images, tuple(notes)


def _without(image: ImageCorners, first: int, tags: np.ndarray) -> ImageCorners:
    """The image without the tags with these indices into `Markers.known`, whose points begin at `first`."""
    rows = ~np.isin((image.point - first) // 4, tags)
    return ImageCorners(*(getattr(image, f.name)[rows] for f in dataclasses.fields(image)))


def sightings(target: Target, images: list[ImageCorners]) -> tuple[Remark, ...]:
    """Sentences: how many images show each target, how many corners were dropped and why, and which targets are never
    seen."""
    kept = sum(int(i.kept.sum()) for i in images)
    dropped = {name: sum(i.counts()[name] for i in images) for k, name in enumerate(VERDICTS) if k != KEPT}
    reasons = ", ".join(f"{n} {name}" for name, n in dropped.items() if n)
    tail = f"; corners rejected: {reasons}" if reasons else ""
    counts = {part[0] or "the target": n_images_with(images, part) for part in parts_of(target)}
    words = ", ".join(f"{name} is in {n}" for name, n in counts.items())
    missing = " and ".join(name for name, n in counts.items() if not n)
    notes = (Remark("target_sightings", f"{words} of {len(images)} images, {kept} corners{tail}."),)
    if missing:
        sentence = f"{missing} is never seen; check its type, family, ids and sizes."
        notes = (*notes, Remark("target_never_seen", sentence))
    return notes


def number_continuously(target: Target, images: Sequence[ImageCorners]) -> list[ImageCorners]:
    """The images, with the points of each symmetric target renumbered.

    `images` are those of one camera in temporal order. In each image, the rotation is chosen that moves the points
    least from the last image with a known position of the whole target. The first image keeps its numbers, because no
    rotation is preferred there.
    """
    images = list(images)
    for _, part, first in parts_of(target):
        if part.symmetric:
            previous_uv = None
            for k, image in enumerate(images):
                rows = (image.point >= first) & (image.point < first + len(part.points))
                if rows.any():
                    turn = _nearest_turn(part.turns, previous_uv, image.point[rows] - first, image.uv[rows])
                    point = image.point.copy()
                    point[rows] = first + turn[point[rows] - first]
                    images[k] = image.renumbered(point)
                    completed = _completed(part.points[:, :2], point[rows] - first, image.uv[rows])
                    previous_uv = previous_uv if completed is None else completed
    return images


def _nearest_turn(
    turns: Sequence[np.ndarray], previous_uv: np.ndarray | None, point: np.ndarray, uv: np.ndarray
) -> np.ndarray:
    """The renumbering (n,) by a rotation for which points (m,) at uv (m, 2) px are nearest to their former positions,
    on average.

    previous_uv (n, 2) px: former positions of all points of the target, so that rotations are compared by the same
    points. The first of `turns` if it is None.
    """
    if previous_uv is None:
        return turns[0]
    return min(turns, key=lambda turn: float(np.linalg.norm(previous_uv[turn[point]] - uv, axis=1).mean()))


def _completed(board: np.ndarray, point: np.ndarray, uv: np.ndarray) -> np.ndarray | None:
    """(n, 2) px: the points (m,) at uv (m, 2), and the predicted positions of the other points of the board (n, 2).

    Predictions come from the least-squares affine map. Its error under perspective is a small fraction of the board's
    size; with a wrong rotation, points are off by half of it. None if the points are on one line.
    """
    plane = np.concatenate([board - board.mean(axis=0), np.full((len(board), 1), np.ptp(board))], axis=1)
    affine, _, rank, _ = np.linalg.lstsq(plane[point], uv, rcond=1e-6)
    if rank < 3:
        return None
    completed = plane @ affine
    completed[point] = uv
    return completed
