"""Possible causes of large residuals, ranked by the part of the misfit that they explain.

A cause is tested by its gain: the decrease of chi^2 if the cause is modelled. A significant cause that explains hardly
any of the misfit is not named. If no cause explains the misfit, the message says so and lists the checks. Another noise
density of the IMU is advised only if its readings show it by themselves.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass

import numpy as np

from icalib.estimate.estimate import Estimate
from icalib.estimate.problem.inputs import Inputs
from icalib.estimate.residual_statistics.parameter_changes import Change, changes, scatter
from icalib.estimate.residual_statistics.segments import Segments
from icalib.observability.cause import Cause
from icalib.result import SensorFit
from icalib.result.excess import FAR_BEYOND, excess, times
from icalib.result.timeline import Timeline
from icalib.rig import ImuSensor, Rig
from icalib.sensors import call_all_kinds
from icalib.sensors.sensor import TIME_OFFSET
from icalib.validation.disturbance import Disturbance, disturbance

# Share of the misfit that a cause must gain to explain it. Robust weights hide part of the gain; wrong causes gain less
# than 0.01.
EXPLAINS = 0.1
# Share that one change must gain of the gain by separate parameters for each segment. A simulated change gains 0.36 to
# 0.99, less if it is far from a segment boundary. On EuRoC, where lens and board do not follow the model, the best
# change gains 0.04.
CHANGES = 0.25
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


def explaining(causes: Iterable[Cause], misfit: Misfit) -> bool:
    """Whether one of the causes gains at least the share EXPLAINS of the misfit."""
    return any(c.gain >= EXPLAINS * misfit.chi2 for c in causes)


def changing(
    inputs: Inputs, estimate: Estimate, segments: Segments | None, misfit: Misfit, scattering: bool, timeline: Timeline
) -> Iterator[Cause]:
    """Causes that vary over the recording: sensors that do not measure together, a disturbance at one time, or a
    parameter that changes. scattering: whether estimates from segments scatter more than predicted."""
    yield from call_all_kinds("assess", "clock_causes", inputs, estimate)
    causes = []
    if misfit.fits and (hit := disturbance(estimate, misfit.chi2, misfit.sensors)) is not None:
        causes.append(Cause(_hit_words(hit, timeline), hit.gain, misfit.is_grave))
    if segments is not None and (misfit.fits or scattering):
        causes += _change(inputs, segments, misfit, timeline)
    # the best one only: a change also enlarges residuals at one time, like a disturbance
    yield from ranked(causes)[:1]


def _change(inputs: Inputs, segments: Segments, misfit: Misfit, timeline: Timeline) -> Iterator[Cause]:
    """The change that explains clearly more than all others, if there is one. Two that explain as much are named
    together if they are the same change, seen from either sensor, or changes of one sensor."""
    by_gain, spread = changes(segments, inputs.sensors), scatter(segments)
    if not by_gain or by_gain[0].gain < CHANGES * spread.beyond_chance or not spread.exceeded_by(by_gain[0]):
        return
    best = by_gain[0]
    alike = [c for c in by_gain if c.gain > ALIKE * best.gain]
    kinds_of_best = {(c.name, c.pattern) for c in alike if c.sensors == best.sensors}
    if best.pattern != "pulse" and all((c.name, c.pattern) in kinds_of_best for c in alike):
        words = _change_words(alike, segments, timeline)
        share = f" This explains {min(best.gain / spread.beyond_chance, 1.0):.0%} of what varies over the recording."
        yield Cause(words + share, best.gain, misfit.is_grave or _is_large(best, segments))


def _is_large(c: Change, segments: Segments) -> bool:
    """Whether a parameter changes by more than LARGE tolerances."""
    tolerance = segments.problem.tolerance[segments.problem.layout.columns(c.sensors[0], c.name)]
    return bool((np.abs(c.value[: len(tolerance)]) > LARGE * tolerance).any())


def noise_words(imu: ImuSensor, scales: Mapping[str, float]) -> str:
    """A sentence that the stated noise is too small, as readings show, or too large, as residuals show. scales: fitting
    over stated density by kind of INERTIAL. Bias random walks are not shown: they become larger, too, never smaller."""
    is_small, n = max(scales.values()) > 1.0, imu.noise
    gyro, accel = (scales[kind] for kind in INERTIAL)
    fields = (
        f"gyro: {gyro * n.gyro:.2g}, gyro_walk: {max(gyro, 1.0) * n.gyro_walk:.2g}, accel: {accel * n.accel:.2g}, "
        f"accel_walk: {max(accel, 1.0) * n.accel_walk:.2g}"
    )
    return (
        f"the stated noise of {imu.name} is too {'small' if is_small else 'large'}: "
        f"over the stated one, {'readings in quiet moments show at least' if is_small else 'residuals show at most'} "
        f"{', '.join(f'{kind} {scale:.2g}x' for kind, scale in scales.items())}. Write noise: {{{fields}}} "
        "and calibrate again."
    )


def unknown_words(rig: Rig, misfit: Misfit) -> str:
    """A sentence that the cause is unknown, with the checks that were made."""
    checks = {
        "noise of the readings, fixed values and priors": True,
        "target size": rig.has_target,
        "camera models and lenses that change": bool(rig.cameras),
        "swapped cameras": len(rig.cameras) > 1,
        "clocks that drift or jump, mounts that move, disturbances at one time": True,
    }
    return (
        f"residuals are larger than the stated noise predicts ({misfit.words}); the cause is unknown. "
        f"Checked: {', '.join(check for check, made in checks.items() if made)}. Do not state more noise than "
        "readings show: errors would stay larger than the standard deviations. Record again, with slower motion and "
        "firm mounts, and compare both results by icalib compare."
    )


def _hit_words(hit: Disturbance, timeline: Timeline) -> str:
    """A sentence on a disturbance at one time."""
    names = " and ".join(hit.sensors)
    part = "leave that part out"
    if timeline.can_be_cut:
        part = f"leave that part out: --to {hit.start:.1f}, or --from {hit.end:.1f}"
    return (
        f"{hit.share:.0%} of the misfit ({names}) comes at one time, near "
        f"{timeline.words(0.5 * (hit.start + hit.end))}: a shock, or wrong readings or stamps there; {part}."
    )


def _change_words(alike: list[Change], segments: Segments, timeline: Timeline) -> str:
    """A sentence on a change. alike: changes that explain about as much, the best first."""
    best = alike[0]
    others = list(dict.fromkeys(" and ".join(c.sensors) for c in alike if c.sensors != best.sensors))
    when = "over the recording" if best.pattern == "drift" else f"near {timeline.words(best.second)}"
    if best.name == TIME_OFFSET.name:
        return _clock_words(best, others, segments, when, timeline)
    changed = [_changed(c, segments) for c in alike if c.sensors == best.sensors and c.name != TIME_OFFSET.name]
    what = " or ".join(size for size, _ in changed)
    advice = " ".join(dict.fromkeys(against for _, against in changed))
    instead = f" (or {', or '.join(others)} the opposite way)" if others else ""
    return (
        f"{_names(best)} changes {when}: {what}{instead}. {advice} Record again"
        f"{_apart(best, timeline, ', or calibrate the recording before or after that alone')}."
    )


def _names(c: Change) -> str:
    return " and ".join(c.sensors)


def _changed(c: Change, segments: Segments) -> tuple[str, str]:
    """Texts with the size of a change of a lens, of wheels or of extrinsics, and what to do against it."""
    if c.name == "intrinsics":
        size = f"its lens by up to {np.abs(c.value).max():.2g} px"
        return size, "Switch off autofocus, zoom and image stabilisation."
    if c.name not in ("rotation", "translation"):
        value = segments.state.values[c.sensors[0], c.name]
        size = f"its {c.name.replace('_', ' ')} by up to {100.0 * np.abs(c.value / value).max():.2g} %"
        return size, "Check tyres, load and encoders."
    turn, move = _sizes(segments, c)
    return f"it moves on its mount by {np.rad2deg(turn):.2g} deg and {1e3 * move:.2g} mm", "Fasten all mounts."


def _clock_words(c: Change, others: list[str], segments: Segments, when: str, timeline: Timeline) -> str:
    """A sentence on a time offset that drifts or jumps. others: clocks that explain as much."""
    instead = f" (or that of {', or of '.join(others)} the opposite way)" if others else ""
    if c.pattern == "drift":
        span = float(np.ptp(segments.state.seconds[segments.ends]))
        return (
            f"the clock of {_names(c)}{instead} drifts against the others by about {1e6 * c.value[0] / span:+.0f} ppm, "
            f"{1e3 * abs(c.value[0]):.2g} ms {when}. Stamp all sensors by one clock (hardware trigger, PTP) "
            "and record again."
        )
    return (
        f"the time offset of {_names(c)}{instead} changes by about {1e3 * c.value[0]:+.2g} ms {when}: its clock "
        f"jumped, or stamps are wrong{_apart(c, timeline, '. Calibrate the recording before or after that alone')}."
    )


def _apart(c: Change, timeline: Timeline, words: str) -> str:
    """`words`, with how to use one side of a step alone. Empty for a drift, and without --from and --to. The step is
    somewhere within the segments around `c.second`."""
    if c.pattern == "drift" or not timeline.can_be_cut:
        return ""
    return f"{words} (--to or --from; stay clear of the change near {c.second:.1f} s)"


def _sizes(segments: Segments, c: Change) -> tuple[float, float]:
    """Angle [rad] and distance [m] of a change of rotation, translation or both."""
    layout, n = segments.problem.layout, 0
    sizes = {"rotation": 0.0, "translation": 0.0}
    for name in sizes:
        if layout.is_free(c.sensors[0], name) and n + 3 <= len(c.value):
            sizes[name], n = float(np.linalg.norm(c.value[n : n + 3])), n + 3
    return sizes["rotation"], sizes["translation"]
