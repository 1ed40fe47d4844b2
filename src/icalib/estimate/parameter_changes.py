"""Parameters that change during the recording: a clock that drifts or jumps, extrinsics that moved, a lens that
refocused.

Score test of parameter constancy (Nyblom 1989; for a break, Chow 1960). The estimate has constant calibration
parameters. In the test those of one group are x + d_g e in segment g. The pattern d_g is linear in time (drift), or 0
before and 1 after a boundary (step). Near the optimum chi^2 is a quadratic form of the common step and of e, from
which the trajectory of the whole recording is eliminated: that it goes on shows a jump. One solve gives e, its
covariance, and the decrease of chi^2. A pulse, a few segments that differ, is no change, but competes with them:
one bad set of images looks like a small step. Only directions that the data determine change. Gains are compared with
the scatter of the segments that is left, as formal standard deviations are too small where the model is wrong.
Within a segment half of it is taken to have changed. This hides a step, or lets other parameters explain more of it, so
that shorter segments around it decide."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Literal, NamedTuple

import numpy as np
from scipy import special

from icalib.estimate.problem import Problem
from icalib.estimate.residual_statistics import Segments
from icalib.optim.arrowhead import (
    UNOBSERVABLE_BELOW,
    complement,
)
from icalib.optim.state import State
from icalib.rig import Sensor
from icalib.sensors.sensor import TIME_OFFSET

# information in tolerance units (sigma of 1000 tolerances): keeps the form positive definite if unobservable
RIDGE_INFORMATION = 1e-6
Pattern = Literal["drift", "step", "pulse"]
SIGNIFICANT = 25.0  # gain of one parameter, five standard deviations, as many instants are tried; of more: as unlikely
LEAD = 9.0  # of gains of two patterns: three standard deviations
INSTANTS = 16  # segments, at whose ends changes are tried
SHORTER = 4  # parts of each segment around a change
MOST = 0.5  # least share that a change gains with these, which are where it looks largest
# Share that a change must gain of the gain by separate parameters for each segment. On EuRoC, where lens and board do
# not follow the model, the best change gains 0.04.
MIN_CHANGE_SHARE = 0.25


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
    number of directions that are determined; rival: largest gain of another pattern of the same parameters; step: time
    of the best step of these."""

    sensors: tuple[str, ...]
    name: str
    pattern: Pattern
    second: float
    value: np.ndarray
    sigma: np.ndarray
    gain: float
    count: int
    rival: float = 0.0
    step: float = 0.0

    @property
    def parameters(self) -> tuple[tuple[str, ...], str]:
        """What changes: sensors, and the first of the parameters that change together."""
        return self.sensors, self.name

    @property
    def is_clock_drift(self) -> bool:
        """Whether it is the rate of a clock, which an estimate can include."""
        return self.name == TIME_OFFSET.name and self.pattern == "drift"


def least_chi2(m: int) -> float:
    """The chi^2 of m numbers that is as unlikely as SIGNIFICANT of one."""
    return float(special.chdtri(max(m, 1), special.chdtrc(1, SIGNIFICANT)))


@dataclass(frozen=True)
class Scatter:
    """What separate parameters for each segment, or pair of them, gain. gain: decrease of chi^2; dof: number of their
    directions that are determined."""

    gain: float
    dof: float

    @property
    def beyond_chance(self) -> float:
        """The gain beyond that of noise, which is one for each direction."""
        return max(self.gain - self.dof, 1.0)

    def exceeded_by(self, change: Change) -> bool:
        """Whether the change, and its lead over other patterns, is significant beside the scatter that it leaves."""
        rest = max((self.gain - change.gain) / max(self.dof - change.count, 1.0), 1.0)
        leads = change.gain - change.rival > LEAD * rest
        return change.count > 0 and change.gain > least_chi2(change.count) * rest and leads


class Changes(NamedTuple):
    """by_gain: the pattern with the largest gain for each candidate, sorted by how much more this is than chance may
    give so many numbers; scatter: what separate parameters for each segment gain, or for each pair of them."""

    by_gain: tuple[Change, ...]
    scatter: Scatter

    @property
    def clear(self) -> Change | None:
        """The first, if it is significant and explains a fair share of what varies."""
        best = next(iter(self.by_gain), None)
        if best is None or best.gain < MIN_CHANGE_SHARE * self.scatter.beyond_chance:
            return None
        return best if self.scatter.exceeded_by(best) else None


NO_CHANGES = Changes((), Scatter(0.0, 0.0))


def changes(problem: Problem, state: State, sensors: Sequence[Sensor]) -> Changes:
    """Changes of the parameters of `sensors`. Target, planes and IMU are the reference for the others; the clock of the
    IMU is that which all others share. None is found in a recording that is too short for segments. None is clear if
    shorter segments around it show another."""
    parts, candidates = Segments.between(problem, state, INSTANTS), list(_candidates(problem, sensors))
    if parts is None or not candidates:
        return NO_CHANGES
    coarse = _by_gain(parts, candidates, 2)
    best, chance = coarse.by_gain[0], coarse.scatter.beyond_chance
    may_be_clear = SHORTER * best.gain >= MIN_CHANGE_SHARE * chance and best.gain > least_chi2(best.count)
    if best.is_clock_drift or not may_be_clear:
        return coarse
    near = best.step if best.pattern == "drift" else best.second
    fine = _by_gain(Segments.at(problem, state, _shorter_around(near, parts)), candidates, 1)
    if fine.clear is not None and fine.clear.gain >= MOST * max(fine.scatter.beyond_chance, chance):
        return fine
    is_same = fine.by_gain[0].parameters == best.parameters
    return coarse if is_same else coarse._replace(scatter=Scatter(np.inf, 0.0))


def _shorter_around(second: float, parts: Segments) -> np.ndarray:
    """(G + 1,) keyframes that bound segments: two of `parts` together, and parts of those next to an instant."""
    seconds, ends = parts.state.seconds[parts.ends], parts.ends
    at = int(np.searchsorted(seconds, second)) - 1  # the segment in which the instant is, or at whose end
    near = np.arange(max(at - 1, 0), min(at + 2, parts.count) + 1)
    short = np.interp(np.arange(near[0], near[-1] + 1e-9, 1.0 / SHORTER), near, ends[near]).astype(np.int64)
    far = np.setdiff1d(ends[::2], np.arange(short[0], short[-1] + 1))
    return np.unique(np.concatenate([short, far, ends[[0, -1]], parts.problem.chain.starts]))


def _by_gain(parts: Segments, candidates: Sequence[Candidate], together: int) -> Changes:
    """The best change of each candidate, and the scatter of the segments, so many `together`."""
    form = _Form.of(parts, np.flatnonzero(np.any([c.directions.any(axis=1) for c in candidates], axis=0)))
    best_changes = []
    for candidate in candidates:
        by_pattern: dict[Pattern, Change] = {}
        for change in _tested(parts, form, candidate):
            by_pattern[change.pattern] = max(by_pattern.get(change.pattern, change), change, key=lambda c: c.gain)
        best, second, *_ = sorted(by_pattern.values(), key=lambda c: -c.gain)
        best_changes.append(replace(best, rival=second.gain, step=by_pattern["step"].second))
    return Changes(tuple(sorted(best_changes, key=lambda c: least_chi2(c.count) - c.gain)), form.scatter(together))


def _candidates(problem: Problem, sensors: Sequence[Sensor]) -> Iterator[Candidate]:
    """Each group of each sensor that may change, and the clocks that several share: those of one kind, or all."""
    layout, tolerance = problem.layout, problem.tolerance
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
    candidate_form = form.of_candidate(candidate)
    for kind, second, pattern in _patterns(parts.state.seconds[parts.ends]):
        one = candidate_form.change(pattern)
        value, sigma = candidate.unit * one.step, candidate.unit * one.std
        yield Change(candidate.sensors, candidate.name, kind, second, value, sigma, one.gain, one.dof)


def _patterns(ends: np.ndarray) -> Iterator[tuple[Pattern, float, np.ndarray]]:
    """Kind, time and values (G,) of each pattern over segments that end at `ends` (G + 1,) s."""
    middle, centre = 0.5 * (ends[:-1] + ends[1:]), 0.5 * (ends[0] + ends[-1])
    yield "drift", float(centre), (middle - centre) / (ends[-1] - ends[0])
    for second in np.sort([*ends[1:-1], *middle[1:-1]]):  # within a segment about half of it changes
        yield "step", float(second), np.heaviside(middle - second, 0.5)
    for n in range(2, SHORTER + 1):
        for k in range(1, len(middle) - n):  # one that reaches an end of the recording is a step
            yield "pulse", float(np.mean(ends[[k, k + n]])), np.isin(np.arange(len(middle)), k + np.arange(n)) * 1.0


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
    """Quadratic form in a further part of m calibration parameters, those with `columns` (m,), in each of G segments;
    all that is common is eliminated; tolerance units. information (G, m, G, m); gradient (G, m)."""

    columns: np.ndarray
    information: np.ndarray
    gradient: np.ndarray

    @classmethod
    def of(cls, parts: Segments, columns: np.ndarray) -> _Form:
        information, gradient = parts.varying(columns)
        B, G, t = parts.problem.layout.size, parts.count, parts.problem.tolerance
        t = np.concatenate([t, np.tile(t[columns], G)])
        information, gradient = t[:, None] * information * t, t * gradient
        free = complement(parts.problem.fixed_directions, B)
        values, vectors = np.linalg.eigh(free.T @ information[:B, :B] @ free)
        root = free @ vectors / np.sqrt(np.maximum(values, RIDGE_INFORMATION))
        cross, shape = information[B:, :B] @ root, (G, len(columns))
        left = information[B:, B:] - cross @ cross.T
        return cls(columns, left.reshape(shape * 2), (gradient[B:] - cross @ (root.T @ gradient[:B])).reshape(shape))

    def of_candidate(self, candidate: Candidate) -> _Form:
        """The form in the n directions of a candidate, which all patterns share."""
        D = candidate.directions[self.columns]
        information = np.einsum("ai,gahb,bj->gihj", D, self.information, D, optimize=True)
        return _Form(np.arange(D.shape[1]), information, self.gradient @ D)

    def change(self, pattern: np.ndarray) -> _Solved:
        """The change by `pattern` (G,), estimated together with all that is common."""
        information = np.einsum("g,gahb,h->ab", pattern, self.information, pattern, optimize=True)
        return _Solved.of(information, pattern @ self.gradient)

    def scatter(self, together: int) -> Scatter:
        """What separate parameters for each segment gain, or for so many `together`."""
        groups = np.arange(0, len(self.gradient), together)
        information = np.add.reduceat(np.add.reduceat(self.information, groups, axis=0), groups, axis=2)
        gradient = np.add.reduceat(self.gradient, groups, axis=0)
        each = _Solved.of(information.reshape(gradient.size, -1), gradient.ravel())
        return Scatter(each.gain, each.dof)
