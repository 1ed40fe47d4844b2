"""A step that promises next to nothing along what the data hardly tell is not taken where it costs."""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np

from icalib.estimation.arrowhead import NOTHING, make_pieces
from icalib.estimation.solver import minimise
from icalib.estimation.state import State, make_layout

KEY = ("sensor", "value")
FAR, WEAK, STEEP = 10.0, 1e-3, 1e3


class Valley:
    """Residuals WEAK (y - FAR) and STEEP y^2, of which no linearisation at y = 0 knows; one node that is left alone."""

    layout = make_layout([(*KEY, "vector", 1, True)])
    n_nodes, tolerance, held = 1, np.array([1e3]), NOTHING

    def pieces(self):
        return make_pieces(1, 1)

    def residuals(self):
        return SimpleNamespace()

    def settled(self, residuals):
        return self

    def linearise(self, state, pieces, residuals, sums=True, curved=False):
        y = state.values[KEY][0]
        r, J = np.array([WEAK * (y - FAR), STEEP * y**2]), np.array([WEAK, 2.0 * STEEP * y])
        if sums:
            (piece,) = pieces
            piece.clear()
            piece.diagonal[0] = np.eye(15)
            piece.border[:] = [[J @ J, J @ r], [J @ r, 0.0]]
        return float(0.5 * r @ r)


def still() -> State:
    one = np.zeros((1, 3))
    return State(np.zeros(1), np.eye(3)[None], one, one, np.zeros((1, 6)), {KEY: np.zeros(1)})


def test_it_ends_where_it_is_and_calls_that_converged():
    for tolerance in (0.5, 5e-4):
        outcome = minimise(Valley(), still(), tolerance=tolerance)
        assert outcome.converged, outcome.status
        assert outcome.state.values[KEY][0] == 0.0
        assert not outcome.steps[-1].accepted
        assert outcome.cost < 1e-4
