"""Changes between calibrations of one robot, with the tests and sentences of `icalib compare`."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from math import erfc, sqrt

from icalib.errors import CalibrationError
from icalib.result import Calibration
from icalib.tools.comparison.compare import Comparison, Difference, compare_sides
from icalib.tools.comparison.results import side_of_result
from icalib.tools.comparison.sides import Side
from icalib.tools.comparison.words import sentence


@dataclass(frozen=True)
class GroupChange:
    """A block that differs between the jobs `before` and `after`; words: the sentence on it. at_its_sensor: the block
    is relative to the body or to no other sensor, so that the change is due to its sensor. testable: the block is
    determined on both sides, with standard deviations."""

    before: str
    after: str
    difference: Difference
    words: str
    at_its_sensor: bool
    testable: bool


@dataclass(frozen=True)
class Drift:
    """Changes of one robot. jobs: those with a result, in order of time. changes: beyond `limit` sigmas, between
    successive jobs; from the first to the last job only those that no step shows. unsure: differences that cannot be
    tested, as they are unusable or have no standard deviations. n_tested: number of tested differences. notes:
    what could not be compared."""

    robot: str
    jobs: tuple[str, ...]
    changes: tuple[GroupChange, ...] = ()
    unsure: tuple[GroupChange, ...] = ()
    n_tested: int = 0
    notes: tuple[str, ...] = ()

    @property
    def sensors(self) -> tuple[str, ...]:
        """Names of the sensors that changed. If only poses between two sensors changed, the sensor of the pair that is
        not the reference frame."""
        changes = [c for c in self.changes if c.at_its_sensor] or self.changes
        return tuple(dict.fromkeys(c.difference.sensor for c in changes))


@dataclass(frozen=True)
class _Comparison:
    """Comparison of two jobs: the blocks that differ, the number of tested blocks, and notes."""

    changes: tuple[GroupChange, ...] = ()
    n_tested: int = 0
    notes: tuple[str, ...] = ()


def drift_of(robot: str, jobs: Sequence[str], load: Callable[[str], Calibration], limit: float) -> Drift:
    """Changes of one robot. jobs: names in order of time. load: returns the result of a job; the message of its
    CalibrationError becomes a note, as does the first reason of a result that is not usable. limit: sigmas beyond which
    a block has changed. At most three results are in memory."""
    steps, notes, first, last = list[_Comparison](), list[str](), None, None
    for name in jobs:
        try:
            result = load(name)
        except CalibrationError as error:
            notes.append(str(error))
            continue
        if result.verdict == "not usable":
            notes.append(f"{name} is not usable and is not compared: {result.reasons[0]}")
            continue
        side = side_of_result(result, name)
        if last is not None:
            steps.append(_step(last, side, limit))
        first, last = first or side, side
    step_blocks = {_block(c) for s in steps for c in s.changes}
    if first is not None and last is not None and len(steps) > 1:
        slow = _step(first, last, limit)
        steps.append(_Comparison(tuple(c for c in slow.changes if _block(c) not in step_blocks), slow.n_tested))
    changes = [c for s in steps for c in s.changes]
    return Drift(
        robot,
        tuple(jobs),
        tuple(c for c in changes if c.testable),
        tuple(c for c in changes if not c.testable),
        sum(s.n_tested for s in steps),
        tuple(dict.fromkeys([*notes, *(n for s in steps for n in s.notes)])),
    )


def by_chance(n_tested: int, limit: float) -> float:
    """Expected number of `n_tested` comparisons beyond `limit` sigmas by chance."""
    return n_tested * erfc(limit / sqrt(2.0))


def _step(a: Side, b: Side, limit: float) -> _Comparison:
    try:
        comparison = compare_sides(a, b, limit=limit)
    except CalibrationError as error:
        return _Comparison(notes=(str(error),))
    changes = tuple(_change(d, comparison) for d in comparison.differences if d.differs)
    return _Comparison(changes, sum(_is_testable(d) for d in comparison.differences), comparison.notes)


def _change(d: Difference, c: Comparison) -> GroupChange:
    at_its_sensor = d.frame in (c.reference, d.sensor, c.a.body)
    return GroupChange(c.a.path, c.b.path, d, sentence(d, c), at_its_sensor, _is_testable(d))


def _is_testable(d: Difference) -> bool:
    return d.sigmas is not None and d.given_by == "both" and not d.open


def _block(c: GroupChange) -> tuple[str, str, str]:
    return c.difference.sensor, c.difference.frame, c.difference.what
