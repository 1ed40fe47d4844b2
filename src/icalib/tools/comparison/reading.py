"""Reads the two sides of a comparison from files, whose kind follows from their content."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TypeGuard

import numpy as np

from icalib.base.files import regular
from icalib.base.yaml_nodes import YamlValue, read_yaml, suggestion
from icalib.errors import CalibrationError, RigError
from icalib.export.kalibr import KALIBR_NOISE
from icalib.export.ros import read_urdf
from icalib.result import Calibration, load_calibration
from icalib.sensors.sensor import TIME_OFFSET
from icalib.tools.comparison.compare import (
    DENSITIES,
    Comparison,
    ComparisonTolerances,
    LensSide,
    Quantity,
    Side,
    compare_sides,
    noise_quantities,
    quantity,
    side_of_result,
    side_of_rig,
    unknown,
)
from icalib.tools.inspection.kalibr import MODELS

_XML = b"<"


def compare_files(
    a: str | Path | Calibration,
    b: str | Path | Calibration,
    frames: Mapping[str, str] | None = None,
    tolerances: ComparisonTolerances | None = None,
    limit: float = 3.0,
) -> Comparison:
    """Compares two files. a, b: each a calibration, the folder of a result, a Kalibr camchain or imu file, a URDF, or a
    rig file. frames: sensor of A -> its name in B, or sensor of one side -> its link in the URDF of the other, if names
    differ.

    Raises CalibrationError, one sentence, if a file cannot be read or the two have nothing in common.
    """
    frames = frames or {}
    a, b = (x if isinstance(x, Calibration) else Path(x) for x in (a, b))
    if _is_urdf(a) and _is_urdf(b):
        one, other = side_of_urdf_alone(a, b, frames), side_of_urdf_alone(b, a, frames)
    elif _is_urdf(a):
        other = _side(b)
        one = _beside(a, other, frames)
    elif _is_urdf(b):
        one = _side(a)
        other = _beside(b, one, frames)
    else:
        one, other = _renamed(_side(a), _side(b), frames)
    return compare_sides(one, other, tolerances, limit)


def _beside(urdf: Path, side: Side, frames: Mapping[str, str]) -> Side:
    for name in frames:
        _check_known(name, side)
    sensors = [name for name in side.poses if name != side.body]
    return side_of_urdf(urdf, side.body, side.has_imu, sensors, frames)


def _renamed(a: Side, b: Side, frames: Mapping[str, str]) -> tuple[Side, Side]:
    """a unchanged, and b with its sensors renamed as in a. frames: name in a -> name in b."""
    for name, theirs in frames.items():
        _check_known(name, a)
        _check_known(theirs, b)
        b = b.renamed(theirs, name)
    return a, b


def _check_known(name: str, side: Side) -> None:
    if name not in side.sensors:
        near = suggestion(name, side.sensors)
        raise CalibrationError(f"there is no sensor {name} in {side.path}{near}; it has {', '.join(side.sensors)}.")


def _side(path: Path | Calibration) -> Side:
    if isinstance(path, Calibration):
        return side_of_result(path, "a calibration")
    if path.is_dir():
        return side_of_result(load_calibration(path), str(path))
    if path.name == "calibration.yaml":
        return side_of_result(load_calibration(path.parent), str(path))
    root = read_yaml(path, "result's folder, Kalibr file, URDF or rig file")
    entries = root.entries()
    if "sensors" in entries:
        return side_of_rig(path)
    if is_kalibr(entries):
        return side_of_kalibr(root)
    raise RigError(
        f"{path} is neither a Kalibr file nor a rig file; give a result's folder, a Kalibr camchain or imu file, a "
        "URDF or a rig file."
    )


def _is_urdf(path: Path | Calibration) -> TypeGuard[Path]:
    if isinstance(path, Calibration):
        return False
    if path.suffix in (".urdf", ".xacro"):
        return True
    try:
        with regular(path).open("rb") as file:
            return file.read(64).lstrip(b"\xef\xbb\xbf \t\r\n").startswith(_XML)
    except OSError:
        return False


# Sides of a comparison from files of other programs: Kalibr's camchain and imu file, URDF.

_ROUNDING = 1e-3  # largest deviation of R R^T from the identity, by printed digits


def is_kalibr(entries: Mapping[str, YamlValue]) -> bool:
    """Whether the entries of a YAML file are those of a camchain or an imu file."""
    inside = [set(value.entries()) for value in entries.values() if value.is_mapping]
    return any({"camera_model"} <= keys or {KALIBR_NOISE["gyro"]} <= keys for keys in [set(entries), *inside])


def side_of_kalibr(root: YamlValue) -> Side:
    """The side that a Kalibr camchain or imu file describes. Raises RigError naming line and field."""
    entries = root.entries()
    parts = {"imu0": root} if KALIBR_NOISE["gyro"] in entries else {n: v for n, v in entries.items() if v.is_mapping}
    cameras = {n: v.entries() for n, v in parts.items() if "camera_model" in v.entries()}
    imus = {n: v.entries() for n, v in parts.items() if KALIBR_NOISE["gyro"] in v.entries()}
    has_imu = bool(imus) or any({"T_cam_imu", "T_imu_cam"} & set(fields) for fields in cameras.values())
    body = next(iter(imus), "imu") if has_imu else next(iter(cameras))
    poses, T_gyro_imu = {body: np.eye(4)}, _T_gyro_imu(Path(root.file))
    for i, (name, fields) in enumerate(cameras.items()):
        poses[name] = _camera_pose(T_gyro_imu, name, fields, poses, list(cameras)[i - 1] if i else None)
    quantities: dict[tuple[str, str], Quantity] = {}
    for name, fields in cameras.items():
        if "timeshift_cam_imu" in fields:
            shift = np.array([fields["timeshift_cam_imu"].number()])
            quantities[name, "time_offset"] = quantity(TIME_OFFSET, shift, unknown(1))
    for name, fields in list(imus.items())[:1]:
        parts[name].record(tuple(KALIBR_NOISE.values()), tuple(k for k in fields if k not in KALIBR_NOISE.values()))
        quantities |= noise_quantities(name, {key: fields[KALIBR_NOISE[key]].positive() for key in DENSITIES})
    lenses = {n: lens for n, fields in cameras.items() if (lens := _lens(fields)) is not None}
    return Side(root.file, "Kalibr file", body, has_imu, poses, quantities=quantities, lenses=lenses)


def _T_gyro_imu(chain: Path) -> np.ndarray:
    """(4, 4) rotation from Kalibr's IMU frame, which has the axes of the accelerometer, to the axes of the gyroscope.
    It is that of the imu file that Kalibr writes beside `chain`; without one the identity."""
    beside, T = chain.with_name(chain.name.replace("camchain-imucam", "imu")), np.eye(4)
    if beside != chain and beside.is_file():
        entries = read_yaml(beside, "Kalibr file").entries()
        imu = entries["imu0"].entries() if "imu0" in entries else entries
        gyroscope = imu["gyroscopes"].entries() if "gyroscopes" in imu else {}
        if "C_gyro_i" in gyroscope:
            T[:3, :3] = _matrix(gyroscope["C_gyro_i"], 3, "a rotation")
    return T


def _camera_pose(
    T_gyro_imu: np.ndarray, name: str, fields: dict[str, YamlValue], poses: dict[str, np.ndarray], before: str | None
) -> np.ndarray:
    """(4, 4) T_body_cam: from T_cam_imu, or its inverse T_imu_cam (OpenVINS), or along the chain of cameras; else
    NaN. before: name of the previous camera of the chain."""
    if "T_cam_imu" in fields:
        return T_gyro_imu @ np.linalg.inv(_transform(fields["T_cam_imu"]))
    if "T_imu_cam" in fields:
        return _transform(fields["T_imu_cam"])
    if before is not None and "T_cn_cnm1" in fields:
        return poses[before] @ np.linalg.inv(_transform(fields["T_cn_cnm1"]))
    return poses.get(name, np.full((4, 4), np.nan))


def _transform(value: YamlValue) -> np.ndarray:
    T = _matrix(value, 4, "a transform")
    if np.abs(T[3] - [0, 0, 0, 1]).max() > 0:
        value.fail("is not a transform: its last row must be 0, 0, 0, 1; correct it.")
    return T


def _matrix(value: YamlValue, size: int, what: str) -> np.ndarray:
    """(size, size) matrix, whose first 3 x 3 entries are rounded digits of a rotation, made orthonormal."""
    rows = value.items()
    if len(rows) != size:
        value.fail(f"{what} has {size} rows of {size} numbers, but this has {len(rows)}; correct it.")
    T = np.array([row.vector(size) for row in rows])
    R = T[:3, :3]
    if np.abs(R @ R.T - np.eye(3)).max() > _ROUNDING or np.linalg.det(R) < 0:
        value.fail(f"is not {what}: its first 3 x 3 entries must be a rotation; correct it.")
    u, _, vt = np.linalg.svd(R)
    T[:3, :3] = u @ vt
    return T


def _lens(fields: dict[str, YamlValue]) -> LensSide | None:
    distortion = fields["distortion_model"].text() if "distortion_model" in fields else "none"
    kind = (fields["camera_model"].text(), distortion)
    if kind not in MODELS or not {"intrinsics", "resolution"} <= set(fields):
        return None
    model, before = MODELS[kind]
    values = fields["intrinsics"].vector(before + 4)
    if distortion != "none" and "distortion_coeffs" not in fields:
        fields["distortion_model"].fail("needs distortion_coeffs beside it; add them.")
    more = fields["distortion_coeffs"].vector(4) if distortion != "none" else []
    width, height = (side.whole(1) for side in fields["resolution"].items()[:2])
    params = np.concatenate([values[before:], values[:before], more])
    return LensSide(model, (width, height), params, unknown(len(params)))


def side_of_urdf(path: Path, body: str, has_imu: bool, sensors: Sequence[str], frames: Mapping[str, str]) -> Side:
    """The side that a URDF describes: poses of `sensors` relative to `body`. frames: sensor -> its link, if the link
    has another name than the sensor. Sensors without a link are left out.

    Raises CalibrationError if the file cannot be read, or if the body or a link in `frames` does not exist.
    """
    tree = read_urdf(path)
    link = {name: frames.get(name, name) for name in sensors}
    for name in frames:
        if name in link:
            tree.check_link(link[name], name)
    tree.check_link(frames.get(body, body), body)
    known = [name for name in sensors if link[name] in tree.links]
    poses = {name: tree.T(frames.get(body, body), link[name]) for name in known}
    return Side(str(path), "URDF", body, has_imu, poses | {body: np.eye(4)})


def side_of_urdf_alone(path: Path, other: Path, frames: Mapping[str, str]) -> Side:
    """The side that the URDF `path` describes, if the other side is a URDF as well. It has the links that both files
    have, relative to the first of them, without links that can move.

    Raises CalibrationError if a file cannot be read, if they have no link in common, or if `frames` is not empty.
    """
    tree, links = read_urdf(path), read_urdf(other).links
    common = sorted(set(tree.links) & set(links))
    if frames or not common:
        why = "share no link" if not common else "are compared by the names of their links, so leave out --frame"
        raise CalibrationError(f"{path} and {other} {why}.")
    poses = {common[0]: np.eye(4)}
    for link in common[1:]:
        if tree.is_fixed(common[0], link):
            poses[link] = tree.T(common[0], link)
    return Side(str(path), "URDF", common[0], False, poses)
