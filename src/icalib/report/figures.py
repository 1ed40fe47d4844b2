"""Figures of the report: axes, colours, panels, histograms, curves of residuals."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np

from icalib.kinds import presenters
from icalib.result import Calibration, RowResiduals
from icalib.sensors.stream import Residuals

# Figures as plain data that plotly.js draws. Plotly's Python package is slow to import and not needed.

Figure = dict[str, Any]
COLORS = ("#2563a8", "#d97706", "#15803d", "#7c3aed", "#be185d", "#0e7490")
AXIS_COLORS = ("#c0392b", "#1e8449", "#2563a8")  # x, y, z
REJECTED = "#dc2626"
VIEW = {
    "aspectmode": "data",
    "camera": {"eye": {"x": 1.5, "y": 1.5, "z": 1.1}, "center": {"x": 0, "y": 0, "z": -0.15}},
}  # layout of 3D scenes
DIGITS = 5  # significant digits of numbers in the page; more only make the file larger
_GRID = {"gridcolor": "#e5e7eb", "zerolinecolor": "#cbd5e1", "linecolor": "#94a3b8"}


def figure(traces: list[dict[str, Any]], height: int = 380, **layout: Any) -> Figure:
    """A figure of `traces` in the style of the page. height [px]; layout: further entries of plotly's layout."""
    style: dict[str, Any] = {
        "height": height,
        "margin": {"l": 64, "r": 16, "t": 34, "b": 48},
        "paper_bgcolor": "rgba(0,0,0,0)",
        "plot_bgcolor": "#ffffff",
        "font": {"family": "system-ui, sans-serif", "size": 12, "color": "#1f2937"},
        "legend": {"orientation": "h", "y": 1.02, "yanchor": "bottom", "x": 0},
        "hovermode": "closest",
    }
    return {"data": traces, "layout": style | layout}


def axis(title: str, **more: Any) -> dict[str, Any]:
    """Plotly layout of an axis with its title, in the style of the page."""
    return _GRID | {"title": {"text": title}} | more


def line(x: np.ndarray, y: np.ndarray, name: str, color: str, **more: Any) -> dict[str, Any]:
    """A scatter trace drawn as a line."""
    style = {"type": "scatter", "mode": "lines", "line": {"color": color, "width": 1.4}}
    return style | {"x": numbers(x), "y": numbers(y), "name": name} | more


def dots(x: np.ndarray, y: np.ndarray, name: str, color: str, size: float = 3, **more: Any) -> dict[str, Any]:
    """A scatter trace drawn as dots."""
    marker = {"color": color, "size": size, "opacity": 0.6}
    style = {"type": "scatter", "mode": "markers", "marker": marker}
    return style | {"x": numbers(x), "y": numbers(y), "name": name} | more


def path_3d(points: np.ndarray, name: str, color: str, **more: Any) -> dict[str, Any]:
    """A 3D line trace through points (N, 3); a row of NaN interrupts the line."""
    x, y, z = (numbers(points[:, i]) for i in range(3))
    style = {"type": "scatter3d", "mode": "lines", "line": {"color": color, "width": 4}, "hoverinfo": "name"}
    return style | {"x": x, "y": y, "z": z, "name": name} | more


def stacked_axes(titles: list[str], gap: float = 0.045) -> dict[str, Any]:
    """Layout of panels stacked vertically with a common time axis. Traces of panel i belong to the y-axis `y_of(i)`."""
    n = len(titles)
    panel = (1.0 - gap * (n - 1)) / n
    layout: dict[str, Any] = {"xaxis": axis("time [s]", anchor=y_of(n - 1))}
    for i, title in enumerate(titles):
        top = 1.0 - i * (panel + gap)
        layout[y_of(i).replace("y", "yaxis")] = axis(title, domain=[max(0.0, top - panel), top])
    return layout


def y_of(panel: int) -> str:
    """Plotly's name of the y-axis of panel number `panel`."""
    return "y" if panel == 0 else f"y{panel + 1}"


def numbers(values: np.ndarray) -> list[Any]:
    """Nested lists of `values`, rounded to `DIGITS` significant digits. Values that are not finite become None, as JSON
    has no NaN."""
    values = np.asarray(values, dtype=np.float64)
    if values.ndim > 1:
        return [numbers(row) for row in values]
    return [float(f"{v:.{DIGITS}g}") if np.isfinite(v) else None for v in values.tolist()]


def thin(count: int, most: int) -> np.ndarray:
    """Indices of at most `most` of `count` items, evenly spaced."""
    return np.arange(count) if count <= most else np.linspace(0, count - 1, most).astype(np.int64)


# Panels over time.

MOST_ROWS = 2500  # rows in one figure; more are thinned out
DISPLAY_UNITS = {"rad": ("mrad", 1e3), "m": ("mm", 1e3), "m/s": ("mm/s", 1e3)}
SHOWN_PERCENTILES = (1.0, 99.0)  # of the values in a panel, which one of them far away must not flatten
ROOM = 0.5  # on either side of them, as a share of their span: normal noise is cut beyond 4.7 standard deviations


def panels(r: RowResiduals) -> Figure:
    """Residuals over time, one panel for each column, with a common time axis. Units with rad and m are shown in mrad
    and mm."""
    keep = thin(len(r.seconds), MOST_ROWS)
    units = [DISPLAY_UNITS.get(unit, (unit, 1.0)) for unit in r.units]
    columns = [(r.seconds[keep], scale * r.residual[keep, k : k + 1]) for k, (_, scale) in enumerate(units)]
    titles = tuple(f"{label} [{unit}]" for label, (unit, _) in zip(r.labels, units, strict=True))
    return stacked_panels(columns, titles, 130 * len(titles) + 90, ("",), COLORS)


def stacked_panels(
    panels: list[tuple[np.ndarray, np.ndarray]],
    titles: tuple[str, ...],
    height: int,
    names: tuple[str, ...] = ("x", "y", "z"),
    colors: tuple[str, ...] = AXIS_COLORS,
) -> Figure:
    """Stacked panels with a line for each of `names`. panels: times (n,) and values (n, m) of each; height [px].
    Triangles at the edge of a panel mark values beyond it, see `shown_range`."""
    layout, traces, cut = stacked_axes(list(titles)), list[dict[str, Any]](), list[dict[str, Any]]()
    for p, (t, v) in enumerate(panels):
        low, high = shown_range(v)
        layout[y_of(p).replace("y", "yaxis")]["range"] = numbers(np.array([low, high]))
        for i, name in enumerate(names):
            style = {"line": {"color": colors[i], "width": 1}, "showlegend": p == 0 and name != ""}
            traces.append(line(t, v[:, i], name, colors[i], yaxis=y_of(p), **style))
            out = (v[:, i] < low) | (v[:, i] > high)
            cut += [cut_marks(t[out], v[out, i], low, high, yaxis=y_of(p), showlegend=not cut)] if out.any() else []
    return figure(traces + cut, height, **layout)


def shown_range(values: np.ndarray) -> tuple[float, float]:
    """Ends of an axis: SHOWN_PERCENTILES of `values` and ROOM about them, or their extent where that is less."""
    finite = values[np.isfinite(values)]
    if not len(finite):
        return -1.0, 1.0
    low, high = np.percentile(finite, SHOWN_PERCENTILES)
    low, high = max(finite.min(), low - ROOM * (high - low)), min(finite.max(), high + ROOM * (high - low))
    edge = 0.05 * (high - low) or 0.5 * abs(high) or 1.0
    return float(low - edge), float(high + edge)


def cut_marks(x: np.ndarray, y: np.ndarray, low: float, high: float, **more: Any) -> dict[str, Any]:
    """Trace of triangles at the edges of the axis from `low` to `high`, for values y beyond it."""
    keep = thin(len(x), MOST_ROWS)
    symbols = np.where(y[keep] > high, "triangle-up", "triangle-down").tolist()
    marker = {"color": REJECTED, "size": 6, "symbol": symbols}
    named = {"text": [f"{value:.3g}" for value in y[keep].tolist()], "hovertemplate": "%{text}<extra></extra>"}
    return dots(x[keep], np.clip(y[keep], low, high), "beyond the frame", "", marker=marker, **named, **more)


# Coverage of an image.

CELL_PX = 40


def coverage(count: np.ndarray, size: tuple[int, int]) -> Figure:
    """Number of points in each cell, count (rows, columns), of an image of this size (width, height) [px]."""
    v, u = ((np.arange(n) + 0.5) * side / n - 0.5 for n, side in zip(count.shape, reversed(size), strict=True))
    heat = {"type": "heatmap", "x": numbers(u), "y": numbers(v), "z": numbers(np.where(count > 0, count, np.nan))}
    heat |= {"colorscale": "YlGnBu", "reversescale": True, "colorbar": {"title": {"text": "points"}, "thickness": 10}}
    down = axis("v [px]", range=[size[1] - 0.5, -0.5], scaleanchor="x", constrain="domain")
    return figure([heat], 330, xaxis=axis("u [px]", range=[-0.5, size[0] - 0.5], constrain="domain"), yaxis=down)


# Histogram of the normalised residuals of all sensors.

REACH = 6.0  # range of the histogram on either side of zero, in standard deviations
BINS = 96


def normalised_histogram(c: Calibration) -> Figure:
    """Densities of residuals over their standard deviations, compared with the standard normal density. The logarithmic
    axis shows the tails."""
    edges = np.linspace(-REACH, REACH, BINS + 1)
    x = 0.5 * (edges[1:] + edges[:-1])
    traces = []
    for i, (name, z) in enumerate(_normalised(c).items()):
        count, _ = np.histogram(z, edges)
        density = count / max(1, len(z)) / (edges[1] - edges[0])
        density = np.where(count > 0, density, np.nan)
        step = {"color": COLORS[i % len(COLORS)], "width": 1.6, "shape": "hvh"}
        traces.append(line(x, density, name, COLORS[i % len(COLORS)], line=step))
    normal = np.exp(-0.5 * x**2) / np.sqrt(2.0 * np.pi)
    dashed = {"color": "#6b7280", "dash": "dash", "width": 1.4}
    traces.append(line(x, normal, "standard normal", "#6b7280", line=dashed))
    return figure(
        traces,
        380,
        xaxis=axis("residual / standard deviation"),
        yaxis=axis("density", type="log", range=[-5, 0], exponentformat="power"),
    )


def _normalised(c: Calibration) -> dict[str, np.ndarray]:
    """Residuals over their standard deviation, by sensor and name."""
    out = {f"{r.sensor} {name}": z for r in c.residuals.values() for name, z in r.normalised().items()}
    return {name: z for name, z in out.items() if len(z)}


# Data that the 3D view shows of residuals: curves over time, and points in space. Each kind of sensor defines them.


@dataclass(frozen=True, eq=False)
class ResidualCurve:
    """Curves over time. name: the kind of residual, "" if the sensor has only one. seconds (n,); values (n, m), one
    column for each label, whitened or in the unit that the label names."""

    name: str
    seconds: np.ndarray
    values: np.ndarray
    labels: tuple[str, ...]


@dataclass(frozen=True, eq=False)
class ResidualCloud:
    """Points (n, 3) [m] measured by a sensor, in the world frame, at seconds (n,). size (n,): absolute values of their
    residuals [m]."""

    sensor: str
    seconds: np.ndarray
    points: np.ndarray
    size: np.ndarray


def curves(c: Calibration, r: Residuals) -> Iterator[ResidualCurve]:
    """Curves of one residual record as its kind of sensor defines them; by default one whitened curve for each column
    of `RowResiduals`."""
    of_kind = presenters()[c.rig["sensors"][r.sensor]["type"]].curves
    if of_kind is not None:
        yield from of_kind(r)
    elif isinstance(r, RowResiduals):
        for k, label in enumerate(r.labels):
            yield ResidualCurve(label, r.seconds, r.whitened[:, k : k + 1], (f"{label}, whitened",))
