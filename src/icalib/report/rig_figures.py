"""Pictures of the rig, of its uncertainty and of its motion."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from icalib.geometry import so3
from icalib.geometry.targets import Target, target_from_plain
from icalib.kinds import presenters
from icalib.report.figures import (
    AXIS_COLORS,
    COLORS,
    VIEW,
    Figure,
    axis,
    figure,
    line,
    numbers,
    path_3d,
    stacked_panels,
    thin,
)
from icalib.result import Calibration, joint_covariance
from icalib.result.pictures import scene_in_worlds
from icalib.result.verdict import worst

# Figures of the rig in 3D, and of the correlation of its parameters.


def rig_picture(c: Calibration) -> Figure:
    """Axes and shapes of all sensors in the imu frame [m], with magnified ellipsoids of their position uncertainty."""
    frames, spread = frames_of(c), spread_of(c)
    origins = np.array([T[:3, 3] for T in frames.values()])
    traces = _axes(list(frames.values()), 0.25 * spread)
    shapes = [(name, pen) for name in c.mounted if (pen := shape_of(c, name)) is not None]
    for i, (name, pen) in enumerate(shapes):
        color, T = COLORS[i % len(COLORS)], frames[name]
        traces.append(path_3d(pen @ T[:3, :3].T + T[:3, 3], name, color, line={"color": color, "width": 2}))
    factor = magnification(c)
    traces += [_uncertainty(e, frames[e.sensor][:3, 3], factor, spread) for e in ellipsoids(c)]
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


def _axes(frames: Sequence[np.ndarray], length: float) -> list[dict[str, Any]]:
    """Traces of the axes of frames T (4, 4), lines of this length [m]."""
    lines = [
        np.concatenate([np.vstack([T[:3, 3], T[:3, 3] + length * T[:3, i], PEN_UP]) for T in frames]) for i in range(3)
    ]
    styles = [{"color": color, "width": 6} for color in AXIS_COLORS]
    return [path_3d(lines[i], "xyz"[i], AXIS_COLORS[i], line=styles[i]) for i in range(3)]


def _uncertainty(e: Ellipsoid, origin: np.ndarray, factor: float, longest: float) -> dict[str, Any]:
    """Trace of an ellipsoid, whose axes are cut at a half length of `longest` [m]."""
    color, short = VERDICT_COLORS[e.verdict], np.minimum(factor * e.half_sizes, longest)
    name = f"{e.sensor}: {e.verdict}{', cut' if (factor * e.half_sizes > longest).any() else ''}"
    style = {"color": color, "width": 3}
    return path_3d(outline(replace(e, half_sizes=short), 1.0) + origin, name, color, line=style)


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


# Shapes of sensors and targets as polylines, for the report and the 3D view.

PEN_UP = np.full((1, 3), np.nan)  # separates two polylines: a row of NaN
_ROUND = np.linspace(0.0, 2.0 * np.pi, 41)
CIRCLE = np.stack([np.cos(_ROUND), np.sin(_ROUND)], axis=1)
_LEAST_SPREAD_M = 0.02


def frames_of(c: Calibration) -> dict[str, np.ndarray]:
    """T_imu_sensor (4, 4) of the reference (identity) and of each mounted sensor, by name."""
    return {c.reference: np.eye(4)} | {name: c.T_imu_sensor(name) for name in c.mounted}


def spread_of(c: Calibration) -> float:
    """Size of the rig [m], which scales the drawn shapes: largest extent of the sensor origins along an axis of the imu
    frame."""
    origins = np.array([T[:3, 3] for T in frames_of(c).values()])
    return max(float(np.ptp(np.vstack([origins, np.zeros(3)]), axis=0).max()), _LEAST_SPREAD_M)


def shape_of(c: Calibration, name: str) -> np.ndarray | None:
    """(n, 3) polylines of a sensor's shape in the sensor frame [m]; None if its kind has no shape."""
    return presenters()[c.rig["sensors"][name]["type"]].shape(c, name, spread_of(c))


def legends(c: Calibration) -> list[str]:
    """Explanations of the shapes of all kinds of sensors in the rig."""
    return [p.legend for kind, p in presenters().items() if p.legend and c.of_type(kind)]


def body_outline(target: Target, body: int) -> np.ndarray:
    """(6, 3) bounding rectangle of a body of the target [m], closed, in the plane z = 0 of its frame. The last row is
    NaN."""
    (x0, y0, _), (x, y, _) = (f(target.points[target.body == body], axis=0) for f in (np.min, np.max))
    corners = np.array([(x0, y0, 0.0), (x, y0, 0.0), (x, y, 0.0), (x0, y, 0.0), (x0, y0, 0.0)])
    return np.vstack([corners, PEN_UP])


# Ellipsoids of the position uncertainty of each sensor, for the report and the 3D view.

SIGMAS = 3.0
VERDICT_COLORS = {"determined": "#15803d", "weak": "#d97706", "too uncertain": "#dc2626", "unobservable": "#dc2626"}
_LARGEST = 0.4  # largest half size of determined ellipsoids when magnified, as a fraction of the rig's size


@dataclass(frozen=True)
class Ellipsoid:
    """Uncertainty ellipsoid of a sensor's position in the imu frame. axes (3, 3): unit vectors of the principal axes as
    columns. half_sizes (3,): half lengths of these axes [m], SIGMAS standard deviations with empirical factors.
    verdict: the worst of the three components."""

    sensor: str
    verdict: str
    axes: np.ndarray
    half_sizes: np.ndarray


def ellipsoids(c: Calibration) -> list[Ellipsoid]:
    """Uncertainty ellipsoids of all estimated translations."""
    shapes = []
    for name in c.mounted:
        group = c.group(name, "translation")
        if group.columns is None:
            continue
        values, axes = np.linalg.eigh(joint_covariance(c, [group]))
        axes[:, 0] *= np.sign(np.linalg.det(axes))
        shapes.append(Ellipsoid(name, worst(group.verdict), axes, SIGMAS * np.sqrt(np.maximum(values, 0.0))))
    return shapes


def magnification(c: Calibration) -> float:
    """Largest power of ten, at least 1, by which all determined ellipsoids can be magnified and stay smaller than the
    rig. If none is determined, the smallest ellipsoid is used."""
    sizes = [(e.verdict, float(e.half_sizes.max())) for e in ellipsoids(c)]
    reference_sizes = [size for verdict, size in sizes if verdict == "determined"] or [
        min((x for _, x in sizes), default=0.0)
    ]
    if not 0.0 < max(reference_sizes) < np.inf:
        return 1.0
    return max(1.0, 10.0 ** float(np.floor(np.log10(_LARGEST * spread_of(c) / max(reference_sizes)))))


def outline(e: Ellipsoid, factor: float) -> np.ndarray:
    """(n, 3) polylines [m]: three ellipses in the principal planes, centred at the origin, magnified by `factor`, with
    the axes of the imu frame. Rows of NaN separate the ellipses."""
    x, y = CIRCLE.T
    circles = [np.insert(np.stack([x, y], axis=1), k, 0.0, axis=1) for k in range(3)]
    return np.vstack([p for c in circles for p in (factor * (c * e.half_sizes) @ e.axes.T, PEN_UP)])


# Figures of the trajectory, its derivatives, and the convergence of the solver.

MAX_PLOTTED_KEYFRAMES = 1500


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
    """Trajectory of the reference frame in the world frame, coloured by time, or its axes at each stop, with the
    outlines of the target."""
    path = c.trajectory
    keep = thin(len(path.seconds), MAX_PLOTTED_KEYFRAMES)
    color = {"color": numbers(path.seconds[keep]), "colorscale": "Viridis", "width": 4}
    color |= {"showscale": True, "colorbar": {"title": {"text": "time [s]"}, "thickness": 10}}
    ends, words = path.position[[0, -1]], {"mode": "markers+text", "text": ["start", "end"], "showlegend": False}
    traces = [path_3d(_lifted(c, path.position)[keep], c.reference, "", line=color, showlegend=False)]
    if not c.rates:  # of stops, which no motion connects
        stops = np.tile(np.eye(4), (len(keep), 1, 1))
        stops[:, :3, :3], stops[:, :3, 3] = path.rotation[keep], path.position[keep]
        traces = _axes(list(stops), 0.1 * float(np.ptp(path.position, axis=0).max()))
    traces += [path_3d(ends, "ends", "#111827", marker={"size": 3}, **words), *_board(c)]
    scene = {name: {"title": {"text": f"world {name[0]} [m]"}, "nticks": 6} for name in ("xaxis", "yaxis", "zaxis")}
    return figure(traces, 520, scene=scene | VIEW, margin={"l": 0, "r": 0, "t": 30, "b": 0})


def _board(c: Calibration) -> list[dict]:
    """Outlines of the target's bodies in the world frame of each recording."""
    target, stands = target_from_plain(c.rig), scene_in_worlds(c)
    if target is None or not stands:
        return []
    bodies = c.bodies or target.bodies
    outline = np.concatenate([_outline(c, target, target.bodies.index(body)) for body in bodies])
    return [path_3d(outline @ R.T, name, "#be185d") for name, R in stands]


def _outline(c: Calibration, target: Target, body: int) -> np.ndarray:
    """(6, 3) rectangle around a body in the scene frame [m]; the last row is NaN."""
    T = c.T_scene_body(target.bodies[body]) if c.bodies else np.eye(4)
    return body_outline(target, body) @ T[:3, :3].T + T[:3, 3]


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
