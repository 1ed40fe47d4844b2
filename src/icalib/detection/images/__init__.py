"""Images of a recording, worked on by all cores; results kept on disk.

Processes all images of a stream on all cores, in order, with a few batches in memory at a time.

Cache of detected corners: one file for each stream of images, named by its content and the settings.

The folder is $ICALIB_CACHE, or the user's cache folder. A file that is damaged or of another format counts as absent.
"""

from __future__ import annotations

import hashlib
import os
from collections import deque
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import contextmanager, suppress
from itertools import islice
from pathlib import Path
from typing import Any, TypeVar

import numpy as np

from icalib.base.extras import load_cv2
from icalib.base.files import staged
from icalib.base.input_files import load_arrays
from icalib.data.recordings import DamagedImageError, Payload, Recording, decode
from icalib.detection.primitives.corners import ImageCorners
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


def words_on_damaged(damaged_ns: Sequence[int], files: Mapping[int, str]) -> tuple[str, ...]:
    """A sentence on damaged images with these stamps; empty without any. files: names by stamp."""
    if not len(damaged_ns):
        return ()
    first = which_image(files.get(damaged_ns[0], ""), damaged_ns[0])
    return (f"{len(damaged_ns)} damaged images were ignored, the first {first}.",)


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
