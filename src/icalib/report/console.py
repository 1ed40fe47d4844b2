"""The calibration as a table for the terminal, and one-line summaries."""

from __future__ import annotations

import numpy as np
from rich.table import Table
from rich.text import Text

from icalib.result import Calibration, relative_poses
from icalib.result.quantities import NEAR_LOCK, NOT_COUNTED, TURNS, Row, format_number, rpy_deg, table_rows
from icalib.result.summary import body_name, reference_name
from icalib.result.verdict import TOO_UNCERTAIN, UNUSABLE, tolerance
from icalib.rig.kinds import ALL_SPECS

TOLERANCES = ("rotation_tolerance_deg", "translation_tolerance_m", "time_tolerance_s", "pixel_tolerance")
SCALED = "includes the empirical factor: how much more segments of the recording scatter than the noise predicts"
STYLES = {"determined": "green", "weak": "yellow", "fixed": "dim"} | dict.fromkeys(UNUSABLE, "bold red")


def table(calibration: Calibration) -> Table:
    """Table with one row for each parameter: sensor, name, value, standard deviation, unit, verdict."""
    entries = table_rows(calibration)
    out = Table(
        title="Calibration", caption=_caption(calibration, entries), caption_justify="left", title_justify="left"
    )
    for header in ("sensor", "parameter", "value", "std", "unit", "verdict"):
        out.add_column(header, justify="right" if header in ("value", "std") else "left", no_wrap=True)
    for i, row in enumerate(entries):
        first = i == 0 or entries[i - 1].sensor != row.sensor
        last = i + 1 == len(entries) or entries[i + 1].sensor != row.sensor
        cells = (row.sensor if first else "", row.name, row.value, row.std, row.unit)
        verdict = Text(row.verdict, style=STYLES.get(row.verdict, ""))
        out.add_row(*map(Text, cells), verdict, end_section=last)
    return out


def bodies_words(calibration: Calibration) -> str:
    """One line on the largest standard deviations of the poses of the target's rigid bodies; empty for a single
    body."""
    placed = calibration.bodies[1:]
    if not placed:
        return ""
    turn = max(float(calibration.group(b, "rotation").std.max()) for b in placed)
    shift = max(float(calibration.group(b, "translation").std.max()) for b in placed)
    return (
        f"{len(placed)} bodies placed in the frame of {calibration.bodies[0]}, std up to "
        f"{format_number(np.rad2deg(turn))} deg, {format_number(1e3 * shift)} mm; poses are in calibration.yaml."
    )


def relative_words(calibration: Calibration) -> list[str]:
    """One line for each pair of sensors: pose of the second in the frame of the first, with the baseline of two
    cameras."""
    lines = []
    for r in relative_poses(calibration):
        x, y, z = (f"{v:.1f} +- {format_number(s)}" for v, s in zip(1e3 * r.T[:3, 3], 1e3 * r.std[3:], strict=True))
        turns = zip(*rpy_deg(r.T[:3, :3], r.covariance[:3, :3]), strict=True)
        a, b, c = (f"{v:.3f} +- {format_number(s)}" for v, s in turns)
        baseline = ""
        if {r.frame, r.sensor} <= calibration.lenses.keys():
            baseline = f"baseline {1e3 * r.distance:.2f} +- {format_number(1e3 * r.distance_std)} mm; "
        lines.append(f"{r.name}: {baseline}x, y, z {x}, {y}, {z} mm; roll, pitch, yaw {a}, {b}, {c} deg")
    return lines


def _caption(calibration: Calibration, entries: list[Row]) -> str:
    body, reference = body_name(calibration), reference_name(calibration)
    text = (
        f"T_{body}_sensor; rotation: Rz(yaw) Ry(pitch) Rx(roll); x, y, z: std about the sensor's axes; t_{reference} = "
        "t_sensor + time offset."
    )
    scaled = any(g.factor is not None and (g.factor > 1.0).any() for g in calibration.groups)
    text += f" std {SCALED if scaled else 'is formal'}."
    if {"weak", *UNUSABLE} & {v for g in calibration.groups for v in g.verdict}:
        turn, move, time, pixels = (tolerance(calibration, name) for name in TOLERANCES)
        text += (
            f" Tolerances: {turn:g} deg, {1e3 * move:g} mm, {1e3 * time:g} ms, {pixels:g} px; std above it is weak, "
            f"above {TOO_UNCERTAIN:g} of it too uncertain; unobservable is what depends on its guess alone."
        )
    if any(row.verdict.startswith("(") for row in entries):
        text += f" {NOT_COUNTED}"
    if any(row.std == "unknown" and row.name in TURNS for row in entries):
        text += f" {NEAR_LOCK}"
    names = {g.name for g in calibration.groups}
    return " ".join([text, *(f"{s.name}: {s.meaning}." for s in ALL_SPECS if s.is_auxiliary and s.name in names)])
