"""Figures of the trajectory, its derivatives, and the convergence of the solver."""

from __future__ import annotations

import numpy as np

from icalib.geometry import so3
from icalib.geometry.targets import Target, target_from_plain
from icalib.report import rig_shapes
from icalib.report.plot import (
    AXIS_COLORS,
    COLORS,
    VIEW,
    Figure,
    axis,
    figure,
    line,
    numbers,
    path_3d,
    stacked_axes,
    thin,
    y_of,
)
from icalib.result import Calibration

MAX_PLOTTED_KEYFRAMES = 2000


def motion(c: Calibration) -> Figure:
    """Angular rate, speed and biases over time."""
    path = c.trajectory
    steps = np.diff(path.seconds)
    between = np.einsum("kji,kjl->kil", path.rotation[:-1], path.rotation[1:])
    rate = so3.log_many(np.ascontiguousarray(between)) / steps[:, None]
    rate[_seams(c)] = np.nan
    keep, inner = thin(len(path.seconds), MAX_PLOTTED_KEYFRAMES), thin(len(steps), MAX_PLOTTED_KEYFRAMES)
    t = path.seconds
    panels = [
        (t[:-1][inner] + 0.5 * steps[inner], np.rad2deg(rate[inner])),
        (t[keep], _lifted(c, path.velocity)[keep]),
        (t[keep], np.rad2deg(_lifted(c, path.gyro_bias)[keep])),
        (t[keep], _lifted(c, path.accel_bias)[keep]),
    ]
    titles = ("rate [deg/s]", "velocity [m/s]", "gyro bias [deg/s]", "accel bias [m/s^2]")
    return stacked_panels(panels, titles, 640)


def trajectory(c: Calibration) -> Figure:
    """Trajectory of the reference frame in the world frame, coloured by time, with the outlines of the target."""
    path = c.trajectory
    keep = thin(len(path.seconds), MAX_PLOTTED_KEYFRAMES)
    color = {"color": numbers(path.seconds[keep]), "colorscale": "Viridis", "width": 4}
    color |= {"showscale": True, "colorbar": {"title": {"text": "time [s]"}, "thickness": 10}}
    ends = path.position[[0, -1]]
    traces = [
        path_3d(_lifted(c, path.position)[keep], c.reference, "", line=color, showlegend=False),
        path_3d(
            ends, "ends", "#111827", mode="markers+text", text=["start", "end"], marker={"size": 3}, showlegend=False
        ),
        *_board(c),
    ]
    scene = {name: {"title": {"text": f"world {name[0]} [m]"}, "nticks": 6} for name in ("xaxis", "yaxis", "zaxis")}
    return figure(traces, 520, scene=scene | VIEW, margin={"l": 0, "r": 0, "t": 30, "b": 0})


def _board(c: Calibration) -> list[dict]:
    """Outlines of the target's bodies in the world frame of each recording."""
    target, stands = target_from_plain(c.rig), rig_shapes.scene_in_worlds(c)
    if target is None or not stands:
        return []
    bodies = c.bodies or target.bodies
    outline = np.concatenate([_outline(c, target, target.bodies.index(body)) for body in bodies])
    return [path_3d(outline @ R.T, name, "#be185d") for name, R in stands]


def _outline(c: Calibration, target: Target, body: int) -> np.ndarray:
    """(6, 3) rectangle around a body in the scene frame [m]; the last row is NaN."""
    T = c.T_scene_body(target.bodies[body]) if c.bodies else np.eye(4)
    return rig_shapes.body_outline(target, body) @ T[:3, :3].T + T[:3, 3]


def _seams(c: Calibration) -> np.ndarray:
    """Indices of the last keyframe of each recording except the last recording."""
    return np.flatnonzero(np.diff(c.recording_of(c.trajectory.seconds)))


def _lifted(c: Calibration, values: np.ndarray) -> np.ndarray:
    """Copy of values (K, 3) at the keyframes with NaN at `_seams`, so that no line joins two recordings."""
    out = values.copy()
    out[_seams(c)] = np.nan
    return out


def convergence(c: Calibration) -> Figure:
    """Cost and predicted decrease at each step of the solver, one colour for each stage. Crosses are rejected steps."""
    step = np.arange(1, len(c.iterations) + 1, dtype=float)
    traces = []
    for i, stage in enumerate(dict.fromkeys(s.stage for s in c.iterations)):
        of = np.array([s.stage == stage for s in c.iterations])
        cost = np.array([s.cost for s in c.iterations])[of]
        kept = np.array([s.accepted for s in c.iterations])[of]
        color = COLORS[i % len(COLORS)]
        marker = {"size": 8, "color": color, "symbol": np.where(kept, "circle", "x").tolist()}
        traces.append(line(step[of], cost, f"cost, {stage}", color, mode="lines+markers", marker=marker))
    predicted = np.array([s.predicted_decrease for s in c.iterations])
    dashed = {"color": "#6b7280", "dash": "dot"}
    traces.append(
        line(step, np.where(predicted > 0.0, predicted, np.nan), "predicted decrease", "#6b7280", line=dashed)
    )
    log = axis("cost (chi^2 / 2)", type="log", exponentformat="power")
    return figure(traces, 380, xaxis=axis("step (x: rejected)", dtick=max(1, len(step) // 12)), yaxis=log)


def stacked_panels(panels: list[tuple[np.ndarray, np.ndarray]], titles: tuple[str, ...], height: int) -> Figure:
    """Stacked panels with lines of x, y and z. panels: times (n,) and values (n, 3) of each; height [px]."""
    traces = [
        line(
            t,
            v[:, i],
            "xyz"[i],
            AXIS_COLORS[i],
            yaxis=y_of(p),
            showlegend=p == 0,
            line={"color": AXIS_COLORS[i], "width": 1},
        )
        for p, (t, v) in enumerate(panels)
        for i in range(3)
    ]
    return figure(traces, height, **stacked_axes(list(titles)))
