"""Sentences on the result of a fleet, for the terminal and the page."""

from __future__ import annotations

from collections import Counter
from datetime import datetime

from icalib.result.verdict import EXIT_CODES
from icalib.tools.comparison.words import digits
from icalib.tools.fleet.drift import Drift, GroupChange
from icalib.tools.fleet.result import Fleet, JobResult


def answer(fleet: Fleet) -> str:
    """Sentences with the number of jobs and failures, and the robots that changed."""
    jobs, robots, failed = len(fleet.results), len(fleet.drifts), len(fleet.failed)
    counts = f"{_count(jobs, 'job')} of {_count(robots, 'robot')}: {jobs - failed} calibrated, {failed} failed."
    return f"{counts} {changed_words(fleet)}"


def changed_words(fleet: Fleet) -> str:
    if fleet.drifted:
        return f"Changed over time: {'; '.join(f'{d.robot} ({_listed(d.sensors)})' for d in fleet.drifted)}."
    if not sum(d.n_tested for d in fleet.drifts):
        return "No robot has two usable calibrations to compare."
    return "Nothing changed over time."


def chance_words(fleet: Fleet) -> str:
    """A sentence that compares the number of changes with that expected by chance."""
    n_tested = sum(d.n_tested for d in fleet.drifts)
    changes = sum(len(d.changes) for d in fleet.drifts)
    return (
        f"{changes} of {n_tested} comparisons exceed {fleet.limit:g} sigma; about {digits(fleet.by_chance)} are "
        "expected by chance."
    )


def change_words(robot: str, change: GroupChange) -> str:
    return f"{robot}, {change.before} to {change.after}: {change.words}"


def changes(fleet: Fleet) -> list[str]:
    return [change_words(d.robot, c) for d in fleet.drifts for c in d.changes]


def unsure(fleet: Fleet) -> list[str]:
    """Sentences on differences that cannot be tested: unusable on one side, or without standard deviation."""
    return [change_words(d.robot, c) for d in fleet.drifts for c in d.unsure]


def notes(fleet: Fleet) -> list[str]:
    return [f"{d.robot}: {note}" for d in fleet.drifts for note in d.notes]


def failures(fleet: Fleet) -> list[str]:
    return [f"{r.job.name}: {r.sentence}" for r in fleet.failed]


def time_words(time: datetime | None) -> str:
    """Date and time; only the date if the time is midnight, as it is if unknown; "" for None."""
    if time is None:
        return ""
    return f"{time:%Y-%m-%d}" if (time.hour, time.minute, time.second) == (0, 0, 0) else f"{time:%Y-%m-%d %H:%M}"


def span_words(results: list[JobResult]) -> str:
    """First and last time; "" if none is known."""
    known = sorted(r.time for r in results if r.time is not None)
    return " to ".join(dict.fromkeys(time_words(t) for t in known[:1] + known[-1:]))


def care_words(one: JobResult) -> str:
    """Verdict of a job, with the numbers of unobservable combinations and of warnings; "" without a result."""
    parts = [one.record.verdict] if one.record.verdict else []
    parts += [_count(len(one.record.unobservable), "combination") + " unobservable"] if one.record.unobservable else []
    parts += [_count(len(one.record.warnings), "warning")] if one.record.warnings else []
    return ", ".join(parts)


def verdict_words(results: list[JobResult]) -> str:
    """Number of results with each verdict, the best verdict first; without failed jobs."""
    counts = Counter(r.record.verdict for r in results if not r.failed)
    return ", ".join(f"{counts[verdict]} {verdict}" for verdict in EXIT_CODES if counts[verdict])


ROBOT_HEADERS = "robot", "jobs", "failed", "time", "verdicts", "changed"


def robot_rows(fleet: Fleet) -> list[tuple[str, int, int, str, str, str]]:
    """A row for each robot, with the cells of `ROBOT_HEADERS`."""
    rows = []
    for drift in fleet.drifts:
        results = [r for r in fleet.results if r.job.robot == drift.robot]
        failed, verdicts = sum(r.failed for r in results), verdict_words(results)
        rows.append((drift.robot, len(results), failed, span_words(results), verdicts, drift_cell(drift)))
    return rows


def drift_cell(drift: Drift) -> str:
    if drift.changes:
        return _listed(drift.sensors)
    return "nothing" if drift.n_tested else ""


def _listed(names: tuple[str, ...]) -> str:
    return ", ".join(names)


def _count(n: int, what: str) -> str:
    return f"{n} {what}{'' if n == 1 else 's'}"
