"""Cameras in the report and in the 3D view: residuals in images, uncertainty of each lens, fields of view."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from icalib.report.residual_views import ResidualCurve
from icalib.report.rig_shapes import PEN_UP
from icalib.report.sections import Section, plot_place
from icalib.report.tables import Html, element, html
from icalib.result import Calibration
from icalib.sensors.camera.record import ImageResiduals, rms_of_images
from icalib.sensors.camera.show import image_figures, projection_figures

LEGEND = "pyramids are fields of view"
_KIND_WORDS = {"corners": "corners", "observations": "observations of points that were followed"}
_IMAGE_WORDS = (
    "Predicted - measured, of corners of the target and of tracked points of the scene. A good calibration leaves a"
    " round cloud about zero, and arrows without a pattern. What was rejected stays in the data and is red. At most"
    f" {image_figures.MOST_DOTS} dots of a kind are drawn, evenly picked; densities, cells, RMS and histograms use "
    "all that is in use."
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
        figures, parts = {}, []
        for i, r in enumerate(c.image_residuals):
            width, height = c.rig["sensors"][r.sensor]["resolution"]
            figures[f"plane-{i}"] = image_figures.residual_plane(r)
            figures[f"image-{i}"] = image_figures.residuals_over_image(r, (width, height))
            figures[f"time-{i}"] = image_figures.residuals_over_time(r)
            plots = [plot_place(f"{kind}-{i}", css) for kind, css in (("plane", ""), ("image", ""), ("time", "wide"))]
            parts += [
                element("h3", [html(r.sensor), element("small", f" {_counts(r)}")]),
                element("div", plots, "pair"),
            ]
        yield Section("images", "Residuals in the images", _IMAGE_WORDS, Html("".join(parts)), figures)
    if c.cameras:
        yield _projection_section(c)


def _counts(r: ImageResiduals) -> str:
    """Text with the numbers of residuals that are used, rejected, and left out with their tracks."""
    used, rejected = int(r.used.sum()), int(r.rejected.sum())
    left_out = len(r.uv) - used - rejected
    more = f", {left_out} left out with their tracks" if left_out else ""
    return f"{used} {r.kind} used, {rejected} rejected{more}"


def _projection_section(c: Calibration) -> Section:
    """Section with maps of projection uncertainty, named `projection-i-0` and `projection-i-1` for camera i.

    A camera with a fixed lens has a sentence instead."""
    figures, parts = {}, []
    for i, name in enumerate(c.cameras):
        size, residuals = c.rig["sensors"][name]["resolution"], [r for r in c.image_residuals if r.sensor == name]
        maps = []
        for k, m in enumerate(projection_figures.projection_maps(c, name)):
            place = f"projection-{i}-{k}"
            figures[place] = projection_figures.projection_figure(m, residuals, size)
            title = element("h3", f"{name}: {projection_figures.map_title(m).lower()}")
            maps.append(element("div", [title, element("p", projection_figures.map_words(m)), plot_place(place)]))
        fixed = f"{name}: intrinsics and distortion are fixed by the rig file, and taken as exact."
        parts.append(element("div", maps, "pair") if maps else element("p", fixed, "quiet"))
    return Section("projection", "How well each lens is known", _LENS_WORDS, Html("".join(parts)), figures)


def curves(r: ImageResiduals) -> Iterator[ResidualCurve]:
    """Curve of the residual RMS [px] per image over time, for images with points in use."""
    rms = rms_of_images(r)
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
