"""The calibration as a table for the terminal."""

from __future__ import annotations

from rich.table import Table
from rich.text import Text

from icalib.calibration import Calibration
from icalib.report.quantities import rows

STYLES = {"determined": "green", "weak": "yellow", "undetermined": "bold red", "fixed": "dim"}


def table(calibration: Calibration) -> Table:
    """One row for each parameter: sensor, name, value, standard deviation, unit, verdict."""
    out = Table(title="Calibration", caption=_caption(calibration), caption_justify="left", title_justify="left")
    for header in ("sensor", "parameter", "value", "std", "unit", "verdict"):
        out.add_column(header, justify="right" if header in ("value", "std") else "left", no_wrap=True)
    found = rows(calibration)
    for i, row in enumerate(found):
        first = i == 0 or found[i - 1].sensor != row.sensor
        last = i + 1 == len(found) or found[i + 1].sensor != row.sensor
        cells = (row.sensor if first else "", row.name, row.value, row.std, row.unit)
        verdict = Text(row.verdict, style=STYLES[row.verdict])
        out.add_row(*map(Text, cells), verdict, end_section=last)
    return out


def _caption(calibration: Calibration) -> str:
    body = "imu" if calibration.imu else calibration.body
    text = f"T_{body}_sensor; rotation: std about the sensor's axes; t_{body} = t_sensor + time offset."
    scaled = any(g.columns is not None and g.factor is not None for g in calibration.groups)
    return text + (" std includes the empirical factor." if scaled else " std is formal: the recording was not split.")
