"""Figures of the rig in 3D, and of the correlation of its parameters."""

from __future__ import annotations

from typing import Any

import numpy as np

from icalib.report import rig_shapes
from icalib.report.ellipsoids import VERDICT_COLORS, Ellipsoid, ellipsoids, magnification, outline
from icalib.report.plot import AXIS_COLORS, COLORS, VIEW, Figure, axis, figure, numbers, path_3d
from icalib.report.rig_shapes import PEN_UP
from icalib.result import Calibration


def rig_picture(c: Calibration) -> Figure:
    """Axes and shapes of all sensors in the imu frame [m], with magnified ellipsoids of their position uncertainty."""
    frames, spread = rig_shapes.frames_of(c), rig_shapes.spread_of(c)
    origins = np.array([T[:3, 3] for T in frames.values()])
    traces = [
        path_3d(
            _axis_line(frames, i, 0.25 * spread), "xyz"[i], AXIS_COLORS[i], line={"color": AXIS_COLORS[i], "width": 6}
        )
        for i in range(3)
    ]
    shapes = [(name, pen) for name in c.mounted if (pen := rig_shapes.shape_of(c, name)) is not None]
    for i, (name, pen) in enumerate(shapes):
        color, T = COLORS[i % len(COLORS)], frames[name]
        traces.append(path_3d(pen @ T[:3, :3].T + T[:3, 3], name, color, line={"color": color, "width": 2}))
    factor = magnification(c)
    traces += [_uncertainty(e, frames[e.sensor][:3, 3], factor) for e in ellipsoids(c)]
    traces.append(
        path_3d(
            origins, "sensors", "#111827", mode="markers+text", text=list(frames), marker={"size": 4}, showlegend=False
        )
    )
    scene = {
        name: {"title": {"text": f"{name[0]} of {c.reference} [m]"}, "nticks": 5}
        for name in ("xaxis", "yaxis", "zaxis")
    }
    return figure(traces, 520, scene=scene | VIEW, margin={"l": 0, "r": 0, "t": 30, "b": 0})


def _axis_line(frames: dict[str, np.ndarray], i: int, length: float) -> np.ndarray:
    """(n, 3) line of this length [m] along axis i of each frame."""
    pieces = [np.stack([T[:3, 3], T[:3, 3] + length * T[:3, i]]) for T in frames.values()]
    return np.concatenate([np.vstack([p, PEN_UP]) for p in pieces])


def _uncertainty(e: Ellipsoid, origin: np.ndarray, factor: float) -> dict[str, Any]:
    color = VERDICT_COLORS[e.verdict]
    return path_3d(outline(e, factor) + origin, f"{e.sensor}: {e.verdict}", color, line={"color": color, "width": 3})


def correlation(c: Calibration) -> Figure:
    """Correlation coefficients of all estimated parameters except scene planes, from the formal covariance."""
    planes = {p.name for p in c.planes}
    columns = [i for i, name in enumerate(c.covariance_names) if name.rsplit(".", 2)[0] not in planes]
    covariance = c.covariance[np.ix_(columns, columns)]
    std = np.sqrt(np.diag(covariance))
    scale = np.where(std > 0.0, std, 1.0)
    rho = covariance / np.outer(scale, scale)
    names = [c.covariance_names[i].replace("time_offset.time_offset", "time_offset") for i in columns]
    heat = {
        "type": "heatmap",
        "z": numbers(np.round(rho, 3)),
        "x": names,
        "y": names,
        "zmin": -1,
        "zmax": 1,
        "colorscale": [[0, "#b2182b"], [0.25, "#f4a582"], [0.5, "#ffffff"], [0.75, "#92c5de"], [1, "#2166ac"]],
        "colorbar": {"title": {"text": "correlation"}, "thickness": 12},
        "hovertemplate": "%{y}<br>%{x}<br>%{z:.3f}<extra></extra>",
    }
    small = {"tickfont": {"size": 9 if len(names) < 60 else 6}, "automargin": True, "dtick": 1}
    height = int(np.clip(14 * len(names) + 190, 380, 1100))
    return figure([heat], height, xaxis=axis("", tickangle=-90, **small), yaxis=axis("", autorange="reversed", **small))
