"""Figures of the residuals (predicted - measured) of one camera, for corners or tracked points."""

from __future__ import annotations

from typing import Any

import numpy as np

from icalib.report.plot import REJECTED, Figure, axis, dots, figure, line, numbers, thin
from icalib.sensors.camera.record import ImageResiduals, image_of, rms_of_images

MOST_DOTS = 2500  # dots of each kind in one figure; more are thinned out
BINS = 60
CELL_PX = 40
FEWEST_IN_CELL = 5


def residual_plane(r: ImageResiduals) -> Figure:
    """Two-dimensional histogram of the residuals (u, v) in use. Crosses mark rejected observations that have a
    residual."""
    used = r.residual[r.used]
    reach = 1.3 * float(np.quantile(np.abs(used), 0.999)) if len(used) else 1.0
    edges = np.linspace(-reach, reach, BINS + 1)
    count, _, _ = np.histogram2d(used[:, 1], used[:, 0], bins=[edges, edges])
    middle = 0.5 * (edges[1:] + edges[:-1])
    heat = {
        "type": "heatmap",
        "x": numbers(middle),
        "y": numbers(middle),
        "z": [[value or None for value in row] for row in count.tolist()],
        "colorscale": [[0, "#dbeafe"], [0.5, "#4a86c5"], [1, "#0b2545"]],
        "colorbar": {"title": {"text": r.kind}, "thickness": 10},
        "hovertemplate": "u %{x} px, v %{y} px: %{z}<extra></extra>",
    }
    far = r.residual[_measured(r)]
    far = far[thin(len(far), MOST_DOTS)]
    cross = {"color": REJECTED, "size": 5, "symbol": "x-thin", "line": {"color": REJECTED, "width": 1}}
    outside = int((np.abs(far) > 2.0 * reach).any(axis=1).sum())
    name = "rejected" + (f" ({outside} beyond the frame)" if outside else "")
    marks = dots(far[:, 0], far[:, 1], name, REJECTED, marker=cross)
    window = {"range": [-2.0 * reach, 2.0 * reach]}
    return figure(
        [heat, marks] if len(far) else [heat],
        400,
        xaxis=axis("u residual [px]", **window),
        yaxis=axis("v residual [px]", scaleanchor="x", constrain="domain", **window),
    )


def residuals_over_time(r: ImageResiduals) -> Figure:
    """Length of each residual and RMS of each image over time [px]."""
    size = np.linalg.norm(r.residual, axis=1)
    used, rejected = np.flatnonzero(r.used), np.flatnonzero(_measured(r))
    some, few = used[thin(len(used), MOST_DOTS)], rejected[thin(len(rejected), MOST_DOTS)]
    rms, keep = rms_of_images(r), thin(len(r.seconds), MOST_DOTS)
    top = 1.5 * float(size[used].max(initial=1e-3))
    seconds, clipped = r.seconds[image_of(r)], "rejected (clipped to the frame)"
    return figure(
        [
            dots(seconds[some], size[some], r.kind, "#93b7dc"),
            *([dots(seconds[few], np.minimum(size[few], top), clipped, REJECTED, 4)] if len(few) else []),
            line(r.seconds[keep], rms[keep], "RMS of an image, per coordinate", "#0f2f57"),
        ],
        400,
        xaxis=axis("time [s]"),
        yaxis=axis("residual [px]", rangemode="tozero"),
    )


def residuals_over_image(r: ImageResiduals, resolution: tuple[int, int]) -> Figure:
    """RMS residual in cells of the image [px], with the mean residual of each cell as a magnified arrow. resolution:
    width and height [px]."""
    width, height = resolution
    nx, ny = max(1, round(width / CELL_PX)), max(1, round(height / CELL_PX))
    x, y = np.clip(r.uv[r.used], 0, [width - 1, height - 1]).T
    cell = (y * ny / height).astype(int) * nx + (x * nx / width).astype(int)
    error = r.residual[r.used]
    count = np.bincount(cell, minlength=nx * ny)
    enough = np.where(count >= FEWEST_IN_CELL, count, np.nan)
    mean = np.stack([np.bincount(cell, error[:, i], minlength=nx * ny) / enough for i in range(2)], axis=1)
    rms = np.sqrt(np.bincount(cell, (error**2).sum(axis=1), minlength=nx * ny) / (2.0 * enough))
    u, v = (np.arange(nx) + 0.5) * width / nx, (np.arange(ny) + 0.5) * height / ny
    heat = {
        "type": "heatmap",
        "x": numbers(u),
        "y": numbers(v),
        "z": numbers(rms.reshape(ny, nx)),
        "colorscale": "YlGnBu",
        "reversescale": True,
        "zmin": 0,
        "colorbar": {"title": {"text": "RMS [px]"}, "thickness": 10},
        "hovertemplate": "RMS %{z} px<extra></extra>",
    }
    rejected = r.uv[r.rejected][thin(int(r.rejected.sum()), MOST_DOTS)]
    traces = [heat, *_arrows(np.stack(np.meshgrid(u, v), axis=-1).reshape(-1, 2), mean)]
    if len(rejected):
        traces.append(dots(rejected[:, 0], rejected[:, 1], "rejected", REJECTED))
    return figure(
        traces,
        400,
        xaxis=axis("u [px]", range=[-0.5, width - 0.5], constrain="domain"),
        yaxis=axis("v [px]", range=[height - 0.5, -0.5], scaleanchor="x", constrain="domain"),
    )


def _measured(r: ImageResiduals) -> np.ndarray:
    """(N,) bool: rejected observations that have a residual."""
    return r.rejected & np.isfinite(r.residual[:, 0])


def _arrows(at: np.ndarray, mean: np.ndarray) -> list[dict[str, Any]]:
    """Traces of arrows at the points `at` (n, 2) along the mean residuals (n, 2) [px]. The longest is one cell long; a
    dot marks the start of each."""
    length = np.linalg.norm(mean, axis=1)
    longest = float(np.nanmax(length, initial=0.0))
    if longest == 0.0:
        return []
    gain = CELL_PX / longest
    tip = at + gain * mean
    pieces = np.stack([at, tip, np.full_like(at, np.nan)], axis=1).reshape(-1, 2)
    foot = at[np.isfinite(length)]
    name = f"mean, x{gain:.0f} (longest {longest:.3f} px)"
    return [
        line(pieces[:, 0], pieces[:, 1], name, "#111827", hoverinfo="skip"),
        dots(foot[:, 0], foot[:, 1], "", "#111827", 3, showlegend=False, hoverinfo="skip"),
    ]
