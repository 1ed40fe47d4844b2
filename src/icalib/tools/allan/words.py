"""An IMU noise study as text: table for the terminal, fields of a rig file, and JSON."""

from __future__ import annotations

import re
from math import floor, log10
from typing import Any

import numpy as np
from rich.console import Console
from rich.table import Table
from rich.text import Text

from icalib.base.text_files import json_text
from icalib.tools.allan.analysis import AXES, ImuNoiseStudy, SensorNoise
from icalib.tools.allan.fit import AllanFit

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
    for title, sentences in (("Warning", study.warnings), ("Note", study.notes)):
        for sentence in sentences:
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
    below = "below " if sensor.open[axis] else ""
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
