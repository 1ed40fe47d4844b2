"""Record of one job, as JSON beside its result: how it ended, and its parameters."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import numpy as np

from icalib.base.files import SEAL, sealed
from icalib.geometry.euler import rpy_std
from icalib.result import Calibration, ParameterGroup, joint_covariance
from icalib.result.quantities import nontrivial_groups
from icalib.tools.batch import plain_record, record_json
from icalib.tools.fleet.inputs import InputHashes

FORMAT = 2
WALL_CLOCK_NS = (10**18, 4 * 10**18)  # 2001 to 2096; clocks that start with the computer are far below


@dataclass(frozen=True)
class GroupRecord:
    """One parameter group of one sensor, as in `ParameterGroup`. value: (n,), for a rotation (3, 3). rpy_std: (3,) of
    roll, pitch and yaw of a rotation [rad], NaN near gimbal lock; else (0,)."""

    sensor: str
    name: str
    labels: tuple[str, ...]
    unit: str
    value: np.ndarray
    std: np.ndarray  # (n,)
    verdict: tuple[str, ...]
    rpy_std: np.ndarray = field(default_factory=lambda: np.empty(0))


@dataclass(frozen=True)
class JobRecord:
    """One job. failure: the message, or "" if the solver converged; seconds: run time; status: how the solver ended, a
    sentence.

    inputs: hashes of the inputs; None if the worker died, and the record is not stored. stamp_ns: first stamp of the
    recording, None unless it is of a wall clock. unobservable, warnings: sentences. blocks: parameter groups.
    verdict: `Calibration.verdict`, "" without a result.
    """

    name: str
    failure: str
    seconds: float
    inputs: InputHashes | None
    status: str = ""
    stamp_ns: int | None = None
    unobservable: tuple[str, ...] = ()
    warnings: tuple[str, ...] = ()
    blocks: tuple[GroupRecord, ...] = ()
    verdict: str = ""

    @classmethod
    def of(cls, name: str, result: Calibration, seconds: float, inputs: InputHashes) -> JobRecord:
        """Record of a job with a result, converged or not."""
        stamp = min((r.origin_ns for r in result.recordings), default=0)
        low, high = WALL_CLOCK_NS
        blocks = tuple(_block(result, g) for g in nontrivial_groups(result) if g.sensor in result.rig["sensors"])
        known = stamp if low <= stamp < high else None
        about = (result.status, known, result.unobservable, result.warnings, blocks, result.verdict)
        return cls(name, result.failure, seconds, inputs, *about)


def _block(c: Calibration, g: ParameterGroup) -> GroupRecord:
    angles = rpy_std(g.value, joint_covariance(c, [g])) if g.value.ndim == 2 else np.empty(0)
    return GroupRecord(g.sensor, g.name, g.labels, g.unit, g.value, g.std, g.verdict, angles)


def to_json(record: JobRecord) -> bytes:
    """The record as JSON, with all digits and icalib's seal."""
    return sealed(record_json(record, FORMAT))


def from_json(text: bytes) -> JobRecord:
    """The record that `to_json` wrote. Raises ValueError, KeyError or TypeError if `text` is not such a record."""
    plain = plain_record(text, FORMAT)
    plain.pop(SEAL, None)
    inputs = plain["inputs"]
    plain["inputs"] = InputHashes(inputs["rig"], tuple(inputs["recordings"]), inputs["program"])
    for name in ("unobservable", "warnings"):
        plain[name] = tuple(plain[name])
    plain["blocks"] = tuple(_block_of(b) for b in plain["blocks"])
    return JobRecord(**plain)


def _block_of(plain: dict[str, Any]) -> GroupRecord:
    value, std, angles = (np.array(plain[name], dtype=np.float64) for name in ("value", "std", "rpy_std"))
    labels, verdict = (tuple(plain[name]) for name in ("labels", "verdict"))
    return GroupRecord(plain["sensor"], plain["name"], labels, plain["unit"], value, std, verdict, angles)
