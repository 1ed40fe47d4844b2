"""Kalibr's files beside a recording: camchain, imu and target, recognised by their fields."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
import yaml

from icalib.base.yaml_nodes import read_yaml
from icalib.errors import RigError
from icalib.export.kalibr import KALIBR_MODELS, KALIBR_NOISE
from icalib.geometry.targets import AprilGrid, Checkerboard, Target

_LARGEST_BYTES = 100_000  # larger YAML files are not read, as they are not written by hand
# Kalibr's camera and distortion model -> icalib's model, and the number of coefficients before the focal lengths in
# Kalibr's intrinsics, which icalib counts as distortion.
MODELS = {(camera, distortion): (model, before) for model, (camera, distortion, before) in KALIBR_MODELS.items()}
Entry = TypeVar("Entry")


@dataclass(frozen=True)
class KalibrCamera:
    """One camera of a camchain, converted to a model of icalib: intrinsics fx, fy, cx, cy [px], and distortion."""

    file: str
    name: str
    topic: str
    model: str
    resolution: tuple[int, int]
    intrinsics: tuple[float, ...]
    distortion: tuple[float, ...]


@dataclass(frozen=True)
class KalibrImu:
    """The noise densities in an imu file, by their names in a rig file, and the topic of the IMU."""

    file: str
    topic: str
    densities: dict[str, float]


@dataclass(frozen=True)
class KalibrFiles:
    """Contents of the Kalibr files beside a recording. notes: files that could not be used, and why."""

    cameras: tuple[KalibrCamera, ...] = ()
    imus: tuple[KalibrImu, ...] = ()
    target: Target | None = None
    target_file: str = ""
    notes: tuple[str, ...] = ()


def find_kalibr_files(recording: Path) -> KalibrFiles:
    """Kalibr's files in the folder of the recording and in its parent; notes name faults of single files.

    If several targets differ, none is used, as the right one is unknown.
    """
    cameras: list[KalibrCamera] = []
    imus: list[KalibrImu] = []
    targets: dict[str, Target] = {}
    notes: list[str] = []
    for path in _yaml_files(recording):
        data = yaml_mapping(path)
        try:
            if "target_type" in data:
                targets[str(path)] = kalibr_target(data, str(path))
            else:
                cameras += _read(path, data, "camera_model", _camera)
                imus += _read(path, data, "gyroscope_noise_density", _imu)
        except RigError as error:
            notes.append(str(error))
    if len(set(map(repr, targets.values()))) > 1:
        notes.append(f"the targets {', '.join(targets)} beside the recording differ; give the right one with --target.")
        targets = {}
    file = next(iter(targets), "")
    return KalibrFiles(tuple(cameras), tuple(imus), targets.get(file), Path(file).name, tuple(notes))


def kalibr_target(data: dict[str, Any], file: str) -> Target:
    """The target of Kalibr's target file. Raises RigError naming file and field."""
    kind = data["target_type"]
    if kind == "aprilgrid":
        rows, cols = (_integer(data, name, file) for name in ("tagRows", "tagCols"))
        return AprilGrid(rows, cols, _positive(data, "tagSize", file), _positive(data, "tagSpacing", file))
    if kind == "checkerboard":
        rows, cols = (_integer(data, name, file) for name in ("targetRows", "targetCols"))
        size, other = (_positive(data, name, file) for name in ("rowSpacingMeters", "colSpacingMeters"))
        if size != other:
            raise RigError(f"{file}: rowSpacingMeters and colSpacingMeters differ; icalib needs square squares.")
        return Checkerboard(rows, cols, size)
    if kind == "circlegrid":
        raise RigError(f"{file}: {_circles(data, file)}")
    raise RigError(
        f"{file}: icalib does not know the target_type {kind!r}; use an aprilgrid, a checkerboard or a circlegrid."
    )


def _circles(data: dict[str, Any], file: str) -> str:
    """Message on how to write a circle grid in the rig file, as Kalibr's file lacks the diameter of its circles."""
    rows, cols = (_integer(data, name, file) for name in ("targetRows", "targetCols"))
    spacing = _positive(data, "spacingMeters", file)
    asymmetric = ", asymmetric: true" if data.get("asymmetricGrid") else ""
    target = f"{{type: circles, rows: {rows}, cols: {cols}, spacing: {spacing:g}, diameter: ...{asymmetric}}}"
    return (
        "the circle grid of Kalibr's file has no diameter, on which the centres of the images of circles "
        f"depend; measure it and write `target: {target}` in the rig file."
    )


def _yaml_files(recording: Path) -> list[Path]:
    above = recording.resolve().parent
    folders = [recording, above] if recording.is_dir() else [above]
    paths = [p for f in folders for p in _entries(f) if p.suffix in (".yaml", ".yml") and p.is_file()]
    return [p for p in paths if p.stat().st_size <= _LARGEST_BYTES]


def _entries(folder: Path) -> list[Path]:
    """Paths in `folder`, sorted; empty if it cannot be listed."""
    try:
        return sorted(folder.iterdir())
    except OSError:
        return []


def yaml_mapping(path: Path) -> dict[str, Any]:
    """The mapping in a YAML file; empty if the file cannot be parsed or is no mapping."""
    try:
        data = yaml.SafeLoader("").construct_document(read_yaml(path).node)
    except (RigError, ValueError, LookupError, AttributeError, yaml.YAMLError, RecursionError):
        return {}  # the loader also fails on tags that do not fit their values, such as !!int of an empty text
    return data if isinstance(data, dict) else {}


def _read(
    path: Path, data: dict[str, Any], mark: str, make: Callable[[str, str, dict[str, Any]], Entry]
) -> list[Entry]:
    """Results of make(file, name, mapping) for the mappings with the key `mark`: the whole file, or its entries (cam0,
    imu0)."""
    entries = {"": data} if mark in data else {k: v for k, v in data.items() if isinstance(v, dict) and mark in v}
    return [make(str(path), str(name), entry) for name, entry in entries.items()]


def _camera(file: str, name: str, data: dict[str, Any]) -> KalibrCamera:
    kind = (str(data["camera_model"]), str(data.get("distortion_model")))
    if kind not in MODELS:
        raise RigError(f"{file}: {name}: icalib has no {kind[0]}-{kind[1]} model; its intrinsics are not used.")
    model, before = MODELS[kind]
    values = _numbers(data, "intrinsics", before + 4, file)
    coefficients = _numbers(data, "distortion_coeffs", 4 if kind[1] != "none" else None, file)
    width, height = (int(side) for side in _numbers(data, "resolution", 2, file))
    return KalibrCamera(
        file,
        name,
        str(data.get("rostopic", "")),
        model,
        (width, height),
        values[before:],
        (*values[:before], *(coefficients if kind[1] != "none" else ())),
    )


def _imu(file: str, _: str, data: dict[str, Any]) -> KalibrImu:
    densities = {name: _positive(data, field, file) for name, field in KALIBR_NOISE.items()}
    return KalibrImu(file, str(data.get("rostopic", "")), densities)


def _numbers(data: dict[str, Any], name: str, size: int | None, file: str) -> tuple[float, ...]:
    try:
        values = tuple(float(x) for x in data.get(name, ()))
    except (TypeError, ValueError):
        values = ()
    if (size is not None and len(values) != size) or not np.isfinite(values).all():
        raise RigError(f"{file}: {name} must be {size} finite numbers; correct the file.")
    return values


def _positive(data: dict[str, Any], name: str, file: str) -> float:
    try:
        value = float(data[name])
    except (KeyError, TypeError, ValueError):
        value = -1.0
    if not 0.0 < value < np.inf:
        raise RigError(f"{file}: {name} must be a number above 0; correct the file.")
    return value


def _integer(data: dict[str, Any], name: str, file: str) -> int:
    value = _positive(data, name, file)
    if value != int(value):
        raise RigError(f"{file}: {name} must be a whole number; correct the file.")
    return int(value)
