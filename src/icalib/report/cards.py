"""One card for each sensor: value, standard deviation and verdict of every component, and its goodness of fit."""

from __future__ import annotations

import re

import numpy as np

from icalib.report.tables import Html, badge, element, html, table
from icalib.result import Calibration, RelativePose, SensorFit, Verdict, relative_poses
from icalib.result.body_frame import in_body_frame
from icalib.result.excess import FAR_BEYOND, excess, times
from icalib.result.quantities import Row, chi2_words, format_number, nontrivial_groups, rms_words, rows
from icalib.result.verdict import (
    AUXILIARY,
    UNUSABLE,
    by_size,
    counted,
    lens_projection_px,
    lens_verdict,
    tolerance,
    worst,
)


def sensor_cards(c: Calibration) -> Html:
    """Cards of all sensors with parameters or residuals, in the order of the rig file; the IMU comes last."""
    known = {g.sensor for g in nontrivial_groups(in_body_frame(c))} | {f.sensor for f in c.fits}
    names = sorted((n for n in c.rig["sensors"] if n in known), key=lambda n: n == c.imu)
    return Html("".join(_card(c, name) for name in names))


def camera_pairs(c: Calibration) -> Html:
    """Table of camera pairs: baseline, and standard deviation of the relative rotation. Empty for fewer than two
    cameras."""
    pairs = [r for r in relative_poses(c) if {r.frame, r.sensor} <= c.lenses.keys()]
    if not pairs:
        return Html("")
    body = [
        (
            f"{r.frame} to {r.sensor}",
            f"{1e3 * r.distance:.2f} ± {format_number(1e3 * r.distance_std)} mm",
            f"± {format_number(float(np.rad2deg(r.std[:3].max())))} deg",
            badge(_pair_verdict(c, r)),
        )
        for r in pairs
    ]
    return table(("camera pair", "baseline", "rotation", "verdict"), body)


def _pair_verdict(c: Calibration, r: RelativePose) -> Verdict:
    """Verdict on a relative pose, by its largest standard deviation in tolerances of the rig file's settings."""
    turn, move = np.deg2rad(tolerance(c, "rotation_tolerance_deg")), tolerance(c, "translation_tolerance_m")
    return by_size(float(max(r.std[:3].max() / turn, r.std[3:].max() / move)))


def _card(c: Calibration, sensor: str) -> Html:
    """Card of one sensor. Red: a component is unusable, residuals are at least `FAR_BEYOND` times the stated noise,
    or an error in the rig file or recording names the sensor. Amber: a component is weak, or residuals exceed the
    stated noise."""
    lens, fits = c.lenses.get(sensor, ()), [f for f in c.fits if f.sensor == sensor]
    groups = [g for g in nontrivial_groups(in_body_frame(c)) if g.sensor == sensor and g.name not in AUXILIARY]
    verdicts: list[Verdict] = [v for g in groups for v in counted(c, g)]
    verdict = worst((*verdicts, *((lens_verdict(c, sensor),) if lens else ())))
    fit = max((excess(f) for f in fits), default=1.0)
    named = any(re.search(rf"(?<!\w){re.escape(sensor)}(?!\w)", sentence) for sentence in c.wrong)
    css = "bad" if verdict in UNUSABLE or named or fit >= FAR_BEYOND else "weak" if fit > 1.0 else verdict
    marks = [w for w, applies in (("poor fit", fit > 1.0), ("see the reasons", named and fit == 1.0)) if applies]
    badges = [element("span", mark, f"badge {css}") for mark in marks]
    kind = c.rig["sensors"][sensor]["type"]
    head = element("h3", [html(sensor), element("small", f" {kind} "), badge(verdict), *badges])
    lines = [element("li", _fit_words(f), "poor" if excess(f) > 1.0 else "") for f in fits]
    fit_lists = [element("ul", lines)] if lines else []
    table = [_components(c, sensor, lens)] if groups else []
    return element("article", [head, *table, *fit_lists], f"card {css}")


def _components(c: Calibration, sensor: str, lens: tuple[str, ...]) -> Html:
    """Table with one row for each component. The coefficients of a lens share one row, which shows its projection
    uncertainty."""
    hidden = {*AUXILIARY, *(n for g in c.groups if g.sensor == sensor and g.name in lens for n in g.labels)}
    components = [r for r in rows(c) if r.sensor == sensor and r.name not in hidden]
    body = [(r.name, r.value, _std(r), badge(r.verdict)) for r in components]
    if lens:
        sigma, verdict = lens_projection_px(c, sensor), lens_verdict(c, sensor)
        size = "" if sigma is None else f"± {format_number(sigma)} px"
        body.append(("lens, projection" if size else "lens", "", size, badge(verdict)))
    return table(("", "value", "std", ""), body, ("value", "std"))


def _std(row: Row) -> str:
    return f"± {row.std} {row.unit}".rstrip() if row.std else row.unit


def _fit_words(f: SensorFit) -> str:
    rms = f"{rms_words(f)} RMS, " if f.rms is not None else ""
    if excess(f) > 1.0:
        return f"{f.kind}: {rms}residuals {times(f)} the stated noise"
    return f"{f.kind}: {rms}chi^2 / dof {chi2_words(f)}"
