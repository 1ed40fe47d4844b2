"""The report as one HTML file, and the sections, cards and tables of which it is made."""

from __future__ import annotations

import json
import re
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, field
from html import escape
from importlib.resources import files
from string import Template
from typing import Any, Generic, TypeVar

import numpy as np

from icalib.detection.images import MOST_PICTURES
from icalib.kinds import presenters
from icalib.report import pictures, rig_figures
from icalib.report.figures import (
    Figure,
    ResidualCloud,
    ResidualCurve,
    axis,
    dots,
    figure,
    line,
    normalised_histogram,
    panels,
)
from icalib.report.rig_figures import SIGMAS, ellipsoids, magnification
from icalib.result import (
    Calibration,
    CrossValidation,
    ParameterGroup,
    PredictedFit,
    RelativePose,
    RowResiduals,
    SensorFit,
    Verdict,
    joint_covariance,
    relative_poses,
)
from icalib.result.quantities import (
    FAR_BEYOND,
    NEAR_LOCK,
    Row,
    chi2_words,
    dof_words,
    excess,
    format_number,
    in_body_frame,
    nontrivial_groups,
    rms_words,
    rows,
    rpy_deg,
    table_rows,
    times,
)
from icalib.result.saving import body_name, reference_name
from icalib.result.verdict import (
    AUXILIARY,
    NEXT,
    UNUSABLE,
    Usability,
    component_verdict,
    counted,
    lens_projection_px,
    lens_verdict,
    tolerance,
    worst,
)
from icalib.sensors.stream import Residuals

# `report.html`: one HTML file that needs no network. The verdict comes first, the supporting figures and tables after
# it.

_NO_CROSS_VALIDATION = (
    "No cross-validation: the recording is too short for segments, or segments are off in the rig file, or its halves "
    "have no parameter in common that both know."
)


_PICTURE_WORDS = (
    f"Up to {MOST_PICTURES} images of each camera, evenly spread, were kept while the recording was read; the median "
    "and the worst of them are shown. Green squares are measured points, red crosses rejected ones. Yellow lines, "
    "magnified, lead to where the calibration projects the point. Lines of a good fit have no common direction."
)
_POINTS_WORDS = (
    "Points of a LiDAR are where the calibration projects them; the trajectory moves each from its own instant to that "
    "of the image. The magenta line is the outline of the target in the pose that the camera sees. In a good "
    "calibration colours change at the edges of objects. A wrong rotation shifts points in all images, a wrong time "
    "offset in those of fast turns. Points that an object hides from the camera are drawn, too."
)


def report_html(calibration: Calibration) -> str:
    """The whole report as one HTML document, plotly.js included."""
    c = calibration
    about_sensors = sections(c)
    words = {
        "sensors": " + ".join((*(() if c.imu is None else (c.imu,)), *c.mounted)),
        "size": size_words(c),
        "body": body_name(c),
        "reference": reference_name(c),
        "status": c.status,
        "answer": f"{c.verdict[0].upper()}{c.verdict[1:]}. {NEXT[c.verdict]}",
        "ellipsoids": _ellipsoid_words(c),
        "legend": "".join(f"; {legend}" for legend in rig_figures.legends(c)),
        "most_keyframes": rig_figures.MAX_PLOTTED_KEYFRAMES,
    }
    parts = {
        "trust": trust(c),
        "cards": sensor_cards(c),
        "pairs": camera_pairs(c),
        "pictures": _pictures(c),
        "reasons": reasons(c),
        "notes": sentences(c.notes, "", "None."),
        "fits": fits(c),
        "parameters": parameters(c),
        "poses": Html(poses(c) + relative(c) + bodies(c)),
        "cross_validation": _cross_validation_section(c),
        "sensor_sections": Html("\n".join(section.html for section in about_sensors)),
        "facts": facts(c),
        "without_imu": "" if c.imu else " hidden",
    }
    escaped = {name: html(value) for name, value in words.items()}
    body = Template(resource("icalib.report", "page.html")).substitute(escaped | parts)
    figures = {name: drawn for section in about_sensors for name, drawn in section.figures.items()}
    return document(f"Calibration of {words['sensors']}", body, _figures(c) | figures)


def _pictures(c: Calibration) -> Html:
    """Section with recorded images and what was found in them; empty without images."""
    shots = [element("figure", [Html(svg), element("figcaption", text)]) for svg, text in pictures.figures(c)]
    if not shots:
        return Html("")
    has_points = any(picture.after is not None for picture in c.pictures)
    text = f"{_PICTURE_WORDS} {_POINTS_WORDS if has_points else ''}".rstrip()
    parts = [element("h2", "What the sensors saw"), element("p", text), element("div", shots, "shots")]
    return Html(f'<section id="pictures">{html(parts)}</section>')


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
        title=html(title),
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
        "trajectory": rig_figures.trajectory(c),
        "motion": rig_figures.motion(c),
        "convergence": rig_figures.convergence(c),
        "correlation": rig_figures.correlation(c),
    }
    if c.imu is None:
        del figures["motion"]
    if c.cross_validation is not None:
        figures["held-out"] = jackknife_shifts(c, c.cross_validation)
    return figures


def _cross_validation_section(c: Calibration) -> Html:
    """Sentences, table and place for the figure of the cross-validation."""
    cross_validation = c.cross_validation
    if cross_validation is None:
        return element("p", _NO_CROSS_VALIDATION, "quiet")
    rise, verdict, parts = words(c, cross_validation)
    paragraphs = [
        element("p", verdict, "answer"),
        element("p", f"{rise} {parts}"),
        predicted_fits(cross_validation),
    ]
    return Html("".join((*paragraphs, element("h3", "Parameters without each part"), plot_place("held-out"))))


def script_json(figures: dict[str, Figure]) -> str:
    """Figures as JSON for a script element. `<` is escaped, so that no sensor name can close the element."""
    text = json.dumps(figures, separators=(",", ":"), allow_nan=False)
    return text.replace("<", "\\u003c")


def resource(package: str, name: str) -> str:
    """Text of a resource file of a Python package."""
    return files(package).joinpath(name).read_text(encoding="utf-8")


# Sections of the report, each about the residuals of one kind of sensor.


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
    """Sections of all kinds of sensors in the order of `SENSOR_KINDS`, with the IMU last."""
    first, *others = presenters().values()
    return [section for presenter in (*others, first) for section in presenter.sections(c)]


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


# One card for each sensor: value, standard deviation and verdict of every component, and its goodness of fit.


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
    return component_verdict(float(max(r.std[:3].max() / turn, r.std[3:].max() / move)))


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


# Texts and tables of the report as HTML. Only this module escapes text.

TRUST: dict[Usability, str] = {
    "usable": "good",
    "usable with care": "care",
    "partly usable": "bad",
    "not usable": "wrong",
}


class Html(str):
    """Text that is already HTML, so that `html` does not escape it."""


def element(tag: str, content: object, css: str = "") -> Html:
    """<tag class=css>content</tag>; content is escaped unless it is Html."""
    attribute = f' class="{escape(css)}"' if css else ""
    return Html(f"<{tag}{attribute}>{html(content)}</{tag}>")


def html(content: object) -> Html:
    """`content` as HTML: unchanged if it is Html, its items joined if it is a list, otherwise escaped text."""
    if isinstance(content, Html):
        return content
    if isinstance(content, list):
        return Html("".join(html(part) for part in content))
    return Html(escape(str(content)))


def table(headers: Sequence[str], body: Iterable[Sequence[object]], numeric: Sequence[str] = ()) -> Html:
    """HTML table; columns named in `numeric` are right-aligned."""
    css = ["number" if h in numeric else "" for h in headers]
    head = element("tr", [element("th", h, c) for h, c in zip(headers, css, strict=True)])
    lines = [element("tr", [element("td", x, c) for x, c in zip(row, css, strict=True)]) for row in body]
    return element("div", element("table", [element("thead", head), element("tbody", lines)]), "scroll")


def sentences(items: Sequence[str], css: str, nothing: str) -> Html:
    """HTML list of sentences, or the paragraph `nothing` if there are none. css: class of the list."""
    if not items:
        return element("p", nothing, "quiet")
    return element("ul", [element("li", item) for item in items], css)


def reasons(c: Calibration) -> Html:
    """Numbered list of why the verdict is not `usable`, the most important reason first."""
    if not c.reasons:
        return element("p", "None: every check passed.", "quiet")
    grave = {c.failure, *c.wrong, *c.unobservable}
    items = [element("li", sentence, "bad" if sentence in grave else "care") for sentence in c.reasons]
    return element("ol", items, "reasons")


def badge(verdict: str) -> Html:
    """Coloured label of a verdict; empty without one."""
    return Html("") if not verdict else element("span", verdict, f"badge {'bad' if verdict in UNUSABLE else verdict}")


def trust(c: Calibration) -> str:
    """CSS class, in page.css, of the verdict on the result."""
    return TRUST[c.verdict]


def parameters(c: Calibration) -> Html:
    """Table of all parameters except poses of the target's rigid bodies; sensors come first."""
    headers = ("sensor", "parameter", "value", "std", "unit", "formal std", "factor", "verdict")
    body = [(r.sensor, r.name, r.value, r.std, r.unit, r.formal, r.factor, badge(r.verdict)) for r in table_rows(c)]
    return table(headers, body, ("value", "std", "formal std", "factor"))


def bodies(c: Calibration) -> Html:
    """Table of the poses of the target's rigid bodies; empty for a single body."""
    if not c.bodies:
        return Html("")
    sizes = ("x [mm]", "y [mm]", "z [mm]", "roll [deg]", "pitch [deg]", "yaw [deg]", "std [mm]", "std [deg]")
    body = [(name, *_body_row(c, name)) for name in c.bodies]
    title = element("h3", f"Target: bodies in the frame of {c.bodies[0]}, standard deviations the largest of three")
    return Html(title + table(("body", *sizes, "verdict"), body, sizes))


def _body_row(c: Calibration, body: str) -> list[object]:
    turn, move = c.group(body, "rotation"), c.group(body, "translation")
    angles, angle_std = rpy_deg(turn.value, joint_covariance(c, [turn]))
    values = [f"{1e3 * x:.2f}" for x in move.value] + [f"{x:.3f}" for x in angles]
    if turn.columns is None:
        return [*values, "", "", badge("fixed")]
    std = [format_number(1e3 * float(move.std.max())), format_number(float(angle_std.max()))]
    return [*values, *std, badge(worst((*turn.verdict, *move.verdict)))]


def poses(c: Calibration) -> Html:
    """T_body_sensor of each sensor as a 4x4 matrix, as text to copy."""
    names = c.mounted if c.body == c.reference else c.on_body
    return element("div", [_matrix(f"T_{c.body}_{name}", c.T_body_sensor(name)) for name in names], "matrices")


def _matrix(name: str, T: np.ndarray) -> Html:
    lines = "\n".join("[" + ", ".join(f"{x: .9f}" for x in row) + "]" for row in T)
    return element("figure", [element("figcaption", name), element("pre", lines)])


def relative(c: Calibration) -> Html:
    """Table and matrices of the relative poses of all pairs in `relative_poses`; empty if there are none."""
    pairs = relative_poses(c)
    if not pairs:
        return Html("")
    title = element("h3", "One sensor seen from another")
    words = element(
        "p",
        "Standard deviations come from the joint covariance of both sensors, empirical factors included. All of it is "
        "in calibration.yaml. T_a_b takes coordinates in the frame of b to that of a. Position: std along the axes "
        f"of a. {NEAR_LOCK} An unobservable component has the uncertainty of its initial guess.",
    )
    headers = ("", "distance [mm]", "x [mm]", "y [mm]", "z [mm]", "roll [deg]", "pitch [deg]", "yaw [deg]")
    body = []
    for r in pairs:
        angles, angle_std = rpy_deg(r.T[:3, :3], r.covariance[:3, :3])
        values = [1e3 * r.distance, *(1e3 * r.T[:3, 3]), *angles]
        std = [1e3 * r.distance_std, *(1e3 * r.std[3:]), *angle_std]
        body.append((r.name, *(f"{x:.3f} ± {format_number(s)}" for x, s in zip(values, std, strict=True))))
    matrices = element("div", [_matrix(r.name, r.T) for r in pairs], "matrices")
    return Html(title + words + table(headers, body, headers[1:]) + matrices)


def fits(c: Calibration) -> Html:
    """Table of the goodness of fit of each kind of measurement."""
    headers = ("sensor", "kind", "residuals", "post-fit dof", "chi2 / dof", "RMS", "rejected")
    body = [(f.sensor, f.kind, f.count, dof_words(f), chi2_words(f), rms_words(f), f.rejected or "") for f in c.fits]
    return table(headers, body, headers[2:])


def facts(c: Calibration) -> Html:
    """Tables of settings, effects that were tested, versions, wall times, sensor rates and input files."""
    names = ("setting", "value")
    parts: list[object] = []
    for title, values in (
        ("Settings", c.settings),
        ("Tested, not in the model", {name: _tested_words(effect) for name, effect in c.effects.items()}),
        ("Versions", c.versions),
        ("Wall time [s]", {k: f"{v:.2f}" for k, v in c.timings.items()}),
        ("Rates [Hz]", {k: f"{v:.4g}" for k, v in c.rates.items()}),
    ):
        parts.append(element("section", [element("h3", title), table(names, values.items())]))
    files = table(("file", "sha256"), [(name, element("code", digest)) for name, digest in c.inputs.items()])
    return Html(element("div", parts, "grid") + element("h3", "Input files") + files)


def _tested_words(effect: dict[str, Any]) -> str:
    """Value and standard deviation of an effect, of the number that is the largest of several."""
    off = [abs(v) / s for v, s in zip(effect["value"], effect["std"], strict=True)]
    k = off.index(max(off))
    label = f"{effect['labels'][k]} " if len(off) > 1 else ""
    return f"{label}{effect['value'][k]:.2g} ± {effect['std'][k]:.2g} {effect['unit']}"


def size_words(c: Calibration) -> str:
    """One line on the amount of data used: recordings, duration, measurements of each kind, keyframes."""
    duration = float(np.ptp(c.trajectory.seconds)) if len(c.trajectory.seconds) else 0.0
    several = f"{len(c.recordings)} recordings, " if len(c.recordings) > 1 else ""
    span = sum(r.end - r.start for r in c.recordings) if several else duration
    several += f"{span:.1f} s, " if c.rates else ""  # pictures have no clock
    return several + ", ".join(
        [*(text for p in presenters().values() for text in p.amounts(c)), f"{len(c.trajectory.seconds)} keyframes"]
    )


# Cross-validation in the report: the estimates without each segment (jackknife), and the two-fold cross-validation.

ROW_PX = 17
_ALLOWED = "#94a3b8"
_PRINTED = "#fde2b3"


def jackknife_shifts(c: Calibration, cv: CrossValidation) -> Figure:
    """One row for each parameter with one dot for each segment: shift of the estimate without the segment, in formal
    standard deviations of that shift. Grey bar: one standard deviation; orange bar: one times the empirical factor."""
    groups = [g for g in nontrivial_groups(c) if g.columns is not None]
    columns = np.array([k for g in groups for k in g.columns or ()], dtype=np.int64)
    names = [f"{g.sensor} {_name(g, label)}" for g in groups for label in g.labels]
    factors = np.concatenate([np.ones(len(g.labels)) if g.factor is None else np.maximum(g.factor, 1) for g in groups])
    z, row = cv.whitened[:, columns], np.arange(len(columns), dtype=float)
    traces = [
        _bars(factors, row, "the same, times the printed factor", _PRINTED, 5),
        _bars(np.ones(len(row)), row, "what noise allows, one standard deviation", _ALLOWED, 9),
        dots(z.ravel(), np.tile(row, cv.segments), "without one part", "#14304f", 5, text=_hover_texts(cv, names)),
    ]
    traces[-1] |= {"hovertemplate": "%{text}: %{x}<extra></extra>"}
    rows: dict[str, Any] = {"tickvals": row.tolist(), "ticktext": names, "automargin": True, "showgrid": False}
    rows |= {"tickfont": {"size": 10}, "range": [len(row) - 0.5, -0.5], "zeroline": False}
    title = axis("moved without one part, in formal standard deviations of that")
    return figure(traces, ROW_PX * len(row) + 110, xaxis=title, yaxis=axis("", **rows))


def _name(g: ParameterGroup, label: str) -> str:
    return (g.name if label in (g.name, "") else f"{g.name} {label}").replace("_", " ")


def _bars(half: np.ndarray, row: np.ndarray, name: str, color: str, width: int) -> dict[str, Any]:
    """Trace of one bar in each row, from -half to half."""
    x = np.stack([-half, half, np.full_like(half, np.nan)], axis=1).ravel()
    return line(x, np.repeat(row, 3), name, color, line={"color": color, "width": width}, hoverinfo="skip")


def _hover_texts(cv: CrossValidation, names: list[str]) -> list[str]:
    """Hover text of each dot: the parameter, and the segment that is left out."""
    return [f"{name}, without part {g + 1}" for g in range(cv.segments) for name in names]


def predicted_fits(cv: CrossValidation) -> Html:
    """Table of the RMS of each kind of residual with the calibration from both halves, and from the other half
    alone."""
    if not cv.fits:
        return element("p", "Each half alone leaves parameters so loose that its residuals in the other mean nothing.")
    whitened, raw = "whitened RMS, took part", "RMS, took part"
    headers = ("sensor", "kind", "residuals", whitened, "predicted", raw, "predicted", "more chi2")
    body = [_row(f) for f in cv.fits if f.count]
    return table(headers, body, headers[2:])


def _row(f: PredictedFit) -> tuple[object, ...]:
    inside, outside = (np.sqrt(x / f.count) for x in (f.chi2_inside, f.chi2_outside))
    rms = (_raw(f.rms_inside, f.unit), _raw(f.rms_outside, f.unit))
    return (
        f.sensor,
        f.kind,
        f.count,
        f"{inside:.4f}",
        f"{outside:.4f}",
        *rms,
        f"{f.chi2_outside - f.chi2_inside:+.1f}",
    )


def _raw(rms: float | None, unit: str) -> str:
    scale, name = {"m": (1e3, "mm"), "rad": (1e3, "mrad")}.get(unit, (1.0, unit))
    return "" if rms is None else f"{scale * rms:.4g} {name}"


def words(c: Calibration, cv: CrossValidation) -> list[str]:
    """Three sentences: the rise of chi^2 by cross-validation, the verdict on the formal standard deviations, and their
    scale by the jackknife."""
    expected, spread = f"{cv.expected:.0f}", f"{cv.spread:.0f}"
    rise = (
        f"Predicted by the other half, chi^2 is {cv.excess:.0f} higher than where both halves took part; noise of "
        f"the stated sizes would make that {expected} ± {spread}, with {cv.directions} parameters that both "
        "halves know."
    )
    rms_shift = float(np.sqrt(np.nanmean(cv.whitened[:, _columns(c)] ** 2))) if len(_columns(c)) else 1.0
    parts = f"By what moves without each of {cv.segments} parts it is {format_number(rms_shift)} on average"
    factor = format_number(cv.factor)
    if cv.optimistic:
        verdict = f"On these data the formal standard deviations are too small by a factor of about {factor}."
    elif cv.pessimistic:
        verdict = f"On these data the formal standard deviations are, if anything, too large (factor {factor})."
    else:
        verdict = f"That is chance: on these data the formal standard deviations hold (factor {factor})."
    return [rise, verdict, f"{parts}; {_printed(c)}"]


def _columns(c: Calibration) -> np.ndarray:
    """Indices in the covariance of the groups of `_estimated_groups`."""
    return np.array([k for g in _estimated_groups(c) for k in g.columns or ()], dtype=np.int64)


def _estimated_groups(c: Calibration) -> list[ParameterGroup]:
    """Estimated groups of sensors except auxiliary ones."""
    return [g for g in c.groups if g.columns is not None and g.sensor in c.rig["sensors"] and g.name not in AUXILIARY]


def _printed(c: Calibration) -> str:
    """Words for the range of empirical factors in the printed standard deviations."""
    factors = [float(g.factor.max()) for g in _estimated_groups(c) if g.factor is not None]
    if not factors:
        return "none is printed."
    low, high = format_number(min(factors)), format_number(max(factors))
    return (
        f"the standard deviations printed here are {low if low == high else f'{low} to {high}'} times the formal ones."
    )


R = TypeVar("R", bound=Residuals)


@dataclass(frozen=True)
class Presenter(Generic[R]):
    """What report, console and 3D view show of one kind of sensor.

    sections: of the report. curves: of one residual record over time; None: one for each column. clouds: points and the
    size of their residuals. amounts: numbers of measurements, as text. shape: (n, 3) polylines in the sensor frame [m],
    for a rig of the given size [m]. legend: explains the shape.
    """

    sections: Callable[[Calibration], Iterable[Section]]
    curves: Callable[[R], Iterable[ResidualCurve]] | None = None
    clouds: Callable[[Calibration], Iterable[ResidualCloud]] = lambda _: ()
    amounts: Callable[[Calibration], Iterable[str]] = lambda _: ()
    shape: Callable[[Calibration, str, float], np.ndarray | None] = lambda *_: None
    legend: str = ""
