"""What report and 3D view show of LiDARs: points on planes, before and after, and residuals over time and distance."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import numpy as np

from icalib.report.plot import VIEW, Figure, axis, dots, figure, line, numbers, path_3d, thin
from icalib.report.residual_views import ResidualCloud, ResidualCurve
from icalib.report.rig_shapes import CIRCLE, PEN_UP
from icalib.report.sections import Section, plot_place
from icalib.report.tables import Html, element, html
from icalib.result import Calibration, Plane
from icalib.sensors.lidar.record import LidarResiduals

MOST_DOTS = 2500  # in a figure of residuals
MOST_IN_SPACE = 20_000  # points in a picture of the planes
BINS = 60
FEWEST_IN_BIN = 20
BIN_S = 0.1  # of time in a curve: some thousand points of a usual LiDAR
WIDEST = 4.0  # of a scale of colours, in RMS of the result
TOP = 5.0  # of a scale of residuals, in their RMS
NEARLY_LEVEL = 0.1  # sine of a slope; below it a plane lies along the axes of the world
_WALL = "#64748b"
_MAPS = (("As the first guess had them", "map-before"), ("As calibrated", "map-after"))
_WORDS = (
    "Where planes are in the world, and how far points lie off them. A good calibration leaves thin planes, one "
    "colour all over, and a mean without a pattern in time and distance. As the first guess had them planes are "
    "those that fit its points best. Each recording has a world of its own; of several the menu above each map "
    f"chooses one. At most {MOST_IN_SPACE} points are drawn in space, {MOST_DOTS} of a kind below, evenly picked."
)
LEGEND = "rings are LiDARs"


def sections(c: Calibration) -> Iterator[Section]:
    """The planes before and after, then each LiDAR."""
    if not c.lidar_residuals:
        return
    maps = [element("div", [element("h3", title), plot_place(name, "")]) for title, name in _MAPS]
    parts, figures = [element("div", maps, "pair")], plane_maps(c)
    for i, r in enumerate(c.lidar_residuals):
        first, now = (1e3 * float(np.sqrt(np.mean(x.astype(np.float64) ** 2))) for x in (r.first_residual, r.residual))
        counts = (
            f"{r.points_used} of {r.points_read} points used; off their planes {first:.1f} mm RMS at first, "
            f"{now:.1f} mm now"
        )
        head = element("h3", [html(r.sensor), element("small", f" {counts}")])
        plots = [plot_place(f"points-{i}", ""), plot_place(f"distance-{i}", "")]
        parts.append(Html(head + element("div", plots, "pair")))
        figures |= {f"points-{i}": residuals_over_time(r), f"distance-{i}": residuals_over_distance(r)}
    yield Section("points", "LiDAR points on planes", _WORDS, Html("".join(parts)), figures)


def curves(r: LidarResiduals) -> Iterator[ResidualCurve]:
    """RMS [mm] of the points in each stretch of time."""
    number, of = np.unique(np.floor(r.seconds / BIN_S).astype(np.int64), return_inverse=True)
    total = np.bincount(of, r.residual.astype(np.float64) ** 2, len(number))
    rms = np.sqrt(total / np.bincount(of, minlength=len(number)))
    yield ResidualCurve("", BIN_S * (number + 0.5), 1e3 * rms[:, None], ("RMS [mm]",))


def clouds(c: Calibration) -> Iterator[ResidualCloud]:
    """Points on the planes that they were found to lie on."""
    for r in c.lidar_residuals:
        yield ResidualCloud(r.sensor, r.seconds, r.world, np.abs(r.residual.astype(np.float64)))


def amounts(c: Calibration) -> Iterator[str]:
    """How much was used."""
    if c.lidar_residuals:
        points = sum(r.points_used for r in c.lidar_residuals)
        yield f"{sum(r.scans for r in c.lidar_residuals)} scans with {points} points on {len(c.planes)} planes"


def shape(c: Calibration, name: str, spread: float) -> np.ndarray:
    """Rings about a LiDAR, in its frame; spread: of the rig [m]."""
    return rings(0.3 * spread)


def rings(radius: float) -> np.ndarray:
    """Three circles about z, as a spinning LiDAR looks level, up and down."""
    x, y = CIRCLE.T
    tilted = ((np.cos(e), np.sin(e)) for e in np.deg2rad([-15.0, 0.0, 15.0]))
    circles = [radius * np.stack([a * x, a * y, np.full_like(x, b)], axis=1) for a, b in tilted]
    return np.vstack([part for circle in circles for part in (circle, PEN_UP)])


def residuals_over_time(r: LidarResiduals) -> Figure:
    """Distance of points to their planes over time, and its RMS and mean in stretches of it."""
    return _residuals_over(r, r.seconds, "time [s]")


def residuals_over_distance(r: LidarResiduals) -> Figure:
    """The same over the distance from the LiDAR."""
    return _residuals_over(r, r.distance, "distance from the LiDAR [m]")


def _residuals_over(r: LidarResiduals, x: np.ndarray, title: str) -> Figure:
    size, some = 1e3 * r.residual, thin(len(x), MOST_DOTS)
    if not len(x):
        return figure([], 340, xaxis=axis(title), yaxis=axis("residual [mm]"))
    edges = np.linspace(x.min(), np.nextafter(x.max(), np.inf), BINS + 1)
    own = np.clip(np.searchsorted(edges, x, side="right") - 1, 0, BINS - 1)
    count = np.bincount(own, minlength=BINS)
    enough = np.where(count >= FEWEST_IN_BIN, count, np.nan)
    rms = np.sqrt(np.bincount(own, size.astype(np.float64) ** 2, BINS) / enough)
    mean = np.bincount(own, size, BINS) / enough
    middle, top = 0.5 * (edges[1:] + edges[:-1]), TOP * float(np.sqrt(np.mean(size.astype(np.float64) ** 2)))
    return figure(
        [
            dots(x[some], np.clip(size[some], -top, top), "points (clipped to the frame)", "#93b7dc"),
            line(middle, rms, "RMS", "#0f2f57"),
            line(middle, mean, "mean", "#d97706"),
        ],
        340,
        xaxis=axis(title),
        yaxis=axis("residual [mm]"),
    )


def plane_maps(c: Calibration) -> dict[str, Figure]:
    """The planes with points of all LiDARs, coloured by how far they lie off: as the first guess had them, and now.

    Each recording has a world of its own: of several one is shown, and a menu chooses it.
    """
    most = MOST_IN_SPACE // len(c.lidar_residuals)
    kept = [(r, thin(len(r.seconds), most)) for r in c.lidar_residuals]
    plane, seconds = (np.concatenate([getattr(r, name)[k] for r, k in kept]) for name in ("plane", "seconds"))
    before = np.concatenate([r.first_world[k] for r, k in kept]), np.concatenate([r.first_residual[k] for r, k in kept])
    after = np.concatenate([r.world[k] for r, k in kept]), np.concatenate([r.residual[k] for r, k in kept])
    top = WIDEST * 1e3 * float(np.sqrt(np.mean(after[1].astype(np.float64) ** 2))) if len(plane) else 1.0
    names = [span.name for span in c.recordings] or [""]
    of_recording = c.recording_of(seconds)
    found: list[tuple[list[dict[str, Any]], list[dict[str, Any]]]] = []
    for k in range(len(names)):
        own = of_recording == k
        walls = _outlines(c.planes, after[0][own], plane[own])
        found.append(([_cloud(before, own, top)], [_cloud(after, own, top), walls]))
    first, now = zip(*found, strict=True)
    return {"map-before": _map(list(first), names), "map-after": _map(list(now), names)}


def _cloud(cloud: tuple[np.ndarray, np.ndarray], own: np.ndarray, top: float) -> dict[str, Any]:
    """The points `own` (N,) bool of a cloud: points and residuals, colours up to `top` mm."""
    points, residual = (x[own] for x in cloud)
    size = np.minimum(np.abs(1e3 * residual.astype(np.float64)), top)
    marker: dict[str, Any] = {"size": 1.6, "color": numbers(np.round(size, 1)), "colorscale": "Viridis"}
    marker |= {"cmin": 0.0, "cmax": top, "colorbar": {"title": {"text": "off its plane [mm]"}, "thickness": 10}}
    shown = np.round(points.astype(np.float64), 3)
    return path_3d(shown, "points", "", mode="markers", marker=marker, hoverinfo="skip", showlegend=False)


def _map(traces: list[list[dict[str, Any]]], names: list[str]) -> Figure:
    """Traces of each recording, of which the first is shown."""
    scene = {name: {"title": {"text": f"world {name[0]} [m]"}, "nticks": 6} for name in ("xaxis", "yaxis", "zaxis")}
    layout: dict[str, Any] = {"scene": scene | VIEW, "margin": {"l": 0, "r": 0, "t": 10, "b": 0}}
    of = [k for k, own in enumerate(traces) for _ in own]
    shown = [trace | {"visible": k == 0} for k, own in enumerate(traces) for trace in own]
    if len(names) > 1:
        choices = [
            {"label": name, "method": "restyle", "args": ["visible", [k == number for k in of]]}
            for number, name in enumerate(names)
        ]
        layout |= {"updatemenus": [{"buttons": choices, "x": 0.0, "xanchor": "left", "y": 1.0, "yanchor": "top"}]}
    return figure(shown, 460, **layout)


def _outlines(planes: tuple[Plane, ...], points: np.ndarray, plane: np.ndarray) -> dict[str, Any]:
    """The rectangle of each plane about its points, one side level; the pen is lifted between them."""
    pen = []
    for k, p in enumerate(planes):
        own = points[plane == k]
        if not len(own):
            continue
        across = _level_axes(p.normal)
        flat = (own - p.point) @ across.T
        (u0, v0), (u1, v1) = flat.min(axis=0), flat.max(axis=0)
        corners = np.array([(u0, v0), (u1, v0), (u1, v1), (u0, v1), (u0, v0)])
        pen += [p.point + corners @ across, np.full((1, 3), np.nan)]
    path = np.concatenate(pen) if pen else np.zeros((0, 3))
    return path_3d(path, "planes", _WALL, line={"color": _WALL, "width": 2}, showlegend=False, hoverinfo="skip")


def _level_axes(normal: np.ndarray) -> np.ndarray:
    """(2, 3) unit vectors across a unit normal, the first of them level."""
    level = np.array([-normal[1], normal[0], 0.0])
    length = float(np.linalg.norm(level))
    level = level / length if length > NEARLY_LEVEL else np.array([0.0, normal[2], -normal[1]]) / np.hypot(*normal[1:])
    return np.stack([level, np.cross(normal, level)])
