"""Writes a `Calibration` to files and reads it back without loss of precision; summary and rig file from a result."""

from __future__ import annotations

import dataclasses
import hashlib
import io
import json
import platform
from collections import Counter
from collections.abc import Callable, Iterable
from contextlib import suppress
from importlib.metadata import version
from math import isnan
from pathlib import Path
from typing import Any, Literal

import numpy as np
import yaml

from icalib.base.files import NAME, hash_of, load_arrays, printable, read_file, sealed
from icalib.base.remark import Remark
from icalib.base.yaml_nodes import LARGEST
from icalib.errors import CalibrationError, RigError
from icalib.geometry.so3 import rpy, rpy_std
from icalib.result.calibration import (
    Calibration,
    CrossValidation,
    Iteration,
    ParameterGroup,
    Plane,
    PredictedFit,
    RecordingSpan,
    SensorFit,
    Trajectory,
    by_key,
    check_arrays,
)
from icalib.result.derived import RelativePose, joint_covariance, relative_poses
from icalib.result.quantities import in_body_frame
from icalib.result.verdict import UNUSABLE
from icalib.rig import Rig, Settings
from icalib.rig.file import rig_from_dict, rig_to_dict
from icalib.rig.rig import ONE
from icalib.sensors.camera.stream import CornerResiduals, TrackResiduals
from icalib.sensors.imu.stream import ImuResiduals
from icalib.sensors.lidar.stream import LidarResiduals
from icalib.sensors.parameter import Parameter
from icalib.sensors.position.stream import PositionResiduals
from icalib.sensors.sensor import MOUNTED_NAMES, ROTATION, TRANSLATION
from icalib.sensors.stream import Residuals, RowResiduals

# Writes a `Calibration` to files and reads it back without loss of precision. File formats: docs/files.md.

FORMAT, FORMAT_VERSION = "icalib result", 5
RECORDS = (ImuResiduals, CornerResiduals, TrackResiduals, LidarResiduals)  # others are `RowResiduals`
_REMARKS = ("unobservable", "warnings", "notes", "wrong")
_UNKNOWN = "unknown"  # identifier of each sentence of an earlier result, which has none
_PLAIN = ("status", "converged", "rig", "rates", "inputs", "settings", "versions", "timings")
_MALFORMED = (KeyError, TypeError, ValueError, AttributeError, IndexError)


def calibration_files(calibration: Calibration) -> dict[str, bytes]:
    """Contents of calibration.yaml, result.json and result.npz, by file name."""
    arrays = _npz(calibration)
    return {
        "calibration.yaml": sealed(printable(calibration_yaml(calibration)).encode()),
        "result.json": sealed(
            printable(
                json.dumps(_plain(calibration, arrays), indent=1, ensure_ascii=False, default=np.ndarray.tolist)
            ).encode()
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
        "groups": [vars(g) for g in c.groups],
        "fits": [dataclasses.asdict(f) for f in c.fits],
        "recordings": [dataclasses.asdict(r) for r in c.recordings],
        "residuals": [_without_arrays(r) for r in c.residuals.values()],
        "planes": [vars(p) for p in c.planes],
        "cross_validation": None if c.cross_validation is None else _plain_cross_validation(c.cross_validation),
        "verdict": c.verdict,
        "reasons": list(c.reasons),
        **{name: list(getattr(c, name)) for name in _REMARKS},
        "identifiers": {name: [r.name for r in getattr(c, name)] for name in ("reasons", *_REMARKS)},
        **{name: getattr(c, name) for name in _PLAIN},
        "made": c.made,
        "effects": c.effects,
    }


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
        **{name: _remarks(plain, name) for name in _REMARKS},
        **{name: plain[name] for name in _PLAIN},
        made=str(plain.get("made", "")),  # earlier results have none
        effects=plain.get("effects", {}),
    )


def _remarks(plain: dict[str, Any], name: str) -> tuple[Remark, ...]:
    """The sentences of the list `name`, with their identifiers."""
    names = plain["identifiers"][name] if "identifiers" in plain else [_UNKNOWN] * len(plain[name])
    return tuple(Remark(str(identifier), sentence) for identifier, sentence in zip(names, plain[name], strict=True))


def _residuals(plain: dict[str, Any], of: Callable[[type, str], dict[str, Any]]) -> Residuals:
    """The residual record of one sensor and kind. Its class is one of RECORDS, by default
    `RowResiduals`. `of` returns the arrays of a class under a prefix."""
    classes = {record.kind: record for record in RECORDS}
    fields = _tuples(plain)
    prefix = f"residuals/{fields['sensor']}/{fields['kind']}"
    if fields["kind"] in classes:
        record = classes[fields.pop("kind")]  # a constant of the class, not an argument
        return record(**fields, **of(record, prefix))
    with suppress(KeyError):  # earlier results have no fixes
        return PositionResiduals(**fields, **of(PositionResiduals, prefix))
    return RowResiduals(**fields, **of(RowResiduals, prefix))


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
    for name in ("value", "std_formal", "std", "factor"):
        fields[name] = None if plain[name] is None else np.array(plain[name], dtype=np.float64)
    fields["std_by"] = {source: np.array(part, dtype=np.float64) for source, part in plain["std_by"].items()}
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
        sizes |= {len(x) for x in (g.columns, g.factor, *g.std_by.values()) if x is not None}
        if sizes != {size} or (g.columns is not None and not all(0 <= k < n for k in g.columns)):
            raise ValueError(f"{g.sensor}.{g.name} does not have {size} entries throughout")
    if not any(s.get("type") in ("imu", "camera", "lidar", "pose") for s in c.rig["sensors"].values()):
        raise ValueError("the rig has no IMU, camera, LiDAR or pose sensor")
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


# Writes `calibration.yaml`: the result in one short file for people and other programs.

HEADER = """\
# Calibration by icalib {version}. Lengths in m, times in s, angles in rad, image quantities in px.
# {key} takes coordinates in the sensor's frame to the {body} frame: p_{body} = {key} p_sensor.
{frames}# time_offset: t_{reference} = t_sensor + time_offset; a list, one for each recording, where a clock restarts.
#   That is in the middle of the recording, and of the middle row of a rolling shutter. clock_rate, ppm, is its change
#   with t_sensor; readout is the time from the first row to the one after the last.
# std: standard deviations, of rotation about the sensor's axes, of translation along the {body} axes. They include
#   empirical_factor: the scatter of segments over the predicted one; formal = std / factor. Those of roll_pitch_yaw,
#   R = Rz(yaw) Ry(pitch) Rx(roll), are null within 5 std of gimbal lock (pitch 90 deg). What is fixed has none.
# date: of the calibration, UTC. sha256: of the rig file and all files of the recordings.
# T_scene_body: poses of a target's bodies, in the frame of that body whose pose is the identity.
# relative: T_a_b takes coordinates in the frame of b to that of a. Its covariance, from the joint one of both, is of
#   rotation about the axes of b and translation along those of a; where one is unobservable it is that of the guess.
# verdict of the whole: usable, usable with care, partly usable or not usable; reasons: why, the most important first.
# reasons, unobservable, warnings, notes: identifier and sentence of each; docs/reasons.md lists the identifiers.
# verdict of a component: determined (std within its tolerance), weak (up to 10 tolerances), too uncertain (above 10
#   tolerances), unobservable (the data do not show it; it depends on its initial guess), or fixed by the rig file.
# The full covariance and all residuals are in result.npz.
"""
RPY = "roll_pitch_yaw"
IMU = "#   The imu frame has the axes of the gyroscope, and its origin at the accelerometer.\n"
KALIBR = "#   Kalibr's T_cam_imu is the inverse, in the axes of the accelerometer; see camchain-imucam.yaml.\n"


def calibration_yaml(calibration: Calibration) -> str:
    """Text of calibration.yaml; the format is in docs/files.md."""
    c = calibration
    names = list(dict.fromkeys([*c.rig["sensors"], *(g.sensor for g in c.groups)]))
    in_body = in_body_frame(c)
    sensors = {n: _sensor(in_body, n) for n in names if n in c.rig["sensors"]}
    targets = {n: _target(c, n) for n in names if n not in c.rig["sensors"]}
    data = {
        **_origin(c),
        "status": c.status,
        "converged": bool(c.converged),
        "verdict": c.verdict,
        "reasons": _by_name(c.reasons),
        "sensors": sensors,
        "targets": targets,
        "relative": {r.name: _relative(r) for r in relative_poses(c)},
        "unobservable": _by_name(c.unobservable),
        "warnings": _by_name(c.warnings),
        "notes": _by_name(c.notes),
        "fits": [_fit(f) for f in c.fits],
    }
    frames = "" if c.imu is None else IMU + (KALIBR if c.lenses else "")
    version = c.versions.get("icalib", "of unknown version")
    header = HEADER.format(
        version=version, key=pose_key(c), body=body_name(c), reference=reference_name(c), frames=frames
    )
    return header + yaml.safe_dump(data, sort_keys=False, default_flow_style=None, width=1000, allow_unicode=True)


def _by_name(remarks: Iterable[Remark]) -> list[dict[str, str]]:
    return [{r.name: str(r)} for r in remarks]


def parameter_keys(groups: tuple[ParameterGroup, ...]) -> dict[tuple[str, str], str]:
    """Keys of the parameters of one sensor in calibration.yaml, by (group, label). A key is the label. It is prefixed
    with the group if the label is empty or not unique, or the group has a singular name (`ONE`)."""
    count = Counter(label for g in groups for label in g.labels)
    keys = {(g.name, n): n if n and count[n] == 1 else f"{g.name}_{n}".rstrip("_") for g in groups for n in g.labels}
    return keys | {(name, label): f"{ONE[name]}_{label}" for name, label in keys if name in ONE}


def pose_key(c: Calibration) -> str:
    """Key of a sensor's pose: T_imu_sensor, or T_cam0_sensor if cam0 is the body."""
    return f"T_{body_name(c)}_sensor"


def body_name(c: Calibration) -> str:
    """Name in files of the frame in which all poses are given: "imu", or the name of the sensor `body`."""
    return "imu" if c.body == c.imu else c.body


def reference_name(c: Calibration) -> str:
    """Name in files of the sensor to whose clock time offsets refer: "imu", or the name of `reference`."""
    return "imu" if c.imu else c.reference


def _sensor(c: Calibration, name: str) -> dict[str, Any]:
    """Entry of the sensor `name`. `c` is a result of `in_body_frame`."""
    T = np.eye(4) if name == c.body else c.T_imu_sensor(name)
    return {"type": c.rig["sensors"][name]["type"], pose_key(c): T.tolist()} | _entry(c, name)


def _origin(c: Calibration) -> dict[str, Any]:
    """When the result was made, and from which recordings and files."""
    spans = [{"name": r.name, "seconds": float(r.end - r.start), "first_stamp_ns": r.origin_ns} for r in c.recordings]
    return {"date": c.made or None, "recordings": spans, "sha256": dict(c.inputs)}


def _is_told(c: Calibration, g: ParameterGroup) -> bool:
    """Whether a group has an entry: zeros of an ideal IMU were not estimated."""
    return g.sensor != c.imu or g.mode != "fixed" or bool(g.value.any())


def _relative(r: RelativePose) -> dict[str, Any]:
    std = {"rotation": r.std[:3].tolist(), "translation": r.std[3:].tolist()}
    return {"T": r.T.tolist(), "std": std, "covariance": r.covariance.tolist()}


def _target(c: Calibration, name: str) -> dict[str, Any]:
    pose = {"T_scene_body": c.T_scene_body(name).tolist()} if name in c.bodies else {}
    return pose | _entry(c, name)


def _entry(c: Calibration, name: str) -> dict[str, Any]:
    """Entry of a sensor or target: time_offset, parameters, and roll, pitch and yaw of a rotation. std, verdict and
    empirical_factor have the same keys, std and the factor only of what was estimated, the latter two without roll,
    pitch and yaw."""
    groups = tuple(g for g in c.groups if g.sensor == name and _is_told(c, g))
    rotation = c.group_or_none(name, ROTATION.name)
    by_name = [g for g in groups if g.name in MOUNTED_NAMES or g.value.ndim == 2]
    by_label = tuple(g for g in groups if g.name not in MOUNTED_NAMES and g.value.ndim == 1)
    entry: dict[str, Any] = {
        g.name: _short(g, g.value) for g in by_name if g.name not in (ROTATION.name, TRANSLATION.name)
    }
    entry["parameters"] = _by_key(by_label, {g.name: g.value for g in by_label})
    for key, of in (("std", _std), ("verdict", _verdict), ("empirical_factor", _factor)):
        named_values = {g.name: _short(g, value) for g in by_name if (value := of(g)) is not None}
        entry[key] = named_values | {"parameters": _by_key(by_label, {g.name: of(g) for g in by_label})}
    if rotation is not None:
        entry[RPY] = rpy(rotation.value).tolist()
    if rotation is not None and _std(rotation) is not None:
        std = rpy_std(rotation.value, joint_covariance(c, [rotation])).tolist()
        entry["std"][RPY] = [None if isnan(s) else s for s in std]
    return entry


def _by_key(groups: tuple[ParameterGroup, ...], values: dict[str, np.ndarray | None]) -> dict[str, Any]:
    keys = parameter_keys(groups)
    entries = ((g, values[g.name]) for g in groups)
    return {keys[g.name, n]: x for g, v in entries if v is not None for n, x in zip(g.labels, v.tolist(), strict=True)}


def _short(group: ParameterGroup, value: np.ndarray) -> Any:
    return value.tolist()[0] if group.name == "time_offset" and len(value) == 1 else value.tolist()


def _std(group: ParameterGroup) -> np.ndarray | None:
    return None if {*group.verdict} == {"fixed"} else group.std  # zeros of what was not estimated are no uncertainty


def _verdict(group: ParameterGroup) -> np.ndarray:
    return np.array(group.verdict)


def _factor(group: ParameterGroup) -> np.ndarray | None:
    return None if group.columns is None else group.factor


def _fit(f: SensorFit) -> dict[str, Any]:
    fit: dict[str, Any] = {"sensor": f.sensor, "kind": f.kind, "count": int(f.count), "dof": max(float(f.dof), 0.0)}
    fit |= {"chi2": float(f.chi2), "chi2_per_dof": f.chi2_per_dof}
    if f.rms is not None:
        fit |= {"rms": float(f.rms), "unit": f.unit, "rejected": int(f.rejected)}
    return fit


# Converts a result to a rig for the next calibration: the values become fixed values, priors or initial guesses.

Treatment = Literal["fixed", "prior", "guess"]
TREATMENTS: tuple[Treatment, ...] = ("fixed", "prior", "guess")


def rig_of_result(c: Calibration, treatment: Treatment) -> tuple[Rig, tuple[str, ...]]:
    """The rig of `c` with the values of the result, and a sentence for each group that could not be treated as asked.

    fixed: all estimated groups are fixed at their values. prior: all estimated groups get priors with their values as
    means and the standard deviations of the result. guess: groups that were free in the rig file start at their values;
    priors of the rig file stay. Groups that the rig file fixed stay fixed. A group with an unusable component is
    never fixed. Raises RigError if `treatment` is none of these.
    """
    if treatment not in TREATMENTS:
        raise RigError(f"values of a result become {', '.join(TREATMENTS)}, not {treatment!r}; use one of these.")
    rig, sentences = rig_from_dict(c.rig, "the rig of the result"), []
    for sensor in rig.sensors.values():
        fields: dict[str, Any] = {}
        for g in c.groups:
            old = getattr(sensor, g.name, None)
            if g.sensor != sensor.name or g.columns is None or not isinstance(old, Parameter) or _is_derived(sensor, g):
                continue
            if g.name == "time_offset" and len(g.value) > 1:
                sentences.append(f"{g.sensor}: each recording has a time offset of its own, so time_offset stays free.")
                continue
            fields[g.name], sentence = _treated(g, old, treatment)
            sentences += [sentence] if sentence else []
        rig = rig.with_(sensor.name, **fields)
    return rig, tuple(sentences)


def rig_text(c: Calibration, treatment: Treatment) -> tuple[str, tuple[str, ...]]:
    """The rig of `rig_of_result` as text of a rig file, with the sentences as comments; and the sentences."""
    rig, sentences = rig_of_result(c, treatment)
    plain = rig_to_dict(rig)
    defaults = dataclasses.asdict(Settings())
    settings = {name: value for name, value in plain.pop("settings").items() if value != defaults[name]}
    plain |= {"settings": settings} if settings else {}
    words = {"fixed": "are fixed", "prior": "have priors of its standard deviations", "guess": "are guesses"}
    comments = [f"Rig file by icalib, from a result: its values {words[treatment]}.", *sentences]
    body = yaml.safe_dump(plain, sort_keys=False, default_flow_style=None, width=1000, allow_unicode=True)
    return "".join(f"# {sentence}\n" for sentence in comments) + body, sentences


def _is_derived(sensor: Any, g: ParameterGroup) -> bool:
    """Whether the group is not a field of the sensor in the rig file, such as the height of wheels over the ground."""
    return g.name not in {f.name for f in dataclasses.fields(sensor)}


def _treated(g: ParameterGroup, old: Parameter, treatment: Treatment) -> tuple[Parameter, str]:
    """The parameter for the new rig file, and a sentence if it is not treated as asked, else an empty string. `old`:
    the parameter in the rig file."""
    if treatment == "guess":
        return (old if old.mode == "prior" else Parameter("free", g.value)), ""
    labels = ["it"] if len(g.labels) == 1 else g.labels
    unusable = [f"{label} is {v}" for label, v in zip(labels, g.verdict, strict=True) if v in UNUSABLE]
    if treatment == "fixed" and unusable:
        kept = old if old.mode == "prior" else Parameter("free", g.value)
        return kept, f"{g.sensor}: {g.name} is not fixed, because {', '.join(unusable)}."
    if treatment == "fixed":
        return Parameter("fixed", g.value), ""
    if not (np.isfinite(g.std) & (g.std > 0.0)).all():
        return Parameter("free", g.value), f"{g.sensor}: {g.name} has no finite standard deviation, so it is a guess."
    return Parameter("prior", g.value, g.std), ""


# Provenance of a result: hashes of its input files, and versions of the software.

_LIBRARIES = ("numpy", "numba")


def provenance(files: list[Path]) -> dict[str, str]:
    """SHA-256 of the content of each file, in hexadecimal, by path."""
    return {str(f): hash_of(f).hexdigest() for f in files}


def versions() -> dict[str, str]:
    """Versions of icalib, Python and the libraries that the numbers depend on."""
    from icalib import __version__

    return {"icalib": __version__, "python": platform.python_version()} | {n: version(n) for n in _LIBRARIES}
