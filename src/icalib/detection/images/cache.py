"""Cache of detected corners: one file for each stream of images, named by its content and the settings.

The folder is $ICALIB_CACHE, or the user's cache folder. A file that is damaged or of another format counts as absent.
"""

from __future__ import annotations

import hashlib
import os
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

import numpy as np

from icalib.base.staging import staged
from icalib.base.unpacking import load_arrays
from icalib.data.recordings import Payload
from icalib.detection.primitives.corners import ImageCorners

DETECTOR_VERSION = 8  # of the detectors and of the file format; raise it with each change that changes corners
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
