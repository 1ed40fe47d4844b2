"""Pictures of the report that are drawn as SVG: recorded images with measured and projected points, and what is
printed in place of 3D figures."""

from __future__ import annotations

from base64 import b64encode
from collections.abc import Iterator
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from icalib.report.figures import VIEW, Figure, thin
from icalib.result import Calibration
from icalib.result.calibration import PointsInImage, ReportImage
from icalib.result.pictures import nearest
from icalib.result.quantities import format_number

# Twelve colours of matplotlib's turbo without its dark ends, so that they show on a grey image. Red is near.
NEAR_TO_FAR = (
    "#a91601", "#d83706", "#f56918", "#fea431", "#ebd339", "#bef434",
    "#80ff53", "#35f394", "#19d5cd", "#37a8fa", "#4773eb", "#3f3e9c",
)  # fmt: skip
SCALE_PERCENTILES = (2.0, 98.0)  # of the distances: ends of the colours, which single points do not stretch
MARK_SHARE, ARROW_SHARE = 0.006, 0.03  # of the width of the image: half a mark, and the arrow of a usual residual
USUAL_PERCENTILE = 90.0  # of the residuals, which sets the magnification of the arrows
ENLARGED = 6.0  # of the part with edges: 0.5 deg is 4 px of 750 of a usual camera
MOST_MARKS = 400  # measured points in a picture: more hide one another


@dataclass(frozen=True)
class Line:
    """A path of an SVG: class in page.css, path data, and its colour where the class has none."""

    css: str
    data: str
    color: str = ""


@dataclass(frozen=True)
class Drawing:
    """An SVG with the caption `words`. size: width and height; texts: place and text; image: HTML id of an image below
    the lines; jpeg: that image as base64, in the first drawing that has it. window: left, top, width and height of the
    part that is shown enlarged beside it; name: its HTML id, which that needs."""

    size: tuple[int, int]
    words: str
    lines: list[Line]
    texts: list[tuple[float, float, str]] = field(default_factory=list)
    image: str = ""
    jpeg: str = ""
    window: tuple[float, float, float, float] | None = None
    name: str = ""


def figures(c: Calibration) -> Iterator[Drawing]:
    """Drawing of each picture, two for those with a first guess."""
    for number, picture in enumerate(c.pictures):
        size = tuple(c.rig["sensors"][picture.camera]["resolution"])
        image, jpeg = f"shot-{number}", b64encode(picture.jpeg).decode()
        if picture.after is None:
            lines, words = _corners(c, picture, size[0])
            yield Drawing(size, f"{_where(picture)}. {words}", lines, [], image, jpeg)
            continue
        ends, window = ends_of(picture.after), window_of(picture.after, size)
        outline = Line("outline", _lines(picture.outline))
        for name, points in (("First guess", picture.before), ("As calibrated", picture.after)):
            if points is not None:
                words = f"{name}. {picture.sensor} in {_where(picture)}; {_scale(points, ends)}"
                lines = [*_dots(points, ends), *_edges(points), outline]
                yield Drawing(size, words, lines, [], image, jpeg, window, f"{image}-{name[0]}")
                jpeg = ""


def window_of(points: PointsInImage, size: tuple[int, int]) -> tuple[float, float, float, float] | None:
    """The part of an image of this size, 1 / ENLARGED as wide and high, that has most points on depth edges of near
    objects, whose solid angle counts; None without any. Far ones are small and crowded."""
    uv, (width, height) = points.uv[points.edge], np.array(size) / ENLARGED
    if not len(uv):
        return None
    within = (np.abs(uv[:, None] - uv) < [0.5 * width, 0.5 * height]).all(axis=2)
    left, top = uv[int(np.argmax(within @ points.distance[points.edge] ** -2.0))] - [0.5 * width, 0.5 * height]
    return float(np.clip(left, 0.0, size[0] - width)), float(np.clip(top, 0.0, size[1] - height)), width, height


def _where(picture: ReportImage) -> str:
    which = picture.file or f"at {picture.seconds:.2f} s"
    return f"{picture.camera} {which}, {picture.title}"


def ends_of(points: PointsInImage) -> tuple[float, float]:
    """Distances [m] at the ends of the colours."""
    low, high = np.percentile(points.distance, SCALE_PERCENTILES) if len(points.distance) else (0.0, 1.0)
    return float(low), float(max(high, 1.001 * low))


def _scale(points: PointsInImage, ends: tuple[float, float]) -> str:
    near, far = (format_number(x) for x in ends)
    return f"{len(points.uv)} points, from {near} m (red) to {far} m (blue)"


def shades(points: PointsInImage, ends: tuple[float, float]) -> np.ndarray:
    """(n,) index into NEAR_TO_FAR of each point; the colours are evenly spread over the logarithm of the distance."""
    low, high = np.log(np.maximum(ends, 1e-3))
    share = (np.log(np.maximum(points.distance, 1e-3)) - low) / (high - low)
    return np.clip(len(NEAR_TO_FAR) * share, 0, len(NEAR_TO_FAR) - 1).astype(int)


def _dots(points: PointsInImage, ends: tuple[float, float]) -> list[Line]:
    """Dots coloured by distance, the farthest first."""
    return _coloured(points.uv, shades(points, ends))


def _edges(points: PointsInImage) -> list[Line]:
    """White dots with a dark rim at points on depth edges."""
    data = "".join(f"M{u:.1f} {v:.1f}h0" for u, v in points.uv[points.edge])
    return [Line("rim", data), Line("edge", data)]


def _coloured(points: np.ndarray, colour: np.ndarray) -> list[Line]:
    """Dots at points (n, 2) with the colours (n,) of NEAR_TO_FAR, the last colour first."""
    return [
        Line("dots", "".join(f"M{u:.0f} {v:.0f}h0" for u, v in points[colour == k]), NEAR_TO_FAR[k])
        for k in reversed(range(len(NEAR_TO_FAR)))
    ]


def _lines(pen: np.ndarray) -> str:
    """Path of polylines (n, 2), in which a row of NaN separates two lines."""
    up = np.isnan(pen[:, 0])
    starts = ~up & np.concatenate([[True], up[:-1]])
    steps = zip(pen.tolist(), up, starts, strict=True)
    return "".join(f"{'M' if begins else 'L'}{u:.1f} {v:.1f}" for (u, v), lifted, begins in steps if not lifted)


def _corners(c: Calibration, picture: ReportImage, width: int) -> tuple[list[Line], str]:
    """Measured points as squares, rejected ones as crosses, and residuals as magnified lines; and words on them."""
    r = next(r for r in c.image_residuals if r.sensor == picture.camera)
    k = int(nearest(r.seconds, np.array([picture.seconds]))[0])
    rows = np.arange(r.start[k], r.start[k + 1])
    rows = rows[:: max(1, -(-len(rows) // MOST_MARKS))]
    rejected, has_residual = r.rejected[rows], np.isfinite(r.residual[rows, 0])
    uv, residual = r.uv[rows], r.residual[rows].astype(np.float64)
    gain = _gain(residual[has_residual & ~rejected], width)
    s = MARK_SHARE * width
    cross = f"l{2 * s:.1f} {2 * s:.1f}m{-2 * s:.1f} 0l{2 * s:.1f} {-2 * s:.1f}"
    crosses = "".join(f"M{u:.1f} {v:.1f}{cross}" for u, v in uv[rejected] - s)
    ends = zip(uv[has_residual], gain * residual[has_residual], strict=True)
    arrows = "".join(f"M{u:.1f} {v:.1f}l{du:.1f} {dv:.1f}" for (u, v), (du, dv) in ends)
    drawn = [squares(uv[~rejected], width), Line("residual", arrows), Line("rejected", crosses)]
    count = f"{(~rejected).sum()} {r.kind}" + (f", {rejected.sum()} rejected" if rejected.any() else "")
    return drawn, f"{count}; residuals are {gain:g} times as long"


def squares(uv: np.ndarray, width: int) -> Line:
    """Squares about points (n, 2) of an image of this width [px]."""
    s = MARK_SHARE * width
    square = f"h{2 * s:.1f}v{2 * s:.1f}h{-2 * s:.1f}z"
    return Line("measured", "".join(f"M{u:.1f} {v:.1f}{square}" for u, v in uv - s))


def _gain(residual: np.ndarray, width: int) -> float:
    """1, 2 or 5 times a power of ten by which usual residuals (n, 2) px become ARROW_SHARE of the image."""
    usual = float(np.percentile(np.linalg.norm(residual, axis=1), USUAL_PERCENTILE)) if len(residual) else 0.0
    if not usual:
        return 1.0
    wanted = max(1.0, ARROW_SHARE * width / usual)
    power = 10.0 ** np.floor(np.log10(wanted))
    return float(power * max(k for k in (1.0, 2.0, 5.0) if k * power <= wanted))


# What is printed in place of a 3D figure, which needs a graphics card and leaves a blank on paper.

WIDTH = 900  # of a picture, in units of its SVG; text is 20 high
MARGIN = 60
MOST_STATIC_POINTS = 4000  # of a cloud


def static_picture(f: Figure) -> Drawing | None:
    """Lines, dots and texts of a 3D figure, in parallel projection from where it is seen first; None for 2D ones."""
    traces = [t for t in f["data"] if t["type"] == "scatter3d" and t.get("visible", True)]
    points = [np.array([t["x"], t["y"], t["z"]], float).T @ _axes_of_view().T for t in traces]
    if not traces or not np.isfinite(np.concatenate(points)).any():
        return None
    low, high = (g(np.concatenate(points), axis=0) for g in (np.nanmin, np.nanmax))
    gain = (WIDTH - 2 * MARGIN) / max(high[0] - low[0], (high[1] - low[1]) / 0.7, 1e-9)
    flat = [gain * (p - low) + MARGIN for p in points]
    named = [(t["text"], p) for t, p in zip(traces, flat, strict=True) if "text" in t]
    texts = [(u + 10, v - 8, text) for names, p in named for (u, v), text in zip(p, names, strict=True)]
    lines = [x for t, p in zip(traces, flat, strict=True) for x in _trace(t, p)]
    return Drawing((WIDTH, round(gain * (high[1] - low[1])) + 2 * MARGIN), "", lines, texts)


def _axes_of_view() -> np.ndarray:
    """(2, 3) directions to the right and downwards in the picture."""
    back = np.array([VIEW["camera"]["eye"][k] for k in "xyz"])
    right = np.cross([0.0, 0.0, 1.0], back)
    down = np.cross(right, back)
    return np.stack([right / np.linalg.norm(right), down / np.linalg.norm(down)])


def _trace(t: dict[str, Any], points: np.ndarray) -> list[Line]:
    """A 3D trace at points (n, 2) of the picture. Dots keep their colours, from red to blue for low to high values."""
    if t["mode"].startswith("lines"):
        color = t["line"]["color"]
        return [Line("line", _lines(points), color if isinstance(color, str) else "#2563a8")]
    some = thin(len(points), MOST_STATIC_POINTS)
    values = t["marker"].get("color")
    if not isinstance(values, list):
        return [Line("spot", "".join(f"M{u:.0f} {v:.0f}h0" for u, v in points[some]), "#111827")]
    share = np.array(values, float)[some] / t["marker"]["cmax"]
    return _coloured(points[some], len(NEAR_TO_FAR) - 1 - np.clip(len(NEAR_TO_FAR) * share, 0, 11).astype(int))
