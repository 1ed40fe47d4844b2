"""A comparison as sentences, and as JSON."""

from __future__ import annotations

import dataclasses
from math import floor, log10

import numpy as np

from icalib.base.files import json_text, printable
from icalib.tools.comparison.compare import Comparison, Difference

_ALONG = 0.95  # a vector is along one axis if this component is a larger share of its norm
ROUNDING = 1e-6  # deg, mm, ms, px, %: smaller differences come from the arithmetic, such as that of unprojection
_TITLES = {True: "same", False: "DIFFERS"}


def lines(comparison: Comparison) -> list[str]:
    """Lines to print: the two sides, a line for each block (differing ones first), notes, and the verdict."""
    c = comparison
    text_lines = [f"A: {c.a.path} ({c.a.kind})", f"B: {c.b.path} ({c.b.kind}); from A to B:"]
    width = max(map(len, _TITLES.values()))
    for d in sorted(c.differences, key=lambda d: not d.differs):
        text_lines.append(f"  {_TITLES[not d.differs]:<{width}}  {sentence(d, c)}")
    text_lines += [f"Note: {note}" for note in c.notes]
    count = sum(d.differs for d in c.differences)
    return [*text_lines, "The same." if c.same else f"{count} of {len(c.differences)} differ."]


def sentence(d: Difference, c: Comparison) -> str:
    """A sentence on one difference, such as "cam1 turned by 0.12 deg about its x axis, 4.0 sigma"."""
    relative = "" if d.frame in (c.reference, d.sensor) else f" relative to {d.frame}"
    if d.size < ROUNDING:
        return f"the {d.what} of {d.sensor}{relative} did not change{_open(d)}"
    match d.what:
        case "rotation":
            turn = _axis(d, "about its {} axis", "about its axis {}")
            words = f"{d.sensor} turned by {turn}{relative}"
        case "translation":
            along = f"along {{}} of {d.frame}"
            words = f"{d.sensor} moved by {_axis(d, along, along)}"
        case "lens":
            words = (
                f"the lens of {d.sensor} moved points by {digits(d.size)} px RMS, {digits(d.most or 0.0)} px at most"
            )
        case _:
            most = int(np.argmax(np.abs(d.vector)))
            unit = "%" if d.unit == "percent" else d.unit
            label = f"{d.labels[most]} " if d.labels[most] else ""
            words = f"the {label}{d.what} of {d.sensor} changed by {_signed(d.vector[most])} {unit}"
    return f"{words}, {_certainty(d)}"


def comparison_json(comparison: Comparison) -> str:
    """The comparison as JSON."""
    c = comparison
    plain = {
        "a": {"path": c.a.path, "kind": c.a.kind},
        "b": {"path": c.b.path, "kind": c.b.kind},
        "same": c.same,
        "reference": c.reference,
        "differences": [dataclasses.asdict(d) | {"sentence": sentence(d, c)} for d in c.differences],
        "notes": list(c.notes),
    }
    return printable(json_text(plain))


def digits(value: float) -> str:
    """The value with two significant digits; with an exponent below 1e-4 and from 1e5 on."""
    if value == 0.0 or not 1e-4 <= abs(value) < 1e5:
        return f"{value:.1e}" if value else "0"
    return f"{value:.{max(0, 1 - floor(log10(abs(value))))}f}"


def _signed(value: float) -> str:
    return f"{'+' if value >= 0 else '-'}{digits(abs(value))}"


def _axis(d: Difference, one: str, several: str) -> str:
    """Size and direction of a vector. one: format for a coordinate axis, along which the component has its sign;
    several: format for a unit vector."""
    vector = np.array(d.vector)
    most = int(np.argmax(np.abs(vector)))
    if abs(vector[most]) >= _ALONG * d.size:
        return f"{digits(float(vector[most]))} {d.unit} {one.format(d.labels[most])}"
    axis = ", ".join(f"{v:.2f}" for v in vector / d.size)
    return f"{digits(d.size)} {d.unit} {several.format(f'[{axis}]')}"


def _certainty(d: Difference) -> str:
    if d.sigmas is None:
        words = f"no standard deviation is known (tolerance {_tolerance(d)})"
    else:
        words = f"{d.sigmas:.1f} sigma" + (f" of {d.given_by} alone" if d.given_by in ("A", "B") else "")
        words += f" (tolerance {_tolerance(d)})" if d.tolerance > 0 else ""
    return words + _open(d)


def _open(d: Difference) -> str:
    return f", unobservable or too uncertain in {' and '.join(d.open)}" if d.open else ""


def _tolerance(d: Difference) -> str:
    return f"{d.tolerance:g} {'%' if d.unit == 'percent' else d.unit}"
