"""Targets as PDF for printing: vector graphics at true scale, with the target's line for the rig file and a ruler."""

from __future__ import annotations

import dataclasses
from io import BytesIO
from pathlib import Path
from typing import Any

from icalib.base.extras import install
from icalib.base.files import refuse_foreign, sealed, staged, writing
from icalib.errors import CalibrationError, RigError
from icalib.geometry.targets import AprilGrid, Markers, Tag, Target
from icalib.geometry.targets.boards import Pattern, pattern_of

# Width and height [mm] in portrait; smallest first.
PAPERS = {
    "a4": (210.0, 297.0),
    "letter": (215.9, 279.4),
    "a3": (297.0, 420.0),
    "a2": (420.0, 594.0),
    "a1": (594.0, 841.0),
    "a0": (841.0, 1189.0),
}
EDGE_MM = 8.0  # margin that printers cannot print on
FOOT_MM = 16.0  # height of the space for text and ruler, below the target
RULER_MM = 100.0
_POINTS = 72.0 / 25.4  # PDF points per millimetre
_FONT, _FONT_POINTS = "Helvetica", 7.5


def write_target(path: str | Path, target: Target, paper: str = "a4", border_bits: int | None = None) -> None:
    """Writes `target_pdf` to `path`.

    Raises the errors of `target_pdf`, and CalibrationError if the file cannot be written, or exists and was not written
    by icalib.
    """
    path = Path(path)
    refuse_foreign([path], advice="choose another place")
    data = sealed(target_pdf(target, paper, border_bits))
    with writing(path, "give the path of a file in a folder that exists"), staged(path.parent) as place:
        (place / path.name).write_bytes(data)
        (place / path.name).replace(path)


def target_pdf(target: Target, paper: str = "a4", border_bits: int | None = None) -> bytes:
    """PDF of `target` on one page, in portrait or landscape as it fits; free tags get one page each. paper: a key of
    `PAPERS`; border_bits: width of the black border of tags, as in `pattern_of`.

    Raises RigError if the paper is unknown or too small, CalibrationError if reportlab, or OpenCV for tags, is not
    installed.
    """
    if paper not in PAPERS:
        raise RigError(f"there is no paper {paper!r}; available are {', '.join(PAPERS)}.")
    if border_bits is not None and isinstance(target, AprilGrid | Markers):
        target = dataclasses.replace(target, border_bits=border_bits)
    patterns = _patterns(target, border_bits)
    width, height = page_mm(next(iter(patterns.values())), paper)
    page = _canvas(width, height)
    page.setTitle(f"{target.type} target, print at 100 %")
    for name, pattern in patterns.items():
        _draw(page, pattern, width, height)
        _draw_circles(page, target, pattern, width, height)
        _foot(page, target, name, border_bits)
        page.showPage()
    return page.getpdfdata()


def _patterns(target: Target, border_bits: int | None) -> dict[str, Pattern]:
    """The pattern of each page, by the name of the tag on it; "" for a target of one page."""
    if not isinstance(target, Markers):
        return {"": pattern_of(target, border_bits)}
    tags = [Tag(target.family, int(i), target.size) for i in target.known]
    return {f"Tag {tag.id}. ": pattern_of(tag, target.border_bits) for tag in tags}


def _draw(page: Any, pattern: Pattern, width: float, height: float) -> None:
    """Draws the black boxes of the pattern in the middle of a page of width x height [mm], above its foot."""
    left, bottom = _lower_left_mm(pattern, width, height)
    # One path for all boxes: with several paths, shared edges would show as hairlines.
    path = page.beginPath()
    for x0, y0, x1, y1 in 1e3 * pattern.black_boxes():
        x, y = left + x0 - 1e3 * pattern.x[0], bottom + y0 - 1e3 * pattern.y[0]
        path.rect(*(_POINTS * side for side in (x, y, x1 - x0, y1 - y0)))
    page.drawPath(path, stroke=0, fill=1, fillMode=1)  # non-zero: rounded edges that overlap stay black


def _draw_circles(page: Any, target: Target, pattern: Pattern, width: float, height: float) -> None:
    """Draws the circles of the target, black, on a page of width x height [mm]; `_draw` has drawn the rest."""
    left, bottom = _lower_left_mm(pattern, width, height)
    for point, radius in zip(1e3 * target.points, 1e3 * target.radii, strict=True):
        if radius > 0.0:
            x, y = left + point[0] - 1e3 * pattern.x[0], bottom + point[1] - 1e3 * pattern.y[0]
            page.circle(*(_POINTS * side for side in (x, y, radius)), stroke=0, fill=1)


def _lower_left_mm(pattern: Pattern, width: float, height: float) -> tuple[float, float]:
    """x and y of the pattern's lower left corner on a page of width x height, all in mm."""
    size_x, size_y = _size_mm(pattern)
    return 0.5 * (width - size_x), EDGE_MM + FOOT_MM + 0.5 * (height - 2.0 * EDGE_MM - FOOT_MM - size_y)


def page_mm(pattern: Pattern, paper: str) -> tuple[float, float]:
    """Width and height of the page [mm], portrait or landscape so that the pattern fits. Raises RigError if it does
    not."""
    size = _size_mm(pattern)
    for width, height in (PAPERS[paper], PAPERS[paper][::-1]):
        if _fits(size, width, height):
            return width, height
    larger = [p for p, (w, h) in PAPERS.items() if _fits(size, w, h) or _fits(size, h, w)]
    rooms = [(w - 2.0 * EDGE_MM, h - 2.0 * EDGE_MM - FOOT_MM) for w, h in (PAPERS[paper], PAPERS[paper][::-1])]
    raise RigError(
        (
            f"the target is {size[0]:.0f} x {size[1]:.0f} mm, but {paper} has space for {rooms[0][0]:.0f} x "
            f"{rooms[0][1]:.0f} mm, or in landscape for {rooms[1][0]:.0f} x {rooms[1][1]:.0f} mm; "
        )
        + (f"choose {larger[0]}, or make the target smaller." if larger else "make the target smaller.")
    )


def _size_mm(pattern: Pattern) -> tuple[float, float]:
    return 1e3 * float(pattern.x[-1] - pattern.x[0]), 1e3 * float(pattern.y[-1] - pattern.y[0])


def _fits(size: tuple[float, float], width: float, height: float) -> bool:
    return size[0] <= width - 2.0 * EDGE_MM and size[1] <= height - 2.0 * EDGE_MM - FOOT_MM


def _canvas(width: float, height: float) -> Any:
    try:
        from reportlab.pdfgen.canvas import Canvas
    except ImportError:
        raise CalibrationError(f"PDF needs reportlab, which is not installed; run {install('print')}.") from None
    # invariant: the file contains no date, so that the same target gives the same file.
    return Canvas(BytesIO(), pagesize=(_POINTS * width, _POINTS * height), pageCompression=0, invariant=1)


def _foot(page: Any, target: Target, name: str, border_bits: int | None) -> None:
    """Draws at the left of the foot, from the top: the target's line for the rig file, the name of the page, how to
    print, and the ruler."""
    fields = target.plain()
    head = "" if isinstance(target, Tag) else "target: "  # a rig file cannot have a single tag as target
    border = "" if border_bits is None or "border_bits" in fields else f", tags with a border of {border_bits} bits"
    page.setFont(_FONT, _FONT_POINTS)
    lines = (
        f"{head}{{{', '.join(f'{name}: {value}' for name, value in fields.items())}}}",
        f"{name}icalib, sizes in metres{border}. Print at 100 %, unscaled; the ruler must measure {RULER_MM:.0f} mm.",
    )
    for i, text in enumerate(lines):
        page.drawString(_POINTS * EDGE_MM, _POINTS * (EDGE_MM + FOOT_MM - 6.0 - 3.5 * i), text)
    page.setLineWidth(0.15 * _POINTS)
    page.line(*(_POINTS * side for side in (EDGE_MM, EDGE_MM, EDGE_MM + RULER_MM, EDGE_MM)))
    for tick in range(11):
        x = EDGE_MM + 0.1 * RULER_MM * tick
        page.line(*(_POINTS * side for side in (x, EDGE_MM, x, EDGE_MM + (3.0 if tick % 5 == 0 else 1.8))))
    page.drawString(_POINTS * (EDGE_MM + RULER_MM + 1.5), _POINTS * EDGE_MM, f"{RULER_MM:.0f} mm")
