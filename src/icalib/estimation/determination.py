"""What the data determine: estimates in which undetermined directions of the border are held where the guess has them.

Broad priors do not make an undetermined direction harmless: the solver wanders along it, and what couples with it at
second order comes out wrong with a small standard deviation. So the information of the data alone, without what noise
makes of it, says which directions are open; these are moved to the guess and held there while all else is estimated
again, until their number stays. How much the rest depends on where they are held is tried out, and is part of the
covariance.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from icalib.estimation.arrowhead import HELD_BELOW, restricted_inverse
from icalib.estimation.assembly import given_priors
from icalib.estimation.debias import spurious_information
from icalib.estimation.estimate import EARLY_DECREASE, Estimate, Judged, OnVisit, estimate
from icalib.estimation.imu_model import N_INTRINSICS
from icalib.estimation.inputs import Inputs
from icalib.estimation.prior_factor import Prior
from icalib.estimation.problem import Problem
from icalib.estimation.solver import Step, minimise
from icalib.estimation.state import Key, State
from icalib.estimation.tolerances import FROM_NOTHING_M, GUESS_SIGMA, OTHER_SIGMA
from icalib.geometry import planes, so3

SPURIOUS_SHARE = 0.5  # a direction most of whose information is noise is not determined either
MOST_ROUNDS = 4
MOVED_BY_HELD = 0.1  # parts of a direction smaller than this do not count as in it
MOSTLY = 0.5  # of the square of a direction
NEAR_GUESS = 0.05  # of what the guess is worth


@dataclass(frozen=True)
class Determined:
    """An estimate and what is known of its border.

    data (B, B): information of the data alone in tolerance units, without priors and without what noise makes of it;
    held (B, m): orthonormal directions in tolerance units, those that are undetermined; shifts (m, B): how all moves
    when one of them moves by what its guess is worth.
    """

    estimate: Estimate
    data: np.ndarray
    held: np.ndarray
    shifts: np.ndarray

    @property
    def covariance(self) -> np.ndarray:
        """(B, B), priors included: of what is determined, and how it moves with what is held."""
        t = self.estimate.problem.tolerance
        return t[:, None] * restricted_inverse(self.estimate.outcome.information * t[:, None] * t, self.held) * t + (
            self.shifts.T @ self.shifts
        )

    @property
    def spread(self) -> np.ndarray:
        """(B,) standard deviations in tolerances that the data alone give."""
        t = self.estimate.problem.tolerance
        return np.sqrt(np.diag(restricted_inverse(self.data, self.held)) + ((self.shifts / t) ** 2).sum(axis=0))


def determine(
    inputs: Inputs,
    start: State,
    on_step: Callable[[str, Step], None] = lambda *_: None,
    on_visit: OnVisit = lambda *_: None,
    guess: dict[Key, np.ndarray] | None = None,
) -> Determined:
    """Estimates from `start`, again and again until what is undetermined stays so: at `guess`, or if there is none at
    `start`.

    Raises EstimationError where the data do not carry an estimate.
    """
    found = estimate(inputs, start, on_step, on_visit=on_visit)
    data, undetermined = _judge(inputs, found)
    for _ in range(MOST_ROUNDS):
        if undetermined.shape == found.problem.held.shape or not (undetermined.size or found.problem.held.size):
            break
        begin, judged = _as_guessed(found, start, guess or {}, undetermined), _worth_keeping(found)
        del found  # before the next one takes as much memory
        found = estimate(inputs, begin, on_step, undetermined, on_visit, judged)
        data, undetermined = _judge(inputs, found)
    for _ in range(MOST_ROUNDS):
        begin = _as_worth(inputs, found, replace(start, values=start.values | (guess or {})))
        if begin is None:
            break
        found = estimate(inputs, begin, on_step, found.problem.held, on_visit, _worth_keeping(found))
        data, _ = _judge(inputs, found)
    held = found.problem.held if found.problem.held.size else np.zeros((inputs.layout.size, 0))
    shifts = np.array([_profile(inputs, found, data, u) for u in held.T]).reshape(-1, inputs.layout.size)
    return Determined(found, data, held, shifts)


def _worth_keeping(found: Estimate) -> Judged | None:
    """Noise and outliers, where the estimate that judged them converged."""
    return found.judged if found.outcome.converged else None


def _as_guessed(found: Estimate, start: State, guess: dict[Key, np.ndarray], held: np.ndarray) -> State:
    """The estimate, or where it did not converge `start`, moved along the directions `held` (B, m) to where `guess` has
    them."""
    problem, state = found.problem, found.outcome.state if found.outcome.converged else start
    way = border_difference(problem, replace(start, values=start.values | guess), state) / problem.tolerance
    step = problem.tolerance * (held @ (held.T @ way))
    return state.retract(problem.layout, np.zeros((len(state.seconds), 15)), step)


def _as_worth(inputs: Inputs, found: Estimate, guess: State) -> State | None:
    """The estimate, moved along the held directions to where the guesses of all that they move have it, each by what it
    is worth; None where the rig file says no guess is worth more than others, or it stands there already.

    Where the data know only how two heights differ, and one was measured, `_as_guessed` would leave both half-way.
    """
    problem, state = found.problem, found.outcome.state
    own = np.concatenate([np.empty(0, dtype=np.int64), *(p.block.columns for p in given_priors(inputs))])
    if not problem.held.size or not np.any(np.abs(problem.held[own]) > MOVED_BY_HELD):
        return None
    sigma, directions = _guess_sigma(inputs), problem.tolerance[:, None] * problem.held
    way = border_difference(problem, guess, state)
    # What nobody guessed moves along, but nothing turns: what little a turn moves would be paid for with all of it.
    for block in (b for b in problem.layout.free if not inputs.is_sensor(b.sensor)):
        way[block.columns] = 0.0
        turns = block.columns[:2] if block.kind == "plane" else block.columns
        if block.kind != "vector":
            sigma[turns] = GUESS_SIGMA["rotation"]
    step = directions @ np.linalg.lstsq(directions / sigma[:, None], way / sigma, rcond=None)[0]
    if np.linalg.norm(step / sigma) < NEAR_GUESS:
        return None
    return state.retract(problem.layout, np.zeros((len(state.seconds), 15)), step)


def _judge(inputs: Inputs, found: Estimate) -> tuple[np.ndarray, np.ndarray]:
    """Information (B, B) of the data alone, and the directions (B, m) that it leaves open, both in tolerance units.

    Nuisances whose priors belong to the model (a target's shape, bloom) are open only where these priors are, too.
    """
    problem, outcome = found.problem, found.outcome
    t = problem.tolerance
    noise = spurious_information(problem, outcome)
    asked = _without(outcome.information, given_priors(inputs), outcome.state)
    scaled = t[:, None] * asked * t
    values, vectors = np.linalg.eigh(scaled - t[:, None] * noise * t)
    raw = np.einsum("ik,ij,jk->k", vectors, scaled, vectors)
    open_ones = (values < HELD_BELOW) | (values < SPURIOUS_SHARE * raw)
    data = _without(outcome.information - noise, problem.priors, outcome.state)
    return t[:, None] * data * t, vectors[:, open_ones]


def _without(information: np.ndarray, priors: Sequence[Prior], state: State) -> np.ndarray:
    bare = information.copy()
    for prior in priors:
        _, J = prior.residual(state)
        columns = prior.block.columns
        bare[np.ix_(columns, columns)] -= J.T @ J
    return bare


def _profile(inputs: Inputs, found: Estimate, data: np.ndarray, direction: np.ndarray) -> np.ndarray:
    """(B,) how the border moves when the guess moves along `direction` (B,), which is held, by what it is worth.

    A direction that is mostly of what nobody guessed moves by what `data` (B, B) leave open, where that is less: a
    board turned against gravity by as much as it likes would be turned round and round, with a bias of the
    accelerometer that nobody believes.
    """
    problem, state = found.problem, found.outcome.state
    step = problem.tolerance * direction
    inverse = float(np.linalg.norm(step / _guess_sigma(inputs)))
    guessed = sum(float((direction[b.columns] ** 2).sum()) for b in problem.layout.free if inputs.is_sensor(b.sensor))
    if guessed < MOSTLY:
        inverse = max(inverse, float(np.sqrt(np.clip(direction @ data @ direction, 0.0, HELD_BELOW))))
    step = step / inverse
    moved = state.retract(problem.layout, np.zeros((len(state.seconds), 15)), step)
    return border_difference(problem, minimise(problem, moved, tolerance=EARLY_DECREASE).state, state)


def _guess_sigma(inputs: Inputs) -> np.ndarray:
    """(B,) standard deviations of the guess: given ones, or what one without is worth."""
    sigma, sensors = np.zeros(inputs.layout.size), {s.name: s for s in inputs.sensors}
    for b in inputs.layout.free:
        sigma[b.columns] = OTHER_SIGMA if b.size == N_INTRINSICS else GUESS_SIGMA[b.name]
        if b.name == "translation" and b.sensor in sensors and sensors[b.sensor].translation.value is None:
            sigma[b.columns] = FROM_NOTHING_M
    for prior in given_priors(inputs):
        sigma[prior.block.columns] = prior.sigma
    return sigma


def border_difference(problem: Problem, a: State, b: State) -> np.ndarray:
    """(B,) the step of the border from `b` to `a`."""
    out = np.zeros(problem.layout.size)
    for block in problem.layout.free:
        x, y = a.values[block.key], b.values[block.key]
        if block.kind == "rotation":
            out[block.columns] = so3.log(np.ascontiguousarray(y.T @ x))
        elif block.kind == "tilt":
            out[block.columns] = so3.log(np.ascontiguousarray(x @ y.T))[:2]
        elif block.kind == "plane":
            out[block.columns] = planes.difference(x, y)
        else:
            out[block.columns] = x - y
    return out
