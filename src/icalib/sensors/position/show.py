"""Sections of the report on position sensors: residuals over time, and the path over the fixes from above."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from typing import Any

import numpy as np

from icalib.report.figures import COLORS, REJECTED, Figure, axis, dots, figure, line, numbers, thin
from icalib.report.page import Group, Plot, Presenter, Section, row_sections
from icalib.result import Calibration, RecordingSpan
from icalib.sensors.position.stream import PositionResiduals

OUTLIER_SIGMA = 3.0  # standard deviations: white noise exceeds it in 1 of 34 fixes (chi, three degrees of freedom)
MAX_DOTS = 4000  # of fixes in a figure, and of instants of the path
MAX_GAP_STEPS = 2.5  # median intervals between fixes: over a longer one the path is interrupted
MARGIN = 0.05  # around the path, as a share of its size
_WORDS = (
    "Along x, y and z of the sensor's frame: east, north and up of GNSS. They should look like noise; waves and steps "
    "are errors that last."
)
_MAP = (
    "Fixes of each antenna, and its estimated path at their instants, from above. Axes are those of the fixes. A slow "
    "offset of the fixes, where one is estimated, is part of the path. Where fixes that are off lie together, look for "
    "walls and trees. Fixes that were removed on reading are in the notes, not here."
)


def sections(c: Calibration) -> Iterator[Section]:
    """Residuals of each position sensor, and the path over its fixes."""
    yield from row_sections(c, "position", "positions", "Residuals of position sensors", _WORDS)
    parts = [(span, part) for r in _fixes(c) for span, part in _by_recording(c, r)]
    names = [f"{r.sensor}{f' in {span.name}' if len(c.recordings) > 1 else ''}" for span, r in parts]
    plots = [Plot(f"map-{i}", path_over_fixes(r), names[i]) for i, (_, r) in enumerate(parts)]
    if plots:
        yield Section("maps", "Path over the fixes", _MAP, [Group(plots=plots)])


def amounts(c: Calibration) -> Iterator[str]:
    """The number of fixes in use."""
    if records := _fixes(c):
        yield f"{sum(int((~r.rejected).sum()) for r in records)} fixes"


def _fixes(c: Calibration) -> list[PositionResiduals]:
    return [r for r in c.residuals.values() if isinstance(r, PositionResiduals)]


def _by_recording(c: Calibration, r: PositionResiduals) -> Iterator[tuple[RecordingSpan, PositionResiduals]]:
    """Each recording with fixes in use, and those of `r` in it: recordings may have different origins."""
    recording = c.recording_of(r.seconds)
    for k, span in enumerate(c.recordings):
        arrays = {name: getattr(r, name)[recording == k] for name in r.shapes}
        if not arrays["rejected"].all():
            yield span, replace(r, **arrays)


def path_over_fixes(r: PositionResiduals) -> Figure:
    """The estimated path of the antenna over its fixes, from above in their frame. The axes end where path and fixes in
    use end, so that a rejected fix far away does not hide them."""
    path, fixes = (r.position + r.residual)[:, :2], r.position[:, :2]
    off = np.linalg.norm(r.whitened, axis=1) > OUTLIER_SIGMA
    kinds = {
        "fixes": (~r.rejected & ~off, "#64748b", 4, "circle"),
        f"off by more than {OUTLIER_SIGMA:g} sigma": (~r.rejected & off, COLORS[1], 7, "circle"),
        "rejected": (r.rejected, REJECTED, 8, "x"),
    }
    stretches = _interrupted(r.seconds, path)
    traces = [line(stretches[:, 0], stretches[:, 1], "path", COLORS[0]) | _places(stretches)]
    for name, (which, color, size, symbol) in kinds.items():
        some = np.flatnonzero(which)[thin(int(which.sum()), MAX_DOTS)]
        farthest = np.linalg.norm(r.residual[some], axis=1).max(initial=0.0)
        words = f"{which.sum()} {name}" + (f", by up to {farthest:.2g} m" if name == "rejected" else "")
        marker, (x, y) = {"color": color, "size": size, "symbol": symbol}, fixes[some].T
        traces += [dots(x, y, words, color, marker=marker) | _places(fixes[some])] if len(some) else []
    seen = np.concatenate([path, fixes[~r.rejected]])
    low, high = seen.min(axis=0), seen.max(axis=0)
    room = MARGIN * (high - low).max()
    x, y = (axis(f"{r.labels[k]} [m]", range=numbers(np.array([low[k] - room, high[k] + room]))) for k in range(2))
    return figure(traces, 480, xaxis=x, yaxis=y | {"scaleanchor": "x"})


def _interrupted(seconds: np.ndarray, path: np.ndarray) -> np.ndarray:
    """(m, 2) m: points of a path (n, 2), thinned, with a row of NaN in gaps."""
    step = np.diff(seconds)
    stretch = np.cumsum(np.concatenate([[0.0], step > MAX_GAP_STEPS * np.median(step) if len(step) else step]))
    keep = thin(len(path), MAX_DOTS)
    return np.insert(path[keep], np.flatnonzero(np.diff(stretch[keep])) + 1, np.nan, axis=0)


def _places(points: np.ndarray) -> dict[str, Any]:
    """Entries x and y of a trace, in millimetres: `numbers` would round a drive of 1 km to 0.1 m."""
    return {name: [None if np.isnan(v) else round(v, 3) for v in points[:, k].tolist()] for k, name in enumerate("xy")}


PRESENTER = Presenter(
    sections=sections,
    amounts=amounts,
)
