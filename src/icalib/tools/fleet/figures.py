"""Figures of a robot's parameters over time: differences from the first calibration, with one-sigma error bars."""

from __future__ import annotations

from typing import Any

import numpy as np

from icalib.geometry import so3
from icalib.report.plot import AXIS_COLORS, COLORS, Figure, figure, numbers, stacked_axes, y_of
from icalib.sensors.parameter_spec import display_unit
from icalib.tools.fleet.record import GroupRecord
from icalib.tools.fleet.result import JobResult

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
