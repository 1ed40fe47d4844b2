"""The calibration as a table for the terminal, and one-line summaries."""

from __future__ import annotations

from collections.abc import Collection

import numpy as np
from rich.table import Table
from rich.text import Text

from icalib.result import Calibration, relative_poses
from icalib.result.quantities import NEAR_LOCK, NOT_COUNTED, TURNS, Row, format_number, rpy_deg, table_rows
from icalib.result.saving import body_name, reference_name
from icalib.result.verdict import AUXILIARY, TOO_UNCERTAIN, UNUSABLE, WORST_FIRST, counted, tolerance, worst
from icalib.rig import LENS
from icalib.rig.rig import ALL_SPECS
from icalib.sensors.sensor import MOUNTED_NAMES, ROTATION, TRANSLATION

TOLERANCES = ("rotation_tolerance_deg", "translation_tolerance_m", "time_tolerance_s", "pixel_tolerance")
SCALED = "includes the empirical factor: how much more segments of the recording scatter than the noise predicts"
STYLES = {"determined": "green", "weak": "yellow", "fixed": "dim"} | dict.fromkeys(UNUSABLE, "bold red")


def shown_rows(c: Calibration, verbose: bool) -> list[Row]:
    """Rows of the table, extrinsics and time offsets of all sensors first. Rows of lenses, IMU intrinsics and auxiliary
    parameters are there only if `verbose`, if a reason names them, or if a bad verdict on them counts."""
    out, reasons = list[Row](), " ".join(c.reasons).replace("_", " ")
    for r in sorted(table_rows(c), key=lambda r: r.group not in MOUNTED_NAMES):
        names = (f"{r.sensor} {r.group}", f"{r.group} of {r.sensor}", f"{r.name} of {r.sensor}")
        is_named = any(name.replace("_", " ") in reasons for name in names)
        counts = r.verdict in WORST_FIRST[:3] and r.sensor not in c.lenses  # a lens has its line, with its verdict
        if verbose or is_named or counts or r.group not in (*LENS, *AUXILIARY):
            out.append(r)
    return out


def table(entries: list[Row]) -> Table:
    """Table with one row for each of `entries`: sensor, name, value, standard deviation, unit, verdict."""
    out = Table(title="Calibration", title_justify="left")
    for header in ("sensor", "parameter", "value", "std", "unit", "verdict"):
        out.add_column(header, justify="right" if header in ("value", "std") else "left", no_wrap=True)
    sensors = ["", *(row.sensor for row in entries), ""]
    for row, above, below in zip(entries, sensors, sensors[2:], strict=False):
        cells = (row.sensor if row.sensor != above else "", row.name, row.value, row.std, row.unit)
        verdict = Text(row.verdict, style=STYLES.get(row.verdict, ""))
        out.add_row(*map(Text, cells), verdict, end_section=row.sensor != below)
    return out


def lens_words(c: Calibration, width: int) -> list[str]:
    """One line for each camera: focal lengths and principal point, and the projection uncertainty, with a verdict that
    is bad. Camera model and distortion follow if the line has at most `width` characters then."""
    lines, entries = [], table_rows(c)
    for camera, names in c.lenses.items():
        groups = [g for g in c.groups if g.sensor == camera and g.name in names]
        values = [[f"{r.name} {r.value}" for r in entries if (r.sensor, r.group) == (camera, n)] for n in names]
        sigma, verdict = c.lens_projections_px[camera], worst(tuple(v for g in groups for v in counted(c, g)))
        size = f"projection +- {format_number(sigma or np.nan)} px" if any(g.columns for g in groups) else "fixed"
        line = f"{camera} lens: {' '.join(values[0])} px, {size}" + f", {verdict}" * (verdict in WORST_FIRST[:3])
        longer = f"{line}, {c.rig['sensors'][camera]['model']}"
        longest = " ".join([longer, *values[1]])
        lines.append(next((words for words in (longest, longer) if len(words) <= width), line))
    return lines


def bodies_words(calibration: Calibration) -> str:
    """Line on the largest standard deviations of the poses of the target's rigid bodies; empty for a single body."""
    if not (placed := calibration.bodies[1:]):
        return ""
    turn, shift = (max(calibration.group(b, s.name).std.max() for b in placed) for s in (ROTATION, TRANSLATION))
    return (
        f"target: {len(placed)} bodies placed in the frame of {calibration.bodies[0]}, std up to "
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
        baseline = f"baseline {1e3 * r.distance:.2f} +- {format_number(1e3 * r.distance_std)} mm; "
        baseline *= {r.frame, r.sensor} <= calibration.lenses.keys()
        lines.append(f"{r.name}: {baseline}x, y, z {x}, {y}, {z} mm; roll, pitch, yaw {a}, {b}, {c} deg")
    return lines


def legend(calibration: Calibration, entries: list[Row]) -> str:
    """What words and numbers of the table of `entries` mean, and which parameters `-v` adds."""
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
    hidden = [row.group for row in table_rows(calibration) if row not in entries]
    text += f" -v adds {len(hidden)} rows: {', '.join(dict.fromkeys(hidden))}." if hidden else ""
    names = {row.group for row in entries}
    return " ".join([text, *meanings(names)])


def meanings(names: Collection[str]) -> list[str]:
    """Sentences on groups of parameters whose names do not explain them."""
    return [f"{s.name}: {s.meaning}." for s in ALL_SPECS if s.meaning and s.name in names]
