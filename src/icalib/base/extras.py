"""Packages that only some work needs: they are imported on use, and where one is missing a sentence says so."""

from __future__ import annotations

import importlib
from types import ModuleType
from typing import Any

from icalib.errors import RecordingError


def install(extra: str) -> str:
    """The command that installs `extra`, in words."""
    return f'pip install ".[{extra}]" in the checkout of icalib'


def load_cv2() -> Any:
    """OpenCV. Raises RecordingError where it is not installed."""
    return _load("cv2", "images", "Images and tags need OpenCV")


def load_typesys() -> Any:
    """The message types of rosbags. Raises RecordingError where it is not installed."""
    return _load("rosbags.typesys", "bags", "Bags need the package rosbags")


def load_lz4() -> Any:
    """lz4's frame format. Raises RecordingError where it is not installed."""
    return _load("lz4.frame", "bags", "Bags compressed by lz4 need the package lz4")


def load_zstd() -> Any:
    """zstd: the standard library's from Python 3.14 on. Raises RecordingError where it is not installed."""
    try:
        return importlib.import_module("compression.zstd")
    except ImportError:
        return _load("backports.zstd", "bags", "Bags compressed by zstd need the package backports.zstd")


def load_distributed() -> Any:
    """Dask's distributed. Raises RecordingError where it is not installed."""
    return _load("distributed", "montecarlo", "Many runs need Dask's package distributed")


def load_dask() -> Any:
    """Dask, whose settings distributed has. Raises RecordingError where it is not installed."""
    return _load("dask", "montecarlo", "Many runs need Dask's package distributed")


def load_filelock() -> Any:
    """filelock. Raises RecordingError where it is not installed."""
    return _load("filelock", "montecarlo", "Many runs need the package filelock")


def load_matplotlib() -> Any:
    """matplotlib's figures, drawn without a screen. Raises RecordingError where it is not installed."""
    return _load("matplotlib.figure", "montecarlo", "Figures as PNG need the package matplotlib")


def load_rerun() -> Any:
    """Rerun's SDK with its blueprints. Raises RecordingError where it is not installed."""
    _load("rerun.blueprint", "view", "The 3D view needs the package rerun-sdk")
    return importlib.import_module("rerun")


def _load(module: str, extra: str, need: str) -> ModuleType:
    try:
        return importlib.import_module(module)
    except ImportError:
        raise RecordingError(f"{need}, which is not installed; run {install(extra)}.") from None
