"""Parameters that change during the recording: a clock that drifts or jumps, extrinsics that moved, a lens that
refocused.

Score test of parameter constancy (Nyblom 1989; for a break, Chow 1960). The estimate has constant calibration
parameters. In the test those of one group are x + d_g e in segment g. The pattern d_g is linear in time (drift), or 0
before and 1 after a boundary (step). Near the optimum chi^2 is a quadratic form of the common step and of e, made from
the segments' sums, in which the chain is marginalised. One solve gives e, its covariance, and the decrease of chi^2.
Changes within a segment are not detected.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np

from icalib.estimate.residual_statistics.segments import Segments
from icalib.optim.calib_block import UNOBSERVABLE_BELOW, complement
from icalib.optim.state import Key
from icalib.rig import Sensor

# information in tolerance units (sigma of 1000 tolerances): keeps the form positive definite if unobservable
RIDGE_INFORMATION = 1e-6


@dataclass(frozen=True)
class Change:
    """Tested change of one group of parameters. key: sensor, and first parameter of the group. second: time of a step,
    or middle of the recording for a drift [s, joined clock]. value, sigma (n,): the step, or the drift per second [SI,
    or px]. gain: decrease of chi^2."""

    key: Key
    pattern: Literal["drift", "step"]
    second: float
    value: np.ndarray
    sigma: np.ndarray
    gain: float

    @property
    def count(self) -> int:
        """Number of parameters in the group."""
        return len(self.value)


def changes(parts: Segments, sensors: Sequence[Sensor]) -> tuple[Change, ...]:
    """The pattern with the largest gain for each group of `sensors`, sorted by decreasing gain. Target, planes and IMU
    are the reference for the others, and are not tested."""
    best_changes: dict[Key, Change] = {}
    form = _Form.of(parts)
    for change in _tested(parts, form, sensors):
        best = best_changes.get(change.key)
        if best is None or change.gain > best.gain:
            best_changes[change.key] = change
    return tuple(sorted(best_changes.values(), key=lambda c: -c.gain))


def _tested(parts: Segments, form: _Form, sensors: Sequence[Sensor]) -> Iterator[Change]:
    """Yields the drift and all steps of each group of `sensors`."""
    ends = parts.state.seconds[parts.ends]
    middle = 0.5 * (ends[:-1] + ends[1:])
    centre = 0.5 * (ends[0] + ends[-1])
    layout = parts.problem.layout
    free = {b.key for b in layout.free}
    for sensor in sensors:
        for names in sensor.may_change:
            free_names = [name for name in names if (sensor.name, name) in free]
            if not free_names:
                continue
            columns = np.concatenate([layout.columns(sensor.name, name) for name in free_names])
            key = (sensor.name, free_names[0])
            yield form.change(key, columns, middle - centre, "drift", float(centre))
            for k in range(1, parts.count):
                pattern = (np.arange(parts.count) >= k).astype(np.float64)
                yield form.change(key, columns, pattern, "step", float(ends[k]))


@dataclass(frozen=True)
class _Form:
    """Quadratic forms in tolerance units. information (G, B, B), gradient (G, B): of the segments. root (B, n): root A
    of the inverse A A^T of the total information, without fixed directions."""

    tolerance: np.ndarray
    information: np.ndarray
    gradient: np.ndarray
    root: np.ndarray

    @classmethod
    def of(cls, parts: Segments) -> _Form:
        t, B = parts.problem.tolerance, parts.problem.layout.size
        information = t[:, None] * parts.sums[:, :-1, :-1] * t
        free = complement(parts.problem.fixed_directions, B)
        whole = free.T @ information.sum(axis=0) @ free
        values, vectors = np.linalg.eigh(whole)
        return cls(
            t, information, t * parts.sums[:, :-1, -1], free @ vectors / np.sqrt(np.maximum(values, RIDGE_INFORMATION))
        )

    def change(
        self, key: Key, columns: np.ndarray, pattern: np.ndarray, kind: Literal["drift", "step"], second: float
    ) -> Change:
        """The change of `columns` by `pattern` (G,), estimated together with a common step of all parameters."""
        rows = self.information[:, columns]
        A = np.einsum("g,gij->ij", pattern**2, rows[:, :, columns]) + RIDGE_INFORMATION * np.eye(len(columns))
        cross = np.einsum("g,gij->ij", pattern, rows) @ self.root
        common = self.root.T @ self.gradient.sum(axis=0)
        g = np.einsum("g,gi->i", pattern, self.gradient[:, columns]) - cross @ common
        # Singular directions, also negative ones within rounding, do not move, and have a large standard deviation.
        values, vectors = np.linalg.eigh(A - cross @ cross.T)
        variances = 1.0 / np.maximum(values, UNOBSERVABLE_BELOW)
        step = -vectors @ np.where(values > UNOBSERVABLE_BELOW, variances * (vectors.T @ g), 0.0)
        t, std = self.tolerance[columns], np.sqrt(vectors**2 @ variances)
        return Change(key, kind, second, t * step, t * std, float(-g @ step))


def heterogeneity(parts: Segments) -> float:
    """Decrease of chi^2 if each segment has separate calibration parameters."""
    t = parts.problem.tolerance
    free = complement(parts.problem.fixed_directions, len(t))
    total = 0.0
    for sums in parts.sums:
        S, b = free.T @ (t[:, None] * sums[:-1, :-1] * t) @ free, free.T @ (t * sums[:-1, -1])
        total += float(b @ np.linalg.solve(S + RIDGE_INFORMATION * np.eye(len(S)), b))
    return total
