"""Possible causes of a wrong result, ranked by the part of the misfit that they explain."""

from __future__ import annotations

from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from icalib.base.remark import Remark
from icalib.data.measurements import ImuStream
from icalib.estimate.estimate import Estimate
from icalib.estimate.inputs import Inputs
from icalib.estimate.parameter_changes import NO_CHANGES, Change, Changes, changes
from icalib.estimate.problem import Problem
from icalib.estimate.residual_statistics import rows_of
from icalib.kinds import assessors
from icalib.motion.factor import FitKey
from icalib.motion.poses import PPM
from icalib.observability.assessor import AssessedEstimate, Cause, Remedy, assessments
from icalib.observability.contradictions import SIGMAS, Contradiction, contradictions
from icalib.observability.prior_sensitivity import Relaxed, relaxed
from icalib.optim.state import Key, Layout, State
from icalib.result import CrossValidation, SensorFit
from icalib.result.calibration import Timeline
from icalib.result.quantities import FAR_BEYOND, dof_known, excess, is_small, ratio, times
from icalib.result.verdict import AUXILIARY
from icalib.rig import ImuSensor, Rig, Sensor
from icalib.sensors.imu.assess import quiet_scatter
from icalib.sensors.imu.spec import ACCEL_DELAY
from icalib.sensors.sensor import CLOCK_RATE, TIME_OFFSET
from icalib.validation.guesses import (
    absurd_values,
    felt_size,
    is_certain,
    scale_causes,
    scale_notes,
    size_words,
    stated_words,
)

IMAGE_KINDS = ("corners", "features")


def all_causes(assessed: AssessedEstimate, against: Sequence[Contradiction]) -> tuple[list[Cause], tuple[Remark, ...]]:
    """All causes, the grave ones first, then by decreasing gain; and notes on the size of the target.

    against: values of the rig file that contradict an estimate without any of its values. Such an estimate is made only
    if the first one fails or fits poorly. If `against` is empty, contradictions are searched here.

    If it is not empty, its causes are grave, and tests that these values may distort are skipped. These are tests of
    the target size, of changes over the recording, and of residuals of other kinds than IMAGE_KINDS.
    """
    stated, notes = _stated(assessed, against)
    omitted = {kind for a in assessments(assessed) for kind in a.unreliable}
    fits = [f for f in assessed.fits if (not against or f.kind in IMAGE_KINDS) and f.kind not in omitted]
    misfit = Misfit.of(fits)
    known, drifts = stated, any(e.spec is CLOCK_RATE and e.differs for e in assessed.effects)
    # A wrong value has no remedy, and may be the mean of one that changes.
    mean = {key for c in stated if c.remedy is None for key in c.explains} & _may_change(assessed.inputs)
    if not against and (drifts or mean or not any_explains([c for c in stated if c.gain < np.inf], misfit)):
        varying = list(varying_causes(assessed, misfit))
        changed = {key for c in varying for key in c.explains}
        known = [*varying, *(c for c in stated if c.remedy is not None or changed.isdisjoint(c.explains))]
    both = ranked([*known, *misfit_causes(replace(assessed, fits=fits), misfit, any_explains(known, misfit))])
    return [*(c for c in both if c.grave), *(c for c in both if not c.grave)], notes


def _may_change(inputs: Inputs) -> set[Key]:
    """Groups of parameters that may change during a recording."""
    return {key for s in inputs.sensors for names in s.may_change for key in _changes_with(s, names[0])}


def _changes_with(sensor: Sensor, name: str) -> set[Key]:
    """Groups that change with one of these: those of a mount, or of a lens."""
    together = {n for names in sensor.may_change if name in names for n in names}
    return {(sensor.name, n) for n in together | set(sensor.lens if name in sensor.lens else ())}


def _stated(assessed: AssessedEstimate, against: Sequence[Contradiction]) -> tuple[list[Cause], tuple[Remark, ...]]:
    """Causes that are wrong values in the rig file: target size, scales, those that each kind of sensor tests, other
    values; and notes on the size."""
    inputs, factor = assessed.inputs, assessed.factor
    relaxed_rig, given = relaxed(inputs, assessed.estimate), bool(against)
    size = felt_size(inputs, relaxed_rig, factor)
    wrong_size, notes = ((), ()) if given else size_words(inputs, size)
    # Other contradictions may follow from a wrong size, or from the scale of the accelerometer.
    certain, relaxed_rig = is_certain(size), None if given else relaxed_rig
    scale = max(factor, assessed.misfit_factor)
    against = against or contradictions(inputs, relaxed_rig, scale)
    if certain:  # a wrong size also changes lever arms
        against = tuple(c for c in against if c.in_prior_sigmas > 1.0)
    causes: list[Cause] = []
    if size is not None:
        causes += [Cause(sentence, size.gain, certain) for sentence in wrong_size]
    causes += scale_causes(inputs, assessed.groups, size)
    for assessment in assessments(replace(assessed, relaxed_rig=None if certain else relaxed_rig)):
        causes += assessment.causes
    explained = {key for cause in causes for key in cause.explains}
    against = tuple(c for c in against if c.key not in explained)
    causes += _contradicted(assessed, against, scale, certain or given, relaxed_rig)
    return causes, (*notes, *scale_notes(inputs, size))


def _contradicted(
    assessed: AssessedEstimate, against: Sequence[Contradiction], scale: float, grave: bool, relaxed_rig: Relaxed | None
) -> Iterator[Cause]:
    """A cause for each contradicted value in `against`, then for absurd values. scale: factor on formal standard
    deviations; grave: whether all of them are grave. relaxed_rig: None if gains are unknown, which
    then count as infinite."""
    for c in against:
        gain = np.inf if relaxed_rig is None else float(((c.off / (c.sigma / scale)) ** 2).max())
        moves = relaxed_rig is not None and _moves_others(assessed, relaxed_rig, c.key)
        yield Cause(stated_words(assessed.inputs, c), gain, grave or moves, (c.key,))
    yield from (Cause(s, 0.0, grave) for s in absurd_values(assessed.inputs, against, assessed.groups))


def _moves_others(assessed: AssessedEstimate, relaxed_rig: Relaxed, key: Key) -> bool:
    """Whether the stated value of the group `key` distorts the result: without it, a parameter of another group moves
    by more than SIGMAS printed standard deviations."""
    step, _ = relaxed_rig.step([key])
    for g in assessed.groups:
        if g.columns is None or (g.sensor, g.name) == key or g.name in AUXILIARY:
            continue
        if (np.abs(step[relaxed_rig.layout.columns(g.sensor, g.name)]) > SIGMAS * g.std).any():
            return True
    return False


# The misfit, and the part of it that a cause explains.
#
# A cause is tested by its gain: the decrease of chi^2 if the cause is modelled. A significant cause that explains
# hardly any of the misfit is not named. If no cause explains the misfit, the message says so and lists the checks.
# Another noise density of the IMU is advised only if its readings show it by themselves.

# Share of the misfit that a cause must gain to explain it. Robust weights hide part of the gain; wrong causes gain less
# than 0.01.
MIN_EXPLAINED_SHARE = 0.1
ALIKE = 0.8  # share of the best gain from which on another change explains the data as well
LARGE = 2.0  # tolerances; a constant value is wrong by half of a change
INERTIAL = ("gyroscope", "accelerometer")


@dataclass(frozen=True)
class Misfit:
    """Sensors whose residuals exceed the stated noise. fits: their statistics."""

    fits: tuple[SensorFit, ...]

    @classmethod
    def of(cls, sensor_fits: Iterable[SensorFit]) -> Misfit:
        """The misfit of those in `sensor_fits` whose residuals exceed the stated noise."""
        return cls(tuple(f for f in sensor_fits if excess(f) > 1.0))

    @property
    def chi2(self) -> float:
        """Sum of chi^2 beyond the degrees of freedom."""
        return sum(max(f.chi2 - f.dof, 0.0) for f in self.fits)

    @property
    def sensors(self) -> set[str]:
        """Names of the sensors."""
        return {f.sensor for f in self.fits}

    @property
    def is_grave(self) -> bool:
        """Whether the residuals of a sensor are so large that standard deviations mean nothing."""
        return any(excess(f) >= FAR_BEYOND for f in self.fits)

    @property
    def words(self) -> str:
        """Text with the ratio of residuals to stated noise of each sensor, the largest first."""
        worst_first = sorted(self.fits, key=lambda f: -excess(f))
        return ", ".join(f"{f.kind} of {f.sensor} {times(f)}" for f in worst_first)


def ranked(causes: Iterable[Cause]) -> list[Cause]:
    """The causes by decreasing gain; equal gains keep their order."""
    return sorted(causes, key=lambda c: -c.gain)


def any_explains(causes: Iterable[Cause], misfit: Misfit) -> bool:
    """Whether one of the causes gains at least the share MIN_EXPLAINED_SHARE of the misfit."""
    return any(c.gain >= MIN_EXPLAINED_SHARE * misfit.chi2 for c in causes)


# Causes that vary over the recording.


def varying_causes(assessed: AssessedEstimate, misfit: Misfit) -> Iterator[Cause]:
    """Causes that vary over the recording: sensors that do not measure together, a disturbance at one time, or a
    parameter that changes."""
    for assessment in assessments(assessed):
        yield from assessment.clock_causes
    tried = NO_CHANGES
    if assessed.segments is not None:  # beside effects, which also differ between segments
        tried = changes(*assessed.beside, assessed.inputs.sensors)
    if drifts := list(drifting_clocks(assessed, tried)):  # the others may follow from these
        yield from drifts
        return
    change = None if tried.clear is None else next(_change(tried, assessed, misfit), None)
    if change is not None:  # it also enlarges residuals at one time, like a disturbance
        yield change
    elif misfit.fits and (hit := disturbance(assessed.estimate, misfit.chi2, misfit.sensors)) is not None:
        yield Cause(_hit_words(hit, assessed.timeline), hit.gain, misfit.is_grave)


LIKELY = 10.0  # times its usual size: a larger effect, of 500 ppm, is named only, as something else may look like it


def drifting_clocks(assessed: AssessedEstimate, tried: Changes) -> Iterator[Cause]:
    """A cause for each clock rate that differs from zero, with standard deviations that include the scatter of
    segments; or that is the clear change of those `tried`, as one step leaves scatter where it is large. A clock that
    jumps does not drift."""
    clear = tried.clear
    jumping = {c.sensors for c in tried.by_gain if c.name == TIME_OFFSET.name and not c.is_clock_drift}
    drifting = clear.sensors if clear is not None and clear.is_clock_drift else ()
    rig = assessed.inputs.user_rig or assessed.inputs.rig
    duration = float(np.ptp(assessed.estimate.outcome.state.seconds))
    for e in (e for e in assessed.effects if e.spec is CLOCK_RATE):
        rate = float(e.value[0])
        if (e.differs or e.sensor in drifting) and (e.sensor,) not in jumping:
            late_s = PPM * abs(rate) * duration
            sentence = (
                f"the clock of {e.sensor} runs about {pace_words(rate)} against that of {rig.reference}, "
                f"{1e3 * late_s:.2g} ms over the recording. Write clock_rate: {{prior: 0, sigma: "
                f"{e.prior_sigma:.0f}}}, and leave time_offset free; or stamp all sensors by one clock, and "
                "record again."
            )
            remedy = Remedy(e.amended) if abs(rate) < LIKELY * e.spec.prior_sigma else None
            grave = late_s > LARGE * rig.settings.time_tolerance_s
            yield Cause(Remark("clock_drifts", sentence), e.gain, grave, remedy=remedy)


def _change(tried: Changes, assessed: AssessedEstimate, misfit: Misfit) -> Iterator[Cause]:
    """The clear change. Two that explain as much are named together if they are the same change, seen from either
    sensor, or changes of one sensor. A clock that drifts is an effect, and none of these."""
    best = tried.by_gain[0]
    alike = [c for c in tried.by_gain if c.gain > ALIKE * best.gain]
    kinds_of_best = {(c.name, c.pattern) for c in alike if c.sensors == best.sensors}
    if best.pattern != "pulse" and not best.is_clock_drift and all((c.name, c.pattern) in kinds_of_best for c in alike):
        words = _change_words(alike, assessed)
        share = min(best.gain / tried.scatter.beyond_chance, 1.0)
        words = words.with_sentence(f"{words} This explains {share:.0%} of what varies over the recording.")
        changed = {key for c in alike for s in c.sensors for key in _changes_with(assessed.inputs.sensor(s), c.name)}
        yield Cause(words, best.gain, misfit.is_grave or _is_large(best, assessed.beside[0]), tuple(changed))


def _is_large(c: Change, problem: Problem) -> bool:
    """Whether a parameter changes by more than LARGE tolerances."""
    tolerance = problem.tolerance[problem.layout.columns(c.sensors[0], c.name)]
    return bool((np.abs(c.value[: len(tolerance)]) > LARGE * tolerance).any())


def _change_words(alike: list[Change], assessed: AssessedEstimate) -> Remark:
    """A sentence on a change. alike: changes that explain about as much, the best first."""
    best, timeline = alike[0], assessed.timeline
    others = list(dict.fromkeys(" and ".join(c.sensors) for c in alike if c.sensors != best.sensors))
    when = "over the recording" if best.pattern == "drift" else f"near {timeline.words(best.second)}"
    if best.name == TIME_OFFSET.name:
        return _clock_words(best, others, when, timeline)
    changed = [_changed(c, *assessed.beside) for c in alike if c.sensors == best.sensors and c.name != TIME_OFFSET.name]
    what = " or ".join(size for size, _ in changed)
    advice = " ".join(dict.fromkeys(against for _, against in changed))
    instead = f" (or {', or '.join(others)} the opposite way)" if others else ""
    return changed[0][0].with_sentence(
        f"{_names(best)} changes {when}: {what}{instead}. {advice} Record again"
        f"{_apart(best, timeline, ', or calibrate the recording before or after that alone')}."
    )


def _names(c: Change) -> str:
    return " and ".join(c.sensors)


def _changed(c: Change, problem: Problem, state: State) -> tuple[Remark, str]:
    """Texts with the size of a change of a lens, of wheels or of extrinsics, and what to do against it."""
    if c.name == "intrinsics":
        size = Remark("lens_changes", f"its lens by up to {np.abs(c.value).max():.2g} px")
        return size, "Switch off autofocus, zoom and image stabilisation."
    if c.name not in ("rotation", "translation"):
        value = state.values[c.sensors[0], c.name]
        sentence = f"its {c.name.replace('_', ' ')} by up to {100.0 * np.abs(c.value / value).max():.2g} %"
        size = Remark("wheel_sizes_change", sentence)
        return size, "Check tyres, load and encoders."
    turn, move = _sizes(problem.layout, c)
    moves, advice = f"it moves on its mount by {np.rad2deg(turn):.2g} deg and {1e3 * move:.2g} mm", "Fasten all mounts."
    if not problem.layout.has(c.sensors[0], "rotation"):  # of an antenna: the two are hard to tell apart
        moves = f"it moves on its mount by {1e3 * move:.2g} mm, or its positions jump"
        advice = "Fasten all mounts; of GNSS, leave out fixes of a low status (least_status)."
    return Remark("mount_moves", moves), advice


def _clock_words(c: Change, others: list[str], when: str, timeline: Timeline) -> Remark:
    """A sentence on a time offset that jumps. others: clocks that explain as much."""
    instead = f" (or that of {', or of '.join(others)} the opposite way)" if others else ""
    return Remark(
        "clock_jumps",
        f"the time offset of {_names(c)}{instead} changes by about {1e3 * c.value[0]:+.2g} ms {when}: its clock "
        f"jumped, or stamps are wrong{_apart(c, timeline, '. Calibrate the recording before or after that alone')}.",
    )


def pace_words(rate_ppm: float, std: float | None = None) -> str:
    """How fast or slow a clock is, from its clock_rate [ppm]: the rate of a fast clock is negative."""
    spread = "" if std is None else f" +- {std:.2g}"
    return f"{abs(rate_ppm):.0f}{spread} ppm {'fast' if rate_ppm < 0.0 else 'slow'}"


def _apart(c: Change, timeline: Timeline, words: str) -> str:
    """`words`, with how to use one side of a step alone. Empty for a drift, and without --from and --to. The step is
    somewhere within the segments around `c.second`."""
    if c.pattern == "drift" or not timeline.can_be_cut:
        return ""
    return f"{words} (--to or --from; stay clear of the change near {c.second:.1f} s)"


def _sizes(layout: Layout, c: Change) -> tuple[float, float]:
    """Angle [rad] and distance [m] of a change of rotation, translation or both."""
    n, sizes = 0, {"rotation": 0.0, "translation": 0.0}
    for name in sizes:
        if layout.has(c.sensors[0], name) and layout.is_free(c.sensors[0], name) and n + 3 <= len(c.value):
            sizes[name], n = float(np.linalg.norm(c.value[n : n + 3])), n + 3
    return sizes["rotation"], sizes["translation"]


# Misfit that is concentrated at one time.

BINS, WINDOWS = 64, (3, 6, 9)  # bins of the recording, and of a window: a shock affects a few keyframes around it
AT_ONE_TIME = 0.5  # share of the misfit in one window
NEARLY_ALL = 0.9  # of the largest share of a window
# Times the median chi^2 of a window; below it, the number of measurements may explain the difference.
LARGE_WINDOW = 3.0


@dataclass(frozen=True)
class Disturbance:
    """A window with most of the misfit. start, end: [s, joined clock]; share: of the misfit; gain: its chi^2 beyond
    that of a usual window; sensors: those with large residuals in it."""

    start: float
    end: float
    share: float
    gain: float
    sensors: tuple[str, ...]


def disturbance(estimate: Estimate, misfit: float, misfits: Collection[str]) -> Disturbance | None:
    """The shortest window with nearly all that any window has of the `misfit` (chi^2 beyond the degrees of freedom) of
    the sensors `misfits`. None if that is less than half of it."""
    seconds = estimate.outcome.state.seconds
    edges = np.linspace(float(seconds[0]), float(seconds[-1]), BINS + 1)
    chi2 = {s: np.histogram(t, edges, weights=x)[0] for s, (t, x) in _chi2_over_time(estimate).items() if s in misfits}
    hits: list[Disturbance] = []
    for width in WINDOWS if misfit > 0.0 else ():
        beyond = {}
        for sensor, of_bins in chi2.items():
            usual = width * np.median(of_bins[of_bins > 0.0]) if of_bins.any() else 0.0
            window = np.convolve(of_bins, np.ones(width), "valid")
            beyond[sensor] = np.where(window > LARGE_WINDOW * usual, window - usual, 0.0)
        total = np.sum([np.zeros(BINS - width + 1), *beyond.values()], axis=0)
        k, gain = int(np.argmax(total)), float(total.max())
        sensors = tuple(s for s, excess in beyond.items() if excess[k] > 0.1 * gain)
        hits.append(Disturbance(float(edges[k]), float(edges[k + width]), min(gain / misfit, 1.0), gain, sensors))
    enough = max([AT_ONE_TIME, *(NEARLY_ALL * hit.share for hit in hits)])
    return next((hit for hit in hits if hit.share >= enough), None)


def _chi2_over_time(estimate: Estimate) -> dict[str, tuple[np.ndarray, np.ndarray]]:
    """By sensor: times (n,) s on the joined clock and chi^2 (n,) of its residuals."""
    outcome = estimate.outcome
    rows = [r for key, f in outcome.problem.factors.items() for r in f.rows(outcome.residuals[key], outcome.state)]
    chi2: dict[str, list[tuple[np.ndarray, np.ndarray]]] = {r.sensor: [] for r in rows}
    for r in rows:
        chi2[r.sensor].append((r.seconds, (r.weighted.astype(np.float64) ** 2).sum(axis=1)))
    return {
        s: (np.concatenate([t for t, _ in pairs]), np.concatenate([c for _, c in pairs])) for s, pairs in chi2.items()
    }


def _hit_words(hit: Disturbance, timeline: Timeline) -> Remark:
    """A sentence on a disturbance at one time, of which no change of a parameter is the clear cause."""
    names = " and ".join(hit.sensors)
    part = "leave that part out"
    if timeline.can_be_cut:
        part = f"calibrate what is before or after it: --to {hit.start:.1f}, or --from {hit.end:.1f}"
    return Remark(
        "disturbance_at_one_time",
        f"{hit.share:.0%} of the misfit ({names}) comes at one time, near "
        f"{timeline.words(0.5 * (hit.start + hit.end))}: wrong readings or stamps, a shock, or a mount, clock or "
        f"target that changes there; {part}.",
    )


# Causes and warnings for residuals that differ from the stated noise.

LARGE_FACTOR = 3.0  # empirical factor; a warning above it
CLEARLY = 1.5  # ratio of noise densities, from which on one is clearly larger
BLOCKS = (3, 10, 30, 100)  # successive rows whose means are compared with those of white noise
MAX_COLOUR = 2.5  # variance of means over that of white noise, or its inverse, that still counts as white
CHANCE_SIGMAS = 3.0  # standard deviations that statistics may be off by chance
N_NOISE_SEGMENTS = 8  # segments of the recording whose mean squares are compared
MAX_VARIATION = 3.0  # mean square of a segment over that of the recording, or its inverse
BEYOND_FACTOR = 1.5  # times the largest empirical factor; a warning if the cross-validation factor is above it


def misfit_causes(assessed: AssessedEstimate, misfit: Misfit, explained: bool) -> Iterator[Cause]:
    """Causes of the misfit: rejected outliers, the noise of the IMU, stated noise of other sensors, or unknown.
    explained: whether a named cause explains the misfit; then one sentence states the residuals."""
    rig, fits = assessed.inputs.rig, assessed.fits
    yield from (Cause(sentence, 0.0) for a in assessments(assessed) for sentence in a.many_rejected)
    noise_ratio = _noise_over_stated(assessed.inputs)
    noise = list(_noise_of_imus(assessed, misfit, noise_ratio))
    yield from noise
    if explained:
        if misfit.fits:
            yield Cause(
                Remark(
                    "residuals_exceed_noise", f"residuals are larger than the stated noise predicts: {misfit.words}."
                ),
                0.0,
            )
        return
    inertial = [f for f in misfit.fits if f.kind in INERTIAL]
    if not noise or any(noise_ratio[f.sensor, f.kind] < 0.5 * excess(f) for f in inertial):
        yield from _unknown(assessed, misfit)
    for f in fits:
        if sentence := misfit_words(rig, f, _is_noise(assessed.estimate, f)):
            yield Cause(sentence, max(f.chi2 - f.dof, 0.0), excess(f) >= FAR_BEYOND)


def misfit_words(rig: Rig, f: SensorFit, is_noise: bool) -> Remark | None:
    """A sentence on residuals of one sensor that contradict the rig file; None if they do not. is_noise: whether they
    are white and constant over the recording; only then a larger noise is advised."""
    sensor = rig.sensors.get(f.sensor)
    if sensor is None:
        return None
    return assessors()[sensor.sensor_type].misfit(sensor, f, is_noise)


def _noise_of_imus(assessed: AssessedEstimate, misfit: Misfit, noise_ratio: Mapping[FitKey, float]) -> Iterator[Cause]:
    """Causes that are noise of an IMU, stated too small or too large. Another noise is advised only if the readings
    show it by themselves. noise_ratio: see `_noise_over_stated`."""
    overstated = tuple(s for a in assessments(assessed) for s in a.overstated_noise)
    rig = assessed.inputs.rig
    for imu in () if rig.imu is None else (rig.imu, *rig.further_imus):
        fits = [f for f in assessed.fits if f.sensor == imu.name and f.kind in INERTIAL]
        of_imu = {kind: noise_ratio[imu.name, kind] for kind in INERTIAL}
        small = [f for f in fits if is_small(f)]
        if any(of_imu[f.kind] > CLEARLY for f in fits if excess(f) > 1.0 or not dof_known(f)):
            scales = {kind: max(s, 1.0) for kind, s in of_imu.items()}
            yield Cause(noise_words(imu, scales), misfit.chi2, misfit.is_grave)
        elif fits and overstated:  # the trajectory then follows the IMU, and its residuals become small
            yield from (Cause(sentence, 0.0) for sentence in overstated)
            return
        elif small and all(of_imu[f.kind] < 1.0 / CLEARLY for f in small):
            scales = dict.fromkeys(INERTIAL, 1.0) | {f.kind: max(ratio(f), of_imu[f.kind]) for f in small}
            yield Cause(noise_words(imu, scales), 0.0)
        elif small:
            yield Cause(_small_words(imu, small), 0.0)


def _small_words(imu: ImuSensor, small: Sequence[SensorFit]) -> Remark:
    sizes = " and ".join(f"{f.kind} {ratio(f):.2g}x" for f in small)
    return Remark(
        "imu_residuals_small",
        f"residuals of {imu.name} are smaller than the stated noise predicts ({sizes}); standard "
        "deviations are too large, if anything.",
    )


def noise_words(imu: ImuSensor, scales: Mapping[str, float]) -> Remark:
    """A sentence that the stated noise is too small, as readings show, or too large, as residuals show. scales: fitting
    over stated density by kind of INERTIAL. Bias random walks are not shown: they become larger, too, never smaller."""
    is_small, n = max(scales.values()) > 1.0, imu.noise
    gyro, accel = (scales[kind] for kind in INERTIAL)
    fields = (
        f"gyro: {gyro * n.gyro:.2g}, gyro_walk: {max(gyro, 1.0) * n.gyro_walk:.2g}, accel: {accel * n.accel:.2g}, "
        f"accel_walk: {max(accel, 1.0) * n.accel_walk:.2g}"
    )
    sentence = (
        f"the stated noise of {imu.name} is too {'small' if is_small else 'large'}: "
        f"over the stated one, {'readings in quiet moments show at least' if is_small else 'residuals show at most'} "
        f"{', '.join(f'{kind} {scale:.2g}x' for kind, scale in scales.items())}. Write noise: {{{fields}}} "
        "and calibrate again."
    )
    return Remark("imu_noise_understated", sentence) if is_small else Remark("imu_noise_overstated", sentence)


def _unknown(assessed: AssessedEstimate, misfit: Misfit) -> Iterator[Cause]:
    """A sentence on residuals of the IMU that are too large without a known cause. None if another sensor's are, too,
    and are white: a wrong noise of that sensor also enlarges those of the IMU."""
    large = any(f.kind in INERTIAL for f in misfit.fits)
    if large and not any(f.kind not in INERTIAL and _is_noise(assessed.estimate, f) for f in misfit.fits):
        yield Cause(unknown_words(assessed, misfit), misfit.chi2, misfit.is_grave)


def unknown_words(assessed: AssessedEstimate, misfit: Misfit) -> Remark:
    """A sentence that the cause is unknown, with the checks that were made. Without segments those of effects and of
    changes say nothing."""
    rig, split = assessed.inputs.rig, assessed.segments is not None
    checks = {
        "noise of the readings, fixed values and priors of mounted sensors": True,
        "target size": rig.has_target,
        "camera models": bool(rig.cameras),
        "rolling shutters, and lenses that change": bool(rig.cameras) and split,
        "swapped cameras": len(rig.cameras) > 1,
        "delays, filters and places in IMUs": any(e.spec.name == ACCEL_DELAY.name for e in assessed.effects) and split,
        "clocks that drift or jump, mounts that move": split,
        "disturbances at one time": True,
    }
    return Remark(
        "residuals_unexplained",
        f"residuals are larger than the stated noise predicts ({misfit.words}); the cause is unknown. "
        f"Checked: {', '.join(check for check, made in checks.items() if made)}. Do not state more noise than "
        "readings show: errors would stay larger than the standard deviations. Record again, with slower motion and "
        "firm mounts, and compare both results by icalib compare.",
    )


def _noise_over_stated(inputs: Inputs) -> dict[FitKey, float]:
    """By IMU and kind of INERTIAL: the noise density that the readings show in quiet moments over the stated one; NaN
    for an assumed motion."""
    ratios: dict[FitKey, float] = {}
    for stream in inputs.measurements.of(ImuStream):
        imu = inputs.sensor(stream.name)
        of_kinds = zip(INERTIAL, (stream.gyro, stream.accel), (imu.noise.gyro, imu.noise.accel), strict=True)
        for kind, x, density in of_kinds:
            ratios[imu.name, kind] = np.nan if imu.assumed else quiet_scatter(stream.seconds, x) / density
    return ratios


def _is_noise(estimate: Estimate, f: SensorFit) -> bool:
    """Whether the residuals of `f` are white and constant over the recording."""
    rows = rows_of(estimate.outcome, f.sensor, f.kind)
    return rows is not None and are_noise(rows.weighted)


def are_noise(rows: np.ndarray) -> bool:
    """Whether residuals, rows (n, m), are white and of constant variance. The fit must have taken few of their degrees
    of freedom. The mean of n white numbers has a variance n times smaller."""
    n, square = len(rows), float(np.vdot(rows, rows))  # `vdot` needs no copy of many rows
    if n < 2 * N_NOISE_SEGMENTS or square == 0.0:
        return False
    white = True
    for length in (b for b in BLOCKS if n >= N_NOISE_SEGMENTS * b):
        means = rows[: n // length * length].reshape(n // length, length, -1).mean(axis=1)
        colour = length * float((means**2).mean()) / (square / rows.size)
        allowed = MAX_COLOUR + CHANCE_SIGMAS * np.sqrt(2.0 / means.size)
        white &= 1.0 / allowed < colour < allowed
    sizes = [
        float(np.vdot(segment, segment)) / segment.size / (square / rows.size)
        for segment in np.array_split(rows, N_NOISE_SEGMENTS)
    ]
    allowed = np.log(MAX_VARIATION) + CHANCE_SIGMAS * np.sqrt(2.0 * N_NOISE_SEGMENTS / rows.size)
    return bool(white and max(abs(np.log(max(s, 1e-12))) for s in sizes) < allowed)


def scatter_warnings(factors: np.ndarray, split: bool, validation: CrossValidation | None) -> Iterator[Remark]:
    """Warnings on the scatter of estimates from segments. factors (n,): empirical factors of the sensors' parameters;
    split: whether the recording was cut into segments; validation: result of the cross-validation."""
    if len(factors) and factors.max() > LARGE_FACTOR:
        yield Remark(
            "segments_scatter",
            f"estimates from segments of the recording scatter {factors.max():.1f}x more than predicted; the printed "
            "standard deviations are inflated accordingly.",
        )
    if (
        validation is not None
        and len(factors)
        and validation.optimistic
        and validation.factor > BEYOND_FACTOR * factors.max()
    ):
        yield Remark(
            "halves_disagree",
            f"one half of the recording predicts the other {validation.factor:.1f}x worse than predicted, and the "
            f"printed standard deviations are only {factors.max():.1f}x the formal ones: they are too small.",
        )
    if not split:
        yield Remark(
            "recording_too_short",
            "the recording is too short for segments (or segments are off): standard deviations are formal and too "
            "small, as they include white noise only. Record longer.",
        )
