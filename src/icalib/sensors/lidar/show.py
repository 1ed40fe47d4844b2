"""LiDARs in report and 3D view: points on planes before and after calibration, residuals over time and distance."""

from __future__ import annotations

from collections.abc import Iterator
from itertools import cycle
from typing import Any

import numpy as np

from icalib.report.figures import (
    COLORS,
    VIEW,
    Figure,
    ResidualCloud,
    ResidualCurve,
    axis,
    dots,
    figure,
    line,
    numbers,
    path_3d,
    shown_range,
    thin,
)
from icalib.report.page import Group, Plot, Presenter, Section
from icalib.report.rig_figures import CIRCLE, PEN_UP
from icalib.result import Calibration, Plane
from icalib.sensors.lidar.stream import LidarResiduals

MAX_DOTS = 2500  # points in a figure of residuals: more hide one another
MAX_MAP_POINTS = 10_000  # points in a 3D map of the planes: keeps the page small
N_FIGURE_BINS = 60  # along the x axis of RMS and mean
MIN_BIN_POINTS = 20  # of a figure bin; their RMS has a standard deviation of 16 %
CURVE_BIN_S = 0.1  # duration of a bin of the curves in the 3D view: some thousand points of a usual LiDAR
MAX_COLOR_RMS = 4.0  # end of the colour scale, in RMS of the result
MAX_RESIDUAL_RMS = 5.0  # end of the residual axis, in RMS of the residuals
MAX_WALL_SLOPE = 0.5  # sine of the inclination of a wall
MAX_WALL_POINTS = 4000  # of a LiDAR from above
MIN_SLOPE = 0.1  # sine; the outline of a flatter plane is aligned with the axes of the world
_WALL = "#64748b"
_MAPS = (("Points as the first guess had them", "map-before"), ("Points as calibrated", "map-after"))
_SECTION_WORDS = (
    "Planes in the world, and distances of points from them. A good calibration leaves thin planes of one colour, and "
    "a mean without a pattern in time and distance. The planes of the first guess are those that fit its points "
    "best. Each recording has a world of its own; the menu above each map chooses among several. At most "
    f"{MAX_MAP_POINTS} points are drawn in space, {MAX_DOTS} of a kind below, evenly picked."
)
_WHEN = ("before", "after")
_WALL_WORDS = (
    "Points on walls in the first recording, a colour for each LiDAR, by the first guess and by the result. Lines of "
    "two LiDARs lie on one another if they are calibrated."
)
LEGEND = "rings are LiDARs"


def sections(c: Calibration) -> Iterator[Section]:
    """One section: maps of the planes before and after, then residuals of each LiDAR."""
    if not c.lidar_residuals:
        return
    maps = plane_maps(c)
    groups = [Group(plots=[Plot(name, maps[name], title) for title, name in _MAPS])]
    if len(c.lidar_residuals) > 1:
        plots = [Plot(f"walls-{when}", walls(c, when == "before"), f"Walls from above, {when}") for when in _WHEN]
        groups.append(Group("All LiDARs", plots, words=_WALL_WORDS))
    for i, r in enumerate(c.lidar_residuals):
        first, now = (1e3 * float(np.sqrt(np.mean(x.astype(np.float64) ** 2))) for x in (r.first_residual, r.residual))
        counts = (
            f"{r.points_used} of {r.points_read} points used; off their planes {first:.1f} mm RMS at first, "
            f"{now:.1f} mm now"
        )
        plots = [
            Plot(f"points-{i}", residuals_over_time(r), "Over time"),
            Plot(f"distance-{i}", residuals_over_distance(r), "Over distance"),
        ]
        groups.append(Group(r.sensor, plots, counts))
    yield Section("points", "LiDAR points on planes", _SECTION_WORDS, groups)


def curves(r: LidarResiduals) -> Iterator[ResidualCurve]:
    """The curve of the RMS residual [mm] of points over time, in bins of CURVE_BIN_S."""
    number, of = np.unique(np.floor(r.seconds / CURVE_BIN_S).astype(np.int64), return_inverse=True)
    total = np.bincount(of, r.residual.astype(np.float64) ** 2, len(number))
    rms = np.sqrt(total / np.bincount(of, minlength=len(number)))
    yield ResidualCurve("", CURVE_BIN_S * (number + 0.5), 1e3 * rms[:, None], ("RMS [mm]",))


def clouds(c: Calibration) -> Iterator[ResidualCloud]:
    """Points on planes in the world, with their absolute distances from the planes [m]."""
    for r in c.lidar_residuals:
        yield ResidualCloud(r.sensor, r.seconds, r.world, np.abs(r.residual.astype(np.float64)))


def amounts(c: Calibration) -> Iterator[str]:
    """Numbers of scans, points and planes, as text for the summary."""
    if c.lidar_residuals:
        points = sum(r.points_used for r in c.lidar_residuals)
        yield f"{sum(r.scans for r in c.lidar_residuals)} scans with {points} points on {len(c.planes)} planes"


def shape(c: Calibration, name: str, spread: float) -> np.ndarray:
    """Polyline (n, 3) [m] of rings that depict a LiDAR, in its frame. spread: size of the rig [m]."""
    return rings(0.3 * spread)


def rings(radius: float) -> np.ndarray:
    """Polyline (n, 3) [m] of three circles about z, like beams of a spinning LiDAR at elevations -15, 0 and 15 deg."""
    x, y = CIRCLE.T
    tilted = ((np.cos(e), np.sin(e)) for e in np.deg2rad([-15.0, 0.0, 15.0]))
    circles = [radius * np.stack([a * x, a * y, np.full_like(x, b)], axis=1) for a, b in tilted]
    return np.vstack([part for circle in circles for part in (circle, PEN_UP)])


def residuals_over_time(r: LidarResiduals) -> Figure:
    """Distances of points from their planes over time, with RMS and mean."""
    return _residuals_over(r, r.seconds, "time [s]")


def residuals_over_distance(r: LidarResiduals) -> Figure:
    """Distances of points from their planes over the range, with RMS and mean."""
    return _residuals_over(r, r.distance, "distance from the LiDAR [m]")


def _residuals_over(r: LidarResiduals, x: np.ndarray, title: str) -> Figure:
    """Residuals [mm] over x (N,), with RMS and mean in N_FIGURE_BINS bins."""
    size, some = 1e3 * r.residual, thin(len(x), MAX_DOTS)
    if not len(x):
        return figure([], 340, xaxis=axis(title), yaxis=axis("residual [mm]"))
    edges = np.linspace(x.min(), np.nextafter(x.max(), np.inf), N_FIGURE_BINS + 1)
    bin_of = np.clip(np.searchsorted(edges, x, side="right") - 1, 0, N_FIGURE_BINS - 1)
    count = np.bincount(bin_of, minlength=N_FIGURE_BINS)
    enough = np.where(count >= MIN_BIN_POINTS, count, np.nan)
    rms = np.sqrt(np.bincount(bin_of, size.astype(np.float64) ** 2, N_FIGURE_BINS) / enough)
    mean = np.bincount(bin_of, size, N_FIGURE_BINS) / enough
    middle = 0.5 * (edges[1:] + edges[:-1])
    top = MAX_RESIDUAL_RMS * float(np.sqrt(np.mean(size.astype(np.float64) ** 2)))
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
    """Maps of all planes at the first guess and at the estimate, with points coloured by their distance.

    Each recording has a world frame of its own. A menu chooses among several.
    """
    most = MAX_MAP_POINTS // len(c.lidar_residuals)
    kept = [(r, thin(len(r.seconds), most)) for r in c.lidar_residuals]
    plane, seconds = (np.concatenate([getattr(r, name)[k] for r, k in kept]) for name in ("plane", "seconds"))
    before = np.concatenate([r.first_world[k] for r, k in kept]), np.concatenate([r.first_residual[k] for r, k in kept])
    after = np.concatenate([r.world[k] for r, k in kept]), np.concatenate([r.residual[k] for r, k in kept])
    top = MAX_COLOR_RMS * 1e3 * float(np.sqrt(np.mean(after[1].astype(np.float64) ** 2))) if len(plane) else 1.0
    names = [span.name for span in c.recordings] or [""]
    of_recording = c.recording_of(seconds)
    traces: list[tuple[list[dict[str, Any]], list[dict[str, Any]]]] = []
    for k in range(len(names)):
        in_recording = of_recording == k
        walls = _outlines(c.planes, after[0][in_recording], plane[in_recording])
        traces.append(([_cloud(before, in_recording, top)], [_cloud(after, in_recording, top), walls]))
    first, now = zip(*traces, strict=True)
    return {"map-before": _map(list(first), names), "map-after": _map(list(now), names)}


def walls(c: Calibration, before: bool) -> Figure:
    """Points of each LiDAR on planes along z of the world, from above, by the first guess or by the result."""
    upright = np.array([abs(plane.normal[2]) < MAX_WALL_SLOPE for plane in c.planes])
    traces, ends = [], []
    for r, color in zip(c.lidar_residuals, cycle(COLORS)):
        on_wall = np.flatnonzero(upright[r.plane] & (c.recording_of(r.seconds) == 0))
        some = on_wall[thin(len(on_wall), MAX_WALL_POINTS)]
        x, y = (r.first_world if before else r.world)[some, :2].astype(np.float64).T
        traces.append(dots(x, y, r.sensor, color, 2.5))
        ends.append(r.world[some, :2])
    (x0, x1), (y0, y1) = (shown_range(np.concatenate(ends)[:, k]) for k in range(2))
    across = {"scaleanchor": "x", "range": [y0, y1]}
    return figure(traces, 460, xaxis=axis("world x [m]", range=[x0, x1]), yaxis=axis("world y [m]", **across))


def _cloud(cloud: tuple[np.ndarray, np.ndarray], chosen: np.ndarray, top: float) -> dict[str, Any]:
    """Trace of the points `chosen` (N,) bool of a cloud: points (N, 3) and residuals (N,) [m]; colours end at `top`
    mm."""
    points, residual = (x[chosen] for x in cloud)
    size = np.minimum(np.abs(1e3 * residual.astype(np.float64)), top)
    marker: dict[str, Any] = {"size": 1.6, "color": numbers(np.round(size, 1)), "colorscale": "Viridis"}
    marker |= {"cmin": 0.0, "cmax": top, "colorbar": {"title": {"text": "off its plane [mm]"}, "thickness": 10}}
    rounded = np.round(points.astype(np.float64), 3)
    return path_3d(rounded, "points", "", mode="markers", marker=marker, hoverinfo="skip", showlegend=False)


def _map(traces: list[list[dict[str, Any]]], names: list[str]) -> Figure:
    """Figure with the traces of all recordings. A menu selects one; the first is selected at the start."""
    scene = {name: {"title": {"text": f"world {name[0]} [m]"}, "nticks": 6} for name in ("xaxis", "yaxis", "zaxis")}
    layout: dict[str, Any] = {"scene": scene | VIEW, "margin": {"l": 0, "r": 0, "t": 10, "b": 0}}
    of = [k for k, of_recording in enumerate(traces) for _ in of_recording]
    visible = [trace | {"visible": k == 0} for k, of_recording in enumerate(traces) for trace in of_recording]
    if len(names) > 1:
        choices = [
            {"label": name, "method": "restyle", "args": ["visible", [k == number for k in of]]}
            for number, name in enumerate(names)
        ]
        layout |= {"updatemenus": [{"buttons": choices, "x": 0.0, "xanchor": "left", "y": 1.0, "yanchor": "top"}]}
    return figure(visible, 460, **layout)


def _outlines(planes: tuple[Plane, ...], points: np.ndarray, plane: np.ndarray) -> dict[str, Any]:
    """Trace of a rectangle around the points (N, 3) of each plane, one side level, separated by NaN."""
    pen = []
    for k, p in enumerate(planes):
        on_plane = points[plane == k]
        if not len(on_plane):
            continue
        across = _level_axes(p.normal)
        flat = (on_plane - p.point) @ across.T
        (u0, v0), (u1, v1) = flat.min(axis=0), flat.max(axis=0)
        corners = np.array([(u0, v0), (u1, v0), (u1, v1), (u0, v1), (u0, v0)])
        pen += [p.point + corners @ across, np.full((1, 3), np.nan)]
    path = np.concatenate(pen) if pen else np.zeros((0, 3))
    return path_3d(path, "planes", _WALL, line={"color": _WALL, "width": 2}, showlegend=False, hoverinfo="skip")


def _level_axes(normal: np.ndarray) -> np.ndarray:
    """(2, 3) orthonormal vectors in the plane with the unit `normal` (3,). The first is horizontal unless the plane
    nearly is, see MIN_SLOPE."""
    level = np.array([-normal[1], normal[0], 0.0])
    length = float(np.linalg.norm(level))
    level = level / length if length > MIN_SLOPE else np.array([0.0, normal[2], -normal[1]]) / np.hypot(*normal[1:])
    return np.stack([level, np.cross(normal, level)])


PRESENTER = Presenter(
    sections=sections,
    over_time=residuals_over_time,
    curves=curves,
    clouds=clouds,
    amounts=amounts,
    shape=shape,
    legend=LEGEND,
)
