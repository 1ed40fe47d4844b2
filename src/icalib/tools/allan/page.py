"""`allan.html`: Allan deviations and fitted noise, in one file that needs no network."""

from __future__ import annotations

from string import Template

import numpy as np

from icalib.report.page import document, resource
from icalib.report.plot import AXIS_COLORS, Figure, axis, figure, line
from icalib.report.tables import Html, element, html, sentences
from icalib.tools.allan.analysis import AXES, ImuNoiseStudy, SensorNoise
from icalib.tools.allan.deviation import model_variance
from icalib.tools.allan.words import rig_snippet, rows

_HEADERS = ("", "noise density", "bias walk", "bias instability")


def allan_html(study: ImuNoiseStudy) -> str:
    """The page as one HTML document, plotly.js included."""
    figures = {sensor.kind: deviation_figure(sensor, study.period) for sensor in study.sensors}
    words = {"name": study.name, "seconds": f"{study.seconds:.0f}", "rate": f"{1.0 / study.period:.6g}"}
    words |= {"snippet": rig_snippet(study), "where": study.where}
    parts = {
        "table": _table(study),
        "warnings": sentences(study.warnings, "care", "None."),
        "notes": sentences(study.notes, "", "None."),
    }
    escaped = {name: html(value) for name, value in words.items()}
    body = Template(resource("icalib.tools.allan", "page.html")).substitute(escaped | parts)
    return document(f"Noise of {study.name}", body, figures)


def deviation_figure(sensor: SensorNoise, period: float) -> Figure:
    """Allan deviation of each axis with one standard deviation, and that of the noise fitted to all axes together."""
    d, fit = sensor.deviation, sensor.together
    traces = []
    for k, (name, color) in enumerate(zip(AXES, AXIS_COLORS, strict=True)):
        y = d.deviation[:, k]
        spread = {"type": "data", "array": (y * d.relative).tolist(), "thickness": 0.8, "width": 0, "color": color}
        traces.append(line(d.tau, y, f"{sensor.kind} {name}", color, error_y=spread))
    walk = fit.walk if fit.resolved else 0.0
    model = np.sqrt(model_variance(fit.white, walk, d.tau, period))
    parts = [(model, "fitted", "solid"), (fit.white / np.sqrt(d.tau), "white noise", "dot")]
    if fit.resolved:
        parts.append((walk * np.sqrt(d.tau / 3.0), "bias walk", "dash"))
    keep = float(0.5 * d.deviation.min())
    for y, name, dash in parts:
        style = {"color": "#1f2937", "width": 1.2, "dash": dash}
        traces.append(line(d.tau, np.where(y > keep, y, np.nan), name, "#1f2937", line=style))
    log = {"type": "log", "exponentformat": "power"}
    return figure(
        traces,
        460,
        xaxis=axis("averaging time [s]", **log),
        yaxis=axis(f"Allan deviation [{sensor.unit}]", **log),
    )


def _table(study: ImuNoiseStudy) -> Html:
    head = element("thead", element("tr", [element("th", header) for header in _HEADERS]))
    cells_of_rows = [cells for sensor in study.sensors for cells in rows(sensor)]
    body = element("tbody", [element("tr", [element("td", cell) for cell in cells]) for cells in cells_of_rows])
    return element("div", element("table", [head, body]), "scroll")
