"""Pictures of the report: recorded images, with measured and projected points drawn over them as SVG."""

from __future__ import annotations

from base64 import b64encode
from collections.abc import Iterator

import numpy as np

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
MOST_MARKS = 400  # measured points in a picture: more hide one another


def figures(c: Calibration) -> Iterator[tuple[str, str]]:
    """SVG and caption of each picture, two for those with a first guess."""
    for number, picture in enumerate(c.pictures):
        width, height = c.rig["sensors"][picture.camera]["resolution"]
        jpeg = b64encode(picture.jpeg).decode()
        box = f'x="-.5" y="-.5" width="{width}" height="{height}"'
        image = f'<image id="shot-{number}" {box} preserveAspectRatio="none" href="data:image/jpeg;base64,{jpeg}"/>'
        if picture.after is None:
            drawn, words = _corners(c, picture, width)
            yield _svg(image + drawn, width, height), f"{_where(picture)}. {words}"
            continue
        ends = ends_of(picture.after)
        outline = _path("outline", _lines(picture.outline))
        for name, points in (("first guess", picture.before), ("as calibrated", picture.after)):
            if points is not None:
                words = f"{name}. {picture.sensor} in {_where(picture)}; {_scale(points, ends)}"
                yield _svg(image + _dots(points, ends) + outline, width, height), words[0].upper() + words[1:]
                image = f'<use href="#shot-{number}"/>'


def _where(picture: ReportImage) -> str:
    which = picture.file or f"at {picture.seconds:.2f} s"
    return f"{picture.camera} {which}, {picture.title}"


def _svg(content: str, width: int, height: int) -> str:
    return f'<svg class="shot" viewBox="-.5 -.5 {width} {height}" role="img">{content}</svg>'


def _path(css: str, d: str, color: str = "") -> str:
    stroke = f' stroke="{color}"' if color else ""
    return f'<path class="{css}"{stroke} d="{d}"/>' if d else ""


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


def _dots(points: PointsInImage, ends: tuple[float, float]) -> str:
    """Dots coloured by distance, the farthest first."""
    colour = shades(points, ends)
    parts = (
        _path("dots", "".join(f"M{u:.0f} {v:.0f}h0" for u, v in points.uv[colour == k]), NEAR_TO_FAR[k])
        for k in reversed(range(len(NEAR_TO_FAR)))
    )
    return "".join(parts)


def _lines(pen: np.ndarray) -> str:
    """Path of polylines (n, 2), in which a row of NaN separates two lines."""
    up = np.isnan(pen[:, 0])
    starts = ~up & np.concatenate([[True], up[:-1]])
    steps = zip(pen.tolist(), up, starts, strict=True)
    return "".join(f"{'M' if begins else 'L'}{u:.1f} {v:.1f}" for (u, v), lifted, begins in steps if not lifted)


def _corners(c: Calibration, picture: ReportImage, width: int) -> tuple[str, str]:
    """Measured points as squares, rejected ones as crosses, and residuals as magnified lines; and words on them."""
    r = next(r for r in c.image_residuals if r.sensor == picture.camera)
    k = int(nearest(r.seconds, np.array([picture.seconds]))[0])
    rows = np.arange(r.start[k], r.start[k + 1])
    rows = rows[:: max(1, -(-len(rows) // MOST_MARKS))]
    rejected, has_residual = r.rejected[rows], np.isfinite(r.residual[rows, 0])
    uv, residual = r.uv[rows], r.residual[rows].astype(np.float64)
    gain = _gain(residual[has_residual & ~rejected], width)
    s = MARK_SHARE * width
    square = f"h{2 * s:.1f}v{2 * s:.1f}h{-2 * s:.1f}z"
    cross = f"l{2 * s:.1f} {2 * s:.1f}m{-2 * s:.1f} 0l{2 * s:.1f} {-2 * s:.1f}"
    squares, crosses = (
        "".join(f"M{u:.1f} {v:.1f}{mark}" for u, v in uv[chosen] - s)
        for mark, chosen in ((square, ~rejected), (cross, rejected))
    )
    ends = zip(uv[has_residual], gain * residual[has_residual], strict=True)
    arrows = "".join(f"M{u:.1f} {v:.1f}l{du:.1f} {dv:.1f}" for (u, v), (du, dv) in ends)
    drawn = _path("measured", squares) + _path("residual", arrows) + _path("rejected", crosses)
    count = f"{(~rejected).sum()} {r.kind}" + (f", {rejected.sum()} rejected" if rejected.any() else "")
    return drawn, f"{count}; residuals are {gain:g} times as long"


def _gain(residual: np.ndarray, width: int) -> float:
    """1, 2 or 5 times a power of ten by which usual residuals (n, 2) px become ARROW_SHARE of the image."""
    usual = float(np.percentile(np.linalg.norm(residual, axis=1), USUAL_PERCENTILE)) if len(residual) else 0.0
    if not usual:
        return 1.0
    wanted = max(1.0, ARROW_SHARE * width / usual)
    power = 10.0 ** np.floor(np.log10(wanted))
    return float(power * max(k for k in (1.0, 2.0, 5.0) if k * power <= wanted))
