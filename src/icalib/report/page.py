"""`report.html`: one file without network that says first whether to trust the calibration, then shows why."""

from __future__ import annotations

import json
from importlib.resources import files
from string import Template

import numpy as np

from icalib.report import (
    held_out_figures,
    image_figures,
    motion_figures,
    projection_figures,
    rig_figures,
    robot_figures,
    tables,
)
from icalib.report.cards import camera_pairs, sensor_cards
from icalib.report.ellipsoids import SIGMAS, ellipsoids, magnification
from icalib.report.histogram import normalised_histogram
from icalib.report.plot import Figure
from icalib.report.tables import Html, element
from icalib.result import Calibration, ImageResiduals, ProjectionMap
from icalib.result.verdict import NEXT

_NOT_HELD_OUT = (
    "No cross-validation: the recording is too short for segments, or segments are off in the rig file, or its halves "
    "have no parameter in common that both know."
)
_MAPS = (("As the first guess had them", "map-before"), ("As calibrated", "map-after"))


def report_html(calibration: Calibration) -> str:
    """The whole report as one HTML document, plotly.js included."""
    c = calibration
    maps = {name: projection_figures.projection_maps(c, name) for name in c.cameras}
    words = {
        "sensors": " + ".join((*(() if c.imu is None else (c.imu,)), *c.mounted)),
        "size": tables.size_words(c),
        "body": "imu" if c.imu else c.body,
        "status": c.status,
        "answer": f"{c.verdict[0].upper()}{c.verdict[1:]}. {NEXT[c.verdict]}",
        "ellipsoids": _ellipsoid_words(c),
        "most_dots": image_figures.MOST_DOTS,
        "most_nodes": motion_figures.MOST_NODES,
        "most_points": robot_figures.MOST_IN_SPACE,
    }
    parts = {
        "trust": tables.trust(c),
        "cards": sensor_cards(c),
        "pairs": camera_pairs(c),
        "reasons": tables.reasons(c),
        "notes": tables.sentences(c.notes, "", "None."),
        "fits": tables.fits(c),
        "parameters": tables.parameters(c),
        "poses": Html(tables.poses(c) + tables.relative(c) + tables.bodies(c)),
        "image_figures": _image_sections(c),
        "without_images": "" if c.image_residuals else " hidden",
        "cross_validation": _held_out_section(c),
        "projection_figures": _projection_sections(maps),
        "without_cameras": "" if c.cameras else " hidden",
        "lidar_figures": _lidar_sections(c),
        "without_lidars": "" if c.lidar_residuals else " hidden",
        "wheel_figures": _wheel_sections(c),
        "without_wheels": "" if c.wheel_residuals else " hidden",
        "pose_figures": _pose_sections(c),
        "without_poses": "" if c.pose_residuals else " hidden",
        "facts": tables.facts(c),
        "without_imu": "" if c.imu else " hidden",
    }
    escaped = {name: tables.html(value) for name, value in words.items()}
    body = Template(resource("icalib.report", "page.html")).substitute(escaped | parts)
    return document(f"Calibration of {words['sensors']}", body, _figures(c) | _projection_figures(c, maps))


def _ellipsoid_words(c: Calibration) -> str:
    if not ellipsoids(c):
        return ""
    return (
        f" Ellipsoids of green, amber or red lines show where a sensor may be: {SIGMAS:g} standard deviations of its "
        f"position, {magnification(c):g} times as large as they are; red ones are not determined."
    )


def document(title: str, body: str, figures: dict[str, Figure]) -> str:
    """One HTML file, plotly.js included, that draws each of the `figures` in the place with its id."""
    return Template(resource("icalib.report", "frame.html")).substitute(
        title=tables.html(title),
        body=body,
        figures=script_json(figures),
        css=resource("icalib.report", "page.css"),
        plotly=resource("plotly", "package_data/plotly.min.js"),
    )


def _figures(c: Calibration) -> dict[str, Figure]:
    """Every figure by the id of its place in the page."""
    found = {
        "rig": rig_figures.rig_picture(c),
        "histogram": normalised_histogram(c),
        "imu-residuals": motion_figures.imu_residuals(c),
        "trajectory": motion_figures.trajectory(c),
        "motion": motion_figures.motion(c),
        "convergence": motion_figures.convergence(c),
        "correlation": rig_figures.correlation(c),
    }
    if c.imu is None:
        del found["imu-residuals"], found["motion"]
    for i, r in enumerate(c.image_residuals):
        width, height = c.rig["sensors"][r.sensor]["resolution"]
        found[f"plane-{i}"] = image_figures.residual_plane(r)
        found[f"image-{i}"] = image_figures.residuals_over_image(r, (width, height))
        found[f"time-{i}"] = image_figures.residuals_over_time(r)
    if c.cross_validation is not None:
        found["held-out"] = held_out_figures.moved_without_parts(c, c.cross_validation)
    for i, r in enumerate(c.lidar_residuals):
        found[f"points-{i}"] = robot_figures.residuals_over_time(r)
        found[f"distance-{i}"] = robot_figures.residuals_over_distance(r)
    for i, r in enumerate(c.wheel_residuals):
        found[f"wheels-{i}"] = robot_figures.panels(r)
    for i, r in enumerate(c.pose_residuals):
        found[f"poses-{i}"] = robot_figures.panels(r)
    return found | (robot_figures.plane_maps(c) if c.lidar_residuals else {})


def _image_sections(c: Calibration) -> Html:
    sections = []
    for i, r in enumerate(c.image_residuals):
        plots = [plot_place(f"{kind}-{i}", css) for kind, css in (("plane", ""), ("image", ""), ("time", "wide"))]
        head = element("h3", [tables.html(r.sensor), element("small", f" {_counts(r)}")])
        sections.append(Html(head + element("div", plots, "pair")))
    return Html("".join(sections))


def _counts(r: ImageResiduals) -> str:
    """How many are in use, and what became of the others."""
    used, rejected = int(r.used.sum()), int(r.rejected.sum())
    left_out = len(r.uv) - used - rejected
    more = f", {left_out} left out with their tracks" if left_out else ""
    return f"{used} {r.kind} used, {rejected} rejected{more}"


def _held_out_section(c: Calibration) -> Html:
    held = c.cross_validation
    if held is None:
        return element("p", _NOT_HELD_OUT, "quiet")
    rise, verdict, parts = held_out_figures.words(c, held)
    found = [element("p", verdict, "answer"), element("p", f"{rise} {parts}"), held_out_figures.predicted_fits(held)]
    return Html("".join((*found, element("h3", "Parameters without each part"), plot_place("held-out"))))


def _projection_figures(c: Calibration, maps: dict[str, list[ProjectionMap]]) -> dict[str, Figure]:
    """The maps of camera i as `projection-i-0`, `projection-i-1`."""
    found = {}
    for i, (name, own) in enumerate(maps.items()):
        size = c.rig["sensors"][name]["resolution"]
        seen = [r for r in c.image_residuals if r.sensor == name]
        for k, m in enumerate(own):
            found[f"projection-{i}-{k}"] = projection_figures.projection_figure(m, seen, size)
    return found


def _projection_sections(maps: dict[str, list[ProjectionMap]]) -> Html:
    """Each camera, or that its lens is fixed."""
    sections = []
    for i, (name, own) in enumerate(maps.items()):
        parts = [
            element(
                "div",
                [
                    element("h3", f"{name}: {projection_figures.title(m).lower()}"),
                    element("p", projection_figures.words(m)),
                    plot_place(f"projection-{i}-{k}"),
                ],
            )
            for k, m in enumerate(own)
        ]
        fixed = element(
            "p", f"{name}: intrinsics and distortion are fixed by the rig file, and taken as exact.", "quiet"
        )
        sections.append(element("div", parts, "pair") if parts else fixed)
    return Html("".join(sections))


def _lidar_sections(c: Calibration) -> Html:
    """The planes before and after, then each LiDAR."""
    if not c.lidar_residuals:
        return Html("")
    maps = [element("div", [element("h3", title), plot_place(name, "")]) for title, name in _MAPS]
    sections = [element("div", maps, "pair")]
    for i, r in enumerate(c.lidar_residuals):
        first, now = (1e3 * float(np.sqrt(np.mean(x.astype(np.float64) ** 2))) for x in (r.first_residual, r.residual))
        counts = (
            f"{r.points_used} of {r.points_read} points used; off their planes {first:.1f} mm RMS at first, "
            f"{now:.1f} mm now"
        )
        head = element("h3", [tables.html(r.sensor), element("small", f" {counts}")])
        plots = [plot_place(f"points-{i}", ""), plot_place(f"distance-{i}", "")]
        sections.append(Html(head + element("div", plots, "pair")))
    return Html("".join(sections))


def _wheel_sections(c: Calibration) -> Html:
    return Html(
        "".join(element("h3", r.sensor) + plot_place(f"wheels-{i}", "") for i, r in enumerate(c.wheel_residuals))
    )


def _pose_sections(c: Calibration) -> Html:
    return Html("".join(element("h3", r.sensor) + plot_place(f"poses-{i}", "") for i, r in enumerate(c.pose_residuals)))


def plot_place(name: str, css: str = "") -> Html:
    """Where the figure `name` is drawn."""
    return Html(f'<div class="plot {css}" id="{tables.html(name)}"></div>')


def script_json(figures: dict[str, Figure]) -> str:
    """JSON that cannot end the script element around it, whatever a sensor is called."""
    text = json.dumps(figures, separators=(",", ":"), allow_nan=False)
    return text.replace("<", "\\u003c")


def resource(package: str, name: str) -> str:
    """Text of a file that came with a package."""
    return files(package).joinpath(name).read_text(encoding="utf-8")
