"""`report.html`: one HTML file that needs no network. The verdict comes first, the supporting figures and tables after
it."""

from __future__ import annotations

import json
from importlib.resources import files
from string import Template

from icalib.report import cross_validation_figures, motion_figures, rig_figures, rig_shapes, tables
from icalib.report.cards import camera_pairs, sensor_cards
from icalib.report.ellipsoids import SIGMAS, ellipsoids, magnification
from icalib.report.histogram import normalised_histogram
from icalib.report.plot import Figure
from icalib.report.sections import plot_place, sections
from icalib.report.tables import Html, element
from icalib.result import Calibration
from icalib.result.summary import body_name, reference_name
from icalib.result.verdict import NEXT

_NO_CROSS_VALIDATION = (
    "No cross-validation: the recording is too short for segments, or segments are off in the rig file, or its halves "
    "have no parameter in common that both know."
)


def report_html(calibration: Calibration) -> str:
    """The whole report as one HTML document, plotly.js included."""
    c = calibration
    about_sensors = sections(c)
    words = {
        "sensors": " + ".join((*(() if c.imu is None else (c.imu,)), *c.mounted)),
        "size": tables.size_words(c),
        "body": body_name(c),
        "reference": reference_name(c),
        "status": c.status,
        "answer": f"{c.verdict[0].upper()}{c.verdict[1:]}. {NEXT[c.verdict]}",
        "ellipsoids": _ellipsoid_words(c),
        "legend": "".join(f"; {legend}" for legend in rig_shapes.legends(c)),
        "most_keyframes": motion_figures.MAX_PLOTTED_KEYFRAMES,
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
        "cross_validation": _cross_validation_section(c),
        "sensor_sections": Html("\n".join(section.html for section in about_sensors)),
        "facts": tables.facts(c),
        "without_imu": "" if c.imu else " hidden",
    }
    escaped = {name: tables.html(value) for name, value in words.items()}
    body = Template(resource("icalib.report", "page.html")).substitute(escaped | parts)
    figures = {name: drawn for section in about_sensors for name, drawn in section.figures.items()}
    return document(f"Calibration of {words['sensors']}", body, _figures(c) | figures)


def _ellipsoid_words(c: Calibration) -> str:
    """Legend of the uncertainty ellipsoids; empty if no translation was estimated."""
    if not ellipsoids(c):
        return ""
    return (
        f" Ellipsoids of green, amber or red lines show where a sensor may be: {SIGMAS:g} standard deviations of its "
        f"position, {magnification(c):g} times as large as they are; red ones are not determined."
    )


def document(title: str, body: str, figures: dict[str, Figure]) -> str:
    """One HTML file, plotly.js included. Each of `figures` is drawn in the element of `body` whose id is its key."""
    return Template(resource("icalib.report", "frame.html")).substitute(
        title=tables.html(title),
        body=body,
        figures=script_json(figures),
        css=resource("icalib.report", "page.css"),
        plotly=resource("plotly", "package_data/plotly.min.js"),
    )


def _figures(c: Calibration) -> dict[str, Figure]:
    """Figures that are not about one kind of sensor, by the id of their HTML element."""
    figures = {
        "rig": rig_figures.rig_picture(c),
        "histogram": normalised_histogram(c),
        "trajectory": motion_figures.trajectory(c),
        "motion": motion_figures.motion(c),
        "convergence": motion_figures.convergence(c),
        "correlation": rig_figures.correlation(c),
    }
    if c.imu is None:
        del figures["motion"]
    if c.cross_validation is not None:
        figures["held-out"] = cross_validation_figures.jackknife_shifts(c, c.cross_validation)
    return figures


def _cross_validation_section(c: Calibration) -> Html:
    """Sentences, table and place for the figure of the cross-validation."""
    cross_validation = c.cross_validation
    if cross_validation is None:
        return element("p", _NO_CROSS_VALIDATION, "quiet")
    rise, verdict, parts = cross_validation_figures.words(c, cross_validation)
    paragraphs = [
        element("p", verdict, "answer"),
        element("p", f"{rise} {parts}"),
        cross_validation_figures.predicted_fits(cross_validation),
    ]
    return Html("".join((*paragraphs, element("h3", "Parameters without each part"), plot_place("held-out"))))


def script_json(figures: dict[str, Figure]) -> str:
    """Figures as JSON for a script element. `<` is escaped, so that no sensor name can close the element."""
    text = json.dumps(figures, separators=(",", ":"), allow_nan=False)
    return text.replace("<", "\\u003c")


def resource(package: str, name: str) -> str:
    """Text of a resource file of a Python package."""
    return files(package).joinpath(name).read_text(encoding="utf-8")
