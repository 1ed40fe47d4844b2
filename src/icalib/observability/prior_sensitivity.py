"""Unobservable directions: the prior mean at which they are fixed, and the consider covariance of all other parameters.

A fixed direction has the value of the guesses of all parameters that it moves. Independent errors of these guesses give
the prior covariance of the fixed directions. The response of all other parameters is that of the normal equations at
the solution (implicit function theorem). Its derivative gives the second-order terms: on a plane the baseline of wheels
changes with the square of their roll.

Score tests, by one Newton step with more parameters: of values that the rig file states, and of effects that the
estimate leaves out.
"""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from functools import cached_property
from types import MappingProxyType
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike
from scipy import special
from scipy.linalg import eigh

from icalib.errors import EstimationError
from icalib.estimate.estimate import Estimate
from icalib.estimate.inputs import UNGUESSED_SIGMA, Inputs, groups_of, usual, with_association, with_groups
from icalib.estimate.parameter_changes import SIGNIFICANT, least_chi2
from icalib.estimate.problem import Problem, begun, given_priors, guess_sigma
from icalib.estimate.residual_statistics import Segments, calibration_columns, noise_variance, spread_variance
from icalib.estimate.solver import Linearised, Outcome, outcome_of
from icalib.geometry import planes, so3
from icalib.motion.factor import Residuals
from icalib.optim.arrowhead import (
    NO_DIRECTIONS,
    UNOBSERVABLE_BELOW,
    Factors,
    NotDefiniteError,
    Solution,
    free_root,
    restricted_root,
    sums_of_priors,
)
from icalib.optim.state import Block, Key, Layout, State
from icalib.rig import Parameter, ParameterSpec, Rig, Sensor
from icalib.sensors.sensor import CLOCK_RATE, MOUNTED_NAMES, ROTATION, TIME_OFFSET

# information in tolerance units, noise in the Jacobian included; below it a direction is reset to the guess
WEAKLY_CONSTRAINED_BELOW = 0.25
MAX_PRIOR_SIGMAS = 2.0  # standard deviations of the guess; a direction farther from the guess is reset to it
MOVED_ABOVE = 0.1  # entry of a unit direction above which the direction moves that parameter
MIN_RESET = 0.05  # of the prior uncertainty of the guess; a shorter reset is skipped
SHORT_STEP = 0.1  # standard deviations of the guess: half the step of the central differences of the response


def directions_to_reset(
    inputs: Inputs, problem: Problem, state: State, guess: State, null_space: np.ndarray, information: np.ndarray
) -> np.ndarray:
    """(B, k) orthonormal directions in the span of `null_space` (B, m) along which `state` is to be reset to `guess`.

    A direction keeps its estimate if two conditions hold. Its `information` (B, B; tolerance units, noise in the
    Jacobian included) exceeds WEAKLY_CONSTRAINED_BELOW, and `state` is within MAX_PRIOR_SIGMAS prior standard
    deviations of the guess. Noise in the Jacobian biases towards values where it is smallest, such as a zero lever arm.
    But it can also hide weak data, and a reset to a wrong guess would then distort well-known parameters.
    """
    if not null_space.size:
        return null_space
    values, turn = np.linalg.eigh(null_space.T @ information @ null_space)
    axes = null_space @ turn
    to_guess = axes.T @ (calib_difference(problem, guess, state) / problem.tolerance)
    prior_sigma = np.sqrt(np.diag(_prior_covariance(inputs, problem, state, axes)))
    return axes[:, (values < WEAKLY_CONSTRAINED_BELOW) | (np.abs(to_guess) > MAX_PRIOR_SIGMAS * prior_sigma)]


def project_to_guess(problem: Problem, state: State, guess: State, fixed_directions: np.ndarray) -> State:
    """`state` with its components along `fixed_directions` (B, m) set to those of `guess` (orthogonal projection)."""
    to_guess = calib_difference(problem, guess, state) / problem.tolerance
    return _moved(problem, state, fixed_directions @ (fixed_directions.T @ to_guess))


def project_to_prior(
    inputs: Inputs, problem: Problem, state: State, guess: State, fixed_directions: np.ndarray
) -> State | None:
    """`state`, reset along `fixed_directions` (B, m) to the mean of the priors of all parameters in them, by weighted
    least squares. None if the rig file has no prior on them, or if the state is at the mean already.

    Example: the data show only the difference of two heights, and one height was measured. `project_to_guess` would
    change both heights by half.
    """
    if not _has_priors(inputs, fixed_directions):
        return None
    sigma, to_guess = _weights(inputs, state), calib_difference(problem, guess, state)
    # Parameters without a guess may move along, but their own difference from the guess must not cause a move.
    for block in _unguessed(inputs):
        to_guess[block.columns] = 0.0
    directions = problem.tolerance[:, None] * fixed_directions
    step = directions @ np.linalg.lstsq(directions / sigma[:, None], to_guess / sigma, rcond=None)[0]
    if np.linalg.norm(step / sigma) < MIN_RESET:
        return None
    return _moved(problem, state, step / problem.tolerance)


def prior_sensitivity(inputs: Inputs, outcome: Outcome, data: np.ndarray, noise: np.ndarray) -> np.ndarray:
    """(n, B) changes of the calibration parameters, in their units, whose outer products add up to the consider
    covariance of the m fixed directions.

    The first m rows are the linear responses to independent errors of the guess, one standard deviation each. The
    others hold the mean and the covariance of the second-order terms for Gaussian errors (Athans, Wishner and Bertolini
    1968). The sum does not depend on signs and choice of the axes. data, noise (B, B): information of the data alone,
    and what noise in the Jacobian adds, in tolerance units. Overwrites the workspace of `outcome`. A failed estimate,
    or one with no other direction, has no response: only the fixed directions themselves move.
    """
    problem, state = outcome.problem, outcome.state
    errors = _guess_errors(inputs, outcome, data)
    m, is_usable = errors.shape[1], outcome.converged or outcome.stopped_early
    if not is_usable or m == len(problem.layout.essential):
        return problem.tolerance * errors.T
    factors = _factors(outcome, state)
    first, second = _response(factors, noise, errors), np.zeros((m, len(errors), m))
    chain = factors.back(np.vstack([first, np.zeros((1, m))]), [np.zeros((n, m)) for n in factors.rows()])
    for k in range(m):
        step = SHORT_STEP * np.ascontiguousarray(chain[:, :, k]), SHORT_STEP * first[:, k]
        ends = (state.retract(problem.layout, sign * step[0], sign * step[1]) for sign in (1.0, -1.0))
        with suppress(NotDefiniteError):  # no second-order terms where even a short step is too long
            up, down = (_response(_factors(outcome, end), noise, errors) for end in ends)
            second[k] = (up - down) / (2.0 * SHORT_STEP)
    second = 0.5 * (second + second.transpose(2, 1, 0))
    return np.vstack([first.T, 0.5 * np.einsum("kbk->b", second), *np.sqrt(0.5) * second.transpose(0, 2, 1)])


def _factors(outcome: Outcome, state: State) -> Factors:
    """The factorised normal equations of `outcome` at `state`; overwrites its workspace."""
    problem, pieces = outcome.problem, outcome.workspace or outcome.problem.pieces()
    problem.linearise(state, pieces, problem.residuals(), curved=True)
    return problem.solve(pieces).factors


def _response(factors: Factors, noise: np.ndarray, errors: np.ndarray) -> np.ndarray:
    """(B, m) change of all calibration parameters, in their units, with `errors` (B, m) along the fixed directions, by
    the implicit function theorem. noise (B, B): information that noise in the Jacobian adds; both in tolerance units.

    Directions that are unobservable at this state do not respond, as in a step of the solver. Away from the solution,
    less noise may be left than is subtracted, and a floor of the information would make any coupling 1e4 times as
    large."""
    t = factors.tolerance[:, None]
    known = t * factors.information * t.T - noise
    free, root = free_root(known, np.ones(len(known)), factors.fixed_directions, factors.essential)
    axes = free @ root
    return t * (errors - axes @ (axes.T @ (known @ errors)))


def _guess_errors(inputs: Inputs, outcome: Outcome, data: np.ndarray) -> np.ndarray:
    """(B, m) independent errors of the guess along the fixed directions, one standard deviation each, in tolerance
    units.

    Walls, boards and frames have no guess. The more a direction consists of them, the more the information `data` (B,
    B) limits its standard deviation. Unlimited, a board would be rotated by any angle against gravity, with an absurd
    accelerometer bias.
    """
    problem, fixed_directions = outcome.problem, outcome.problem.fixed_directions
    of_sensors = [b.columns for b in problem.layout.free if inputs.is_sensor(b.sensor)]
    unguessed = np.delete(fixed_directions, np.concatenate([np.arange(0), *of_sensors]), axis=0)
    share = _root(unguessed.T @ unguessed, 1.0)
    limit = _root(fixed_directions.T @ data @ fixed_directions, UNOBSERVABLE_BELOW) @ share
    root = _root(_prior_covariance(inputs, problem, outcome.state, fixed_directions), np.inf)
    limited = np.linalg.inv(np.eye(len(root)) + root @ limit.T @ limit @ root)
    return fixed_directions @ root @ _root(limited, 1.0)


def _root(covariance: np.ndarray, largest: float) -> np.ndarray:
    """(m, m) symmetric root of `covariance` (m, m), whose eigenvalues are clipped to 0 and `largest`."""
    # NumPy's divide and conquer has failed on many nearly equal eigenvalues.
    values, vectors = eigh(covariance, driver="evr")
    return vectors * np.sqrt(np.clip(values, 0.0, largest)) @ vectors.T


def _prior_covariance(inputs: Inputs, problem: Problem, state: State, fixed_directions: np.ndarray) -> np.ndarray:
    """(m, m) prior covariance of the guess along `fixed_directions` (B, m), in tolerance units.

    With V = `fixed_directions` and S the diagonal matrix of the prior variances, it is (V^T S^-1 V)^-1 if the rig file
    has priors there. The state is then reset by weighted least squares (`project_to_prior`). Without priors it is V^T S
    V, and the reset is an orthogonal projection (`project_to_guess`).
    """
    if _has_priors(inputs, fixed_directions):
        scaled = fixed_directions * (problem.tolerance / _weights(inputs, state))[:, None]
        return np.linalg.inv(scaled.T @ scaled)
    sigma = guess_sigma(inputs, state)
    for block in _unguessed(inputs):
        sigma[block.columns] = np.minimum(sigma[block.columns], UNGUESSED_SIGMA)
    scaled = fixed_directions * (sigma / problem.tolerance)[:, None]
    return scaled.T @ scaled


def _has_priors(inputs: Inputs, fixed_directions: np.ndarray) -> bool:
    """Whether the rig file has a prior on a parameter that `fixed_directions` (B, m) move."""
    columns = np.concatenate([np.empty(0, dtype=np.int64), *(p.block.columns for p in given_priors(inputs))])
    return bool(fixed_directions.size and np.any(np.abs(fixed_directions[columns]) > MOVED_ABOVE))


def _weights(inputs: Inputs, state: State) -> np.ndarray:
    """(B,) prior standard deviations of the guess, in parameter units: those of `guess_sigma`, with one exception.

    Walls, boards and frames have no guess. Their rotations, tilts and normals get the default sigma of a sensor's
    rotation [rad], instead of their own wide default.
    """
    sigma = guess_sigma(inputs, state)
    for block in _unguessed(inputs):
        if block.kind not in ("vector", "nuisance"):
            sigma[block.columns[:2] if block.kind == "plane" else block.columns] = ROTATION.prior_sigma
    return sigma


def _unguessed(inputs: Inputs) -> list[Block]:
    """Blocks that belong to no sensor: walls, boards and frames. They have no initial guess."""
    return [b for b in inputs.layout.free if not inputs.is_sensor(b.sensor)]


def _moved(problem: Problem, state: State, step: np.ndarray) -> State:
    """`state` with the calibration parameters moved by `step` (B,), in tolerance units."""
    return state.retract(
        problem.layout, np.zeros((len(state.seconds), problem.layout.keyframe_dim)), problem.tolerance * step
    )


def calib_difference(problem: Problem, a: State, b: State) -> np.ndarray:
    """(B,) step of the calibration parameters that leads from `b` to `a`, in their units."""
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


# Normal equations at the solution with all values free that the rig file fixes, and optionally without its priors.
#
# This is a score test (Lagrange multiplier test; Rao 1948). A constraint that the data contradict leaves a gradient at
# the solution. One Newton step without the constraint gives the value of the data alone and its standard deviation.


@dataclass(frozen=True)
class Relaxed:
    """The solution of an estimate, linearised again at `state` with the fixed values in the layout.

    inputs, problem: with all groups `stated` as columns. solution: gradient (B,) and information (B, B) of the
    calibration parameters at `state`. before: the layout of the estimate. stated: groups that the rig file fixes or
    gives a prior.
    """

    inputs: Inputs
    problem: Problem
    state: State
    solution: Solution
    residuals: Residuals
    before: Layout
    stated: tuple[Key, ...]

    @property
    def layout(self) -> Layout:
        return self.problem.layout

    def fixed_columns(self, freed: Collection[Key]) -> np.ndarray:
        """Columns that were fixed in the estimate, except those of the groups `freed`."""
        free = {*freed, *(b.key for b in self.before.free)}
        fixed = [b for b in self.layout.free if b.key not in free]
        return np.concatenate([np.arange(0), *(b.columns for b in fixed)])

    def step(self, freed: Collection[Key]) -> tuple[np.ndarray, np.ndarray]:
        """(B,) Newton step of the calibration parameters, and (B,) its standard deviations. The groups `freed` are free
        and without their priors; all other values stay as the rig file states them."""
        t, (pull, known) = self.problem.tolerance, self._priors_of(freed)
        information, gradient = self.solution.information - known, self.solution.gradient[:-1] - pull
        step, root = _newton_step(information, gradient, t, _also_fixed(self.problem, self.fixed_columns(freed)))
        return step, np.sqrt((root**2).sum(axis=1))

    def without(self, freed: Collection[Key]) -> tuple[Outcome, np.ndarray]:
        """The outcome without the priors on the groups `freed`, and the gradient (B,) of the calibration parameters.
        Noise in the Jacobian can be estimated from this outcome."""
        pull, known = self._priors_of(freed)
        problem = self.problem.without([p for p in self.problem.priors if p.block.key in freed])
        outcome = outcome_of(Linearised(problem, self.state, 0.0, self.residuals), 0.0, [], self.solution)
        return replace(outcome, information=outcome.information - known), self.solution.gradient[:-1] - pull

    def _priors_of(self, freed: Collection[Key]) -> tuple[np.ndarray, np.ndarray]:
        """Gradient (B,) and information (B, B) of the priors on the groups `freed`."""
        priors = [p for p in self.problem.priors if p.block.key in freed]
        return sums_of_priors(priors, self.state, self.layout.size)[1:]


def _also_fixed(problem: Problem, columns: np.ndarray) -> np.ndarray:
    """The fixed directions of `problem`, and `columns`, as directions."""
    n = problem.layout.size
    return np.hstack([np.eye(n)[:, columns], problem.fixed_directions.reshape(n, -1)])


def _newton_step(
    information: np.ndarray, gradient: np.ndarray, t: np.ndarray, fixed_directions: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """(B,) step of the calibration parameters for their information (B, B) and gradient (B,), and a root (B, n) of its
    covariance. fixed_directions (B, m): in units of the tolerances t (B,)."""
    root = t[:, None] * restricted_root(t[:, None] * information * t, fixed_directions)
    return -root @ (root.T @ gradient), root


def relaxed(inputs: Inputs, estimate: Estimate) -> Relaxed | None:
    """Normal equations at the solution of `estimate`, with a column for each value that the rig file fixes, and for the
    size of the target.

    The state does not move, and priors still act: `Relaxed.step` frees chosen groups and drops their priors. None if
    the rig file states none of these, if the solver did not converge, or if the equations are singular.
    """
    is_stated = bool(inputs.bodies.used) or any(_is_stated(p) for _, _, p in groups_of(inputs.rig))
    if not estimate.outcome.converged or not is_stated:
        return None
    freed = freed_inputs(_sized(inputs))
    if (linearised := _linearised(freed, estimate)) is None:
        return None
    problem, state, solution, residuals = linearised
    return Relaxed(freed, problem, state, solution, residuals, inputs.layout, tuple(stated_keys(inputs, freed.layout)))


def _sized(inputs: Inputs) -> Inputs:
    """The inputs with the size of the target as a parameter."""
    return replace(inputs, bodies=replace(inputs.bodies, sized=bool(inputs.bodies.used)))


def _linearised(
    inputs: Inputs, estimate: Estimate, effects: Collection[Key] = ()
) -> tuple[Problem, State, Solution, Residuals] | None:
    """Normal equations at the solution of `estimate` for `inputs` with more free groups; None if they are singular.
    Priors on `effects` are so wide that they have no weight."""
    fixed_directions = _in_layout(inputs.layout, estimate.problem.layout, estimate.problem.fixed_directions)
    state = begun(inputs, estimate.outcome.state)
    zeros = {b.key: np.zeros(b.size) for b in inputs.layout.free if b.key not in state.values}
    state = replace(state, values=zeros | state.values)
    try:
        problem = estimate.measurement_model.problem(inputs, state, fixed_directions)
        priors = (replace(p, sigma=WIDE * p.sigma) if p.block.key in effects else p for p in problem.priors)
        problem = replace(problem, priors=tuple(priors))
        pieces, residuals = problem.pieces(), problem.residuals()
        problem.linearise(state, pieces, residuals, curved=True)
        return problem, state, problem.solve(pieces), residuals
    except EstimationError:
        return None


def stated_keys(inputs: Inputs, layout: Layout) -> list[Key]:
    """Groups that the original rig file fixes or gives a prior, and that have columns in `layout`.

    Without a real IMU the pose of the reference sensor defines the body frame, so it is no stated value. With assumed
    motion neither is its time offset.
    """
    user_rig = inputs.user_rig or inputs.rig
    body = () if inputs.rig.imu is not None and not inputs.rig.assumes_motion else ("rotation", "translation")
    if inputs.rig.assumes_motion:
        body = (*body, "time_offset")
    return [
        (s.name, name)
        for s, name, parameter in groups_of(user_rig)
        if _is_stated(parameter)
        if not (s.name == user_rig.reference and name in body)
        if any(b.key == (s.name, name) and b.start is not None for b in layout.blocks)
    ]


def freed_inputs(inputs: Inputs, keys: Collection[Key] | None = None) -> Inputs:
    """`inputs` with groups free that start at their stated values: all fixed ones, or with `keys` exactly these,
    whether fixed or with a prior."""

    def freed(sensor: Sensor, name: str, p: Parameter) -> Parameter:
        wanted = p.mode == "fixed" if keys is None else (sensor.name, name) in keys
        return Parameter("free", p.value) if wanted and p.value is not None else p

    return _of_rig(inputs, with_groups(inputs.rig, freed))


def _of_rig(inputs: Inputs, rig: Rig) -> Inputs:
    """`inputs` with another treatment of the same sensors."""
    return with_association(replace(inputs, rig=rig), inputs.association)


def _is_stated(parameter: Parameter) -> bool:
    return parameter.mode != "free" and parameter.value is not None


def _in_layout(layout: Layout, before: Layout, fixed_directions: np.ndarray) -> np.ndarray:
    """Directions of the calibration parameters of the layout `before`, as directions of `layout`, which has more
    columns."""
    if not fixed_directions.size:
        return NO_DIRECTIONS
    out = np.zeros((layout.size, fixed_directions.shape[1]))
    for block in before.free:
        out[layout.block(*block.key).columns] = fixed_directions[block.columns]
    return out


# Effects: parameters that are zero for an ideal sensor, and that the estimate does not have.

# standard deviations from which an effect differs from zero; of several numbers: the same chance
EFFECT_SIGMAS = SIGNIFICANT**0.5
COVERED_SIGMAS = 3.0  # from which on standard deviations cover an effect: chance exceeds them in 1 of 370
SHORTLY = 0.01  # of a step: over it the gradients of segments are linear
WIDE = 1e3  # of a prior: instead of none, as the motion need not show an effect


@dataclass(frozen=True)
class Effect:
    """An effect of the whole recording, such as the rate of a clock, by a score test. value (m,): one Newton step of
    its parameters [the unit of `spec`], beside all other effects that were tested; root (m, n): of its covariance, by
    the scatter of segments after this step where an effect is suspected. gain: decrease of
    chi^2 where it is estimated, for white noise. moves: the largest change of a parameter of the estimate by this
    effect alone, in tolerances."""

    sensor: str
    spec: ParameterSpec
    value: np.ndarray
    root: np.ndarray
    gain: float
    moves: float

    @property
    def std(self) -> np.ndarray:
        """(m,) standard deviations."""
        return np.sqrt((self.root**2).sum(axis=1))

    @property
    def chi2(self) -> float:
        """Of the step."""
        return _chi2(self.value, self.root)

    @property
    def differs(self) -> bool:
        """Whether it differs from zero."""
        return self.chi2 > least_chi2(len(self.value))

    @property
    def plain(self) -> dict[str, Any]:
        """Its numbers for files."""
        numbers = {"value": self.value.tolist(), "std": self.std.tolist()}
        return numbers | {"labels": list(self.spec.labels), "unit": self.spec.unit}

    def amended(self, rig: Rig) -> Rig:
        """The rig with a prior on the effect, so that it is estimated."""
        prior = Parameter("prior", np.zeros(self.spec.size), np.full(self.spec.size, self.prior_sigma))
        return rig.with_sensors(replace(rig.sensors[self.sensor], **{self.spec.name: prior}))

    @property
    def prior_sigma(self) -> float:
        """Standard deviation of the prior with which it is estimated: the usual one, or a larger one that the value
        does not contradict. Of several numbers it is half the largest, as it may be all that holds their mean."""
        largest = float(np.abs(self.value).max())
        needed = 0.5 * largest if len(self.value) > 1 else 10.0 ** np.ceil(np.log10(largest))
        return max(float(needed), self.spec.prior_sigma)


class EffectsLeftOut(NamedTuple):
    """Effects that an estimate leaves out: all that were tested; and for each effect that is considered the shift (B,)
    of the calibration parameters whose outer product adds to their covariance. beside: problem with these effects and
    with fixed values free, and the solution; rates of clocks are fixed, as they are changes, too. None: no effects."""

    tested: tuple[Effect, ...] = ()
    shifts: Mapping[Key, np.ndarray] = MappingProxyType({})
    beside: tuple[Problem, State] | None = None


def effects_left_out(inputs: Inputs, estimate: Estimate) -> EffectsLeftOut:
    """All effects that the rig file does not mention, and IMU intrinsics that it fixes without a value, tested
    together; none without convergence."""
    equipped = _of_rig(inputs, inputs.rig.with_sensors(*(s.with_effects() for s in inputs.rig.sensors.values())))
    specs = _testable(equipped) if estimate.outcome.converged else {}
    freed = _with_effects(equipped, specs)
    specs = {key: spec for key, spec in specs.items() if freed.layout.has(*key) and freed.layout.is_free(*key)}
    single = [key for key, spec in specs.items() if spec.size == 1]
    if not specs or (linearised := _linearised(freed, estimate, single)) is None:
        return EffectsLeftOut()
    freed_estimate = _FreedEstimate(inputs.layout, *linearised)
    problem, state, *_ = linearised
    rates = [problem.layout.columns(*key) for key, spec in specs.items() if spec is CLOCK_RATE]
    fixed = _also_fixed(problem, np.concatenate([np.arange(0), *rates]))
    beside = replace(problem, fixed_directions=fixed), state
    effects = freed_estimate.effects(specs, freed)
    shifts = freed_estimate.considered(specs) | freed_estimate.covered([e for e in effects if not e.differs])
    return EffectsLeftOut(effects, shifts, beside)


def _testable(inputs: Inputs) -> dict[Key, ParameterSpec]:
    """The effects to test. Without a time offset a clock has no rate."""
    rig, layout, out = inputs.rig, inputs.layout, dict[Key, ParameterSpec]()
    for s in rig.sensors.values():
        is_clocked = layout.has(s.name, TIME_OFFSET.name) and layout.is_free(s.name, TIME_OFFSET.name)
        effects = (spec for spec in s.parameters if spec.is_effect)
        for spec in effects if s is not rig.imu or not rig.assumes_motion else ():
            p, key = getattr(s, spec.name), (s.name, spec.name)
            left_out = p.mode == "fixed" and p.value is None and not (layout.has(*key) and layout.is_free(*key))
            if left_out and (is_clocked or spec != CLOCK_RATE):
                out[key] = spec
    return out


def _with_effects(inputs: Inputs, effects: Collection[Key]) -> Inputs:
    """The inputs with `effects` estimated: with the prior of their class, or without one. Fixed values get the prior of
    a guess, so that an effect is named only where a wrong value does not explain it."""
    rig = inputs.rig
    body = rig.reference_without_imu if rig.imu is None or rig.assumes_motion else ""
    frame = [(body, name) for name in MOUNTED_NAMES]  # that of the body is no stated value

    def estimated(sensor: Sensor, name: str, p: Parameter) -> Parameter:
        if (key := (sensor.name, name)) in effects:
            return usual(sensor, name)
        if p.mode != "fixed" or p.value is None or key in frame:
            return p
        return Parameter("prior", p.value, np.full(p.size, sensor.spec(name).prior_sigma))

    return _of_rig(_sized(inputs), with_groups(rig, estimated))


@dataclass(frozen=True)
class _FreedEstimate:
    """Normal equations at the solution of an estimate with the layout `before`, with effects and fixed values free."""

    before: Layout
    problem: Problem
    state: State
    solution: Solution
    residuals: Residuals

    def effects(self, specs: Mapping[Key, ParameterSpec], freed: Inputs) -> tuple[Effect, ...]:
        """All of the effects `specs`, at one Newton step; none where one may differ from zero and no segments show its
        standard deviation."""
        step, root = self._step_of(np.arange(self.problem.layout.size))
        columns = {key: self.problem.layout.columns(*key) for key in specs}
        suspected = any(_is_far(step[k], root[k]) for k in columns.values())
        ratio = self._scatter(step, root, freed) if suspected else np.ones(len(step))
        if ratio is None:
            return ()
        out = []
        for key, k in columns.items():
            moves = float(np.abs(self._response(k) @ step[k] / self._tolerance).max(initial=0.0))
            out.append(Effect(key[0], specs[key], step[k], ratio[k, None] * root[k], _chi2(step[k], root[k]), moves))
        return tuple(out)

    def covered(self, effects: Sequence[Effect]) -> dict[Key, np.ndarray]:
        """(B,) changes of the calibration parameters by each effect that may differ from zero."""
        columns = self.problem.layout.columns
        far = (e for e in effects if _is_far(e.value, e.root))
        return {(e.sensor, e.spec.name): self._response(columns(e.sensor, e.spec.name)) @ e.value for e in far}

    def considered(self, specs: Mapping[Key, ParameterSpec]) -> dict[Key, np.ndarray]:
        """(B,) responses of the calibration parameters to effects that are considered (Schmidt 1966). Each is as
        large as the RMS error that prior and data allow it, all fixed values being right."""
        shifts = dict[Key, np.ndarray]()
        for key in (key for key, spec in specs.items() if spec.is_considered):
            k = self.problem.layout.columns(*key)
            step, root = self._step_of([*self._estimated, *k])
            by_data, by_prior = float((root[k] ** 2).sum()), specs[key].prior_sigma ** 2
            weight = by_prior / (by_prior + by_data)
            rms = np.sqrt(weight * by_data + (weight * step[k[0]]) ** 2)
            shifts[key] = rms * self._response(k)[:, 0]
        return shifts

    @cached_property
    def _estimated(self) -> np.ndarray:
        """Columns of the parameters that the estimate has, in the order of `before`."""
        return np.concatenate([np.arange(0), *(self.problem.layout.columns(*b.key) for b in self.before.free)])

    @cached_property
    def _tolerance(self) -> np.ndarray:
        """Of each of these; infinite for nuisance parameters."""
        essential = np.isin(self._estimated, self.problem.layout.essential)
        return np.where(essential, self.problem.tolerance[self._estimated], np.inf)

    def _step_of(self, columns: ArrayLike) -> tuple[np.ndarray, np.ndarray]:
        """Step of the parameters with `columns`, and root of its covariance; all others are fixed."""
        others = np.setdiff1d(np.arange(self.problem.layout.size), columns)
        gradient, t = self.solution.gradient[:-1], self.problem.tolerance
        return _newton_step(self.solution.information, gradient, t, _also_fixed(self.problem, others))

    @cached_property
    def _root(self) -> np.ndarray:
        """Root of the covariance of the estimate."""
        return self._step_of(self._estimated)[1]

    def _response(self, columns: np.ndarray) -> np.ndarray:
        """(B, m) derivative of the parameters that the estimate has by those with `columns` (m,); others are fixed."""
        return -(self._root @ (self._root.T @ self.solution.information[:, columns]))[self._estimated]

    def _scatter(self, step: np.ndarray, root: np.ndarray, freed: Inputs) -> np.ndarray | None:
        """(B,) ratios of standard deviations, by the scatter of segments after `step`, which trajectory and points
        follow, and by white noise; at least that of all parameters that matter together. None without segments."""
        if (before := self._segments(self.state, freed)) is None:
            return None
        factors = self.solution.factors
        chain = factors.back(np.append(step, 1.0)[:, None], [np.zeros((n, 1)) for n in factors.rows()])[:, :, 0]
        moved = self.state.retract(self.problem.layout, SHORTLY * chain, SHORTLY * step)
        shortly = self._segments(moved, freed) or before
        gradients = before.gradients + (shortly.gradients - before.gradients) / SHORTLY
        outcome = self._outcome(self.state)
        white = noise_variance(self.problem, outcome)
        scattered = spread_variance(outcome, replace(before, gradients=gradients), white)
        variance, ratio = (root**2).sum(axis=1), np.ones(len(step))
        np.divide(scattered, variance, out=ratio, where=variance > 0.0)  # 0: fixed
        ratio = np.sqrt(np.maximum(ratio, 1.0))
        return np.maximum(ratio, np.sqrt(np.mean(ratio[calibration_columns(freed)] ** 2)))

    def _segments(self, state: State, freed: Inputs) -> Segments | None:
        """Segments at another state."""
        return Segments.of(self.problem, self._outcome(state), freed.rig.settings.segments)

    def _outcome(self, state: State) -> Outcome:
        """The outcome at another state."""
        return outcome_of(Linearised(self.problem, state, 0.0, self.residuals), 0.0, [], self.solution)


def _is_far(step: np.ndarray, root: np.ndarray) -> bool:
    """Whether `step` (m,), whose covariance has the root (m, n), differs from zero by what is as unlikely as
    COVERED_SIGMAS of one number: as a whole, or along a principal direction. Priors hide one direction of many."""
    values, vectors = np.linalg.eigh(root @ root.T)
    squares = (vectors.T @ step) ** 2 / np.maximum(values, 1e-12 * values[-1])
    chance = special.chdtrc(1, COVERED_SIGMAS**2)
    m = len(step)
    return bool(squares.sum() > special.chdtri(m, chance) or squares.max() > special.chdtri(1, chance / m))


def _chi2(step: np.ndarray, root: np.ndarray) -> float:
    """chi^2 of a step (m,) whose covariance has the root (m, n)."""
    return float(((np.linalg.pinv(root) @ step) ** 2).sum())
