"""Converts a result to poses relative to the sensor `body` of the rig file, if that is not the reference."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import replace
from math import inf, radians

import numpy as np
from scipy.linalg import orth

from icalib.result.calibration import Calibration, ParameterGroup, Verdict
from icalib.result.relative import pose_groups, relative_jacobian
from icalib.result.verdict import by_size, in_null_space, tolerance
from icalib.sensors.sensor import ROTATION, TRANSLATION

_POSE = (ROTATION, TRANSLATION)
_NAMES = tuple(spec.name for spec in _POSE)
_SI = {"rotation_tolerance_deg": radians(1.0), "translation_tolerance_m": 1.0}  # SI value of one unit of each setting


def in_body_frame(c: Calibration) -> Calibration:
    """`c` with rotation and translation of every sensor as T_body_sensor; `c` itself if `body` is `reference`.

    The body gets the identity as a fixed pose. An IMU that is not the body gets a pose. The covariance is J C J^T, to
    first order. The empirical factor of a pose is the ratio of its standard deviations with and without the factors of
    its source groups. The null space becomes span(J N). Verdicts on poses follow from the null space and the standard
    deviations, as in `c`. All other groups are unchanged; time offsets stay relative to the reference.
    """
    if c.body == c.reference:
        return c
    groups, row_blocks, names = list[ParameterGroup](), [np.zeros((0, len(c.covariance)))], list[str]()
    for group, rows in _reframed(c):
        columns = tuple(range(len(names), len(names) + len(rows))) if rows.any() else None
        groups.append(replace(group, columns=columns))
        if columns is not None:
            row_blocks.append(rows)
            names += [f"{group.sensor}.{group.name}.{label}" for label in group.labels]
    J = np.vstack(row_blocks)
    null = _null_space(c, J, groups)
    return replace(
        c,
        groups=tuple(_with_null_space(c, g, null) for g in groups),
        covariance=J @ c.covariance @ J.T,
        covariance_names=tuple(names),
        null_space=null,
    )


def _reframed(c: Calibration) -> Iterator[tuple[ParameterGroup, np.ndarray]]:
    """Each group in the frame of the body, with its Jacobian (n, B) by the estimated parameters of `c`. The pose of the
    IMU comes first."""
    sensors = (*(() if c.imu is None else (c.imu,)), *c.mounted)
    moved = {(name, g.name): (g, rows) for name in sensors for g, rows in _pose(c, name)}
    yield from (moved.pop((c.imu, name)) for name in _NAMES if c.imu is not None)
    for group in c.groups:
        yield moved.get((group.sensor, group.name), (group, _rows(c, group)))


def _pose(c: Calibration, sensor: str) -> Iterator[tuple[ParameterGroup, np.ndarray]]:
    """Rotation and translation of T_body_sensor as groups, with their Jacobians (3, B) by the estimated parameters of
    `c`."""
    T, J = c.T_body_sensor(sensor), np.zeros((6, len(c.covariance)))
    if sensor != c.body:
        pair = [*pose_groups(c, c.body), *pose_groups(c, sensor)]
        J = relative_jacobian(c, c.body, sensor) @ np.vstack([_rows(c, g) for g in pair])
    scale = _scales(c)
    for spec, value, rows in zip(_POSE, (T[:3, :3], T[:3, 3]), (J[:3], J[3:]), strict=True):
        formal, std = (np.sqrt(np.einsum("ij,jk,ik->i", r, c.covariance, r)) for r in (rows, rows * scale))
        sizes, by_guess = std / _allowed(c, spec.tolerance), _by_guess(c, rows)
        verdict: tuple[Verdict, ...] = tuple(
            "fixed" if s == 0.0 else by_size(s if c.converged else inf, g) for s, g in zip(sizes, by_guess, strict=True)
        )
        factor = np.divide(std, formal, out=np.ones(3), where=formal > 0.0)
        mode = "free" if rows.any() else "fixed"
        group = ParameterGroup(
            sensor, spec.name, spec.labels, spec.unit, value, formal, std, verdict, mode, factor=factor
        )
        yield group, rows


def _by_guess(c: Calibration, rows: np.ndarray) -> np.ndarray:
    """(n,) whether unobservable parameters are most of the variance, for n rows of a Jacobian (n, B)."""
    columns = [k for g in c.groups for k, v in zip(g.columns or (), g.verdict, strict=False) if v == "unobservable"]
    some = np.zeros_like(rows)
    some[:, columns] = rows[:, columns]
    total, part = (np.einsum("ij,jk,ik->i", r, c.covariance, r) for r in (rows, some))
    return part > 0.5 * total


def _rows(c: Calibration, group: ParameterGroup | None) -> np.ndarray:
    """(n, B) selection matrix of the columns of the group: zeros if the group is fixed, and (3, B) zeros for a None."""
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


def _null_space(c: Calibration, J: np.ndarray, groups: Sequence[ParameterGroup]) -> np.ndarray:
    """(B', m) orthonormal basis of the null space of the parameters of `groups`, in tolerance units. J (B', B): their
    Jacobian by the estimated parameters of `c`."""
    if not c.null_space.size:
        return np.zeros((len(J), 0))
    before, after = _pose_tolerances(c, c.groups, J.shape[1]), _pose_tolerances(c, groups, len(J))
    return orth(J * before / after[:, None] @ c.null_space)


def _pose_tolerances(c: Calibration, groups: Sequence[ParameterGroup], size: int) -> np.ndarray:
    """(size,) tolerances of the parameters in `groups`: of rotations [rad] and translations [m]. All other entries are
    1, as J leaves these parameters unchanged."""
    tolerances = np.ones(size)
    for spec in _POSE:
        columns = [k for g in groups if g.name == spec.name for k in g.columns or ()]
        tolerances[columns] = _allowed(c, spec.tolerance)
    return tolerances


def _allowed(c: Calibration, setting: object) -> float:
    """Tolerance of rotations [rad] or translations [m], from the setting of this name."""
    assert isinstance(setting, str)
    return tolerance(c, setting) * _SI[setting]


def _with_null_space(c: Calibration, group: ParameterGroup, null: np.ndarray) -> ParameterGroup:
    """The group with verdict unobservable on each component of a sensor's pose that lies in the null space (B', m)."""
    if group.name not in _NAMES or group.columns is None or group.sensor not in c.rig["sensors"]:
        return group
    is_null = in_null_space(null)[list(group.columns)]
    verdict: tuple[Verdict, ...] = tuple(
        "unobservable" if n else v for n, v in zip(is_null, group.verdict, strict=True)
    )
    return replace(group, verdict=verdict)
