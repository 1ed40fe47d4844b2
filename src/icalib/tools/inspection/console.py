"""Prints an inspection on the terminal: first whether the recording can be calibrated, then the figures."""

from __future__ import annotations

from rich.console import Console
from rich.table import Table
from rich.text import Text

from icalib.tools.inspection.facts import Inspection, StreamFacts, Vector

STYLES = {"problem": "bold red", "warning": "yellow", "hint": "dim"}
_ANSWERS = {
    "yes": Text("Yes.", style="bold green"),
    "yes, but": Text("Yes, but not as well as it could be.", style="bold yellow"),
    "no": Text("No.", style="bold red"),
}
_UNSEEN = Text("Yes, as far as can be told without searching images for the target.", style="bold green")


def print_inspection(inspection: Inspection, console: Console | None = None) -> None:
    """Prints on `console`, by default on standard output."""
    out = console or Console()
    answer = _UNSEEN if inspection.verdict == "yes" and inspection.target is None else _ANSWERS[inspection.verdict]
    out.print(Text("Can this be calibrated? ", style="bold") + answer)
    for f in inspection.findings:
        out.print(Text(f"  {f.severity}: ", style=STYLES[f.severity]) + Text(f.sentence))
    out.print()
    out.print(streams_table(inspection))
    if inspection.imus:
        out.print(imu_table(inspection))
    if inspection.frames:
        out.print(frames_table(inspection))
    if inspection.views:
        out.print(target_table(inspection))
        for name, view in inspection.views.items():
            if view.cells:
                out.print(Text(f"Corners over the image of {name} (. none, 1 to 9 the share of the fullest cell):"))
                out.print(Text(coverage_map(view.cells)))
    for note in inspection.notes + tuple(n for v in inspection.views.values() for n in v.notes):
        out.print(Text(f"Note: {note}"))


def streams_table(inspection: Inspection) -> Table:
    """One row for each topic."""
    names = {c.images.name: c.name for c in inspection.sources.cameras if c.images}
    names |= {c.corners.name: c.name for c in inspection.sources.cameras if c.corners}
    names |= {t.name: name for name, t in inspection.sources.imus.items()}
    names |= {source.topic.name: name for name, source in inspection.sources.others.items()}
    table = _table(
        f"Topics of {inspection.recording}",
        ("topic", "type", "sensor", "count", "rate [Hz]", "jitter [ms]", "gaps (longest)", "from to [s]"),
        right=3,
        caption=_caption(inspection),
    )
    origin = _origin(inspection)
    for s in inspection.streams:
        table.add_row(
            *map(Text, (s.topic.name, _type(inspection, s), names.get(s.topic.name, ""), *_timing(s, origin)))
        )
    return table


def imu_table(inspection: Inspection) -> Table:
    """One row for each axis of each IMU."""
    table = _table(
        "IMU",
        ("sensor", "axis", "gyro [rad/s]", "RMS", "accel [m/s^2]", "RMS about mean", "saturated"),
        right=2,
        caption="; ".join(f"{n}: mean |accel| {f.mean_accel:.2f} m/s^2" for n, f in inspection.imus.items()),
    )
    for name, f in inspection.imus.items():
        for k, axis in enumerate("xyz"):
            saturated = ", ".join(f"{s.kind} at {s.limit:.4g}" for s in f.saturated if s.axis == axis)
            cells = (
                name if k == 0 else "",
                axis,
                _range(f.gyro_min, f.gyro_max, k),
                f"{f.gyro_rms[k]:.3f}",
                _range(f.accel_min, f.accel_max, k),
                f"{f.accel_std[k]:.2f}",
                saturated or "no",
            )
            table.add_row(*map(Text, cells), end_section=k == 2)
    return table


def frames_table(inspection: Inspection) -> Table:
    """One row for each transform between two frames."""
    table = _table(
        "Frames",
        ("topic", "parent -> child", "count", "rate [Hz]", "moves"),
        right=2,
        caption="frames of a pose sensor: any two that these connect, parent and child.",
    )
    for f in inspection.frames:
        rate = "" if f.rate_hz is None else f"{f.rate_hz:.1f}"
        cells = (f.topic, f"{f.parent} -> {f.child}", str(f.count), rate, "yes" if f.moves else "no")
        table.add_row(*map(Text, cells))
    return table


def target_table(inspection: Inspection) -> Table:
    """One row for each camera: number of images with the target, coverage of the image, tilts and distances."""
    table = _table(
        f"Target ({inspection.target.target.type} of {inspection.target.file})" if inspection.target else "",
        ("camera", "images", "with target", "corners", "cells covered", "tilt [deg]", "farthest / nearest"),
        right=1,
        caption=(
            "tilt: 10th to 90th percentile of the images; tilt and distances are rough, for the intrinsics are unknown."
        ),
    )
    for name, v in inspection.views.items():
        share = f" ({v.seen / v.images:.0%})" if v.images else ""
        filled = sum(n > 0 for row in v.cells for n in row) if v.cells else None
        table.add_row(
            *map(
                Text,
                (
                    name,
                    "" if v.images is None else str(v.images),
                    f"{v.seen}{share}",
                    str(v.corners),
                    f"{filled} of {len(v.cells) * len(v.cells[0])}" if v.cells else "",
                    f"{v.tilt_deg[0]:.0f} to {v.tilt_deg[2]:.0f}" if v.tilt_deg else "",
                    f"{v.distance_ratio:.1f}" if v.distance_ratio else "",
                ),
            )
        )
    return table


def coverage_map(cells: tuple[tuple[int, ...], ...]) -> str:
    """The grid of cells as lines of text."""
    most = max(max(row) for row in cells) or 1
    return "\n".join("  " + " ".join(_digit(n, most) for n in row) for row in cells)


def _digit(count: int, most: int) -> str:
    return str(max(1, round(9 * count / most))) if count else "."


def _table(title: str, headers: tuple[str, ...], right: int, caption: str) -> Table:
    table = Table(title=title, caption=caption, caption_justify="left", title_justify="left")
    for k, header in enumerate(headers):
        # The first column, the name of the row, does not wrap.
        table.add_column(Text(header), justify="right" if k >= right else "left", overflow="fold", no_wrap=k == 0)
    return table


def _origin(inspection: Inspection) -> int | None:
    """The earliest stamp of all cameras and IMUs [ns]; None if there is none."""
    sensors = {t.name for t in inspection.sources.imus.values()} | {c.topic.name for c in inspection.sources.cameras}
    stamps = [s.timing.first_ns for s in inspection.streams if s.timing and s.topic.name in sensors]
    return min(stamps, default=None)


def _caption(inspection: Inspection) -> str:
    origin = _origin(inspection)
    text = "rate: from the median interval; gaps: intervals longer than 1.5 medians"
    return text if origin is None else f"{text}; from, to: stamps after {origin} ns."


def _type(inspection: Inspection, s: StreamFacts) -> str:
    """The message type of a topic; for images also resolution and encoding."""
    name = next((c.name for c in inspection.sources.cameras if c.images and c.images.name == s.topic.name), "")
    facts = inspection.images.get(name)
    kind = s.topic.type.removeprefix("sensor_msgs/msg/")
    if facts is None or facts.resolution is None:
        return kind
    return f"{kind}, {facts.resolution[0]} x {facts.resolution[1]} {facts.encoding}"


def _timing(s: StreamFacts, origin: int | None) -> tuple[str, ...]:
    t = s.timing
    if t is None:
        return (str(s.topic.count), *[""] * 4)
    ends = () if origin is None else (f"{(ns - origin) * 1e-9:.2f}" for ns in (t.first_ns, t.last_ns))
    return (
        str(s.topic.count),
        f"{t.rate_hz:.2f}" if t.rate_hz else "",
        f"{t.jitter_s * 1e3:.3f}" if t.jitter_s is not None else "",
        f"{t.gaps} ({t.longest_gap_s:.3f} s)" if t.longest_gap_s else "0",
        " to ".join(ends),
    )


def _range(low: Vector, high: Vector, k: int) -> str:
    return f"{low[k]:.2f} to {high[k]:.2f}"
