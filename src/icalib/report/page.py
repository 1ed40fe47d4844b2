"""`report.html`: one file without network that says first whether to trust the calibration, then shows why."""

from __future__ import annotations

import json
from importlib.resources import files
from string import Template

from icalib.calibration import Calibration
from icalib.report import corner_figures, motion_figures, rig_figures, tables
from icalib.report.plot import Figure
from icalib.report.tables import Html, element

_NO_UNDETERMINED = "None: the motion determines every direction."
_NO_WARNINGS = "None."


def report_html(calibration: Calibration) -> str:
    """The whole report as one HTML document, plotly.js included."""
    c = calibration
    figures = _figures(c)
    trust = tables.trust(c)
    words = {
        "sensors": " + ".join((*(() if c.imu is None else (c.imu,)), *c.cameras)),
        "size": tables.size_words(c),
        "body": "imu" if c.imu else c.body,
        "status": c.status,
        "answer": tables.TRUST[trust],
        "most_dots": corner_figures.MOST_DOTS,
        "most_nodes": motion_figures.MOST_NODES,
    }
    parts = {
        "trust": trust,
        "cards": tables.sensor_cards(c),
        "undetermined": tables.sentences(c.undetermined, "bad", _NO_UNDETERMINED),
        "warnings": tables.sentences(c.warnings, "care", _NO_WARNINGS),
        "notes": tables.sentences(c.notes, "", "None."),
        "fits": tables.fits(c),
        "parameters": tables.parameters(c),
        "poses": Html(tables.poses(c) + tables.bodies(c)),
        "corner_figures": _corner_sections(c),
        "facts": tables.facts(c),
        "figures": script_json(figures),
        "css": resource("icalib.report", "page.css"),
        "without_imu": "" if c.imu else " hidden",
        "plotly": resource("plotly", "package_data/plotly.min.js"),
    }
    escaped = {name: tables.html(value) for name, value in words.items()}
    return Template(resource("icalib.report", "page.html")).substitute(escaped | parts)


def _figures(c: Calibration) -> dict[str, Figure]:
    """Every figure by the id of its place in the page."""
    found = {
        "rig": rig_figures.rig_picture(c),
        "histogram": corner_figures.normalised_histogram(c.corner_residuals),
        "imu-residuals": motion_figures.imu_residuals(c),
        "trajectory": motion_figures.trajectory(c),
        "motion": motion_figures.motion(c),
        "convergence": motion_figures.convergence(c),
        "correlation": rig_figures.correlation(c),
    }
    if c.imu is None:
        del found["imu-residuals"], found["motion"]
    for i, r in enumerate(c.corner_residuals):
        width, height = c.rig["sensors"][r.sensor]["resolution"]
        found[f"plane-{i}"] = corner_figures.residual_plane(r)
        found[f"image-{i}"] = corner_figures.residuals_over_image(r, (width, height))
        found[f"time-{i}"] = corner_figures.residuals_over_time(r)
    return found


def _corner_sections(c: Calibration) -> Html:
    sections = []
    for i, r in enumerate(c.corner_residuals):
        counts = f"{int((~r.rejected).sum())} corners used, {int(r.rejected.sum())} rejected"
        plots = [_place(f"{kind}-{i}", css) for kind, css in (("plane", ""), ("image", ""), ("time", "wide"))]
        head = element("h3", [tables.html(r.sensor), element("small", f" {counts}")])
        sections.append(Html(head + element("div", plots, "pair")))
    return Html("".join(sections))


def _place(name: str, css: str) -> Html:
    return Html(f'<div class="plot {css}" id="{name}"></div>')


def script_json(figures: dict[str, Figure]) -> str:
    """JSON that cannot end the script element around it, whatever a sensor is called."""
    text = json.dumps(figures, separators=(",", ":"), allow_nan=False)
    return text.replace("<", "\\u003c")


def resource(package: str, name: str) -> str:
    """Text of a file that came with a package."""
    return files(package).joinpath(name).read_text(encoding="utf-8")
