"""Cross-validation in the report: the estimates without each segment (jackknife), and the two-fold cross-validation."""

from __future__ import annotations

from typing import Any

import numpy as np

from icalib.report.plot import Figure, axis, dots, figure, line
from icalib.report.tables import Html, element, table
from icalib.result import Calibration, CrossValidation, ParameterGroup, PredictedFit
from icalib.result.quantities import format_number, nontrivial_groups

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
    """Estimated groups of sensors except edge bloom."""
    return [g for g in c.groups if g.columns is not None and g.sensor in c.rig["sensors"] and g.name != "bloom"]


def _printed(c: Calibration) -> str:
    """Words for the range of empirical factors in the printed standard deviations."""
    factors = [float(g.factor.max()) for g in _estimated_groups(c) if g.factor is not None]
    if not factors:
        return "none is printed."
    low, high = format_number(min(factors)), format_number(max(factors))
    return (
        f"the standard deviations printed here are {low if low == high else f'{low} to {high}'} times the formal ones."
    )
