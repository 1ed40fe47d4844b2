"""Cameras in the report and in the 3D view: residuals in images, uncertainty of each lens, fields of view."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import Any

import numpy as np

from icalib.report.figures import (
    CELL_PX,
    REJECTED,
    Figure,
    ResidualCurve,
    axis,
    cut_marks,
    dots,
    figure,
    line,
    numbers,
    shown_range,
    thin,
)
from icalib.report.page import Group, Plot, Presenter, Section
from icalib.report.rig_figures import PEN_UP
from icalib.result import Calibration, ProjectionMap, projection_uncertainty, working_distance
from icalib.result.quantities import format_number
from icalib.sensors.camera.stream import ImageResiduals, image_of

# Figures of the residuals (predicted - measured) of one camera, for corners or tracked points.

MOST_DOTS = 2500  # dots of each kind in one figure; more are thinned out
BINS = 60
WIDEST_CELL = 98.0  # percentile of the cells of an image at which colours and arrows end
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
    rms, keep = r.rms_of_images, thin(len(r.seconds), MOST_DOTS)
    top = shown_range(size[used])[1]
    seconds, clipped, out = r.seconds[image_of(r)], "rejected (clipped to the frame)", used[size[used] > top]
    return figure(
        [
            dots(seconds[some], size[some], r.kind, "#93b7dc"),
            *([cut_marks(seconds[out], size[out], 0.0, top)] if len(out) else []),
            *([dots(seconds[few], np.minimum(size[few], top), clipped, REJECTED, 4)] if len(few) else []),
            line(r.seconds[keep], rms[keep], "RMS of an image, per coordinate", "#0f2f57"),
        ],
        400,
        xaxis=axis("time [s]"),
        yaxis=axis("residual [px]", range=[0.0, 1.03 * top]),
    )


def residuals_over_image(r: ImageResiduals, resolution: tuple[int, int]) -> Figure:
    """RMS residual in cells of the image [px], with the mean residual of each cell as a magnified arrow. Colours and
    arrows are cut at a percentile of the cells. resolution: width and height [px]."""
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
        "zmax": float(np.nanpercentile(rms, WIDEST_CELL)) if np.isfinite(rms).any() else 1.0,
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
    """Traces of arrows at the points `at` (n, 2) along the mean residuals (n, 2) [px]. At a percentile they are one
    cell long, and longer ones are cut; a dot marks the start of each."""
    length = np.linalg.norm(mean, axis=1)
    longest = float(np.nanmax(length, initial=0.0))
    if longest == 0.0:
        return []
    gain = CELL_PX / float(np.nanpercentile(length, WIDEST_CELL))
    tip = at + np.minimum(gain, CELL_PX / np.maximum(length, 1e-12))[:, None] * mean
    pieces = np.stack([at, tip, np.full_like(at, np.nan)], axis=1).reshape(-1, 2)
    foot = at[np.isfinite(length)]
    name = f"mean, x{gain:.0f} (longest {longest:.3f} px)"
    return [
        line(pieces[:, 0], pieces[:, 1], name, "#111827", hoverinfo="skip"),
        dots(foot[:, 0], foot[:, 1], "", "#111827", 3, showlegend=False, hoverinfo="skip"),
    ]


LEGEND = "pyramids are fields of view"
_KIND_WORDS = {"corners": "corners", "observations": "observations of points that were followed"}
_IMAGE_WORDS = (
    "Predicted - measured, of corners of the target and of tracked points of the scene. A good calibration leaves a"
    " round cloud about zero, and arrows without a pattern. What was rejected stays in the data and is red. At most"
    f" {MOST_DOTS} dots of a kind are drawn, evenly picked; densities, cells, RMS and histograms use "
    f"all that is in use. Colours and arrows of the image end at {WIDEST_CELL:g} % of its cells."
)
_LENS_WORDS = (
    "Standard deviation, in its worst direction, of where a camera projects points, from the covariance of its "
    "intrinsics and distortion, empirical factors included. The pose change that best absorbs an error of the lens "
    "over the region where the camera saw points (dots) is removed first. Users of this lens with the extrinsics "
    "found beside it do not meet that part. Errors that no lens of this model can follow are not in it; they show in "
    "the residuals."
)


def sections(c: Calibration) -> Iterator[Section]:
    """Sections of the report: residuals in images, if there are any, and the projection uncertainty of each lens."""
    if c.image_residuals:
        groups = [Group(r.sensor, _residual_plots(c, i, r), _counts(r)) for i, r in enumerate(c.image_residuals)]
        yield Section("images", "Residuals in the images", _IMAGE_WORDS, groups)
    if c.cameras:
        yield _projection_section(c)


def _residual_plots(c: Calibration, i: int, r: ImageResiduals) -> list[Plot]:
    width, height = c.rig["sensors"][r.sensor]["resolution"]
    return [
        Plot(f"plane-{i}", residual_plane(r), "Distribution"),
        Plot(f"image-{i}", residuals_over_image(r, (width, height)), "Over the image"),
        Plot(f"time-{i}", residuals_over_time(r), "Over time", wide=True),
    ]


def _counts(r: ImageResiduals) -> str:
    """Text with the numbers of residuals that are used, rejected, and left out with their tracks."""
    used, rejected = int(r.used.sum()), int(r.rejected.sum())
    left_out = len(r.uv) - used - rejected
    more = f", {left_out} left out with their tracks" if left_out else ""
    return f"{used} {r.kind} used, {rejected} rejected{more}"


def _projection_section(c: Calibration) -> Section:
    """Section with maps of projection uncertainty, named `projection-i-0` and `projection-i-1` for camera i.

    A camera with a fixed lens has a sentence instead."""
    groups = []
    for i, name in enumerate(c.cameras):
        size, residuals = c.rig["sensors"][name]["resolution"], [r for r in c.image_residuals if r.sensor == name]
        maps = [
            Plot(f"projection-{i}-{k}", projection_figure(m, residuals, size), map_title(m), map_words(m))
            for k, m in enumerate(projection_maps(c, name))
        ]
        fixed = f"{name}: intrinsics and distortion are fixed by the rig file, and taken as exact."
        groups.append(Group(plots=maps, words="" if maps else fixed))
    return Section("projection", "How well each lens is known", _LENS_WORDS, groups)


def curves(r: ImageResiduals) -> Iterator[ResidualCurve]:
    """Curve of the residual RMS [px] per image over time, for images with points in use."""
    rms = r.rms_of_images
    some = np.isfinite(rms)
    yield ResidualCurve(r.kind, r.seconds[some], rms[some, None], (f"RMS of {r.kind} [px]",))


def amounts(c: Calibration) -> Iterator[str]:
    """Text with the numbers of images, corners and track observations."""
    if c.cameras:
        images = sum(len(r.seconds) for r in c.corner_residuals)
        counts = {kind: sum(len(r.uv) for r in c.image_residuals if r.kind == kind) for kind in _KIND_WORDS}
        words = " and ".join(f"{n} {_KIND_WORDS[kind]}" for kind, n in counts.items() if n)
        yield f"{images} images with {words or 'nothing in them'}"


def shape(c: Calibration, name: str, spread: float) -> np.ndarray:
    """Line vertices (n, 3) [m] of the camera's field of view, in its frame; spread: extent of the rig [m]."""
    return _frustum(c, name, 0.45 * spread)


def _frustum(c: Calibration, name: str, depth: float) -> np.ndarray:
    """Line vertices (n, 3) [m] of the pyramid of the field of view up to `depth` [m], in the camera frame.

    Distortion is ignored, and each side is at most 60 deg from the axis."""
    fx, fy, cx, cy = c.group(name, "intrinsics").value
    width, height = c.rig["sensors"][name]["resolution"]
    u, v = np.array([0, width, width, 0]) - 0.5, np.array([0, 0, height, height]) - 0.5
    widest = np.tan(np.deg2rad(60.0))
    a, b = np.clip((u - cx) / fx, -widest, widest), np.clip((v - cy) / fy, -widest, widest)
    corners = depth * np.stack([a, b, np.ones(4)], axis=1)
    origin = np.zeros(3)
    return np.vstack([corners, corners[:1], PEN_UP, *(np.stack([origin, p, PEN_UP[0]]) for p in corners)])


# Maps of the projection uncertainty of a camera [px].

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
    where = "far away" if np.isinf(m.range_m) else f"{format_number(m.range_m)} m away, like those it saw"
    return f"{m.camera}: points {where}"


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


PRESENTER = Presenter(
    sections=sections,
    over_time=residuals_over_time,
    curves=curves,
    amounts=amounts,
    shape=shape,
    legend=LEGEND,
)
