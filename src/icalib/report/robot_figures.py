"""Residuals of LiDARs' points, of wheels and of poses, and the planes that LiDARs see."""

from __future__ import annotations

from typing import Any

import numpy as np

from icalib.report.plot import (
    COLORS,
    VIEW,
    Figure,
    axis,
    dots,
    figure,
    line,
    numbers,
    path_3d,
    stacked_axes,
    thin,
    y_of,
)
from icalib.result import Calibration, Plane, RowResiduals
from icalib.sensors.lidar.record import LidarResiduals

MOST_DOTS = 2500  # in a figure of residuals
MOST_IN_SPACE = 20_000  # points in a picture of the planes
BINS = 60
FEWEST_IN_BIN = 20
WIDEST = 4.0  # of a scale of colours, in RMS of the result
TOP = 5.0  # of a scale of residuals, in their RMS
NEARLY_LEVEL = 0.1  # sine of a slope; below it a plane lies along the axes of the world
_WALL = "#64748b"


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


def panels(r: RowResiduals) -> Figure:
    """What each wheel turned, and slip, or rotation and position of poses, over time."""
    keep = thin(len(r.seconds), MOST_DOTS)
    units = ["mrad" if unit == "rad" else "mm" for unit in r.units]
    traces = [
        line(
            r.seconds[keep],
            1e3 * r.residual[keep, k],
            label,
            COLORS[k % len(COLORS)],
            yaxis=y_of(k),
            line={"color": COLORS[k % len(COLORS)], "width": 1},
        )
        for k, label in enumerate(r.labels)
    ]
    titles = [f"{label} [{unit}]" for label, unit in zip(r.labels, units, strict=True)]
    return figure(traces, 130 * len(titles) + 90, **stacked_axes(titles))


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
