"""Fits of the two edges that meet in a corner of a target, one row for each edge.

Columns: first end (2,) and second end (2,) px of the fitted piece, relative to the corner; gain (2,) px^2, derivative
of the corner by the curvature of the edge; fitted curvature [1 / px]. The curvature is positive if the piece turns left
from the first end to the second, with u to the right and v down.
"""

from __future__ import annotations

import numpy as np

EDGE = 7  # number of columns
NO_EDGES = np.zeros((0, 2, EDGE), dtype=np.float32)  # the fits of no corners
