"""Sections of the report, each about the residuals of one kind of sensor."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field

from icalib.report.panels import panels
from icalib.report.plot import Figure
from icalib.report.tables import Html, element, html
from icalib.result import Calibration, RowResiduals
from icalib.sensors import SENSOR_KINDS, facet


@dataclass(frozen=True)
class Section:
    """One section of the report. name: its HTML id; words: introductory paragraph; body: HTML that contains an element
    for each of `figures`, whose id is the key of the figure."""

    name: str
    title: str
    words: str
    body: Html
    figures: dict[str, Figure] = field(default_factory=dict)

    @property
    def html(self) -> Html:
        """The section as an HTML element."""
        content = [element("h2", self.title), element("p", self.words), self.body]
        return Html(f'<section id="{html(self.name)}">{html(content)}</section>')


def sections(c: Calibration) -> list[Section]:
    """Sections of all kinds of sensors in the order of `SENSOR_KINDS`, with the IMU last. A kind without a `sections`
    function gets those of `row_sections`."""
    all_sections = []
    for kind in (*SENSOR_KINDS[1:], SENSOR_KINDS[0]):
        module = facet(kind, "show")
        all_sections += (
            module.sections(c) if hasattr(module, "sections") else row_sections(c, kind, kind, kind.capitalize(), "")
        )
    return all_sections


def row_sections(c: Calibration, kind: str, name: str, title: str, words: str) -> Iterator[Section]:
    """One section with `panels` of each sensor of type `kind` that has `RowResiduals`; none if no sensor has any. name:
    HTML id; words: added to the introduction."""
    residuals = [r for r in c.residuals.values() if isinstance(r, RowResiduals) and r.sensor in c.of_type(kind)]
    if residuals:
        figures = {f"{name}-{i}": panels(r) for i, r in enumerate(residuals)}
        parts = [element("h3", r.sensor) + plot_place(place) for place, r in zip(figures, residuals, strict=True)]
        yield Section(name, title, f"Predicted - measured. {words}".strip(), Html("".join(parts)), figures)


def plot_place(name: str, css: str = "") -> Html:
    """HTML element in which the figure `name` is drawn."""
    return Html(f'<div class="plot {css}" id="{html(name)}"></div>')
