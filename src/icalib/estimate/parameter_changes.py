"""Parameters that change during the recording: a clock that drifts or jumps, extrinsics that moved, a lens that
refocused.

Score test of parameter constancy (Nyblom 1989; for a break, Chow 1960). The estimate has constant calibration
parameters. In the test those of one group are x + d_g e in segment g. The pattern d_g is linear in time (drift), or
0 before and 1 after a boundary (step). Near the optimum chi^2 is a quadratic form of the common step and of e, made
from the segments' sums, in which the chain is marginalised. One solve gives e, its covariance, and the decrease of
chi^2. A pulse, a single segment that differs, is no change, but competes with them: one bad set of images looks like
a small step. Only directions that the data determine change. Gains are compared with the scatter of the segments
that is left, as formal standard deviations are too small where the model is wrong. Changes within a segment are not
detected."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Literal, NamedTuple

import numpy as np

from icalib.estimate.residual_statistics import Segments
from icalib.optim.arrowhead import (
    UNOBSERVABLE_BELOW,
    complement,
)
from icalib.rig import Sensor
from icalib.sensors.sensor import TIME_OFFSET

# information in tolerance units (sigma of 1000 tolerances): keeps the form positive definite if unobservable
RIDGE_INFORMATION = 1e-6
Pattern = Literal["drift", "step", "pulse"]
ROUNDING_OF_GAIN = 1.001  # of the gain of separate parameters, which bounds that of a change
SIGNIFICANT = 25.0  # gain for each parameter: five standard deviations, because many boundaries are tried


@dataclass(frozen=True)
class Candidate:
    """Parameters that may change together. sensors: one, or all that share a clock; name: the first parameter;
    directions (B, n): of the change, in tolerance units; unit (n,): of each [SI, or px]."""

    sensors: tuple[str, ...]
    name: str
    directions: np.ndarray
    unit: np.ndarray


@dataclass(frozen=True)
class Change:
    """Tested change of a candidate. second: time of a step, middle of a segment that differs, or of the recording for a
    drift [s, joined clock]. value, sigma (n,): change over the recording [SI, or px]. gain: decrease of chi^2; count:
    number of directions that are determined; rival: largest gain of another pattern of the same parameters."""

    sensors: tuple[str, ...]
    name: str
    pattern: Pattern
    second: float
    value: np.ndarray
    sigma: np.ndarray
    gain: float
    count: int
    rival: float = 0.0

    @property
    def is_clock_drift(self) -> bool:
        """Whether it is the rate of a clock, which an estimate can include."""
        return self.name == TIME_OFFSET.name and self.pattern == "drift"


@dataclass(frozen=True)
class Scatter:
    """What separate parameters for each segment gain. gain: decrease of chi^2; dof: number of their directions that
    the segment shows."""

    gain: float
    dof: float

    @property
    def beyond_chance(self) -> float:
        """The gain beyond that of noise, which is one for each direction."""
        return max(self.gain - self.dof, 1.0)

    def exceeded_by(self, change: Change) -> bool:
        """Whether the change, and its lead over other patterns, is significant beside the scatter that it leaves. One
        that gains more than separate parameters is none: it moves what no segment shows, as a frame that drifts."""
        rest = max((self.gain - change.gain) / max(self.dof - change.count, 1.0), 1.0)
        leads = change.gain > SIGNIFICANT * change.count * rest and change.gain - change.rival > SIGNIFICANT * rest
        return change.count > 0 and leads and change.gain <= ROUNDING_OF_GAIN * self.gain


def changes(parts: Segments, sensors: Sequence[Sensor]) -> tuple[Change, ...]:
    """The pattern with the largest gain for each candidate of `sensors`, sorted by decreasing gain. Target, planes and
    IMU are the reference for the others; the clock of the IMU is that which all others share."""
    form, best_changes = _Form.of(parts), []
    for candidate in _candidates(parts, sensors):
        by_pattern: dict[Pattern, Change] = {}
        for change in _tested(parts, form, candidate):
            by_pattern[change.pattern] = max(by_pattern.get(change.pattern, change), change, key=lambda c: c.gain)
        best, second, *_ = sorted(by_pattern.values(), key=lambda c: -c.gain)
        best_changes.append(replace(best, rival=second.gain))
    return tuple(sorted(best_changes, key=lambda c: -c.gain))


def scatter(parts: Segments) -> Scatter:
    """Gain of separate calibration parameters for each segment."""
    t = parts.problem.tolerance
    free = complement(parts.problem.fixed_directions, len(t))
    gain = dof = 0.0
    for sums in parts.sums:
        values, vectors = np.linalg.eigh(free.T @ (t[:, None] * sums[:-1, :-1] * t) @ free)
        information, along = np.maximum(values, 0.0), vectors.T @ (free.T @ (t * sums[:-1, -1]))
        gain += float((along**2 / (information + RIDGE_INFORMATION)).sum())
        dof += float((information / (information + RIDGE_INFORMATION)).sum())
    return Scatter(gain, dof)


def _candidates(parts: Segments, sensors: Sequence[Sensor]) -> Iterator[Candidate]:
    """Each group of each sensor that may change, and the clocks that several share: those of one kind, or all."""
    layout, tolerance = parts.problem.layout, parts.problem.tolerance
    free = {b.key for b in layout.free}
    for sensor in sensors:
        for names in sensor.may_change:
            if free_names := [name for name in names if (sensor.name, name) in free]:
                columns = np.concatenate([layout.columns(sensor.name, name) for name in free_names])
                yield Candidate((sensor.name,), free_names[0], np.eye(layout.size)[:, columns], tolerance[columns])
    clocks = [s for s in sensors if (s.name, TIME_OFFSET.name) in free]
    kinds = [[s for s in clocks if s.sensor_type == kind] for kind in dict.fromkeys(s.sensor_type for s in clocks)]
    for shared in (*kinds, clocks) if len(kinds) > 1 else kinds:
        if len(shared) > 1:
            columns = np.concatenate([layout.columns(s.name, TIME_OFFSET.name) for s in shared])
            together = np.zeros((layout.size, 1))
            together[columns, 0] = tolerance[columns[0]] / tolerance[columns]
            yield Candidate(tuple(s.name for s in shared), TIME_OFFSET.name, together, tolerance[columns[:1]])


def _tested(parts: Segments, form: _Form, candidate: Candidate) -> Iterator[Change]:
    """Yields the drift, all steps and all pulses of a candidate."""
    candidate_form = form.seen_by(candidate)
    for kind, second, pattern in _patterns(parts.state.seconds[parts.ends]):
        one = candidate_form.change(pattern)
        value, sigma = candidate.unit * one.step, candidate.unit * one.std
        yield Change(candidate.sensors, candidate.name, kind, second, value, sigma, one.gain, one.dof)


def _patterns(ends: np.ndarray) -> Iterator[tuple[Pattern, float, np.ndarray]]:
    """Kind, time and values (G,) of each pattern over segments that end at `ends` (G + 1,) s."""
    middle, centre = 0.5 * (ends[:-1] + ends[1:]), 0.5 * (ends[0] + ends[-1])
    yield "drift", float(centre), (middle - centre) / (ends[-1] - ends[0])
    for second in ends[1:-1]:
        yield "step", float(second), (middle > second).astype(np.float64)
    for second in middle:
        yield "pulse", float(second), (middle == second).astype(np.float64)


class _Solved(NamedTuple):
    """Minimum of a quadratic form in the directions that it determines. gain: decrease of chi^2; dof: number of these
    directions."""

    step: np.ndarray
    std: np.ndarray
    gain: float
    dof: int

    @classmethod
    def of(cls, information: np.ndarray, gradient: np.ndarray) -> _Solved:
        """Directions that are not determined, also singular ones, whose values may be negative within rounding, do not
        move, and have a large standard deviation."""
        values, vectors = np.linalg.eigh(information)
        variances = 1.0 / np.maximum(values, UNOBSERVABLE_BELOW)
        moves = values > UNOBSERVABLE_BELOW
        step = -vectors @ np.where(moves, variances * (vectors.T @ gradient), 0.0)
        return cls(step, np.sqrt(vectors**2 @ variances), float(-gradient @ step), int(moves.sum()))


@dataclass(frozen=True)
class _Form:
    """Quadratic forms in tolerance units. information (G, B, B), gradient (G, B): of the segments. root (B, n): root A
    of the inverse A A^T of the total information, without fixed directions."""

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
            information, t * parts.sums[:, :-1, -1], free @ vectors / np.sqrt(np.maximum(values, RIDGE_INFORMATION))
        )

    def seen_by(self, candidate: Candidate) -> _CandidateForm:
        """The form in the directions of a candidate, which all patterns share."""
        D = candidate.directions
        rows = D.T @ self.information
        common = self.root.T @ self.gradient.sum(axis=0)
        return _CandidateForm(rows @ D, rows @ self.root, self.gradient @ D, common)


@dataclass(frozen=True)
class _CandidateForm:
    """Quadratic forms of the segments in the n directions of a candidate. information (G, n, n), gradient (G, n): of
    its directions; cross (G, n, r): with the common step, whose gradient is common (r,)."""

    information: np.ndarray
    cross: np.ndarray
    gradient: np.ndarray
    common: np.ndarray

    def change(self, pattern: np.ndarray) -> _Solved:
        """The change by `pattern` (G,), estimated together with a common step of all parameters."""
        cross = np.einsum("g,gir->ir", pattern, self.cross)
        changed = np.einsum("g,gij->ij", pattern**2, self.information)
        return _Solved.of(changed - cross @ cross.T, pattern @ self.gradient - cross @ self.common)
