"""A card for each sensor: value, standard deviation and verdict of every component, and how well its data fit."""

from __future__ import annotations

from icalib.calibration import Calibration, SensorFit, Verdict
from icalib.calibration.excess import excess, times
from icalib.calibration.quantities import Row, chi2_words, rms_words, rows, shown, shown_groups
from icalib.calibration.verdict import LENS, lens_projection_px, lens_verdict, worst
from icalib.report.tables import Html, badge, element, html, table

FAR_BEYOND = 4.0  # times the stated noise: then standard deviations mean nothing


def sensor_cards(c: Calibration) -> Html:
    """Of all sensors and targets, in the order of the result."""
    names = [n for n in dict.fromkeys(g.sensor for g in shown_groups(c)) if n not in c.bodies]
    return Html("".join(_card(c, name) for name in names))


def _card(c: Calibration, sensor: str) -> Html:
    groups = [g for g in shown_groups(c) if g.sensor == sensor]
    is_camera, own = sensor in c.cameras, [f for f in c.fits if f.sensor == sensor]
    judged: list[Verdict] = [v for g in groups if not (is_camera and g.name in LENS) for v in g.verdict]
    verdict = worst((*judged, *((lens_verdict(c, sensor),) if is_camera else ())))
    fit = max((excess(f) for f in own), default=1.0)
    css = "undetermined" if fit >= FAR_BEYOND else "weak" if fit > 1.0 and verdict != "undetermined" else verdict
    kind = c.rig["sensors"].get(sensor, {}).get("type", "target")
    poor = [" ", element("span", "poor fit", f"badge {css}")] if fit > 1.0 else []
    head = element("h3", [html(sensor), element("small", f" {kind} "), badge(verdict), *poor])
    lines = [element("li", _fit_words(f), "poor" if excess(f) > 1.0 else "") for f in own]
    fits = [element("ul", lines)] if lines else []
    return element("article", [head, _components(c, sensor, is_camera), *fits], f"card {css}")


def _components(c: Calibration, sensor: str, is_camera: bool) -> Html:
    """One row a component; the coefficients of a lens as one."""
    hidden = {"fx", "fy", "cx", "cy", *_lens_labels(c, sensor)} if is_camera else set()
    found = [r for r in rows(c) if r.sensor == sensor and r.name not in hidden]
    body = [(r.name, r.value, _std(r), badge(r.verdict)) for r in found]
    if is_camera:
        sigma, verdict = lens_projection_px(c, sensor), lens_verdict(c, sensor)
        size = "" if sigma is None else f"± {shown(sigma)} px"
        body.append(("lens, projection" if size else "lens", "", size, badge(verdict)))
    return table(("", "value", "std", ""), body, ("value", "std"))


def _lens_labels(c: Calibration, camera: str) -> tuple[str, ...]:
    return tuple(n for g in c.groups if g.sensor == camera and g.name in LENS for n in g.labels)


def _std(row: Row) -> str:
    return f"± {row.std} {row.unit}".rstrip() if row.std else row.unit


def _fit_words(f: SensorFit) -> str:
    rms = f"{rms_words(f)} RMS, " if f.rms is not None else ""
    if excess(f) > 1.0:
        return f"{f.kind}: {rms}residuals {times(f)} the stated noise"
    return f"{f.kind}: {rms}chi^2 / dof {chi2_words(f)}"
