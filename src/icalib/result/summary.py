"""Writes `calibration.yaml`: the result in one short file for people and other programs."""

from __future__ import annotations

from collections import Counter
from math import isnan
from typing import Any

import numpy as np
import yaml

from icalib.geometry.euler import rpy, rpy_std
from icalib.result.body_frame import in_body_frame
from icalib.result.calibration import Calibration, ParameterGroup, SensorFit
from icalib.result.relative import RelativePose, joint_covariance, relative_poses
from icalib.rig.kinds import ONE
from icalib.sensors.sensor import MOUNTED_NAMES, ROTATION, TRANSLATION

HEADER = """\
# Calibration by icalib {version}. Lengths in m, times in s, angles in rad, image quantities in px.
# {key} takes coordinates in the sensor's frame to the {body} frame: p_{body} = {key} p_sensor.
{frames}# time_offset: t_{reference} = t_sensor + time_offset; a list, one for each recording, where a clock restarts.
# std: standard deviations, of rotation about the sensor's axes, of translation along the {body} axes. They include
#   empirical_factor: the scatter of segments over the predicted one; formal = std / factor. Those of roll_pitch_yaw,
#   R = Rz(yaw) Ry(pitch) Rx(roll), are null within 5 std of gimbal lock (pitch 90 deg). What is fixed has none.
# date: of the calibration, UTC. sha256: of the rig file and all files of the recordings.
# T_scene_body: poses of a target's bodies, in the frame of that body whose pose is the identity.
# relative: T_a_b takes coordinates in the frame of b to that of a. Its covariance, from the joint one of both, is of
#   rotation about the axes of b and translation along those of a; where one is unobservable it is that of the guess.
# verdict of the whole: usable, usable with care, partly usable or not usable; reasons: why, the most important first.
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
        "reasons": list(c.reasons),
        "sensors": sensors,
        "targets": targets,
        "relative": {r.name: _relative(r) for r in relative_poses(c)},
        "unobservable": list(c.unobservable),
        "warnings": list(c.warnings),
        "notes": list(c.notes),
        "fits": [_fit(f) for f in c.fits],
    }
    frames = "" if c.imu is None else IMU + (KALIBR if c.lenses else "")
    version = c.versions.get("icalib", "of unknown version")
    header = HEADER.format(
        version=version, key=pose_key(c), body=body_name(c), reference=reference_name(c), frames=frames
    )
    return header + yaml.safe_dump(data, sort_keys=False, default_flow_style=None, width=1000, allow_unicode=True)


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
