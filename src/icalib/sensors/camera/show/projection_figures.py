"""Maps of the projection uncertainty of a camera [px]."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from icalib.report.plot import Figure, axis, dots, figure, numbers, thin
from icalib.result import Calibration, ProjectionMap, projection_uncertainty, working_distance
from icalib.result.quantities import format_number
from icalib.sensors.camera.record import ImageResiduals

MOST_RESIDUAL_DOTS = 1500
WIDEST = 6.0  # end of the colour scale, in medians over the seen cells, so that edges without data do not set it
LEVELS = 9  # least number of contours
UNOBSERVED_RATIO = 3.0  # worst over median sigma, above which the page asks for observations near the worst pixel


def projection_maps(c: Calibration, camera: str) -> list[ProjectionMap]:
    """Projection uncertainty maps at infinity and at the working distance; empty if the rig file fixes the lens."""
    if all(c.group(camera, name).columns is None for name in ("intrinsics", "distortion")):
        return []
    ranges = [np.inf, *(x for x in [working_distance(c, camera)] if x is not None)]
    maps = (projection_uncertainty(c, camera, x) for x in ranges)
    return [m for m in maps if m is not None]


def projection_figure(m: ProjectionMap, residuals: Sequence[ImageResiduals], resolution: tuple[int, int]) -> Figure:
    """Standard deviation over the image with contours [px], and the observations in `residuals`. resolution:
    width and height [px]."""
    width, height = resolution
    top = float(min(np.nanmax(m.sigma), WIDEST * m.median_seen))
    step = _round(top / LEVELS)
    heat: dict[str, Any] = {
        "type": "contour",
        "x": numbers(m.u),
        "y": numbers(m.v),
        "z": numbers(m.sigma),
        "zmin": 0,
        "zmax": top,
        "colorscale": [[0, "#f0f9e8"], [0.25, "#a8ddb5"], [0.55, "#43a2ca"], [1, "#0868ac"]],
        "contours": {"start": step, "end": top, "size": step, "showlabels": True},
        "line": {"width": 1, "color": "#1f2937"},
        "colorbar": {"title": {"text": "std [px]"}, "thickness": 10},
        "hovertemplate": "u %{x}, v %{y}: %{z} px<extra></extra>",
    }
    heat["contours"] |= {"coloring": "heatmap", "labelfont": {"size": 10, "color": "#111827"}}
    traces = [heat]
    for r in residuals:
        used = r.uv[r.used]
        used = used[thin(len(used), MOST_RESIDUAL_DOTS)]
        marker = {"color": "#b45309", "size": 2.5, "opacity": 0.35}
        traces.append(dots(used[:, 0], used[:, 1], r.kind, "", marker=marker, hoverinfo="skip"))
    return figure(
        traces,
        330,
        xaxis=axis("u [px]", range=[-0.5, width - 0.5], constrain="domain"),
        yaxis=axis("v [px]", range=[height - 0.5, -0.5], scaleanchor="x", constrain="domain"),
    )


def _round(step: float) -> float:
    """Largest of 1, 2 or 5 times a power of ten that is not above `step`; 1 if `step` is not positive."""
    if not step > 0.0:
        return 1.0
    power = 10.0 ** np.floor(np.log10(step))
    return float(power * max(k for k in (1.0, 2.0, 5.0) if k * power <= 1.001 * step))


def map_title(m: ProjectionMap) -> str:
    """Title of a map: the distance of the points."""
    return "Points far away" if np.isinf(m.range_m) else f"Points {format_number(m.range_m)} m away, like those it saw"


def map_words(m: ProjectionMap) -> str:
    """Text on a map: the median and the largest standard deviation, and what they mean."""
    size, u, v = m.worst
    where = "where it saw points" if m.seen.any() else "over the image"
    motion = "turned" if np.isinf(m.range_m) else "turned and moved"
    text = (
        f"Known to {format_number(m.median_seen)} px {where} (median), to {format_number(size)} px at the worst, at "
        f"pixel ({u:.0f}, {v:.0f}): by so much, one standard deviation, this camera disagrees with the true one that "
        f"is {motion} to fit it best."
    )
    worse = size > UNOBSERVED_RATIO * m.median_seen and m.seen.any()
    return text + (" Let it see points there, too, and the lens is known there." if worse else "")
