"""Processes all images of a stream on all cores, in order, with a few batches in memory at a time."""

from __future__ import annotations

import os
from collections import deque
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import contextmanager, suppress
from itertools import islice
from typing import TypeVar

import numpy as np

from icalib.base.extras import load_cv2
from icalib.data.recordings import DamagedImageError, Payload, Recording, decode
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
