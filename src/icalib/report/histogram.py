"""Histogram of the normalised residuals of all sensors."""

from __future__ import annotations

import numpy as np

from icalib.report.plot import COLORS, Figure, axis, figure, line
from icalib.result import Calibration

REACH = 6.0  # range of the histogram on either side of zero, in standard deviations
BINS = 96


def normalised_histogram(c: Calibration) -> Figure:
    """Densities of residuals over their standard deviations, compared with the standard normal density. The logarithmic
    axis shows the tails."""
    edges = np.linspace(-REACH, REACH, BINS + 1)
    x = 0.5 * (edges[1:] + edges[:-1])
    traces = []
    for i, (name, z) in enumerate(_normalised(c).items()):
        count, _ = np.histogram(z, edges)
        density = count / max(1, len(z)) / (edges[1] - edges[0])
        density = np.where(count > 0, density, np.nan)
        step = {"color": COLORS[i % len(COLORS)], "width": 1.6, "shape": "hvh"}
        traces.append(line(x, density, name, COLORS[i % len(COLORS)], line=step))
    normal = np.exp(-0.5 * x**2) / np.sqrt(2.0 * np.pi)
    dashed = {"color": "#6b7280", "dash": "dash", "width": 1.4}
    traces.append(line(x, normal, "standard normal", "#6b7280", line=dashed))
    return figure(
        traces,
        380,
        xaxis=axis("residual / standard deviation"),
        yaxis=axis("density", type="log", range=[-5, 0], exponentformat="power"),
    )


def _normalised(c: Calibration) -> dict[str, np.ndarray]:
    """Residuals over their standard deviation, by sensor and name."""
    out = {f"{r.sensor} {name}": z for r in c.residuals.values() for name, z in r.normalised().items()}
    return {name: z for name, z in out.items() if len(z)}
