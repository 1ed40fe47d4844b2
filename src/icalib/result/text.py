"""A calibration as text and as HTML, for the Python prompt and for notebooks."""

from __future__ import annotations

from html import escape
from typing import TYPE_CHECKING

from icalib.result.quantities import Row, table_rows

if TYPE_CHECKING:
    from icalib.result.calibration import Calibration

_HEAD = ("sensor", "parameter", "value", "std", "unit", "verdict")
_RIGHT = (False, False, True, True, False, False)  # alignment of the columns: numbers are right-aligned
_COLOURS = {"too uncertain": "#c62828", "unobservable": "#c62828", "weak": "#b26a00"}


def one_line(c: Calibration) -> str:
    """One line with the sensors, the verdict and the number of reasons."""
    sensors = ", ".join(c.rig["sensors"])
    count = len(c.reasons)
    why = f", {count} reason{'s' * (count > 1)}" if count else ""
    return f"<Calibration of {sensors}: {c.verdict}{why}; see .summary()>"


def summary_text(c: Calibration) -> str:
    """The verdict with its reasons, and a table of all parameters with standard deviations and verdicts."""
    table = [_HEAD, *(_cells(row) for row in table_rows(c))]
    widths = [max(len(cells[k]) for cells in table) for k in range(len(_HEAD))]
    lines = []
    for cells in table:
        padded = (x.rjust(w) if right else x.ljust(w) for x, w, right in zip(cells, widths, _RIGHT, strict=True))
        lines.append("  ".join(padded).rstrip())
    return "\n".join([f"Verdict: {c.verdict}", *_reasons(c), "", *lines])


def summary_html(c: Calibration) -> str:
    """The verdict with its reasons, and the table of `summary_text`, as HTML."""
    head = "".join(f"<th>{name}</th>" for name in _HEAD)
    body = "".join(f"<tr>{''.join(_html_cells(row))}</tr>" for row in table_rows(c))
    reasons = "".join(f"<li>{escape(reason)}</li>" for reason in c.reasons)
    listed = f"<ol>{reasons}</ol>" if reasons else ""
    return (
        f"<p><b>Verdict: {c.verdict}</b></p>{listed}<table><thead><tr>{head}</tr></thead><tbody>{body}</tbody></table>"
    )


def _reasons(c: Calibration) -> list[str]:
    return [f"Reason {k}: {reason}" for k, reason in enumerate(c.reasons, 1)]


def _cells(row: Row) -> tuple[str, ...]:
    return row.sensor, row.name, row.value, row.std, row.unit, row.verdict


def _html_cells(row: Row) -> list[str]:
    colour = _COLOURS.get(row.verdict, "")
    styles = ["text-align: right" if right else "text-align: left" for right in _RIGHT]
    styles[-1] += f"; color: {colour}" if colour else ""
    return [f'<td style="{style}">{escape(x)}</td>' for style, x in zip(styles, _cells(row), strict=True)]
