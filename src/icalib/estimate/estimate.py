"""The reweighting loop: solve, estimate noise and inliers from the residuals, freeze them, solve again."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cache
from typing import Any

import numpy as np

from icalib.estimate.evidence.corner_noise import (
    COMMON_ERRORS,
    FIRST_TAU_PX,
    NoiseModel,
    estimate_noise,
    first_noise,
    image_speed,
    scale_common_errors,
)
from icalib.estimate.evidence.evidence import chi2_by_kind, fits
from icalib.estimate.evidence.feature_noise import first_following, next_following
from icalib.estimate.problem.assembly import Following, assemble, keyframe_times, keyframes_for, resample
from icalib.estimate.problem.guess_priors import guess_priors
from icalib.estimate.problem.inputs import Inputs
from icalib.estimate.problem.outcome import Outcome, Step, Visit, way_come
from icalib.estimate.problem.problem import Problem
from icalib.estimate.problem.solver import minimise
from icalib.model.sensor_model import model_of
from icalib.model.statistics import Fit, ResidualStatistics
from icalib.motion.factor import of_type, pairs_of
from icalib.optim import pages
from icalib.optim.calib_block import NOTHING
from icalib.optim.prior_factor import Prior, without_priors
from icalib.optim.state import State
from icalib.rig import Camera
from icalib.sensors.camera.corner_factor import CornerFactor, CornerNoise, CornerOutput
from icalib.sensors.camera.corner_outliers import inliers
from icalib.sensors.camera.features.feature_factor import FeatureFactor
from icalib.sensors.camera.image_pairs import not_simultaneous

FIRST_PASS_PRIOR_WIDTH = 3.0  # times the prior uncertainty of the initial guess
# An early pass stops where the next step would lower half the chi^2 by less, or by less than that share of it.
EARLY_DECREASE, EARLY_SHARE = 0.5, 1e-6
FIRST_SHARE = 1e-3  # the same of the first pass: noise and inliers that it freezes are farther off
MOST_REPEATS = 4  # of the final pass
FAR = 1.1  # ratio of the chi^2 at the start of a pass to that at its end, above which frozen weights are out of date
NEARER = 0.5  # relative cost decrease over that of the pass before: above it passes alternate between two states
ENOUGH_TRACKED = 0.8  # share of the observations of tracks that take part, above which no further pass is tried
MORE_TRACKED = 1.1  # ratio of observations that would take part to those that do, above which the pass is repeated


OnVisit = Callable[[str, Problem, Visit], None]  # told of the pass's name, its problem, and where the solver stood


@dataclass(frozen=True)
class Judged:
    """What the residuals of a pass say before the next. noise: by sensor, of the class that its kind has; models: by
    camera, how its corners err; keep: by camera (N,), corners in use; following: of tracks. coarse: nothing is known
    yet, so the pass takes fewer points, and edges for straight. apart: by camera (M,) bool, images that are rejected
    because they are not simultaneous with others of their keyframe; empty where that is not tested."""

    noise: Mapping[str, Any]
    models: tuple[NoiseModel, ...]
    keep: tuple[np.ndarray, ...]
    following: Following | None
    coarse: bool = False
    apart: tuple[np.ndarray, ...] = ()

    @classmethod
    def first(cls, inputs: Inputs) -> Judged:
        """Before any pass: what the rig file says, or what is usual, of all there is."""
        rig, streams = inputs.rig, inputs.measurements.cameras
        models = tuple(first_noise(c) for c in rig.cameras)
        noise = {s.name: model_of(s).first_noise(s, rig.settings) for s in rig.mounted if not isinstance(s, Camera)}
        noise |= {c.name: m.noise(s, c, rig.settings) for m, s, c in zip(models, streams, rig.cameras, strict=True)}
        keep = tuple(np.ones(len(s.uv), dtype=bool) for s in streams)
        return cls(noise, models, keep, first_following(inputs), True)

    def problem(self, inputs: Inputs, state: State, held: np.ndarray = NOTHING) -> Problem:
        """See `assemble`."""
        return assemble(inputs, state, self.noise, self.keep, held, self.following, self.coarse)

    def next(self, inputs: Inputs, outcome: Outcome, first: bool) -> Judged:
        """As what a pass left behind, the `first` or another, shows it."""
        problem, apart = outcome.problem, _apart(inputs, outcome)
        now = replace(self, keep=_kept(inputs, outcome, apart), apart=apart)
        if now.following is not None:
            now = replace(now, following=next_following(inputs, outcome, now.following, first))
        if _noise_is_estimated(inputs):
            all_fits = cache(lambda: fits(problem, outcome))
            models, cameras = _next_noise(inputs, problem, outcome, all_fits)
            now = replace(now, models=models, noise=_next_others(inputs, outcome, now.noise, all_fits) | cameras)
        return replace(now, coarse=False)


@dataclass(frozen=True)
class Estimate:
    """The last pass: where the solver ended, and what it was told of the noise."""

    outcome: Outcome
    judged: Judged
    steps: tuple[tuple[str, Step], ...]  # of all passes, with the pass's name

    @property
    def problem(self) -> Problem:
        return self.outcome.problem


def estimate(
    inputs: Inputs,
    state: State,
    on_step: Callable[[str, Step], None] = lambda *_: None,
    held: np.ndarray = NOTHING,
    on_visit: OnVisit = lambda *_: None,
    judged: Judged | None = None,
    maybe_rank_deficient: Callable[[Problem, np.ndarray], bool] = lambda *_: False,
    guess: State | None = None,
) -> Estimate:
    """All passes from an initial `state`; the final one alone if noise and outliers are `judged` already.

    Directions of the calibration parameters in `held` (see Problem) are fixed. A pass stops early if the information of
    the calibration parameters (B, B) may be rank deficient, as `maybe_rank_deficient` tells, because it would converge
    slowly along an unobservable direction. Until the null space is known, and while directions are fixed, `guess` is a
    prior, so that unobservable directions do not drift. A pass that ended with that prior counts as stopped early, too.

    Raises EstimationError where the data do not carry an estimate.
    """
    *early, final = pass_names(inputs)
    about = () if guess is None else guess_priors(inputs, guess)
    passes = _Passes(
        inputs, held, on_step, on_visit, maybe_rank_deficient, state, judged or Judged.first(inputs), about
    )
    if judged is None:
        for name in early:
            passes.early(name)
            pages.give_back()  # before the next one takes as much memory
    else:
        passes.begin_at(state)
    way = np.inf
    for left in reversed(range(1 + MOST_REPEATS)):
        way_before = way if left else 0.0  # nearer than that is not to be had any more
        outcome, way = passes.final(final, way_before)
        if not left or not _again(inputs, outcome, passes.judged, way, way_before):
            return Estimate(_without_priors(outcome, passes.about), passes.judged, tuple(passes.history))
        passes.begin_at(outcome.state)
        del outcome
        pages.give_back()
    raise AssertionError("the loop ends where nothing is left")


@dataclass
class _Passes:
    """Passes of one estimate. The next one begins at `state`, with the measurement model `judged` so far. Priors
    `about` the guess apply until every direction is observable and none is fixed."""

    inputs: Inputs
    held: np.ndarray
    on_step: Callable[[str, Step], None]
    on_visit: OnVisit
    maybe_rank_deficient: Callable[[Problem, np.ndarray], bool]
    state: State
    judged: Judged
    about: tuple[Prior, ...]
    history: list[tuple[str, Step]] = field(default_factory=list)

    def begin_at(self, state: State) -> None:
        """The next pass: of the same motion, at the keyframes that its clocks want."""
        self.state = _on_own_keyframes(self.inputs, state)

    def early(self, name: str) -> None:
        """One that leads near, and shows what is judged before the next."""
        first = name == "first"
        problem, told = self._next(name)
        share = FIRST_SHARE if first else EARLY_SHARE

        def leaves(_: float, information: np.ndarray) -> bool:
            return self.maybe_rank_deficient(problem, information)

        outcome = minimise(problem, self.state, told.step, EARLY_DECREASE, told.visit, share, leaves=leaves)
        self._let_go(self.maybe_rank_deficient(problem, told.information))
        self.judged = self.judged.next(self.inputs, outcome, first)
        self.begin_at(outcome.state)

    def final(self, name: str, way_before: float) -> tuple[Outcome, float]:
        """Solve the final pass. Returns the outcome and its relative cost decrease; `inf` if it stopped early because
        the problem is rank deficient. The pass may also stop early to freeze its choices anew, or to drop priors."""
        problem, told = self._next(name)

        def leaves(way: float, information: np.ndarray) -> bool:
            return bool(self.about) or self.maybe_rank_deficient(problem, information) or _is_far(way, way_before)

        def lets_go(way: float, information: np.ndarray) -> tuple[Prior, ...]:
            return () if _is_far(way, way_before) else self._let_go(self.maybe_rank_deficient(problem, information))

        outcome = minimise(problem, self.state, told.step, on_visit=told.visit, leaves=leaves, lets_go=lets_go)
        is_open = self.maybe_rank_deficient(problem, told.information)
        way, gone = way_come(outcome.steps, outcome.cost), self._let_go(is_open)
        if gone and not _is_far(way, way_before):
            without, room = outcome.problem.without(gone), outcome.room
            rest = minimise(without, outcome.state, told.step, on_visit=told.visit, room=room)
            outcome = replace(rest, steps=(*outcome.steps, *rest.steps))
            way = way_come(outcome.steps, outcome.cost)
        return outcome, np.inf if is_open and outcome.half_way else way

    def _next(self, name: str) -> tuple[Problem, _Told]:
        problem = _with_priors(self.judged.problem(self.inputs, self.state, self.held), self.about)
        return problem, _Told(name, problem, self.on_step, self.on_visit, self.history)

    def _let_go(self, is_open: bool) -> tuple[Prior, ...]:
        """Priors that count no more."""
        if is_open or self.held.size:
            return ()
        gone, self.about = self.about, ()
        return gone


@dataclass
class _Told:
    """Passes on what a pass tells of its way, keeps the steps in a `history` of all passes, and the calibration
    parameters' last information (B, B)."""

    name: str
    problem: Problem
    on_step: Callable[[str, Step], None]
    on_visit: OnVisit
    history: list[tuple[str, Step]]
    information: np.ndarray = field(default_factory=lambda: NOTHING)

    def step(self, step: Step) -> None:
        self.history.append((self.name, step))
        self.on_step(self.name, step)

    def visit(self, at: Visit) -> None:
        self.information = at.information
        self.on_visit(self.name, self.problem, at)


def _with_priors(problem: Problem, more: Sequence[Prior]) -> Problem:
    return replace(problem, priors=(*problem.priors, *more))


def _without_priors(outcome: Outcome, more: Sequence[Prior]) -> Outcome:
    """The outcome of a problem with `more` priors as one of the problem without, of which it is no more than half-way
    to the end."""
    if not more:
        return outcome
    return replace(
        outcome,
        problem=outcome.problem.without(more),
        information=without_priors(outcome.information, more, outcome.state),
        half_way=outcome.half_way or outcome.converged,
    )


def _again(inputs: Inputs, outcome: Outcome, judged: Judged, way: float, way_before: float) -> bool:
    """Whether the last pass is to be made anew: what it froze, such as the weights of points on planes, is of a state
    far from its end, but nearer than in the last pass before, or rejected tracks fit again. way: relative cost
    decrease, infinite if the pass stopped early because the problem is rank deficient."""
    return _is_far(way, way_before) or _follows_more(inputs, outcome, judged)


def _is_far(way: float, way_before: float) -> bool:
    return FAR - 1.0 < way < NEARER * way_before


def _follows_more(inputs: Inputs, outcome: Outcome, judged: Judged) -> bool:
    """Whether many tracks were left out because the poses that the pass began with did not find their points, and those
    that it ended with do."""
    (now,) = of_type(outcome.problem.factors, FeatureFactor) or (None,)
    if now is None or now.followed > ENOUGH_TRACKED * sum(int(k.sum()) for k in now.keep):
        return False
    anew = of_type(judged.problem(inputs, _on_own_keyframes(inputs, outcome.state)).factors, FeatureFactor)
    return any(f.followed > MORE_TRACKED * now.followed for f in anew)


def _on_own_keyframes(inputs: Inputs, state: State) -> State:
    """The same motion, at the keyframes that its clocks want."""
    return resample(state, keyframes_for(inputs, keyframe_times(inputs, state.values)), inputs)


def first_pass(inputs: Inputs, state: State) -> State:
    """The state after a first pass over all measurements from `state`, before outliers are rejected. Priors of a few
    times the prior uncertainty keep the calibration near its guess, so that unobservable directions do not drift.

    Raises EstimationError where the data do not carry an estimate.
    """
    problem = Judged.first(inputs).problem(inputs, state)
    problem = _with_priors(problem, guess_priors(inputs, state, FIRST_PASS_PRIOR_WIDTH))
    return minimise(problem, state, tolerance=EARLY_DECREASE, share=EARLY_SHARE, comes_back=False).state


def _next_noise(
    inputs: Inputs, problem: Problem, outcome: Outcome, all_fits: Callable[[], list[Fit]]
) -> tuple[tuple[NoiseModel, ...], dict[str, CornerNoise]]:
    """The noise of cameras in the next pass, as the residuals of this one show it."""
    settings, models, noise = inputs.rig.settings, [], {}
    common = [f for f in all_fits() if f.kind.startswith("common")] if settings.common_error else []
    pairs = pairs_of(problem.factors, outcome.residuals, CornerFactor)
    for camera, (factor, out) in zip(inputs.rig.cameras, pairs, strict=True):
        if not len(factor.stream.uv):
            models.append(first_noise(camera))
            noise[camera.name] = factor.noise
            continue
        speed = image_speed(factor, outcome.state)
        tau = (FIRST_TAU_PX,) * COMMON_ERRORS if settings.common_error else ()
        if len(factor.noise.tau):
            tau = scale_common_errors(tuple(factor.noise.tau), [f for f in common if f.sensor == camera.name])
        model, large = estimate_noise(camera, settings, factor, out, speed, tau)
        models.append(replace(model, later=large and _has_cameras_alone(inputs)))
        noise[camera.name] = models[-1].noise(factor.stream, camera, settings, speed)
    return tuple(models), noise


def _kept(inputs: Inputs, outcome: Outcome, apart: tuple[np.ndarray, ...]) -> tuple[np.ndarray, ...]:
    """By camera (N,) bool: corners that are not rejected, nor all those of an image, which is `apart`."""
    pairs = pairs_of(outcome.problem.factors, outcome.residuals, CornerFactor)
    keep = [inliers(f, out, inputs.rig.settings) for f, out in pairs]
    if apart:
        keep = [k & ~bad[c.stream.image] for k, bad, (c, _) in zip(keep, apart, pairs, strict=True)]
    return tuple(keep)


def _apart(inputs: Inputs, outcome: Outcome) -> tuple[np.ndarray, ...]:
    """By camera (M,) bool: images that are not simultaneous with others of their keyframe; empty if not tested."""
    cameras, settings = of_type(outcome.problem.factors, CornerFactor), inputs.rig.settings
    if len(cameras) < 2 or not _has_cameras_alone(inputs) or settings.outlier_std <= 0.0:
        return ()
    return tuple(not_simultaneous(cameras, of_type(outcome.residuals, CornerOutput), settings))


def _has_cameras_alone(inputs: Inputs) -> bool:
    return inputs.imu is None and len(inputs.sensors) == len(inputs.rig.cameras)


def _next_others(
    inputs: Inputs, outcome: Outcome, noise: Mapping[str, Any], all_fits: Callable[[], list[Fit]]
) -> dict[str, Any]:
    """The noise of all other sensors in the next pass, as their models estimate it."""
    squares, at_rest = cache(lambda: chi2_by_kind(outcome.problem, outcome.residuals)), inputs.imu is None
    others = [s for s in inputs.rig.mounted if not isinstance(s, Camera)]
    found = {s.name: ResidualStatistics(s.name, at_rest, squares, all_fits) for s in others}
    return {s.name: model_of(s).next_noise(s, noise[s.name], found[s.name]) for s in others}


def _noise_is_estimated(inputs: Inputs) -> bool:
    settings = inputs.rig.settings
    cornered = [c for c, s in zip(inputs.rig.cameras, inputs.measurements.cameras, strict=True) if len(s.uv)]
    tracked = inputs.rig.cameras if inputs.measurements.tracks else ()
    return (
        (bool(cornered) and (settings.blur_noise or settings.common_error))
        or any(c.corner_noise_px is None for c in cornered)
        or any(c.track_noise_px is None for c in tracked)
        or any(model_of(s).noise_passes(s) for s in inputs.sensors)
    )


def pass_names(inputs: Inputs) -> tuple[str, ...]:
    """The passes: keyframes and assignment are made anew once; noise that is estimated takes more, and outliers of
    tracks, which show when the lens is found."""
    judged = bool(inputs.measurements.tracks) and inputs.rig.settings.outlier_std > 0.0
    if not (judged or _noise_is_estimated(inputs)):
        return ("first", "final")
    twice = inputs.rig.settings.common_error or any(model_of(s).noise_passes(s) > 1 for s in inputs.sensors)
    return ("first", "noise", "noise again", "final") if twice else ("first", "noise", "final")
