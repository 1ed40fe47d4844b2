"""A result whose poses are relative to the body of the rig file, where that is another sensor than the reference."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from math import radians

import numpy as np

from icalib.result.calibration import Calibration, ParameterGroup, Verdict
from icalib.result.relative import pose_groups, relative_jacobian
from icalib.result.verdict import by_size, tolerance
from icalib.sensors.sensor import ROTATION, TRANSLATION

_POSE = (ROTATION, TRANSLATION)
_NAMES = tuple(spec.name for spec in _POSE)
_GOOD_PART = 0.1  # 1 % of the variance; twice as much would call fewer components undetermined
_SI = {"rotation_tolerance_deg": radians(1.0), "translation_tolerance_m": 1.0}  # of one unit of these settings


def in_body_frame(c: Calibration) -> Calibration:
    """`c` with rotation and translation of every sensor as T_body_sensor; `c` itself if `body` is `reference`.

    The body has the identity, fixed. An IMU that is not the body has a pose like all others. Covariance: J C J^T, to
    first order. The empirical factor of a pose is the ratio of its standard deviations with and without the factors of
    the groups that it comes from. Other groups keep their values, and clocks stay relative to the reference.
    """
    if c.body == c.reference:
        return c
    groups, J, names = list[ParameterGroup](), [np.zeros((0, len(c.covariance)))], list[str]()
    for group, rows in _reframed(c):
        columns = tuple(range(len(names), len(names) + len(rows))) if rows.any() else None
        groups.append(replace(group, columns=columns))
        if columns is not None:
            J.append(rows)
            names += [f"{group.sensor}.{group.name}.{label}" for label in group.labels]
    whole = np.vstack(J)
    return replace(c, groups=tuple(groups), covariance=whole @ c.covariance @ whole.T, covariance_names=tuple(names))


def _reframed(c: Calibration) -> Iterator[tuple[ParameterGroup, np.ndarray]]:
    """Each group in the frame of the body, with its Jacobian (n, B) by the estimated parameters of `c`; first the pose
    of the IMU."""
    sensors = (*(() if c.imu is None else (c.imu,)), *c.mounted)
    moved = {(name, g.name): (g, rows) for name in sensors for g, rows in _pose(c, name)}
    yield from (moved.pop((c.imu, name)) for name in _NAMES if c.imu is not None)
    for group in c.groups:
        yield moved.get((group.sensor, group.name), (group, _rows(c, group)))


def _pose(c: Calibration, sensor: str) -> Iterator[tuple[ParameterGroup, np.ndarray]]:
    """Rotation and translation of T_body_sensor, with their Jacobians."""
    T, J = c.T_body_sensor(sensor), np.zeros((6, len(c.covariance)))
    if sensor != c.body:
        pair = [*pose_groups(c, c.body), *pose_groups(c, sensor)]
        J = relative_jacobian(c, c.body, sensor) @ np.vstack([_rows(c, g) for g in pair])
    scale = _scales(c)
    for spec, value, rows in zip(_POSE, (T[:3, :3], T[:3, 3]), (J[:3], J[3:]), strict=True):
        formal, std = (np.sqrt(np.einsum("ij,jk,ik->i", r, c.covariance, r)) for r in (rows, rows * scale))
        assert isinstance(spec.tolerance, str)
        allowed = tolerance(c, spec.tolerance) * _SI[spec.tolerance]
        # Undetermined by a component that is, and that moves it beyond its tolerance or makes a good part of its std.
        moves = np.abs(rows * scale * np.sqrt(np.diag(c.covariance)))[:, _undetermined(c)]
        is_open = (moves > np.minimum(allowed, _GOOD_PART * std)[:, None]).any(axis=1)
        sizes = np.where(is_open, np.inf, std / allowed)
        verdict: tuple[Verdict, ...] = tuple("fixed" if s == 0.0 else by_size(s) for s in sizes)
        factor = np.divide(std, formal, out=np.ones(3), where=formal > 0.0)
        mode = "free" if rows.any() else "fixed"
        own = ParameterGroup(
            sensor, spec.name, spec.labels, spec.unit, value, formal, std, verdict, mode, factor=factor
        )
        yield own, rows


def _rows(c: Calibration, group: ParameterGroup | None) -> np.ndarray:
    """(n, B) with 1 at the columns of the group; zeros where it is fixed, and (3, B) for what is exactly known."""
    rows = np.zeros((3 if group is None else len(group.labels), len(c.covariance)))
    if group is not None and group.columns is not None:
        rows[np.arange(len(group.columns)), list(group.columns)] = 1.0
    return rows


def _scales(c: Calibration) -> np.ndarray:
    """(B,) empirical factor of each estimated parameter, at least 1."""
    scale = np.ones(len(c.covariance))
    for g in c.groups:
        if g.columns is not None and g.factor is not None:
            scale[list(g.columns)] = np.maximum(g.factor, 1.0)
    return scale


def _undetermined(c: Calibration) -> list[int]:
    """Columns of the components that the data do not determine."""
    groups = (g for g in c.groups if g.columns is not None)
    return [k for g in groups for k, v in zip(g.columns or (), g.verdict, strict=True) if v == "undetermined"]
