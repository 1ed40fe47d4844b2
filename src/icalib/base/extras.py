"""Optional dependencies: imported at first use. A missing one raises RecordingError with the command to install it."""

from __future__ import annotations

import importlib
import os
from functools import partial
from typing import Any

from icalib.errors import RecordingError


def install(extra: str) -> str:
    """Installation advice for a message; extra: name of an optional dependency group in pyproject.toml."""
    return f'pip install ".[{extra}]" in the checkout of icalib'


def _load(module: str, extra: str, need: str) -> Any:
    try:
        return importlib.import_module(module)
    except ImportError:
        raise RecordingError(f"{need}, which is not installed; run {install(extra)}.") from None


# Functions without arguments that return these modules: deserializers of ROS messages, decompression, workers and their
# settings, locks of files, drawing without a display, data frames.
load_typesys = partial(_load, "rosbags.typesys", "bags", "Bags need the package rosbags")
load_lz4 = partial(_load, "lz4.frame", "bags", "Bags compressed by lz4 need the package lz4")
load_distributed = partial(_load, "distributed", "montecarlo", "Many runs need Dask's package distributed")
load_dask = partial(_load, "dask", "montecarlo", "Many runs need Dask's package distributed")
load_filelock = partial(_load, "filelock", "montecarlo", "Many runs need the package filelock")
load_matplotlib = partial(_load, "matplotlib.figure", "montecarlo", "Figures as PNG need the package matplotlib")
load_pandas = partial(_load, "pandas", "pandas", "Data frames need the package pandas")


def load_cv2() -> Any:
    """The module cv2 of OpenCV. Raises RecordingError where it is not installed."""
    # OpenCV reads these when it is loaded. The largest image takes up to 1.6 GB while it is decoded.
    for setting in ("OPENCV_IO_MAX_IMAGE_PIXELS", str(1 << 28)), ("OPENCV_LOG_LEVEL", "OFF"):
        os.environ.setdefault(*setting)
    return _load("cv2", "images", "Images and tags need OpenCV")


def load_zstd() -> Any:
    """compression.zstd (Python 3.14 or later), else backports.zstd. Raises RecordingError if neither is installed."""
    try:
        return importlib.import_module("compression.zstd")
    except ImportError:
        return _load("backports.zstd", "bags", "Bags compressed by zstd need the package backports.zstd")


def load_rerun() -> Any:
    """The module rerun, with rerun.blueprint imported. Raises RecordingError where it is not installed."""
    _load("rerun.blueprint", "view", "The 3D view needs the package rerun-sdk")
    return importlib.import_module("rerun")
