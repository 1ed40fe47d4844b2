"""Turns an estimate into a `Calibration`: standard deviations, empirical factors, verdicts and warnings."""

from __future__ import annotations

import dataclasses
from collections.abc import Collection, Iterator, Mapping, Sequence
from typing import NamedTuple

import numpy as np
from scipy.special import ndtr, stdtrit

from icalib.base.remark import Remark
from icalib.estimate.cross_validation import Prediction, predict, shifts
from icalib.estimate.estimate import Estimate
from icalib.estimate.inputs import Inputs, origin_difference
from icalib.estimate.problem import IN_THE_WORLD, Problem
from icalib.estimate.residual_statistics import (
    Segments,
    calibration_columns,
    chi2_by_kind,
    cluster_covariances,
    fits,
    noise_variance,
    raw_sizes,
    spread_variance,
)
from icalib.estimate.solver import Visit
from icalib.kinds import assessors
from icalib.motion.imu_data import hardly_turned
from icalib.motion.poses import PPM
from icalib.observability.assessor import AssessedEstimate, Remedy, assessments
from icalib.observability.contradictions import Contradiction
from icalib.observability.determination import Determined, Observability, RecordingTraits, observe
from icalib.observability.prior_sensitivity import EFFECT_SIGMAS, Effect, effects_left_out
from icalib.optim.arrowhead import restricted_inverse
from icalib.optim.state import Block, Key, State
from icalib.result import (
    Calibration,
    CrossValidation,
    Iteration,
    ParameterGroup,
    PredictedFit,
    Residuals,
    SensorFit,
    Trajectory,
    Verdict,
    Visited,
    by_key,
)
from icalib.result.calibration import Timeline, row_record
from icalib.result.saving import versions
from icalib.result.verdict import AUXILIARY, component_name, failure_words, named_few
from icalib.rig import ParameterSpec
from icalib.rig.file import rig_to_dict
from icalib.sensors.parameter import display_unit
from icalib.sensors.sensor import CLOCK_RATE, MOUNTED_NAMES
from icalib.validation.causes import all_causes, pace_words, scatter_warnings
from icalib.validation.guesses import guess_notes


def assess(
    inputs: Inputs, determined: Determined, against: Sequence[Contradiction] = ()
) -> tuple[Calibration, tuple[Remedy, ...]]:
    """The result of the estimate `determined`, and remedies for effects that it lacks and the recording shows.
    against: values of the rig file that the data contradict so strongly that other faults of the estimate may follow
    from them."""
    estimate, rig = determined.estimate, inputs.rig
    left_out = effects_left_out(inputs, estimate)  # first, as it needs much memory for a moment
    segments = Segments.of(estimate.problem, estimate.outcome, rig.settings.segments)
    determined = dataclasses.replace(determined, shifts=np.vstack([determined.shifts, *left_out.shifts.values()]))
    observability = _observed(inputs, determined, _column_names(inputs))
    variances = VarianceParts.of(determined, segments)
    unseen = {key: shift**2 for key, shift in left_out.shifts.items()}
    unseen |= {key: variances.weight**2 * v for key, v in determined.prior_variances.items()}
    groups = _groups(inputs, determined, observability, variances, unseen)
    validation = cross_validation(segments, [s for s in (rig.reference,) if _is_assumed(inputs, s)])
    timeline = Timeline.of(inputs.parts, _keyframe_instants(inputs, estimate.outcome.state), rig.reference)
    factors = _factors(inputs, groups)
    sensor_fits = _sensor_fits(inputs, estimate)
    assessed = AssessedEstimate(
        inputs, estimate, groups, sensor_fits, factors.max(initial=1.0), segments, timeline, left_out.tested,
        left_out.beside or (estimate.problem, estimate.outcome.state),
    )  # fmt: skip
    causes, size_notes = all_causes(assessed, against)
    grave = tuple(c.sentence for c in causes if c.grave)
    warnings = (
        *grave,
        *(c.sentence for c in causes if not c.grave),
        *_warnings(assessed),
        *scatter_warnings(factors, segments is not None, validation),
    )
    result = dataclasses.replace(
        _calibration(assessed, determined, observability, variances),
        warnings=tuple(dict.fromkeys(warnings)),
        notes=(*_notes(assessed), *size_notes, *few_segments_notes(inputs, segments)),
        cross_validation=validation,
        wrong=grave,
    )
    return result, tuple(c.remedy for c in causes if c.remedy is not None)


def _calibration(
    assessed: AssessedEstimate, determined: Determined, observability: Observability, variances: VarianceParts
) -> Calibration:
    """The result without warnings, notes and cross-validation."""
    inputs, timeline, estimate = assessed.inputs, assessed.timeline, determined.estimate
    outcome = estimate.outcome
    return Calibration(
        groups=assessed.groups,
        covariance=_correlated(inputs, determined, variances),
        covariance_names=_column_names(inputs),
        null_space=determined.fixed_directions,
        unobservable=observability.unobservable,
        fits=tuple(assessed.fits),
        residuals=by_key(_residuals(assessed)),
        trajectory=_trajectory(inputs, outcome.state, timeline),
        iterations=tuple(Iteration(n, s.cost, s.predicted_decrease, s.damping, s.accepted) for n, s in estimate.steps),
        converged=outcome.converged,
        status=outcome.status,
        warnings=(),
        notes=(),
        rig=rig_to_dict(inputs.user_rig or inputs.rig),
        settings=dataclasses.asdict(inputs.rig.settings),
        rates=_rates(inputs),
        versions=versions(),
        recordings=timeline.spans,
        planes=tuple(plane for a in assessments(assessed) for plane in a.planes),
        effects={f"{e.sensor}.{e.spec.name}": e.plain for e in assessed.effects},
        first_guess=_first_guess(inputs),
    )


def _first_guess(inputs: Inputs) -> dict[tuple[str, str], np.ndarray]:
    """Extrinsics and time offsets in the first guess, if it is kept, as in the result."""
    if (guess := inputs.guess) is None:
        return {}
    blocks = [b for b in inputs.layout.blocks if b.name in MOUNTED_NAMES and b.key in guess.values]
    return {b.key: _raw_value(inputs, guess, b) for b in blocks}


def _observed(inputs: Inputs, determined: Determined, names: tuple[str, ...]) -> Observability:
    """Formal covariance, verdicts, and sentences on unobservable combinations of parameters."""
    state = determined.estimate.outcome.state
    axes = hardly_turned(state.seconds, state.rotation, inputs.rig.reference)
    on_wheels = any(s.drives for s in inputs.rig.mounted)
    traits = RecordingTraits(on_wheels, inputs.rig.has_target, inputs.imu is None, axes)
    return observe(determined, names, _column_specs(inputs), traits)


def _notes(assessed: AssessedEstimate) -> Iterator[Remark]:
    """Notes on the recordings and sensors, on ambiguous parameters, and on wrong guesses."""
    yield from notes(assessed)
    for assessment in assessments(assessed):
        yield from assessment.ambiguities
    yield from guess_notes(assessed.inputs, assessed.groups)


def _rates(inputs: Inputs) -> dict[str, float]:
    """Rate [Hz] of each sensor, from the median interval of its stamps; none without a clock."""
    m = inputs.measurements
    timed = all(p.measurements.has_clock for p in inputs.parts)
    streams = (m.streams[name] for name in inputs.rig.sensors if timed and name in m.streams)
    sensor_streams = (s for s in streams if len(s.stamps_ns) > 1 and not _is_assumed(inputs, s.name))
    return {s.name: float(1.0 / np.median(np.diff(s.seconds))) for s in sensor_streams}


def _is_assumed(inputs: Inputs, name: str) -> bool:
    """Whether `name` is the sensor that carries the assumed motion in place of an IMU."""
    return inputs.rig.assumes_motion and name == inputs.rig.reference


def _column_names(inputs: Inputs) -> tuple[str, ...]:
    """(B,) name of each calibration parameter, such as "cam0.translation.x"."""
    return tuple(f"{b.sensor}.{b.name}.{label}" for b in inputs.layout.free for label in inputs.specs[b.key].labels)


def _column_specs(inputs: Inputs) -> tuple[ParameterSpec, ...]:
    """(B,) definition of the group of each calibration parameter."""
    return tuple(spec for b in inputs.layout.free for spec in [inputs.specs[b.key]] * b.size)


def _mode(inputs: Inputs, block: Block) -> str:
    """The mode of a group in the result: fixed, prior or free."""
    if block.start is None:
        return "fixed"
    if block.is_nuisance or inputs.specs[block.key].is_effect:
        return "prior"
    if not inputs.is_sensor(block.sensor):
        return "free"
    return getattr(inputs.sensor(block.sensor), block.name).mode


def visited(inputs: Inputs, stage: str, problem: Problem, visit: Visit) -> Visited:
    """A state of the solver with its formal standard deviations. Values have the units of the result."""
    t = problem.tolerance
    covariance = restricted_inverse(visit.information * t[:, None] * t, problem.fixed_directions)
    formal = t * np.sqrt(np.diag(covariance))
    free = [b for b in inputs.layout.free if b.name not in IN_THE_WORLD]
    values = {b.key: _raw_value(inputs, visit.state, b) for b in free}
    return Visited(stage, values, {b.key: formal[b.columns] for b in free})


def _raw_value(inputs: Inputs, state: State, block: Block) -> np.ndarray:
    """The value of `block` as in the result: time offsets are between raw stamps, not between first stamps."""
    value = state.values[block.key]
    if block.name == "time_offset":
        return value - origin_difference(inputs.measurements, inputs.stream(block.sensor))
    return value


def _groups(
    inputs: Inputs, determined: Determined, observability: Observability, variances: VarianceParts,
    unseen: Mapping[Key, np.ndarray],
) -> tuple[ParameterGroup, ...]:  # fmt: skip
    """The parameter groups of the result, fixed ones included. `variances` gives the empirical factors; unseen: (B,)
    parts of the variances that come from nuisance parameters and effects, by group."""
    formal, problem = np.sqrt(np.diag(observability.covariance)), determined.estimate.problem
    overall = variances.pooled(calibration_columns(inputs))
    state = determined.estimate.outcome.state
    groups = []
    for block in inputs.layout.blocks:
        if block.name in IN_THE_WORLD or _is_assumed(inputs, block.sensor):
            continue
        if block.start is None:
            if _is_listed(inputs, block, inputs.specs[block.key]):
                zeros = np.zeros(block.size)
                fixed: tuple[Verdict, ...] = ("fixed",) * block.size
                groups.append(_group(inputs, block, state, zeros, zeros, fixed))
            continue
        k = block.columns
        std, factor = formal[k], variances.factor(k, overall)
        sizes = factor * np.maximum(observability.spread[k], std / problem.tolerance[k])
        group = _group(inputs, block, state, std, factor, observability.verdicts(k, sizes))
        by = {f"{sensor}.{name}": np.sqrt(np.maximum(v[k], 0.0)) for (sensor, name), v in unseen.items()}
        groups.append(dataclasses.replace(group, std_by=by))
    return tuple(groups)


def _correlated(inputs: Inputs, determined: Determined, variances: VarianceParts) -> np.ndarray:
    """(B, B) formal covariance, whose correlations are those of all parts, each with the factor of its own."""
    shifts, overall = determined.shifts, variances.pooled(calibration_columns(inputs))
    independent = dataclasses.replace(determined, shifts=shifts[:0]).covariance
    whole, factor = np.ones(len(independent)), np.ones(len(independent))
    for block in inputs.layout.free:
        k = block.columns
        whole[k] = np.maximum(variances.factor(k, overall), 1.0)
        factor[k] = variances.without_shifts(k, overall)
    return with_correlations(independent, shifts.T @ shifts, factor, whole)


def with_correlations(independent: np.ndarray, shared: np.ndarray, factor: np.ndarray, whole: np.ndarray) -> np.ndarray:
    """(n, n) sum of two covariances whose product with the factors `whole` (n,) of standard deviations is the sum of
    `independent` (n, n), with the factors `factor` (n,), and `shared` (n, n). An error of the IMU moves two cameras
    alike, so that the noise of their relative pose keeps its factor."""
    out = (factor[:, None] * independent * factor + shared) / np.outer(whole, whole)
    np.fill_diagonal(out, np.diag(independent + shared))
    return out


def _group(
    inputs: Inputs, block: Block, state: State, std: np.ndarray, factor: np.ndarray, verdict: tuple[Verdict, ...]
) -> ParameterGroup:
    """The group of `block` in the result, with its formal standard deviations `std` and their empirical `factor`."""
    spec = inputs.specs[block.key]
    columns = None if block.start is None else tuple(int(i) for i in block.columns)
    value, printed_std = _raw_value(inputs, state, block), std * np.maximum(factor, 1.0)
    return ParameterGroup(
        block.sensor, block.name, spec.labels, spec.unit, value, std, printed_std, verdict, _mode(inputs, block),
        columns, factor,
    )  # fmt: skip


def _is_listed(inputs: Inputs, block: Block, spec: ParameterSpec) -> bool:
    """Whether the result lists a group that is not estimated: the rig file can state it, and measurements depend on it.
    Wheel radii, for example, have no effect if wheels report poses."""
    sensor = inputs.rig.sensors.get(block.sensor)
    if spec.is_auxiliary or sensor is None:
        return not spec.is_auxiliary
    stated = spec.name in [s.name for s in sensor.stated()]
    return stated and (sensor.is_estimated(spec) or getattr(sensor, spec.name).mode == "fixed")


def few_segments_notes(inputs: Inputs, segments: Segments | None) -> Iterator[Remark]:
    """A note if standard deviations rest on few segments, with advice to get more."""
    if inputs.imu is not None:
        more = "record longer, and leave `segments` at 8 or more"
    else:
        more = f"record more {inputs.rig.sensors[inputs.rig.reference].readings}"
    if segments is not None and segments.count < ENOUGH_SEGMENTS:
        yield Remark(
            "few_segments",
            f"standard deviations rest on the spread of {segments.count} parts of the recording, by Student's t "
            f"distribution {few_factor(segments.count):.2f} times as large as those of many; {more}.",
        )


def _sensor_fits(inputs: Inputs, estimate: Estimate) -> list[SensorFit]:
    """Fit statistics of each sensor and kind of residual, with the sizes of its raw residuals. Assumed motion has
    none."""
    problem, outcome = estimate.problem, estimate.outcome
    sizes = raw_sizes(problem, outcome.residuals)
    measured = [f for f in fits(problem, outcome) if not _is_assumed(inputs, f.sensor)]
    return [SensorFit(f.sensor, f.kind, f.count, f.dof, f.chi2, *sizes[f.sensor, f.kind]) for f in measured]


def _trajectory(inputs: Inputs, s: State, timeline: Timeline) -> Trajectory:
    """The trajectory at the keyframes, on the clock that the user sees."""
    seconds = timeline.on_result_clock(s.seconds, _node_recordings(inputs, s, timeline))
    return Trajectory(seconds, s.rotation, s.position, s.velocity, s.bias[:, :3], s.bias[:, 3:])


def _node_recordings(inputs: Inputs, state: State, timeline: Timeline) -> np.ndarray:
    """(K,) index of the recording of each keyframe; without an IMU, that of the image or pose at the keyframe."""
    if inputs.imu is not None:
        return state.recording
    instants = _keyframe_instants(inputs, state)
    if not instants:
        return timeline.recording_of(state.seconds)
    times = np.concatenate(list(instants.values()))
    recording = np.concatenate([timeline.recordings_of(key) for key in instants])
    order = np.argsort(times, kind="stable")
    return recording[order][np.searchsorted(times[order], state.seconds)]


def _keyframe_instants(inputs: Inputs, state: State) -> dict[str, np.ndarray]:
    """By the key of their stream: instants (M,) of measurements at which keyframes may lie, s on the joined clock."""
    return dict(pair for a in assessors().values() for pair in a.keyframe_instants(inputs, state))


def _residuals(assessed: AssessedEstimate) -> Iterator[Residuals]:
    """Records of residuals for each sensor; a kind without records of a special form gives all rows of its factors."""
    estimate, outcome = assessed.estimate, assessed.estimate.outcome
    for kind, assessment in zip(assessors(), assessments(assessed), strict=True):
        if assessment.residuals is not None:
            yield from assessment.residuals
            continue
        names = [s.name for s in assessed.inputs.rig.sensors.values() if s.sensor_type == kind]
        for key, factor in estimate.problem.factors.items():
            rows = factor.rows(outcome.residuals[key], outcome.state) if factor.name in names else []
            if rows:
                yield row_record(key[1], rows, assessed.timeline)


def _warnings(assessed: AssessedEstimate) -> Iterator[Remark]:
    """Warnings on convergence, measurements, sensors, and estimates that cannot be right."""
    outcome = assessed.estimate.outcome
    if not outcome.converged:
        yield failure_words(outcome.status)
    yield from assessed.inputs.measurements.warnings
    for assessment in assessments(assessed):
        yield from assessment.warnings
    for assessment in assessments(assessed):
        yield from assessment.value_warnings


def _factors(inputs: Inputs, groups: tuple[ParameterGroup, ...]) -> np.ndarray:
    """(n,) empirical factors of all estimated parameters of sensors, without auxiliary ones."""
    sensor_groups = (g for g in groups if g.mode != "fixed" and inputs.is_sensor(g.sensor) and g.name not in AUXILIARY)
    return np.concatenate([np.ones(0), *(g.factor for g in sensor_groups if g.factor is not None)])


# Notes on recordings and sensors, one sentence each.


def notes(assessed: AssessedEstimate) -> Iterator[Remark]:
    """Notes on the recordings, then on each kind of sensor."""
    timeline = assessed.timeline
    for k, span in enumerate(timeline.spans if len(timeline.spans) > 1 else (), 1):
        number, m = f"recording {k}", timeline.parts[k - 1].measurements
        name = number if span.name == number else f"{number}, {span.name}"
        timed = f"{span.end - span.start:.1f} s from {span.origin_ns} ns on"
        yield Remark("recording_span", f"{name}: {timed if m.has_clock else f'{len(m.reference.stamps_ns)} images'}.")
    yield from assessed.inputs.measurements.notes
    yield from _clock_rate_notes(assessed)
    yield from unseen_notes(assessed.groups, assessed.effects)
    for assessment in assessments(assessed):
        yield from assessment.notes


def _clock_rate_notes(assessed: AssessedEstimate) -> Iterator[Remark]:
    """A note on each clock whose rate differs from that of the body, by more than the time tolerance over the
    recording."""
    rig = assessed.inputs.user_rig or assessed.inputs.rig
    duration = float(np.ptp(assessed.estimate.outcome.state.seconds))
    for g in assessed.groups:
        rate, std = (float(x[0]) for x in (g.value, g.std)) if g.name == CLOCK_RATE.name else (0.0, 0.0)
        drift_s = PPM * abs(rate) * duration
        if g.columns is not None and abs(rate) > EFFECT_SIGMAS * std and drift_s > rig.settings.time_tolerance_s:
            sentence = (
                f"the clock of {g.sensor} runs {pace_words(rate, std)} against that of {rig.reference}, "
                f"{1e3 * drift_s:.2g} ms over the recording; the estimate includes it as clock_rate."
            )
            yield Remark("clock_rate_estimated", sentence)


MOST_OF_VARIANCE = 0.5  # share from which on a note names its source


def unseen_notes(groups: Sequence[ParameterGroup], effects: Sequence[Effect]) -> Iterator[Remark]:
    """A note on each nuisance parameter or effect that makes up most of the variance of a value."""
    named, left_out = dict[str, list[str]](), {f"{e.sensor}.{e.spec.name}": e for e in effects}
    for g in groups:
        unit, scale = display_unit(g.unit)
        for source, part in g.std_by.items() if g.mode != "prior" and g.name not in AUXILIARY else ():
            for k in np.flatnonzero(part**2 > MOST_OF_VARIANCE * g.std**2):
                size = f"{scale * part[k]:.2g} of {scale * g.std[k]:.2g} {unit}".strip()
                named.setdefault(source, []).append(f"{component_name(g, g.labels[k])} ({size})")
    for source, values in named.items():
        sensor, name = source.split(".")
        what = f"the {name.replace('_', ' ')} of {sensor}"
        share = f"makes up most of the standard deviation of {named_few(values)}"
        if (e := left_out.get(source)) is None or e.spec.is_considered:
            words = f"the recording hardly shows {what}, which {share}; state a smaller sigma where you know it better."
            yield Remark("std_from_prior", words)
        else:
            yield Remark("std_from_effect", f"{what} may differ from zero, which {share}; let it be estimated.")


# Two-fold cross-validation, in the form of the result.


def cross_validation(segments: Segments | None, assumed: Collection[str]) -> CrossValidation | None:
    """None if the recording cannot be split, or if no parameter is observable in both halves. Sensors in `assumed` get
    no fits; no sensor does if the solutions of the halves are too far apart for a linearisation."""
    prediction = None if segments is None else predict(segments)
    if segments is None or prediction is None:
        return None
    fits = tuple(f for f in _fits(segments.problem, prediction) if f.sensor not in assumed) if prediction.linear else ()
    spread = shifts(segments)
    return CrossValidation(
        segments.count,
        prediction.directions,
        prediction.excess,
        prediction.expected,
        prediction.spread,
        fits,
        spread.moved,
        spread.expected,
    )


def _fits(problem: Problem, prediction: Prediction) -> list[PredictedFit]:
    """Size of the residuals of each sensor and kind, within a half and predicted by the other half."""
    inside, outside = (chi2_by_kind(problem, out) for out in (prediction.inside, prediction.outside))
    size, size_outside = (raw_sizes(problem, out) for out in (prediction.inside, prediction.outside))
    return [
        PredictedFit(*key, count, chi2, outside[key].chi2, size[key].rms, size_outside[key].rms, size[key].unit)
        for key, (count, chi2) in inside.items()
    ]


# Parts of the formal variances by their source, and empirical factors on each part.

ENOUGH_SEGMENTS = 8  # segments; with as many, Student's t differs from the normal distribution by 8 % at most


class VarianceParts(NamedTuple):
    """Shares of the formal variances by source, and how much larger each part is in truth.

    noise, prior (B,): shares of the measurement noise and of errors of nuisance parameters; errors of the initial guess
    along unobservable directions, and effects that are considered, contribute the rest. ratio (B,): empirical over
    formal standard deviation of the noise part. weight: factor on the standard deviation of the prior part, see
    `Determined.inflation`.
    """

    noise: np.ndarray
    prior: np.ndarray
    ratio: np.ndarray
    weight: float

    @classmethod
    def of(cls, determined: Determined, segments: Segments | None) -> VarianceParts:
        """Variance shares and empirical factors of the estimate `determined`. segments: None if the recording is not
        split."""
        estimate = determined.estimate
        variance, guess = np.diag(determined.covariance), (determined.shifts**2).sum(axis=0)
        prior = np.clip(sum(determined.prior_variances.values(), np.zeros(len(variance))), 0.0, variance - guess)
        formal = noise_variance(estimate.problem, estimate.outcome)
        empirical = _empirical_variance(estimate, segments, formal)
        ratio = np.sqrt(np.divide(empirical, formal, out=np.ones_like(formal), where=formal > 0.0))  # 0: fixed
        return cls(np.maximum(1.0 - (guess + prior) / variance, 0.0), prior / variance, ratio, determined.inflation)

    def pooled(self, columns: np.ndarray) -> float:
        """Root mean square of the ratio over `columns`, weighted by the noise share of each."""
        weights = self.noise[columns]
        total = float(weights.sum())
        return float(np.sqrt(weights @ self.ratio[columns] ** 2 / total)) if total > 0.0 else 1.0

    def factor(self, columns: np.ndarray, overall: float) -> np.ndarray:
        """(n,) empirical factors on the formal standard deviations of a group with n `columns`.

        Each part of the variance has its own factor. The noise part has the square of the larger of two ratios: the
        pooled ratio of the group and the `overall` one, at least 1. The prior part has the square of `weight`, and the
        part from the initial guess has 1.
        """
        shifts = np.maximum(1.0 - self.noise[columns] - self.prior[columns], 0.0)
        return np.sqrt((1.0 - shifts) * self.without_shifts(columns, overall) ** 2 + shifts)

    def without_shifts(self, columns: np.ndarray, overall: float) -> np.ndarray:
        """(n,) factors on the part of the standard deviations that comes from noise and priors."""
        noise_factor = max(1.0, self.pooled(columns), overall)
        noise, prior = self.noise[columns], self.prior[columns]
        square = noise_factor**2 * noise + self.weight**2 * prior
        return np.sqrt(np.divide(square, noise + prior, out=np.ones_like(square), where=noise + prior > 0.0))


def _empirical_variance(estimate: Estimate, segments: Segments | None, white: np.ndarray) -> np.ndarray:
    """(B,) variances: the larger of the scatter over segments and over feature tracks. The excess of cluster-robust
    variances over `white` (B,) is added, for image and target regions. Returns `white` without segments and tracks."""
    if segments is None and not estimate.problem.tracks:
        return white
    clusters = cluster_covariances(estimate.problem, estimate.outcome)
    spread = white if clusters.tracks is None else np.diag(clusters.tracks)
    if segments is not None:
        over_segments = few_factor(segments.count) ** 2 * spread_variance(estimate.outcome, segments, white)
        spread = over_segments if clusters.tracks is None else np.maximum(spread, over_segments)
    return spread + sum(np.maximum(np.diag(V) - white, 0.0) for V in clusters.regions)


def few_factor(segments: int) -> float:
    """Factor on a standard deviation from the scatter of few segments, so that 68 % of errors lie within. It is a
    quantile of Student's t with segments - 1 degrees of freedom."""
    return float(stdtrit(segments - 1, ndtr(1.0))) if segments < ENOUGH_SEGMENTS else 1.0
