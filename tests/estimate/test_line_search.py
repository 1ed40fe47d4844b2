"""Steps along what the data hardly tell, of which the sums know little: one that promises next to nothing is not taken
where it costs, and one that goes twice as far as it should is shortened; and steps of which they know all."""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np
from scipy.optimize import minimize
from tests.cases import each
from tests.typed import StandIn

from icalib.estimate.solver import SolverOptions, minimise
from icalib.optim.anderson import Accelerator
from icalib.optim.arrowhead import NO_DIRECTIONS, make_pieces, solve
from icalib.optim.state import State, make_layout

KEY = ("sensor", "value")
FAR, WEAK, STEEP, LARGE = 10.0, 1e-3, 1e3, 100.0


class OneNumber(StandIn):
    """A problem in one number y, with one keyframe that is left alone."""

    layout = make_layout([(*KEY, "vector", 1, True)])
    n_keyframes, tolerance, fixed_directions = 1, np.array([1e3]), NO_DIRECTIONS

    def pieces(self):
        return make_pieces(1, 1)

    def residuals(self):
        return SimpleNamespace()

    def warm_started(self, residuals):
        return self

    def solve(self, pieces, damping=0.0):
        return solve(pieces, self.n_keyframes, self.tolerance, damping, self.fixed_directions)

    def rows(self, y: float) -> tuple[np.ndarray, np.ndarray]:
        """Residuals and their slopes."""
        raise NotImplementedError

    def linearise(self, state, pieces, residuals, sums=True, curved=False):
        r, J = self.rows(state.values[KEY][0])
        if sums:
            (piece,) = pieces
            piece.clear()
            piece.diagonal[0] = np.eye(15)
            piece.calib[:] = [[J @ J, J @ r], [J @ r, 0.0]]
        return float(0.5 * r @ r)


class Valley(OneNumber):
    """Residuals WEAK (y - FAR) and STEEP y^2, of which no linearisation at y = 0 knows."""

    def rows(self, y: float) -> tuple[np.ndarray, np.ndarray]:
        return np.array([WEAK * (y - FAR), STEEP * y**2]), np.array([WEAK, 2.0 * STEEP * y])


class Bowl(OneNumber):
    """Residuals y and LARGE + y^2 / (2 LARGE): curvature 2 at y = 0, where the squared slopes are 1."""

    def rows(self, y: float) -> tuple[np.ndarray, np.ndarray]:
        return np.array([y, LARGE + 0.5 * y**2 / LARGE]), np.array([1.0, y / LARGE])


class Turn(OneNumber):
    """Residual LARGE atan(y): from far out a whole step leads further out, on the other side."""

    def rows(self, y: float) -> tuple[np.ndarray, np.ndarray]:
        return np.array([LARGE * np.arctan(y)]), np.array([LARGE / (1.0 + y * y)])


class Slope(OneNumber):
    """Residual 2 (y - 3) + `bend` y^2, and how often sums were asked for."""

    def __init__(self, bend: float):
        self.bend, self.asked = bend, 0

    def rows(self, y: float) -> tuple[np.ndarray, np.ndarray]:
        return np.array([2.0 * (y - 3.0) + self.bend * y**2]), np.array([2.0 + 2.0 * self.bend * y])

    def linearise(self, state, pieces, residuals, sums=True, curved=False):
        self.asked += sums
        return super().linearise(state, pieces, residuals, sums, curved)


class Saddle(OneNumber):
    """Residuals x - 1, y - 2 and LARGE + c x y / LARGE: curvatures 1 + c and 1 - c, where the squared slopes are 1."""

    layout = make_layout([(*KEY, "vector", 2, True)])
    tolerance, fixed_directions = np.array([1.0, 1.0]), NO_DIRECTIONS

    def __init__(self, c: float):
        self.c = c

    def pieces(self):
        return make_pieces(1, 2)

    def residual(self, z: np.ndarray) -> np.ndarray:
        return np.array([z[0] - 1.0, z[1] - 2.0, LARGE + self.c * z[0] * z[1] / LARGE])

    def linearise(self, state, pieces, residuals, sums=True, curved=False):
        z = state.values[KEY]
        r, J = self.residual(z), np.array([[1.0, 0.0], [0.0, 1.0], self.c / LARGE * z[::-1]])
        if sums:
            (piece,) = pieces
            piece.clear()
            piece.diagonal[0] = np.eye(15)
            A = np.column_stack([J, r])
            piece.calib[:] = A.T @ A
            piece.calib[-1, -1] = 0.0
        return float(0.5 * r @ r)


def at(y: float) -> State:
    one = np.zeros((1, 3))
    return State(np.zeros(1), np.eye(3)[None], one, one, np.zeros((1, 6)), {KEY: np.array([y])})


def test_it_ends_where_it_is_and_calls_that_converged():
    for tolerance in (0.5, 5e-4):
        outcome = minimise(Valley(), at(0.0), SolverOptions(tolerance))
        assert outcome.converged, outcome.status
        assert outcome.state.values[KEY][0] == 0.0
        assert not outcome.steps[-1].accepted
        assert outcome.cost < 1e-4


def test_steps_from_side_to_side_are_shortened():
    """Each would go to -y, at the same cost; halved, one goes to the bottom."""
    outcome = minimise(Bowl(), at(3.0))
    assert outcome.converged, outcome.status
    assert abs(outcome.state.values[KEY][0]) < 0.03
    assert len(outcome.steps) <= 4
    assert all(s.damping == 0.0 for s in outcome.steps)


def test_an_early_pass_ends_with_a_step_that_gains_what_was_foretold():
    """Where nothing bends, the sums that it began with are enough; where something does, they are made anew."""
    straight, bent = Slope(0.0), Slope(0.2)
    for slope, most in ((straight, 1), (bent, 3)):
        outcome = minimise(slope, at(0.0), SolverOptions(0.5))
        assert slope.rows(outcome.state.values[KEY][0])[0][0] ** 2 < 2.0 * 0.5
        assert slope.asked <= most
    assert bent.asked > 1
    assert minimise(Slope(0.0), at(0.0)).converged  # the last pass goes to the end all the same


def test_the_last_pass_makes_its_sums_anew_after_a_step_that_gained_what_was_foretold():
    slope = Slope(0.0)
    minimise(slope, at(0.0))
    assert slope.asked > 1


def test_an_early_pass_finds_the_damping_it_needs_in_few_tries_and_lets_go_of_it_in_few():
    outcome = minimise(Turn(), at(2.0), SolverOptions(0.5))
    assert abs(outcome.state.values[KEY][0]) < 1e-2
    tries = next(k for k, s in enumerate(outcome.steps) if s.accepted)
    assert 1 <= tries <= 3
    assert len(outcome.steps) <= tries + 5
    assert outcome.steps[-1].damping == 0.0


@each("c", [0.7, 0.9, -0.9])
def test_it_is_quick_where_plain_steps_converge_slowly(c, monkeypatch):
    problem, one = Saddle(c), np.zeros((1, 3))
    start = State(np.zeros(1), np.eye(3)[None], one, one, np.zeros((1, 6)), {KEY: np.array([5.0, -3.0])})
    outcome = minimise(problem, start)
    assert outcome.converged, outcome.status
    least = minimize(lambda z: 0.5 * problem.residual(z) @ problem.residual(z), [0.0, 0.0], tol=1e-12).fun
    assert outcome.cost - least < 5e-3  # a tenth of a standard deviation
    monkeypatch.setattr(Accelerator, "step", lambda *_: None)
    assert 3 * len(outcome.steps) < len(minimise(problem, start).steps)
