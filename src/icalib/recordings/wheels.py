"""What wheels measured, as it was written: tables of a folder, joints of a bag."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Protocol

import numpy as np

from icalib.errors import RecordingError
from icalib.measurements import WheelPoses
from icalib.recordings.table import read_table
from icalib.rig import WheelMeasure, Wheels

STAMP = ("t [ns]",)
VALUES: dict[WheelMeasure, tuple[str, str]] = {
    "rates": ("left [rad/s]", "right [rad/s]"),
    "angles": ("left [rad]", "right [rad]"),
    "ticks": ("left [ticks]", "right [ticks]"),
}
ENDS = ("from [ns]", "to [ns]")
POSES = ("yaw [rad]", "x [m]", "y [m]", "yaw yaw", "yaw x", "yaw y", "x x", "x y", "y y")


@dataclass(frozen=True)
class WheelReadings:
    """stamps_ns (N,) int64, which may still repeat or run backwards; value (N, 2), left and right, in the unit of what
    the wheels measure, see `VALUES`."""

    name: str
    stamps_ns: np.ndarray
    value: np.ndarray


class Joints(Protocol):
    """See `streams.JointStream`."""

    @property
    def names(self) -> tuple[str, ...]: ...
    @property
    def stamps_ns(self) -> np.ndarray: ...
    @property
    def position(self) -> np.ndarray: ...
    @property
    def velocity(self) -> np.ndarray: ...


def read_wheel_table(wheels: Wheels, path: Path) -> WheelReadings | WheelPoses:
    """The table at `path`. Raises RecordingError naming file and line where it cannot be read, and the instant where
    relative poses do not follow one another."""
    if wheels.measures == "poses":
        return _read_poses(wheels.name, path)
    table = read_table(path, STAMP, VALUES[wheels.measures])
    return WheelReadings(wheels.name, table.integers[:, 0].copy(), table.decimals)


def _read_poses(name: str, path: Path) -> WheelPoses:
    table = read_table(path, ENDS, POSES)
    begin, end = table.integers.T
    wrong = np.concatenate([[False], begin[1:] != end[:-1]]) | (end <= begin)
    if wrong.any():
        i = int(np.argmax(wrong))
        raise RecordingError(
            f"{path} ({name}): the pose from {begin[i]} to {end[i]} ns does not go on where the one before ends; write "
            "one pose after the other."
        )
    covariance = np.empty((len(begin), 3, 3))
    row, column = np.triu_indices(3)
    covariance[:, row, column] = covariance[:, column, row] = table.decimals[:, 3:]
    size = np.linalg.eigvalsh(covariance)
    if (size[:, 0] < -1e-9 * size[:, 2]).any() or (size[:, 2] <= 0).any():
        i = int(np.argmax((size[:, 0] < -1e-9 * size[:, 2]) | (size[:, 2] <= 0)))
        raise RecordingError(
            f"{path} ({name}): the covariance of the pose from {begin[i]} ns is none (it has a negative direction, or "
            "is zero); correct what writes it."
        )
    return WheelPoses(name, np.append(begin, end[-1]), table.decimals[:, :3].copy(), covariance)


def read_wheel_joints(wheels: Wheels, joints: Joints, what: str) -> WheelReadings:
    """Both wheels' joints. Raises RecordingError naming the topic (`what`): relative poses, which joints do not have,
    joints that are not there or not sent together, and what they do not say."""
    if wheels.measures == "poses":
        raise RecordingError(f"{what}: bags hold no relative poses; set `measures` of {wheels.name} in the rig file.")
    pair = _pair(wheels, joints.names, what)
    of = {"rates": joints.velocity}.get(wheels.measures, joints.position)
    value = of[:, [joints.names.index(name) for name in pair]]
    sent = ~np.isnan(value)
    if not sent.any():
        field, other = ("velocity", "angles") if wheels.measures == "rates" else ("position", "rates")
        raise RecordingError(
            f"{what}: {pair[0]} and {pair[1]} have no {field}; set `measures` of {wheels.name} to {other} in the "
            "rig file."
        )
    both = sent.all(axis=1)
    if (sent.any(axis=1) & ~both).any():
        at = joints.stamps_ns[np.argmax(sent.any(axis=1) & ~both)]
        raise RecordingError(
            f"{what}: the message at {at} ns has only one of {pair[0]} and {pair[1]}; let the driver send both "
            "together."
        )
    return WheelReadings(wheels.name, joints.stamps_ns[both], value[both])


def _pair(wheels: Wheels, names: tuple[str, ...], what: str) -> tuple[str, str]:
    """The names of the left and the right joint."""
    if wheels.joints is not None:
        missing = [name for name in wheels.joints if name not in names]
        if missing:
            raise RecordingError(
                f"{what} has no joint {missing[0]}; it has {', '.join(names)}; correct `joints` of {wheels.name} "
                "in the rig file."
            )
        return wheels.joints
    sides = [[name for name in names if side in name.lower()] for side in ("left", "right")]
    if len(sides[0]) != 1 or len(sides[1]) != 1:
        raise RecordingError(
            f"{what}: which of the joints {', '.join(names)} are the left and the right wheel? Set `joints: [LEFT, "
            f"RIGHT]` of {wheels.name} in the rig file."
        )
    return sides[0][0], sides[1][0]
