"""`fleet.html`: the result of a fleet in one file that needs no network, failures and changes first."""

from __future__ import annotations

import sqlite3
from collections import Counter
from collections.abc import Iterable, Iterator
from contextlib import closing
from datetime import datetime
from pathlib import Path
from typing import Any

import numpy as np

from icalib.base.files import DATABASE_ID, printable
from icalib.errors import CalibrationError
from icalib.geometry import so3
from icalib.geometry.so3 import rpy
from icalib.report.figures import AXIS_COLORS, COLORS, Figure, figure, numbers, stacked_axes, y_of
from icalib.report.page import Plot, document
from icalib.result.quantities import TURNS
from icalib.result.verdict import EXIT_CODES
from icalib.sensors.parameter import display_unit
from icalib.tools.batch import replacing
from icalib.tools.comparison.compare import digits
from icalib.tools.fleet.result import JOBS, Drift, Fleet, GroupChange, GroupRecord, JobResult, by_robot


def fleet_html(fleet: Fleet, title: str) -> str:
    """The page as one HTML document; title: name of the file of jobs."""
    folds = _over_time(fleet)
    return document(
        "tools/fleet/page.html",
        [plot for _, _, plots in folds for plot in plots],
        title=f"Fleet of {title}",
        answer=answer(fleet),
        chance=chance_words(fleet) if any(d.n_tested for d in fleet.drifts) else "",
        limit=f"{fleet.limit:g}",
        trust="bad" if fleet.failed else ("care" if fleet.drifted else "good"),
        failures=failures(fleet),
        changes=changes(fleet),
        robot_headers=ROBOT_HEADERS,
        robots=[(robot, jobs, failed or "", *rest) for robot, jobs, failed, *rest in robot_rows(fleet)],
        folds=folds,
        jobs=[(f"{JOBS}/{r.job.name}/report.html" if r.record.blocks else "", _job(fleet, r)) for r in fleet.results],
        unsure=unsure(fleet),
        notes=notes(fleet),
    )


def _over_time(fleet: Fleet) -> list[tuple[str, bool, list[Plot]]]:
    """Name, whether it changed, and a plot of each sensor, of each robot with several calibrations."""
    robots, folds = by_robot(fleet.results), []
    for i, drift in enumerate(fleet.drifts):
        results = robots[drift.robot]
        if len(results) > 1:
            plots = [Plot(f"time-{i}-{k}", over_time(results, s), s) for k, s in enumerate(sensors(results))]
            folds.append((drift.robot, bool(drift.changes), plots))
    return folds


def _job(fleet: Fleet, r: JobResult) -> tuple[str, ...]:
    """Cells of a job in the table of jobs."""
    why = r.record.failure or fleet.again.get(r.job.name, "")
    seconds = f"{r.record.seconds:.1f}"
    return r.job.name, r.status, r.job.robot, time_words(r.time), care_words(r), seconds, why


# Figures of a robot's parameters over time: differences from the first calibration, with one-sigma error bars.

_PANEL_PX, _EDGE_PX, _GAPS = 170, 90, 0.2


def sensors(results: list[JobResult]) -> tuple[str, ...]:
    """Names of the sensors with at least one estimated parameter."""
    blocks = [b for r in results for b in r.record.blocks if _estimated(b)]
    return tuple(dict.fromkeys(b.sensor for b in blocks))


def over_time(results: list[JobResult], sensor: str) -> Figure:
    """Figure with a panel for each block of the sensor; results: in order of time.

    Unobservable entries, which depend on the guess, have hollow markers and no error bars.
    """
    blocks = [b for r in results for b in r.record.blocks if b.sensor == sensor and _estimated(b)]
    firsts = {b.name: b for b in reversed(blocks)}
    names = list(dict.fromkeys(b.name for b in blocks))
    places, dated = _places(results)
    traces = [t for k, name in enumerate(names) for t in _traces(results, places, firsts[name], k)]
    titles = [f"{n.replace('_', ' ')}{_unit_words(firsts[n])}" for n in names]
    layout = stacked_axes(titles, gap=_GAPS / len(names))
    layout["xaxis"] = layout["xaxis"] | {"title": {"text": "time" if dated else "job"}}
    layout["xaxis"] |= {"type": "date" if dated else "category"}
    return figure(_in_legend_once(traces), height=_EDGE_PX + _PANEL_PX * len(names), showlegend=True, **layout)


def _places(results: list[JobResult]) -> tuple[dict[str, str], bool]:
    """Position of each job on the time axis, by name, and whether it is a time. It is the job's name if a job has no
    time, or two have the same."""
    times = {r.job.name: r.time.isoformat() for r in results if r.time is not None}
    if len(set(times.values())) == len(results):
        return times, True
    return {r.job.name: r.job.name for r in results}, False


def _traces(results: list[JobResult], places: dict[str, str], first: GroupRecord, panel: int) -> list[dict[str, Any]]:
    """A trace for each entry of the block. Calibrations in which the block has other entries are left out."""
    at, blocks = [], []
    for r in results:
        for b in r.record.blocks:
            if (b.sensor, b.name, b.labels) == (first.sensor, first.name, first.labels):
                at.append(r)
                blocks.append(b)
    scale = display_unit(first.unit)[1]
    values = scale * np.array([so3.value_change(first.value, b.value) for b in blocks])
    colors = AXIS_COLORS if len(first.labels) == len(AXIS_COLORS) else COLORS
    return [
        {
            "type": "scatter",
            "mode": "lines+markers",
            "x": [places[r.job.name] for r in at],
            "y": numbers(values[:, k]),
            "yaxis": y_of(panel),
            "name": label or first.name,
            "line": {"width": 1, "color": colors[k % len(colors)]},
            "text": [r.job.name for r in at],
            "showlegend": len(first.labels) > 1,
            "marker": {"size": 7, "symbol": ["circle-open" if _is_hollow(b, k) else "circle" for b in blocks]},
            "error_y": {"array": numbers(scale * np.array([_bar(b, k) for b in blocks])), "thickness": 1.2, "width": 3},
        }
        for k, label in enumerate(first.labels)
    ]


def _in_legend_once(traces: list[dict[str, Any]]) -> list[dict[str, Any]]:
    """The traces, each name only once in the legend: an entry has the same colour in all panels."""
    firsts = {t["name"]: k for k, t in reversed(list(enumerate(traces)))}
    return [t | {"showlegend": t["showlegend"] and firsts[t["name"]] == k} for k, t in enumerate(traces)]


def _is_hollow(b: GroupRecord, entry: int) -> bool:
    return b.verdict[entry] == "unobservable"


def _bar(b: GroupRecord, entry: int) -> float:
    return 0.0 if _is_hollow(b, entry) else float(b.std[entry])


def _estimated(b: GroupRecord) -> bool:
    return any(v != "fixed" for v in b.verdict)


def _unit_words(b: GroupRecord) -> str:
    unit = display_unit(b.unit)[0]
    return f" [{unit}]" if unit else ""


# Sentences on the result of a fleet, for the terminal and the page.


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


# All results of a fleet as one SQLite table, which is written anew from the records each time.

_COLUMNS = (
    "robot TEXT",
    "time TEXT",
    "job TEXT",
    "status TEXT",
    "sentence TEXT",
    "sensor TEXT",
    "block TEXT",
    "entry TEXT",
    "value REAL",
    "sigma REAL",
    "unit TEXT",
    "verdict TEXT",
    "usability TEXT",
)
_NOTHING = (None,) * 7


def write_table(path: Path, results: Iterable[JobResult]) -> None:
    """Writes the table `results` atomically: a row for each parameter of each job, and one for a job without a result.
    Units are SI. Rotations have rows of roll, pitch and yaw, each with its own sigma, and of x, y, z: sigma and verdict
    of small rotations about the sensor's axes.

    Raises CalibrationError if the file cannot be written.
    """
    try:
        with replacing(path) as part, closing(sqlite3.connect(part)) as base:
            base.execute(f"PRAGMA application_id = {DATABASE_ID}")
            base.execute(f"CREATE TABLE results ({', '.join(_COLUMNS)})")
            base.executemany(
                f"INSERT INTO results VALUES ({', '.join('?' * len(_COLUMNS))})",
                (r for one in results for r in rows(one)),
            )
            base.commit()
    except sqlite3.Error as error:
        raise CalibrationError(f"{path} cannot be written ({error}); choose another folder.") from error


def rows(one: JobResult) -> Iterator[tuple[object, ...]]:
    """Rows of one job, cells as in `_COLUMNS`."""
    about = (
        one.job.robot,
        one.time.isoformat() if one.time else None,
        one.job.name,
        one.status,
        printable(one.sentence),
    )
    usability = one.record.verdict or None
    if not one.record.blocks:
        yield (*about, *_NOTHING, usability)
    for b in one.record.blocks:
        values: list[float | None] = [None] * len(b.labels) if b.value.ndim == 2 else b.value.tolist()
        if b.value.ndim == 2:
            for turn, value, std in zip(TURNS, rpy(b.value).tolist(), b.rpy_std.tolist(), strict=True):
                yield (*about, b.sensor, b.name, turn, value, std, b.unit, None, usability)
        for label, value, std, verdict in zip(b.labels, values, b.std.tolist(), b.verdict, strict=True):
            yield (*about, b.sensor, b.name, label or b.name, value, std, b.unit, verdict, usability)
