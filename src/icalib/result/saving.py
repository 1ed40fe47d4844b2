"""Writes a `Calibration` to files and reads it back without loss of precision. File formats: docs/files.md."""

from __future__ import annotations

import dataclasses
import hashlib
import io
import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from icalib.base.files import NAME, printable, read_file, sealed
from icalib.base.input_files import load_arrays
from icalib.base.yaml_nodes import LARGEST
from icalib.errors import CalibrationError
from icalib.result.calibration import (
    Calibration,
    Iteration,
    ParameterGroup,
    RecordingSpan,
    SensorFit,
    Trajectory,
    by_key,
)
from icalib.result.cross_validation import CrossValidation, PredictedFit
from icalib.result.planes import Plane
from icalib.result.shapes import check_arrays
from icalib.result.summary import calibration_yaml
from icalib.sensors import SENSOR_KINDS, facet
from icalib.sensors.records import Residuals, RowResiduals

FORMAT, FORMAT_VERSION = "icalib result", 4
_TEXTS = ("unobservable", "warnings", "notes", "wrong")
_PLAIN = ("status", "converged", "rig", "rates", "inputs", "settings", "versions", "timings")
_MALFORMED = (KeyError, TypeError, ValueError, AttributeError, IndexError)


def calibration_files(calibration: Calibration) -> dict[str, bytes]:
    """Contents of calibration.yaml, result.json and result.npz, by file name."""
    arrays = _npz(calibration)
    return {
        "calibration.yaml": sealed(printable(calibration_yaml(calibration)).encode()),
        "result.json": sealed(
            printable(json.dumps(_plain(calibration, arrays), indent=1, ensure_ascii=False)).encode()
        ),
        "result.npz": arrays,
    }


def load_calibration(folder: str | Path) -> Calibration:
    """The calibration that `Calibration.save` wrote to `folder`, bit for bit.

    Raises CalibrationError, one sentence, if files are absent, malformed, truncated or from different runs.
    """
    folder = Path(folder)
    plain = _read_json(folder)
    arrays = _read_npz(folder, plain)
    try:
        calibration = _build(plain, arrays)
        _check(calibration)
    except _MALFORMED as error:
        what = f"{error} is missing" if isinstance(error, KeyError) else str(error)
        raise CalibrationError(f"{folder / 'result.json'} is damaged ({what}); calibrate again.") from error
    return calibration


def _plain(c: Calibration, arrays: bytes) -> dict[str, Any]:
    """Content of result.json. It includes the SHA-256 hash of the npz file `arrays`, which binds both files."""
    return {
        "format": FORMAT,
        "format_version": FORMAT_VERSION,
        "npz_sha256": hashlib.sha256(arrays).hexdigest(),
        "groups": [_lists(g) for g in c.groups],
        "fits": [dataclasses.asdict(f) for f in c.fits],
        "recordings": [dataclasses.asdict(r) for r in c.recordings],
        "residuals": [_without_arrays(r) for r in c.residuals.values()],
        "planes": [_lists(p) for p in c.planes],
        "cross_validation": None if c.cross_validation is None else _plain_cross_validation(c.cross_validation),
        "verdict": c.verdict,
        "reasons": list(c.reasons),
        **{name: list(getattr(c, name)) for name in _TEXTS},
        **{name: getattr(c, name) for name in _PLAIN},
        "made": c.made,
    }


def _lists(group: ParameterGroup | Plane) -> dict[str, Any]:
    plain = {f.name: getattr(group, f.name) for f in dataclasses.fields(group)}
    return {name: v.tolist() if isinstance(v, np.ndarray) else v for name, v in plain.items()}


def _plain_cross_validation(cross_validation: CrossValidation) -> dict[str, Any]:
    return _without_arrays(cross_validation) | {"fits": [dataclasses.asdict(f) for f in cross_validation.fits]}


def _without_arrays(record: Any) -> dict[str, Any]:
    arrays = _array_names(type(record))
    return {f.name: getattr(record, f.name) for f in dataclasses.fields(record) if f.name not in arrays}


def _npz(c: Calibration) -> bytes:
    arrays = {"covariance": c.covariance, "covariance_names": np.array(c.covariance_names, dtype=np.str_)}
    arrays["null_space"] = c.null_space
    for (sensor, kind), r in c.residuals.items():
        arrays |= {f"residuals/{sensor}/{kind}/{name}": getattr(r, name) for name in _array_names(type(r))}
    if c.cross_validation is not None:
        arrays |= {
            f"cross_validation/{name}": getattr(c.cross_validation, name) for name in _array_names(CrossValidation)
        }
    arrays |= {f"trajectory/{name}": getattr(c.trajectory, name) for name in _array_names(Trajectory)}
    for f in dataclasses.fields(Iteration):
        kind = {"stage": np.str_, "accepted": np.bool_}.get(f.name, np.float64)
        arrays[f"iterations/{f.name}"] = np.array([getattr(i, f.name) for i in c.iterations], dtype=kind)
    buffer = io.BytesIO()
    np.savez(buffer, **arrays)
    return sealed(buffer.getvalue())


def _array_names(kind: type) -> list[str]:
    return [f.name for f in dataclasses.fields(kind) if f.type == "np.ndarray"]


def _read_json(folder: Path) -> dict[str, Any]:
    path = folder / "result.json"
    try:
        plain = json.loads(read_file(folder, path.name))
    except (ValueError, RecursionError) as error:
        raise CalibrationError(f"{path} is damaged or not a result of icalib ({error}); calibrate again.") from error
    if not isinstance(plain, dict) or plain.get("format") != FORMAT:
        raise CalibrationError(f"{path} is not a result of icalib; give the folder that a calibration was written to.")
    if plain.get("format_version") != FORMAT_VERSION:
        raise CalibrationError(
            f"{path} has format version {plain.get('format_version')}, this icalib reads {FORMAT_VERSION}; "
            "use the icalib that wrote it, or calibrate again."
        )
    return plain


def _read_npz(folder: Path, plain: dict[str, Any]) -> dict[str, np.ndarray]:
    path = folder / "result.npz"
    content = read_file(folder, path.name)
    if hashlib.sha256(content).hexdigest() != plain.get("npz_sha256"):
        raise CalibrationError(
            f"{path} is truncated, changed, or of another run than the result.json beside it; calibrate again."
        )
    try:
        return load_arrays(content)
    except ValueError as error:
        raise CalibrationError(f"{path} cannot be read ({error}); calibrate again.") from error


def _build(plain: dict[str, Any], arrays: dict[str, np.ndarray]) -> Calibration:
    def of(kind: type, prefix: str) -> dict[str, Any]:
        return {name: arrays[f"{prefix}/{name}"] for name in _array_names(kind)}

    steps = (arrays[f"iterations/{f.name}"].tolist() for f in dataclasses.fields(Iteration))
    return Calibration(
        groups=tuple(_group(g) for g in plain["groups"]),
        covariance=arrays["covariance"],
        covariance_names=tuple(arrays["covariance_names"].tolist()),
        null_space=arrays["null_space"],
        fits=tuple(SensorFit(**f) for f in plain["fits"]),
        residuals=by_key(_residuals(r, of) for r in plain["residuals"]),
        planes=tuple(
            Plane(p["name"], np.array(p["normal"]), np.array(p["point"]), p["count"]) for p in plain["planes"]
        ),
        cross_validation=_cross_validation(plain["cross_validation"], of),
        trajectory=Trajectory(**of(Trajectory, "trajectory")),
        recordings=tuple(RecordingSpan(**r) for r in plain["recordings"]),
        iterations=tuple(Iteration(*step) for step in zip(*steps, strict=True)),
        **{name: tuple(plain[name]) for name in _TEXTS},
        **{name: plain[name] for name in _PLAIN},
        made=str(plain.get("made", "")),  # earlier results have none
    )


def _residuals(plain: dict[str, Any], of: Callable[[type, str], dict[str, Any]]) -> Residuals:
    """The residual record of one sensor and kind. Its class is the one that a sensor kind lists in RECORDS, by default
    `RowResiduals`. `of` returns the arrays of a class under a prefix."""
    classes = {record.kind: record for kind in SENSOR_KINDS for record in getattr(facet(kind, "record"), "RECORDS", ())}
    fields = _tuples(plain)
    record = classes.get(fields["kind"], RowResiduals)
    arrays = of(record, f"residuals/{fields['sensor']}/{fields['kind']}")
    if record is not RowResiduals:
        del fields["kind"]  # a constant of the class, not an argument
    return record(**fields, **arrays)


def _cross_validation(
    plain: dict[str, Any] | None, of: Callable[[type, str], dict[str, Any]]
) -> CrossValidation | None:
    if plain is None:
        return None
    fits = tuple(PredictedFit(**f) for f in plain["fits"])
    return CrossValidation(**(plain | {"fits": fits}), **of(CrossValidation, "cross_validation"))


def _tuples(plain: dict[str, Any]) -> dict[str, Any]:
    return {name: tuple(v) if isinstance(v, list) else v for name, v in plain.items()}


def _group(plain: dict[str, Any]) -> ParameterGroup:
    fields = dict(plain)
    for name in ("value", "std_formal", "std", "factor", "std_imu"):
        fields[name] = None if plain[name] is None else np.array(plain[name], dtype=np.float64)
    for name in ("labels", "verdict", "columns"):
        fields[name] = None if plain[name] is None else tuple(plain[name])
    return ParameterGroup(**fields)


def _check(c: Calibration) -> None:
    """Raise ValueError if the parts of the result are inconsistent: shapes, counts, column indices, names of sensors,
    values that are no finite numbers."""
    n = len(c.covariance_names)
    for name in c.rig["sensors"]:
        if not NAME.fullmatch(name):
            raise ValueError(f"{name!r} is no name of a sensor")
    check_arrays(c)
    if c.covariance.shape != (n, n):
        raise ValueError(f"the covariance has shape {c.covariance.shape}, but {n} names")
    if c.null_space.ndim != 2 or len(c.null_space) != n:
        raise ValueError(f"the null space has shape {c.null_space.shape}, but there are {n} names")
    for g in c.groups:
        if not (np.abs(g.value) < LARGEST).all():
            raise ValueError(f"{g.sensor}.{g.name} holds a value that is no number, or too large")
        size = len(g.labels)
        sizes = {len(g.std), len(g.std_formal), len(g.verdict), size}
        sizes |= {len(x) for x in (g.columns, g.factor) if x is not None}
        if sizes != {size} or (g.columns is not None and not all(0 <= k < n for k in g.columns)):
            raise ValueError(f"{g.sensor}.{g.name} does not have {size} entries throughout")
    if not any(s.get("type") in ("imu", "camera", "pose") for s in c.rig["sensors"].values()):
        raise ValueError("the rig has neither IMU nor camera nor pose sensor")
    if (
        c.cross_validation is not None
        and not c.cross_validation.shift.shape
        == c.cross_validation.shift_sigma.shape
        == (c.cross_validation.segments, n)
    ):
        raise ValueError(f"cross_validation has not {c.cross_validation.segments} segments and {n} parameters")
    for (sensor, kind), r in c.residuals.items():
        if sensor not in c.rig["sensors"]:
            raise ValueError(f"there are residuals of {sensor!r}, which is no sensor")
        plane = np.asarray(getattr(r, "plane", ()))
        if plane.size and not 0 <= plane.min() <= plane.max() < len(c.planes):
            raise ValueError(f"{sensor} has {kind} on planes that are not there")
