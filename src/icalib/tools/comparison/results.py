"""Sides of a comparison from a result of icalib, or from a rig file with values from CAD or a data sheet."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from icalib.result import Calibration, joint_covariance, relative_pose
from icalib.result.verdict import UNUSABLE
from icalib.rig import Parameter, ParameterSpec, Sensor
from icalib.rig.file import load_rig
from icalib.rig.kinds import SENSOR_TYPES
from icalib.sensors.sensor import ROTATION, TIME_OFFSET, TRANSLATION
from icalib.tools.comparison.sides import LensSide, Quantity, Side, unknown

DENSITIES = {
    "gyro": "noise density of the gyroscope",
    "gyro_walk": "bias walk of the gyroscope",
    "accel": "noise density of the accelerometer",
    "accel_walk": "bias walk of the accelerometer",
}


def compared_specs(kind: type[Sensor]) -> dict[str, ParameterSpec]:
    """The parameters of a kind of sensor that are compared as quantities, by name. Extrinsics are compared as poses,
    and parameters of a lens by projection."""
    return {s.name: s for s in kind.stated() if s not in (ROTATION, TRANSLATION) and not s.by_images}


def noise_quantities(imu: str, noise: dict[str, Any]) -> dict[tuple[str, str], Quantity]:
    """Noise densities as quantities by (imu, name), without standard deviation. noise: densities by name."""
    return {
        (imu, key): Quantity(what, ("",), np.array([float(noise[key])]), unknown(1)) for key, what in DENSITIES.items()
    }


def side_of_result(c: Calibration, path: str) -> Side:
    """The side of a calibration, with covariances; path: its name in messages."""
    poses = {name: _pose_of_result(c, name) for name in c.mounted} | {c.reference: np.eye(4)}
    bad = [g for g in c.groups if {*UNUSABLE} & {*g.verdict}]
    quantities = {}
    for g in c.groups:
        # If a clock restarts in each recording, its time offsets have no counterpart in another result.
        several = g.name == TIME_OFFSET.name and len(g.value) > 1
        if g.sensor in c.mounted and not several:
            spec = compared_specs(SENSOR_TYPES[c.rig["sensors"][g.sensor]["type"]]).get(g.name)
            if spec is not None:
                quantities[g.sensor, g.name] = quantity(spec, g.value, joint_covariance(c, [g]), g in bad)
    if c.imu is not None:
        quantities |= noise_quantities(c.imu, c.rig["sensors"][c.imu]["noise"])
        intrinsics = [g for g in c.groups if (g.sensor, g.name) == (c.imu, "intrinsics") and g.columns is not None]
        for g in intrinsics:
            quantities[c.imu, g.name] = Quantity(
                g.name, g.labels, g.value, joint_covariance(c, [g]), g in bad, g.unit, False
            )
    return Side(
        path=path,
        kind="result",
        body=c.reference,
        has_imu=c.imu is not None,
        poses=poses,
        covariance=lambda frame, sensor: relative_pose(c, frame, sensor).covariance,
        open=frozenset((g.sensor, g.name) for g in bad),
        quantities=quantities,
        lenses={name: _lens_of_result(c, name) for name in c.lenses},
    )


def _pose_of_result(c: Calibration, sensor: str) -> np.ndarray:
    """(4, 4) T_body_sensor; the rotation is NaN if the sensor has none, such as a position sensor."""
    T = c.T_imu_sensor(sensor)
    if not any((g.sensor, g.name) == (sensor, ROTATION.name) for g in c.groups):
        T[:3, :3] = np.nan
    return T


def _lens_of_result(c: Calibration, name: str) -> LensSide:
    groups = [c.group(name, key) for key in c.lenses[name]]
    is_open = any({*UNUSABLE} & {*g.verdict} for g in groups)
    return _lens(c.rig["sensors"][name], [g.value for g in groups], joint_covariance(c, groups), is_open)


def _lens(fields: dict[str, Any], values: list[np.ndarray], covariance: np.ndarray, is_open: bool = False) -> LensSide:
    """A lens. fields: those of its sensor in the rig file; values: those of its parameter groups."""
    width, height = fields["resolution"]
    return LensSide(fields["model"], (int(width), int(height)), np.concatenate(values), covariance, is_open)


def side_of_rig(path: Path) -> Side:
    """The side of a rig file: its guesses, fixed values and priors, the latter with their sigma. Raises RigError if the
    file is wrong."""
    rig = load_rig(path)
    poses = {s.name: _pose(s) for s in rig.mounted} | {rig.reference: np.eye(4)}
    quantities = {}
    for s in rig.mounted:
        for spec in compared_specs(type(s)).values():
            p: Parameter = getattr(s, spec.name)
            if p.value is not None:
                value = np.atleast_1d(p.value)
                quantities[s.name, spec.name] = quantity(spec, value, _covariance(p, value.size))
    if rig.imu is not None:
        noise = {key: getattr(rig.imu.noise, key) for key in DENSITIES}
        quantities |= noise_quantities(rig.imu.name, noise)

    def covariance(frame: str, sensor: str) -> np.ndarray:
        out = unknown(6)
        if frame == rig.reference:
            for block, p in zip((slice(3), slice(3, 6)), _extrinsics(rig.sensors[sensor]), strict=True):
                out[block, block] = _covariance(p, 3)
        return out

    return Side(
        path=str(path),
        kind="rig file",
        body=rig.reference,
        has_imu=rig.imu is not None,
        poses=poses,
        covariance=covariance,
        quantities=quantities,
        lenses={s.name: lens for s in rig.mounted if s.lens and (lens := _lens_of_rig(s)) is not None},
    )


def quantity(spec: ParameterSpec, value: np.ndarray, covariance: np.ndarray, is_open: bool = False) -> Quantity:
    """Quantity of a parameter group. A group of one number has an empty label."""
    labels = spec.labels if spec.size > 1 else ("",)
    what = (spec.one or spec.name).replace("_", " ")
    return Quantity(what, labels, value, covariance, is_open, spec.unit, spec.is_positive)


def _extrinsics(sensor: Sensor) -> tuple[Parameter, Parameter]:
    """Rotation and translation; a Parameter without value if the sensor has none."""
    return getattr(sensor, ROTATION.name, Parameter()), getattr(sensor, TRANSLATION.name, Parameter())


def _pose(sensor: Sensor) -> np.ndarray:
    """(4, 4) T_body_sensor; NaN for values that the rig file does not give."""
    (rotation, translation), T = _extrinsics(sensor), np.eye(4)
    T[:3, :3] = np.nan if rotation.value is None else rotation.value
    T[:3, 3] = np.nan if translation.value is None else translation.value
    return T


def _covariance(p: Parameter, size: int) -> np.ndarray:
    return unknown(size) if p.sigma is None else np.diag(np.broadcast_to(p.sigma, size) ** 2)


def _lens_of_rig(sensor: Sensor) -> LensSide | None:
    """The lens of a sensor; None if the rig file does not give all its values."""
    values = [getattr(sensor, name).value for name in sensor.lens]
    if any(value is None for value in values):
        return None
    return _lens(sensor.plain(), values, unknown(sum(map(len, values))))
