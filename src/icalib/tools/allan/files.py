"""Result files of `icalib allan`.

`allan.html`: Allan deviations and fitted noise, in one file that needs no network. An IMU noise study as text: table
for the terminal, fields of a rig file, and JSON.
"""

from __future__ import annotations

import re
from math import floor, log10
from pathlib import Path
from typing import Any

import numpy as np
from rich.console import Console
from rich.table import Table
from rich.text import Text

from icalib.base.files import check_writable, json_text, printable, refuse_foreign, sealed_texts, write_texts
from icalib.report.figures import AXIS_COLORS, Figure, axis, figure, line
from icalib.report.page import Plot, document
from icalib.tools.allan.analysis import AXES, AllanFit, ImuNoiseStudy, SensorNoise, model_variance

FILES = ("allan.html", "noise.yaml", "allan.json")


def check_folder(folder: Path) -> None:
    """Makes `folder` and checks that it is writable, before the work starts.

    Raises CalibrationError if it is not, or if it has files of the names `FILES` that icalib did not write.
    """
    check_writable(folder)
    refuse_foreign(folder / name for name in FILES)


def write_study(study: ImuNoiseStudy, folder: Path) -> None:
    """Writes allan.html, noise.yaml (fields of a rig file) and allan.json to `folder`. Raises CalibrationError if that
    fails, or a file of the same name is not from icalib."""
    texts = map(printable, (allan_html(study), rig_snippet(study, warned=True), study_json(study)))
    refuse_foreign(folder / name for name in FILES)
    write_texts(folder, sealed_texts(dict(zip(FILES, texts, strict=True))))


_HEADERS = ("", "noise density", "bias walk", "bias instability")


def allan_html(study: ImuNoiseStudy) -> str:
    """The page as one HTML document, plotly.js included."""
    plots = [Plot(s.kind, deviation_figure(s, study.period), s.kind.capitalize()) for s in study.sensors]
    return document(
        "tools/allan/page.html",
        plots,
        title=f"Noise of {study.name}",
        summary=f"{study.where}, {study.seconds:.0f} s at rest, {1.0 / study.period:.6g} Hz",
        headers=_HEADERS,
        rows=[cells for sensor in study.sensors for cells in rows(sensor)],
        snippet=rig_snippet(study),
        study=study,
        plots=plots,
    )


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


_UNITS = {"gyroscope": ("rad/s/sqrt(Hz)", "rad/s^2/sqrt(Hz)"), "accelerometer": ("m/s^2/sqrt(Hz)", "m/s^3/sqrt(Hz)")}
_FIELDS = {"gyroscope": ("gyro", "gyro_walk"), "accelerometer": ("accel", "accel_walk")}


def units(sensor: SensorNoise) -> tuple[str, str]:
    """Units of the noise density and of the bias walk."""
    return _UNITS[sensor.kind]


def rig_snippet(study: ImuNoiseStudy, warned: bool = False) -> str:
    """YAML to be pasted below the IMU of a rig file. A walk that is not significant is given as its upper bound.
    warned: add the warnings as comments."""
    lines = [
        f"# Noise of {study.name}, from {study.seconds:.0f} s at rest at {1.0 / study.period:.6g} Hz (icalib allan).",
        *(f"# Warning: {sentence}" for sentence in study.warnings if warned),
        "noise:",
    ]
    for sensor in study.sensors:
        for name, unit, value, std in _figures(sensor):
            bound = name.endswith("_walk") and not sensor.together.resolved
            known = "upper bound, 95 %: the recording is too short" if bound else f"+- {std:.1e}"
            lines.append(f"  {name}: {value:.3e}  # {unit}, {known}")
    lines.append(f'  source: "{study.seconds:.0f} s at rest"')
    return "\n".join(lines) + "\n"


def study_json(study: ImuNoiseStudy) -> str:
    """Text of allan.json: all figures of the study, in SI units."""
    plain: dict[str, Any] = {"imu": study.name, "recording": study.where, "seconds": study.seconds}
    plain |= {"rate": 1.0 / study.period, "warnings": list(study.warnings), "notes": list(study.notes)}
    for sensor in study.sensors:
        plain[sensor.kind] = {
            "together": _fit(sensor.together),
            "axes": {axis: _fit(fit) for axis, fit in zip(AXES, sensor.axes, strict=True)},
            "bias_instability": sensor.instability.tolist(),
            "bias_instability_tau": sensor.instability_tau.tolist(),
            "allan_tau": sensor.deviation.tau.tolist(),
            "allan_deviation": sensor.deviation.deviation.T.tolist(),
        }
    return json_text(plain)


def print_study(study: ImuNoiseStudy) -> None:
    """Prints table, lines for the rig file, and warnings on standard output."""
    console = Console()
    console.print(noise_table(study))
    console.print("For the rig file, below the IMU:\n\n" + rig_snippet(study), markup=False, highlight=False)
    for title, texts in (("Warning", study.warnings), ("Note", study.notes)):
        for sentence in texts:
            console.print(f"{title}: {sentence}", markup=False)


def noise_table(study: ImuNoiseStudy) -> Table:
    """Table of the study. Each sensor has a row of units, a row for each axis, and a row for all three together."""
    out = Table(title=f"Noise of {study.name}, {study.seconds:.0f} s at rest", title_justify="left")
    for header in ("", "noise density", "bias walk", "bias instability"):
        out.add_column(header, no_wrap=True)
    for sensor in study.sensors:
        for cells in rows(sensor):
            out.add_row(*map(Text, cells), end_section=cells[0].endswith("together"))
    return out


def rows(sensor: SensorNoise) -> list[tuple[str, str, str, str]]:
    """Rows of one sensor: units, each axis, all together. Cells: name, noise density, bias walk, bias instability."""
    table_rows = [(sensor.kind, *units(sensor), sensor.unit)]
    for k, (name, fit) in enumerate([*zip(AXES, sensor.axes, strict=True), ("together", sensor.together)]):
        walk = with_std(fit.walk, fit.walk_std) if fit.resolved else _short(f"below {fit.walk_upper:.1e}")
        table_rows.append((f"  {name}", with_std(fit.white, fit.white_std), walk, _instability(sensor, k)))
    return table_rows


def with_std(value: float, std: float) -> str:
    """Text such as "1.602e-4 +- 2.4e-7"; the standard deviation sets the number of digits."""
    digits = int(np.clip(floor(log10(value)) - floor(log10(std)) + 1, 1, 6)) if value > 0 < std else 2
    return _short(f"{value:.{digits}e} +- {std:.1e}")


def _short(text: str) -> str:
    return re.sub(r"e([-+])0", r"e\1", text)


def _instability(sensor: SensorNoise, axis: int) -> str:
    if axis >= len(AXES):
        return ""
    below = "< " if sensor.open[axis] else ""
    return _short(f"{below}{sensor.instability[axis]:.1e} at {sensor.instability_tau[axis]:.0f} s")


def _figures(sensor: SensorNoise) -> list[tuple[str, str, float, float]]:
    """For density and walk: field of the rig file, unit, value, standard deviation."""
    fit = sensor.together
    walk = fit.walk if fit.resolved else fit.walk_upper
    values = ((fit.white, fit.white_std), (walk, fit.walk_std))
    named = zip(_FIELDS[sensor.kind], units(sensor), values, strict=True)
    return [(name, unit, value, std) for name, unit, (value, std) in named]


def _fit(fit: AllanFit) -> dict[str, Any]:
    return {
        "noise_density": fit.white,
        "noise_density_std": fit.white_std,
        "bias_walk": fit.walk if fit.resolved else None,
        "bias_walk_std": fit.walk_std if fit.resolved else None,
        "bias_walk_upper": fit.walk_upper,
        "misfit": fit.misfit,
    }
