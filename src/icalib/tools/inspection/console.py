"""Prints an inspection on the terminal: first whether the recording can be calibrated, then the figures.

The same as a page with plots and images. Figures of an inspection as plain data and JSON, in SI units.
"""

from __future__ import annotations

import dataclasses
import textwrap
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from errno import EACCES, EADDRINUSE
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from threading import Thread
from typing import Any

import numpy as np
from rich.console import Console
from rich.measure import Measurement
from rich.padding import Padding
from rich.table import Table
from rich.text import Text

from icalib.base.files import json_text
from icalib.errors import CalibrationError
from icalib.geometry.targets import Scene
from icalib.kinds import inspectors
from icalib.report.page import document, render
from icalib.tools.inspection.facts import Inspection, StreamFacts, named, plain

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
    out.print(Text("Can this be calibrated? ", style="bold") + _answer(inspection))
    for f in inspection.findings:
        out.print(Text(f"  {f.severity}: ", style=STYLES[f.severity]) + Text(f.sentence))
    out.print()
    printouts = [kind.printout(inspection) for kind in inspectors().values()]
    tables: list[Table | Text] = [streams_table(inspection)]
    tables += (table for kind in printouts for table in kind.readings)
    tables += (table for kind in printouts for table in kind.target)
    for table in tables:
        _print_table(table, out)
    for note in (*inspection.notes, *(note for kind in printouts for note in kind.notes)):
        out.print(Text(f"Note: {note}"))


def _answer(inspection: Inspection) -> Text:
    return _UNSEEN if inspection.verdict == "yes" and inspection.target is None else _ANSWERS[inspection.verdict]


def inspection_html(inspection: Inspection) -> str:
    """The inspection as one HTML document."""
    kinds = inspectors().values()
    printouts, pictures = [k.printout(inspection) for k in kinds], [k.pictures(inspection) for k in kinds]
    tables = [t for p in printouts for t in (*p.readings, *p.target) if isinstance(t, Table)]
    plots = [plot for of_kind, _ in pictures for plot in of_kind]
    return document(
        "tools/inspection/page.html",
        plots,
        title=f"Recording {Path(inspection.recording).name}",
        answer=str(_answer(inspection)),
        trust={"yes": "good", "yes, but": "care", "no": "bad"}[inspection.verdict],
        inspection=inspection,
        streams=_plain_table(streams_table(inspection)),
        tables=[_plain_table(t) for t in tables],
        notes=[*inspection.notes, *(note for p in printouts for note in p.notes)],
        plots=plots,
        drawings=[drawing for _, of_kind in pictures for drawing in of_kind],
    )


def _plain_table(table: Table) -> dict[str, Any]:
    """Title, headers, rows and caption of a table of the terminal."""
    rows = list(zip(*(map(str, column.cells) for column in table.columns), strict=True))
    headers = [str(column.header) for column in table.columns]
    return {"title": str(table.title or ""), "headers": headers, "rows": rows, "caption": str(table.caption or "")}


def _print_table(table: Table | Text, out: Console) -> None:
    """Prints a table. If the terminal is narrower, each row is a line of text: columns would break words."""
    if isinstance(table, Text) or Measurement.get(out, out.options.update(width=10_000), table).maximum <= out.width:
        out.print(table)
        return
    out.print(Text(str(table.title), style="bold"))
    for cells in zip(*(column.cells for column in table.columns), strict=True):
        named = [f"{c.header} {cell}" for c, cell in zip(table.columns[1:], cells[1:], strict=True) if str(cell)]
        out.print(Padding(Text(f"{cells[0]}: ".lstrip(": ") + ", ".join(named)), (0, 0, 0, 2)))
    out.print(Text(str(table.caption or "")))


def streams_table(inspection: Inspection) -> Table:
    """One row for each topic."""
    names = {topic.name: name for name, source in inspection.sources.sensors.items() for topic in source.topics}
    table = plain_table(
        f"Topics of {inspection.recording}",
        ("topic", "type", "sensor", "count", "rate [Hz]", "jitter [ms]", "gaps (longest)", "from to [s]"),
        right=3,
        caption=_caption(inspection),
    )
    origin = _origin(inspection)
    for s in inspection.streams:
        table.add_row(*map(Text, (s.topic.name, _type(s), names.get(s.topic.name, ""), *_timing(s, origin))))
    return table


def plain_table(title: str, headers: tuple[str, ...], right: int, caption: str) -> Table:
    """An empty table; right: number of the first column that is aligned to the right."""
    table = Table(title=title, caption=caption, caption_justify="left", title_justify="left")
    for k, header in enumerate(headers):
        table.add_column(Text(header), justify="right" if k >= right else "left")
    return table


def _origin(inspection: Inspection) -> int | None:
    """The earliest stamp of all sensors that may set the origin of times [ns]; None if there is none."""
    sensors = named(inspection, lambda kind: kind.sets_origin)
    topics = {inspection.sources.sensors[name].topic for name in sensors}
    stamps = [s.timing.first_ns for s in inspection.streams if s.timing and s.topic in topics]
    return min(stamps, default=None)


def _caption(inspection: Inspection) -> str:
    origin = _origin(inspection)
    text = "rate: from the median interval; gaps: intervals longer than 1.5 medians"
    return text if origin is None else f"{text}; from, to: stamps after {origin} ns."


def _type(s: StreamFacts) -> str:
    """The message type of a topic, and words on the content."""
    kind = s.topic.type.removeprefix("sensor_msgs/msg/")
    return f"{kind}, {s.content}" if s.content else kind


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


def figures(inspection: Inspection) -> dict[str, Any]:
    """The inspection as dicts, lists, numbers and text. Names of figures that are not in SI units end with the unit."""
    return {
        "recording": inspection.recording,
        "verdict": inspection.verdict,
        "findings": [dataclasses.asdict(f) for f in inspection.findings],
        "topics": [_stream(s) for s in inspection.streams],
        **_sensors(inspection),
        "frames": [dataclasses.asdict(f) for f in inspection.frames],
        "left_out": dict(inspection.sources.left_out),
        "target": _target(inspection),
        "notes": list(inspection.notes),
    }


def figures_json(inspection: Inspection) -> str:
    """`figures` as the text of a JSON file."""
    return json_text(figures(inspection)) + "\n"


def _sensors(inspection: Inspection) -> dict[str, Any]:
    """The sections with figures of the sensors; there is one for each kind, if only empty."""
    sections: dict[str, Any] = {"cameras": {}, "imus": {}, "imu": inspection.imu, "others": {}}
    for name, source in inspection.sources.sensors.items():
        kind = inspectors()[source.kind]
        sections[kind.section][name] = kind.figures(inspection, name)
    return sections


def _stream(stream: StreamFacts) -> dict[str, Any]:
    """One topic: its entry in the index, and the statistics of its stamps."""
    topic = dataclasses.asdict(stream.topic)
    figures = {"timing": plain(stream.timing) or None, "clock_rate": plain(stream.clock_rate) or None}
    return topic | figures | {"problem": stream.problem}


def _target(inspection: Inspection) -> dict[str, Any] | None:
    if inspection.target is None:
        return None
    target = inspection.target.target
    fields = {"type": target.type, "targets": target.plain()} if isinstance(target, Scene) else target.plain()
    return fields | {"file": inspection.target.file}


# Coverage of an image by the corners of a target.

GRID = (8, 5)  # columns and rows of cells over the image
EMPTY_EDGE = 0.5  # an edge of the image counts as empty if a larger share of its cells is


def coverage(uv: np.ndarray, resolution: tuple[int, int]) -> tuple[tuple[int, ...], ...]:
    """Number of corners uv (N, 2) [px] in each cell of an image of `resolution` (width, height): GRID[1] rows of
    GRID[0] cells."""
    cell = np.floor((uv + 0.5) / resolution * GRID).astype(np.int64)
    col, row = np.clip(cell, 0, np.array(GRID) - 1).T
    counts = np.bincount(row * GRID[0] + col, minlength=GRID[0] * GRID[1]).reshape(GRID[1], GRID[0])
    return tuple(tuple(int(n) for n in line) for line in counts)


def empty_borders(cells: Sequence[Sequence[int]]) -> tuple[str, ...]:
    """Names of empty image regions, such as "top edge": edges along which most cells are empty, and empty corners on
    the remaining edges. cells: number of target corners in each cell, row by row."""
    grid = np.array(cells)
    edges = {"top": grid[0], "bottom": grid[-1], "left": grid[:, 0], "right": grid[:, -1]}
    empty = [name for name, line in edges.items() if (line == 0).mean() > EMPTY_EDGE]
    corners = [
        f"{rows} {cols} corner"
        for rows, i in (("top", 0), ("bottom", -1))
        for cols, j in (("left", 0), ("right", -1))
        if grid[i, j] == 0 and rows not in empty and cols not in empty
    ]
    return (*(f"{name} edge" for name in empty), *corners)


def coverage_map(cells: Sequence[Sequence[int]]) -> str:
    """The grid of cells as lines of text."""
    most = max(max(row) for row in cells) or 1
    return "\n".join("  " + " ".join(_digit(n, most) for n in row) for row in cells)


def _digit(count: int, most: int) -> str:
    return str(max(1, round(9 * count / most))) if count else "."


# A recording that is being written: what is shown of it, on a terminal and on a local page.


@dataclass(frozen=True)
class Grid:
    """A table: title, headers, rows of text, of which the first `main` are more important. rank: smaller for a table
    that is more important."""

    title: str
    headers: tuple[str, ...]
    rows: tuple[tuple[str, ...], ...]
    main: int
    rank: int


@dataclass(frozen=True)
class View:
    """What is shown at an instant. advice: sentences, the first is the most important; tables: the first has a row for
    each topic; coverage: title and map of each camera."""

    title: str
    advice: tuple[str, ...]
    tables: tuple[Grid, ...]
    coverage: tuple[tuple[str, str], ...]

    @property
    def line(self) -> str:
        """The state in one line."""
        rows = ((row[0] or row[1], row[2], f" ({row[5]} with target)" if row[5] else "") for row in self.tables[0].rows)
        sensors = ", ".join(f"{name} {rate}{seen}" for name, rate, seen in rows)
        return f"{self.title}: {sensors or 'nothing has arrived'}. {self.advice[0] if self.advice else ''}".rstrip()


@dataclass(frozen=True)
class _Block:
    """Lines for a terminal, of which `least` or more are shown, or none. rank: smaller if it is more important."""

    rank: int
    name: str
    lines: Sequence[Text]
    least: int = 1


_ADVICE, _MAPS, _MINOR = 2, 4, 6  # ranks, beside those of the tables
_MAP_CHARS = 2 * GRID[0] + 4


def screen(now: View, width: int, height: int) -> Text:
    """The view in `height` lines of a terminal. Less important lines are left out, which the last line tells."""
    width = max(width, 2 * _MAP_CHARS)
    sentences = [textwrap.wrap(x, width, initial_indent="  ", subsequent_indent="  ") for x in now.advice]
    blocks = [_Block(0, "", [Text(_shortened(now.title, width), style="bold")])]
    for k, lines in enumerate(sentences):
        words = [Text(line, style="yellow" if k == 0 else "") for line in lines]
        blocks.append(_Block(_ADVICE if k else 0, "Advice", words, len(lines)))
    for grid in now.tables:
        lines = list(_table_lines(grid, width))
        name = grid.title.partition(",")[0]
        blocks.append(_Block(grid.rank, name, lines[: 2 + grid.main], min(3, len(lines))))
        blocks.append(_Block(_MINOR, name, lines[2 + grid.main :]))
    maps = list(_map_lines(now.coverage, width))
    blocks.append(_Block(_MAPS, "Coverage", maps, min(1 + GRID[1], len(maps))))
    return Text("\n", no_wrap=True).join(_fitting(blocks, width, height))


def _fitting(blocks: Sequence[_Block], width: int, height: int) -> Iterator[Text]:
    """The lines that fit into a terminal; if some do not, the last one tells it."""
    taken, left_out = dict[int, int](), list[str]()
    room = height if sum(len(block.lines) for block in blocks) <= height else height - 1
    for block in sorted(blocks, key=lambda block: block.rank):
        n = 0 if block.name in left_out or room < block.least else min(len(block.lines), room)
        taken[id(block)], room = n, room - n
        left_out += [block.name] * (n < len(block.lines))
    for block in blocks:
        yield from block.lines[: taken[id(block)]]
    if left_out:
        names = ", ".join(dict.fromkeys(left_out))
        yield Text(_shortened(f"Enlarge the terminal for: {names}", width), style="dim")


def _table_lines(grid: Grid, width: int) -> Iterator[Text]:
    """Title, headers and rows, one line each; the widest columns are shortened."""
    cells = [grid.headers, *grid.rows]
    widths = [max(map(len, column)) for column in zip(*cells, strict=True)]
    while sum(widths) + 2 * len(widths) > width and max(widths) > 1:
        widths[widths.index(max(widths))] -= 1
    yield Text(_shortened(grid.title, width), style="bold")
    for k, row in enumerate(cells):
        line = "  ".join(_shortened(cell, w).ljust(w) for cell, w in zip(row, widths, strict=True))
        yield Text(f"  {line}", style="" if k else "dim")


def _map_lines(maps: Sequence[tuple[str, str]], width: int) -> Iterator[Text]:
    """Names and maps of all cameras, side by side as far as the width goes."""
    beside = width // _MAP_CHARS
    for k in range(0, len(maps), beside):
        lines = [[_shortened(name, _MAP_CHARS - 4), *cells.split("\n")] for name, cells in maps[k : k + beside]]
        for row, line in enumerate(zip(*lines, strict=True)):
            words = "".join(f"  {cell.strip()}".ljust(_MAP_CHARS) for cell in line)
            yield Text(words.rstrip(), style="" if row else "dim")


def _shortened(text: str, width: int) -> str:
    """The text with at most `width` characters: its middle is left out."""
    return text if len(text) <= width else f"{text[: (width - 1) // 2]}\u2026{text[len(text) - width // 2 :]}"


class Page:
    """A local page with the latest view, which refreshes itself. Raises CalibrationError if the address is taken."""

    def __init__(self, address: tuple[str, int]) -> None:
        self._body = ""
        page, frame = self, render("tools/inspection/follow.html")

        class Handler(BaseHTTPRequestHandler):
            def do_GET(self) -> None:
                content = {"/": frame, "/body": page._body}.get(self.path)
                self.send_response(404 if content is None else 200)
                self.send_header("Content-Type", "text/html; charset=utf-8")
                self.end_headers()
                self.wfile.write((content or "").encode())

            def log_message(self, format: str, *args: Any) -> None:
                """Nothing: the terminal shows the recording."""

        try:
            self._server = ThreadingHTTPServer(address, Handler)
        except (OSError, UnicodeError) as error:  # UnicodeError: no name of a host
            is_port = isinstance(error, OSError) and error.errno in (EACCES, EADDRINUSE)
            advice = "another port, as in --serve 8766" if is_port else "this computer's address, as in --serve 8765"
            reason = getattr(error, "strerror", None) or "it is no address"
            raise CalibrationError(
                f"--serve {address[0]}:{address[1]} cannot be used ({reason}); give {advice}."
            ) from error
        self.host, self.port = str(self._server.server_address[0]), int(self._server.server_address[1])
        Thread(target=self._server.serve_forever, daemon=True).start()

    def show(self, now: View) -> None:
        """Replaces the content."""
        self._body = render("tools/inspection/follow_body.html", now=now)

    def close(self) -> None:
        self._server.shutdown()
        self._server.server_close()
