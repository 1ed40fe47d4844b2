"""The report as one HTML file: what its template shows, and the plots, sections and cards of which it is made."""

from __future__ import annotations

import gzip
import json
import re
from base64 import b64encode
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cache
from importlib.resources import files
from pathlib import Path
from typing import Any, Generic, Literal, TypeVar, cast

import numpy as np
from jinja2 import Environment, PackageLoader, StrictUndefined
from markupsafe import Markup

from icalib.detection.images import MOST_PICTURES
from icalib.kinds import presenters
from icalib.report import pictures, rig_figures
from icalib.report.console import meanings
from icalib.report.figures import (
    CELL_PX,
    Figure,
    ResidualCloud,
    ResidualCurve,
    axis,
    coverage,
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
from icalib.result.pictures import EDGE_STEP
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
from icalib.sensors.parameter import display_unit
from icalib.sensors.sensor import MOUNTED_NAMES
from icalib.sensors.stream import Residuals

# A page is one HTML file that needs no network, from a Jinja template that extends report/frame.html.


@dataclass(frozen=True)
class Plot:
    """A figure of a page. name: id of its HTML element; wide: over all columns."""

    name: str
    figure: Figure
    title: str
    words: str = ""
    wide: bool = False

    @property
    def picture(self) -> pictures.Drawing | None:
        """What is printed in place of a 3D figure; None for others, which are printed as they are."""
        return pictures.static_picture(self.figure)


@dataclass(frozen=True)
class Group:
    """Plots under one heading. note: small, beside the heading; words: below it."""

    title: str = ""
    plots: Sequence[Plot] = ()
    note: str = ""
    words: str = ""


@dataclass(frozen=True)
class Section:
    """One section of a page. name: its HTML id; words: introductory paragraph."""

    name: str
    title: str
    words: str
    groups: Sequence[Group]

    @property
    def plots(self) -> list[Plot]:
        """The plots of all groups."""
        return [plot for group in self.groups for plot in group.plots]


_CONTENTS = re.compile(r'<section id="([^"]+)"[^>]*>\s*<h2>(.*?)</h2>')


@cache
def _templates() -> Environment:
    loader = PackageLoader("icalib", ".")
    env = Environment(loader=loader, autoescape=True, undefined=StrictUndefined, trim_blocks=True, lstrip_blocks=True)
    env.filters["contents"] = lambda body: [(name, Markup(title)) for name, title in _CONTENTS.findall(body)]
    return env


def document(template: str, plots: Iterable[Plot], /, **values: object) -> str:
    """One HTML file, plotly.js included, from a template of the package, such as "report/page.html". plots: those that
    it shows; values: what else it names. Text is escaped."""
    figures = _packed(json.dumps({plot.name: plot.figure for plot in plots}, allow_nan=False))
    return render(template, figures=figures, plotly=_plotly(), **values)


def render(template: str, /, **values: object) -> str:
    """A template of the package with `values`, and the style of all pages. Text is escaped."""
    css = Markup(resource("icalib.report", "page.css"))
    return _templates().get_template(template).render(css=css, **values)


@cache
def _plotly() -> str:
    return _packed(resource("plotly", "package_data/plotly.min.js"))


def _packed(text: str) -> str:
    """The text as the page unpacks it, which makes plotly.js 1.9 MB in place of 4.7 MB."""
    return b64encode(gzip.compress(text.encode(), mtime=0)).decode()


def resource(package: str, name: str) -> str:
    """Text of a resource file of a Python package."""
    return files(package).joinpath(name).read_text(encoding="utf-8")


# `report.html`: the verdict comes first, the supporting figures and tables after it.

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
    "offset in those of fast turns. Points that an object hides from the camera are drawn, too. White dots are depth "
    f"edges: beside them the LiDAR sees something at least {100.0 * EDGE_STEP:.0f} % farther. The framed part, which "
    "has most of them on near objects, is enlarged below. In a good calibration they lie along edges of the image."
)
_HISTOGRAM_WORDS = (
    "The distribution is a little narrower than normal where estimated parameters absorb part of the noise, most of "
    "all for points in few images."
)
_CONVERGENCE_WORDS = "Each stage of the solver has its colour. The predicted decrease says how far it has to go."
_CORRELATION_WORDS = "Formal. Pairs near 1 or -1 cannot be told apart well by this motion."
_SHIFT_WORDS = "Each dot is the change of a parameter if one part of the recording is left out."


def report_html(calibration: Calibration) -> str:
    """The whole report as one HTML document, plotly.js included."""
    c = calibration
    about_sensors, drawn, general = sections(c), list(pictures.figures(c)), _plots(c)
    return document(
        "report/page.html",
        [*general.values(), *(plot for section in about_sensors for plot in section.plots)],
        c=c,
        title=f"Calibration of {' + '.join((*(() if c.imu is None else (c.imu,)), *c.mounted))}",
        header=_header(c),
        body=body_name(c),
        reference=reference_name(c),
        answer=f"{c.verdict[0].upper()}{c.verdict[1:]}. {NEXT[c.verdict]}",
        trust=TRUST[c.verdict],
        grave={c.failure, *c.wrong, *c.unobservable},
        extrinsics=extrinsics(c),
        lead=replace(drawn[-1], jpeg="", name="", window=None) if drawn else general["rig"].picture,
        cards=sensor_cards(c),
        pairs=camera_pairs(c),
        drawings=drawn,
        picture_words=_picture_words(c),
        general=general,
        fits=[(f.sensor, f.kind, f.count, dof_words(f), chi2_words(f), rms_words(f), f.rejected or "") for f in c.fits],
        sections=about_sensors,
        held=c.cross_validation and words(c, c.cross_validation),
        predicted=predicted_fits(c.cross_validation),
        no_cross_validation=_NO_CROSS_VALIDATION,
        parameters=[(r.sensor, r.name, r.verdict, r.value, r.std, r.unit, r.formal, r.factor) for r in table_rows(c)],
        bodies=[(name, *_body_row(c, name)) for name in c.bodies],
        matrices={f"T_{c.body}_{name}": _matrix_text(c.T_body_sensor(name)) for name in _posed(c)},
        relative=[_relative_row(r) for r in relative_poses(c)],
        relative_matrices={r.name: _matrix_text(r.T) for r in relative_poses(c)},
        near_lock=NEAR_LOCK,
        facts=facts(c),
        meanings=meanings({g.name for g in c.groups}),
        tested=meanings({name.partition(".")[2] for name in c.effects}),
    )


def summary_html(c: Calibration) -> str:
    """The verdict with its reasons, and a table of all parameters, as HTML for a notebook."""
    return render("report/summary.html", c=c, rows=table_rows(c))


TRUST: dict[Usability, str] = {
    "usable": "good",
    "usable with care": "care",
    "partly usable": "bad",
    "not usable": "wrong",
}


def _header(c: Calibration) -> dict[str, str]:
    """What the page is about: recordings, rig file, date, version, amount of data. Unknown entries are empty."""
    rig = next((Path(name).name for name in c.inputs if Path(name).suffix in (".yaml", ".yml")), "")
    recordings = ", ".join(r.name for r in c.recordings)
    made = c.made[:16].replace("T", " ")
    known = {"Recording": recordings, "Rig file": rig, "Date": made and f"{made} UTC"}
    return known | {"icalib": c.versions.get("icalib", ""), "Data": size_words(c)}


def _picture_words(c: Calibration) -> str:
    has_points = any(picture.after is not None for picture in c.pictures)
    return f"{_PICTURE_WORDS} {_POINTS_WORDS if has_points else ''}".rstrip()


def _ellipsoid_words(c: Calibration) -> str:
    """Legend of the uncertainty ellipsoids; empty if no translation was estimated."""
    if not ellipsoids(c):
        return ""
    factor = magnification(c)
    size = f"{factor:g} times as large as they are" if factor > 1.0 else "as large as they are"
    return (
        f" Ellipsoids of green, amber or red lines show where a sensor may be: {SIGMAS:g} standard deviations of its "
        f"position, {size}; red ones are not determined. "
        "Those larger than the rig are cut."
    )


def _plots(c: Calibration) -> dict[str, Plot]:
    """Plots that are not about one kind of sensor, by name."""
    rig = f"In the frame of {c.reference}. Red, green and blue are x, y and z"
    rig += "".join(f"; {legend}" for legend in rig_figures.legends(c))
    few = f"At most {rig_figures.MAX_PLOTTED_KEYFRAMES} keyframes are drawn."
    plots = [
        Plot("rig", rig_figures.rig_picture(c), "Places of the sensors", f"{rig}.{_ellipsoid_words(c)}"),
        Plot("histogram", normalised_histogram(c), "Normalised residuals", _HISTOGRAM_WORDS),
        Plot("trajectory", rig_figures.trajectory(c), "Trajectory", f"{c.reference} in the world. {few}"),
        Plot("convergence", rig_figures.convergence(c), "Cost at each step", _CONVERGENCE_WORDS),
        Plot("correlation", rig_figures.correlation(c), "Correlation coefficients", _CORRELATION_WORDS),
    ]
    if c.imu is not None:
        plots.append(Plot("motion", rig_figures.motion(c), "Angular rate, velocity and biases over time", few))
    if c.cross_validation is not None:
        shifts = jackknife_shifts(c, c.cross_validation)
        plots.append(Plot("held-out", shifts, "Parameters without each part", _SHIFT_WORDS))
    return {plot.name: plot for plot in plots}


# Sections of the report, each about the residuals of one kind of sensor.


def sections(c: Calibration) -> list[Section]:
    """Sections of all kinds of sensors in the order of `SENSOR_KINDS`, with the IMU last."""
    first, *others = presenters().values()
    return [section for presenter in (*others, first) for section in presenter.sections(c)]


def row_sections(c: Calibration, kind: str, name: str, title: str, words: str) -> Iterator[Section]:
    """One section with `panels` of each sensor of type `kind` that has `RowResiduals`; none if no sensor has any. name:
    HTML id; words: added to the introduction."""
    residuals = [r for r in c.residuals.values() if isinstance(r, RowResiduals) and r.sensor in c.of_type(kind)]
    if residuals:
        plots = [Plot(f"{name}-{i}", panels(r), f"{r.sensor}: residuals over time") for i, r in enumerate(residuals)]
        yield Section(name, title, f"Predicted - measured. {words}".strip(), [Group(plots=plots)])


# Figures for notebooks.


def residuals_over_time(c: Calibration, sensor: str, kind: str = "") -> Figure:
    """Figure of one residual record. Raises KeyError, which lists the records."""
    for r in c.residuals.values():
        if r.sensor == sensor and kind in ("", r.kind):
            of_kind = presenters()[c.rig["sensors"][sensor]["type"]].over_time
            return of_kind(r) if of_kind else panels(cast(RowResiduals, r))
    there = ", ".join(f"{r.kind} of {r.sensor}" for r in c.residuals.values())
    raise KeyError(f"no {kind or 'residuals'} of {sensor}; there are {there}")


def image_coverage(c: Calibration, camera: str) -> Figure:
    """Number of measured points in use in each cell of the image. Raises KeyError, which lists the cameras."""
    points = {r.sensor: r.uv[r.used] for r in c.image_residuals}
    if camera not in points:
        raise KeyError(f"no images of {camera}; there are {', '.join(points)}")
    width, height = c.rig["sensors"][camera]["resolution"]
    grid, (u, v) = (max(1, height // CELL_PX), max(1, width // CELL_PX)), points[camera].T
    count, _, _ = np.histogram2d(v, u, grid, ((-0.5, height - 0.5), (-0.5, width - 0.5)))
    return coverage(count, (width, height))


def plotly_figure(drawn: Figure) -> Any:
    """A figure of the page as `plotly.graph_objects.Figure`."""
    from plotly.graph_objects import Figure as PlotlyFigure  # takes a second

    return PlotlyFigure(drawn)


# Extrinsics on the first screen.


def extrinsics(c: Calibration) -> list[tuple[str, Verdict | Literal[""], str, str, str]]:
    """A row for each sensor with a place: name, verdict, and values with standard deviations of translation, rotation
    and time offset, as text."""
    out, entries = [], rows(c)
    for name in dict.fromkeys(r.sensor for r in entries if r.sensor in c.mounted or r.sensor == c.imu):
        groups = [g for g in in_body_frame(c).groups if g.sensor == name and g.name in MOUNTED_NAMES]
        verdict = _verdict(c, groups)
        cells = (_cell([r for r in entries if (r.sensor, r.group) == (name, g)]) for g in MOUNTED_NAMES)
        by_name = dict(zip(MOUNTED_NAMES, cells, strict=True))
        if any(by_name.values()):
            out.append((name, verdict, by_name["translation"], by_name["rotation"], by_name["time_offset"]))
    return out


def _verdict(c: Calibration, groups: Iterable[ParameterGroup], lens: tuple[Verdict, ...] = ()) -> Verdict | Literal[""]:
    """The worst verdict on a sensor: empty if none of what was estimated counts, as of parameters with a prior."""
    verdict = worst((*lens, *(v for g in groups for v in counted(c, g))))
    return "" if verdict == "fixed" and any(g.columns is not None for g in groups) else verdict


def _cell(entries: list[Row]) -> str:
    return ", ".join(f"{r.value} ± {r.std}" if r.std else r.value for r in entries if r.value)


# One card for each sensor: value, standard deviation and verdict of every component, and its goodness of fit.


@dataclass(frozen=True)
class Card:
    """What is known of one sensor. css: its colour; marks: further labels; components: rows of name, verdict, value
    and standard deviation; fits: sentences on residuals, and whether each is larger than the stated noise predicts."""

    sensor: str
    kind: str
    css: str
    verdict: Verdict | Literal[""]
    marks: list[str]
    components: list[tuple[str, str, str, str]]
    fits: list[tuple[str, bool]]


def sensor_cards(c: Calibration) -> list[Card]:
    """Cards of all sensors with parameters or residuals, in the order of the rig file; the IMU comes last."""
    known = {g.sensor for g in nontrivial_groups(in_body_frame(c))} | {f.sensor for f in c.fits}
    names = sorted((n for n in c.rig["sensors"] if n in known), key=lambda n: n == c.imu)
    return [_card(c, name) for name in names]


def camera_pairs(c: Calibration) -> list[tuple[str, Verdict, str, str]]:
    """Rows of camera pairs: verdict, baseline, standard deviation of the relative rotation."""
    return [
        (
            f"{r.frame} to {r.sensor}",
            _pair_verdict(c, r),
            f"{1e3 * r.distance:.2f} ± {format_number(1e3 * r.distance_std)} mm",
            f"± {format_number(float(np.rad2deg(r.std[:3].max())))} deg",
        )
        for r in relative_poses(c)
        if {r.frame, r.sensor} <= c.lenses.keys()
    ]


def _pair_verdict(c: Calibration, r: RelativePose) -> Verdict:
    """Verdict on a relative pose, by its largest standard deviation in tolerances of the rig file's settings."""
    turn, move = np.deg2rad(tolerance(c, "rotation_tolerance_deg")), tolerance(c, "translation_tolerance_m")
    return component_verdict(float(max(r.std[:3].max() / turn, r.std[3:].max() / move)))


def _card(c: Calibration, sensor: str) -> Card:
    """Card of one sensor. Red: a component is unusable, residuals are at least `FAR_BEYOND` times the stated noise,
    or an error in the rig file or recording names the sensor. Amber: a component is weak, or residuals exceed the
    stated noise."""
    lens, fits = c.lenses.get(sensor, ()), [f for f in c.fits if f.sensor == sensor]
    groups = [g for g in nontrivial_groups(in_body_frame(c)) if g.sensor == sensor and g.name not in AUXILIARY]
    verdict = _verdict(c, groups, (lens_verdict(c, sensor),) if lens else ())
    fit = max((excess(f) for f in fits), default=1.0)
    named = any(re.search(rf"(?<!\w){re.escape(sensor)}(?!\w)", sentence) for sentence in c.wrong)
    css = "bad" if verdict in UNUSABLE or named or fit >= FAR_BEYOND else "weak" if fit > 1.0 else verdict or "fixed"
    marks = [w for w, applies in (("poor fit", fit > 1.0), ("see the reasons", named and fit == 1.0)) if applies]
    components = _components(c, sensor, lens) if groups else []
    lines = [(_fit_words(f), excess(f) > 1.0) for f in fits]
    return Card(sensor, c.rig["sensors"][sensor]["type"], css, verdict, marks, components, lines)


def _components(c: Calibration, sensor: str, lens: tuple[str, ...]) -> list[tuple[str, str, str, str]]:
    """One row for each component. The coefficients of a lens share one row, which shows its projection uncertainty."""
    hidden = {*AUXILIARY, *(n for g in c.groups if g.sensor == sensor and g.name in lens for n in g.labels)}
    components = [r for r in rows(c) if r.sensor == sensor and r.name not in hidden]
    body = [(r.name, r.verdict, r.value, _std(r)) for r in components]
    if lens:
        sigma, verdict = lens_projection_px(c, sensor), lens_verdict(c, sensor)
        size = "" if sigma is None else f"± {format_number(sigma)} px"
        body.append(("lens, projection" if size else "lens", verdict, "", size))
    return body


def _std(row: Row) -> str:
    return f"± {row.std} {row.unit}".rstrip() if row.std else row.unit


def _fit_words(f: SensorFit) -> str:
    rms = f"{rms_words(f)} RMS, " if f.rms is not None else ""
    if excess(f) > 1.0:
        return f"{f.kind}: {rms}residuals {times(f)} the stated noise"
    return f"{f.kind}: {rms}chi^2 / dof {chi2_words(f)}"


# Tables below the first screen.


def _body_row(c: Calibration, body: str) -> list[str]:
    turn, move = c.group(body, "rotation"), c.group(body, "translation")
    angles, angle_std = rpy_deg(turn.value, joint_covariance(c, [turn]))
    values = [f"{1e3 * x:.2f}" for x in move.value] + [f"{x:.3f}" for x in angles]
    if turn.columns is None:
        return [*values, "", "", "fixed"]
    std = [format_number(1e3 * float(move.std.max())), format_number(float(angle_std.max()))]
    return [*values, *std, worst((*turn.verdict, *move.verdict))]


def _posed(c: Calibration) -> tuple[str, ...]:
    """Names of the sensors whose pose in the body frame is shown as a matrix."""
    return c.mounted if c.body == c.reference else c.on_body


def _matrix_text(T: np.ndarray) -> str:
    return "\n".join("[" + ", ".join(f"{x: .9f}" for x in row) + "]" for row in T)


def _relative_row(r: RelativePose) -> list[str]:
    """Name, distance, translation [mm] and rotation [deg] of a relative pose, with standard deviations."""
    angles, angle_std = rpy_deg(r.T[:3, :3], r.covariance[:3, :3])
    values = [1e3 * r.distance, *(1e3 * r.T[:3, 3]), *angles]
    std = [1e3 * r.distance_std, *(1e3 * r.std[3:]), *angle_std]
    return [r.name, *(f"{x:.3f} ± {format_number(s)}" for x, s in zip(values, std, strict=True))]


def facts(c: Calibration) -> dict[tuple[str, str], dict[str, Any]]:
    """Settings, effects that were tested, versions, wall times and sensor rates, by title and header of the names."""
    return {
        ("Settings of the rig file", "name"): c.settings,
        ("Tested, not in the model", "effect"): {name: _tested_words(effect) for name, effect in c.effects.items()},
        ("Versions", "package"): c.versions,
        ("Wall time [s]", "stage"): {k: f"{v:.2f}" for k, v in c.timings.items()},
        ("Rates [Hz]", "sensor"): {k: f"{v:.4g}" for k, v in c.rates.items()},
    }


def _tested_words(effect: dict[str, Any]) -> str:
    """Value and standard deviation of an effect, of the number that is the largest of several."""
    off = [abs(v) / s for v, s in zip(effect["value"], effect["std"], strict=True)]
    k = off.index(max(off))
    label = f"{effect['labels'][k]} " if len(off) > 1 else ""
    unit, scale = display_unit(effect["unit"])
    return f"{label}{scale * effect['value'][k]:.2g} ± {scale * effect['std'][k]:.2g} {unit}"


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


def predicted_fits(cv: CrossValidation | None) -> list[tuple[object, ...]]:
    """Rows of the RMS of each kind of residual with the calibration from both halves, and from the other half alone;
    empty where each half alone leaves parameters too loose."""
    return [_row(f) for f in cv.fits if f.count] if cv else []


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
    factors = [float(x) for g in _estimated_groups(c) if g.factor is not None for x in g.factor]
    if not factors:
        return "none is printed."
    low, high = format_number(min(factors)), format_number(max(factors))
    return (
        f"the printed standard deviations of sensors are {low if low == high else f'{low} to {high}'} times the formal "
        "ones."
    )


R = TypeVar("R", bound=Residuals)


@dataclass(frozen=True)
class Presenter(Generic[R]):
    """What report, console and 3D view show of one kind of sensor.

    sections: of the report. over_time: figure of one residual record; None: `panels`. curves: of one residual record
    over time; None: one for each column. clouds: points and the size of their residuals. amounts: numbers of
    measurements, as text. shape: (n, 3) polylines in the sensor frame [m],
    for a rig of the given size [m]. legend: explains the shape.
    """

    sections: Callable[[Calibration], Iterable[Section]]
    over_time: Callable[[R], Figure] | None = None
    curves: Callable[[R], Iterable[ResidualCurve]] | None = None
    clouds: Callable[[Calibration], Iterable[ResidualCloud]] = lambda _: ()
    amounts: Callable[[Calibration], Iterable[str]] = lambda _: ()
    shape: Callable[[Calibration, str, float], np.ndarray | None] = lambda *_: None
    legend: str = ""
