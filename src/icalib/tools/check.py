"""Tests whether a calibration is still valid on a new recording."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from math import inf
from statistics import NormalDist
from typing import Any, Literal

import numpy as np

from icalib.base.files import json_text, printable
from icalib.data.measurements import Measurements
from icalib.data.recordings import Source
from icalib.errors import CalibrationError, EstimationError
from icalib.geometry import so3
from icalib.pipeline import Progress, calibrate_measurements, measure
from icalib.result import Calibration, ParameterGroup, SensorFit, joint_covariance
from icalib.result.quantities import chi2_words, rms_words
from icalib.result.saving import rig_of_result
from icalib.result.verdict import AUXILIARY, UNUSABLE, counted
from icalib.rig import Rig
from icalib.sensors.sensor import MOUNTED_NAMES
from icalib.tools.comparison.compare import (
    Comparison,
    Difference,
    changes_html,
    compare_sides,
    sentence,
    side_of_result,
    sigmas,
)

__all__ = ["Check", "GroupDifference", "Validity", "check_calibration", "check_measurements", "with_places"]


# Tests a calibration on a new recording.
#
# The new recording is calibrated separately, with the old values as initial guesses without weight. Both results have
# covariances, so each block (pose, time offset, lens, ...) is tested by the Mahalanobis distance of its change. The
# significance level of N sigma holds for all blocks together (Bonferroni), so that many blocks raise no false alarm. A
# second solve with the old values fixed gives the residuals of the old calibration on the new data.

Validity = Literal["valid", "changed", "cannot say"]
EXIT_CODES: dict[Validity, int] = {"valid": 0, "changed": 1, "cannot say": 3}
READING_SHARE, SOLVED_SHARE = 0.5, 0.8  # progress at the end of reading, and progress of solving after the first solve


@dataclass(frozen=True)
class GroupDifference:
    """Change of one parameter group that both results estimate, new minus old, in SI units.

    change (n,): for rotations, the rotation vector in the sensor's axes [rad]. std (n,): standard deviation of
    `change`, from both results. sigmas: of the whole group, see `significance.sigmas`.
    """

    sensor: str
    name: str
    labels: tuple[str, ...]
    unit: str
    change: tuple[float, ...]
    std: tuple[float, ...]
    sigmas: float | None


@dataclass(frozen=True)
class Check:
    """Result of the test of a calibration.

    limit: sigmas above which one block counts as changed. tested: the blocks that both results estimate; changed: those
    beyond the limit. unknown: parameters, such as "cam0 translation", that the calibration determines and the new
    recording does not. untested: parameters that the rig file fixes. reason: why there is no verdict, else "". drifts:
    changes by parameter group. fits: residuals of the calibration on its recording; with its values fixed on the new
    recording; of the new recording calibrated separately.
    """

    validity: Validity
    reason: str
    limit: float
    tested: tuple[Difference, ...]
    changed: tuple[Difference, ...]
    unknown: tuple[str, ...]
    untested: tuple[str, ...]
    comparison: Comparison | None
    drifts: tuple[GroupDifference, ...]
    fits: tuple[tuple[SensorFit, ...], tuple[SensorFit, ...], tuple[SensorFit, ...]]
    new: Calibration | None

    @property
    def exit_code(self) -> int:
        return EXIT_CODES[self.validity]


def check_calibration(
    calibration: Calibration,
    recording: Source | Sequence[Source],
    progress: Progress = lambda *_: None,
    *,
    sigma: float = 3.0,
    start_s: float = 0.0,
    end_s: float = inf,
) -> Check:
    """Checks `calibration` on one recording, or on several jointly. start_s, end_s: used part of each, from its start.

    sigma: significance level of a change, in standard deviations of a normal variable, for all blocks together. Raises
    CalibrationError, one sentence, if the recording is not of the calibration's rig.
    """
    rig = rig_of_result(calibration, "guess")[0]
    read = measure(rig, recording, lambda s, done: progress(s, READING_SHARE * done), start_s=start_s, end_s=end_s)
    return check_measurements(
        calibration, read, lambda s, done: progress(s, READING_SHARE + (1.0 - READING_SHARE) * done), sigma=sigma
    )


def with_places(calibration: Calibration, **fields: Mapping[str, str]) -> Calibration:
    """The calibration, for a check on a recording with another `topic` or `path` of sensors. fields: values by sensor.
    Raises CalibrationError for a sensor that it does not have."""
    sensors = dict(calibration.rig["sensors"])
    for field, name, place in ((field, *item) for field, places in fields.items() for item in places.items()):
        if name not in sensors:
            raise CalibrationError(f"the calibration has no sensor {name}; it has {', '.join(sensors)}.")
        sensors[name] = sensors[name] | {field: place}
    return replace(calibration, rig={**calibration.rig, "sensors": sensors})


def check_measurements(
    calibration: Calibration,
    measurements: Measurements | Sequence[Measurements],
    progress: Progress = lambda *_: None,
    *,
    sigma: float = 3.0,
) -> Check:
    """As `check_calibration`, with measurements in memory."""
    if not 0.0 < sigma < inf:
        raise CalibrationError(f"sigma must be a number above 0, but is {sigma:g}; 3 is usual.")
    rig = rig_of_result(calibration, "guess")[0]
    old = calibration.fits
    try:
        new = calibrate_measurements(rig, measurements, lambda s, done: progress(s, SOLVED_SHARE * done))
    except EstimationError as error:
        return Check("cannot say", str(error), sigma, (), (), (), (), None, (), (old, (), ()), None)
    fixed = _fits_of_fixed(rig_of_result(calibration, "fixed")[0], measurements, progress)
    comparison = compare_sides(
        side_of_result(calibration, "the calibration"), side_of_result(new, "the new recording"), limit=sigma
    )
    tested = [(d, d.sigmas) for d in comparison.differences if d.sigmas is not None]  # else fixed on both sides
    limit = joint_limit(sigma, len(tested))
    changed = tuple(d for d, count in tested if count > limit)
    unknown = tuple(name for name in _unusable(new) if name not in _unusable(calibration))
    reason = new.reasons[0] if new.verdict == "not usable" else ""
    validity: Validity = "cannot say" if reason else "changed" if changed else "cannot say" if unknown else "valid"
    drifts = tuple(_drifts(calibration, new))
    blocks = tuple(d for d, _ in tested)
    untested, all_fits = tuple(_fixed(calibration)), (old, fixed, new.fits)
    return Check(validity, reason, limit, blocks, changed, unknown, untested, comparison, drifts, all_fits, new)


def joint_limit(sigma: float, tests: int) -> float:
    """Sigmas for each of `tests` tests, so that the family of tests has the error probability of one test at `sigma`
    (Bonferroni)."""
    normal = NormalDist()
    tail = (1.0 - normal.cdf(sigma)) / max(tests, 1)
    return max(sigma, -normal.inv_cdf(tail)) if tail > 0.0 else sigma


def _fits_of_fixed(
    rig: Rig, measurements: Measurements | Sequence[Measurements], progress: Progress
) -> tuple[SensorFit, ...]:
    """Residual statistics on `measurements` with the rig's values fixed; empty if there is no solution, because the
    data contradict the values."""
    rest = 1.0 - SOLVED_SHARE
    try:
        return calibrate_measurements(rig, measurements, lambda s, done: progress(s, SOLVED_SHARE + rest * done)).fits
    except EstimationError:
        return ()


def _unusable(c: Calibration) -> list[str]:
    """Names of groups that are unusable; a lens is classified by the uncertainty of its projection."""
    groups = [g for g in c.groups if g.sensor in c.rig["sensors"] and {*UNUSABLE} & {*counted(c, g)}]
    return list(dict.fromkeys(_block(c, g) for g in groups))


def _fixed(c: Calibration) -> list[str]:
    """Names of groups that the rig file fixes, without the pose of the reference sensor, which is the identity."""
    groups = [g for g in c.groups if g.columns is None and g.sensor in c.rig["sensors"] and g.name not in AUXILIARY]
    fixed = [
        _block(c, g) for g in groups if g.mode == "fixed" and not (g.sensor == c.reference and g.name in MOUNTED_NAMES)
    ]
    return list(dict.fromkeys(fixed))


def _block(c: Calibration, g: ParameterGroup) -> str:
    lens = g.name in c.lenses.get(g.sensor, ())
    return f"{g.sensor} {'lens' if lens else g.name.replace('_', ' ')}"


def _drifts(old: Calibration, new: Calibration) -> list[GroupDifference]:
    drifts = []
    before = {(g.sensor, g.name): g for g in old.groups if g.columns is not None}
    for g in new.groups:
        o = before.get((g.sensor, g.name))
        if o is None or g.columns is None or o.value.shape != g.value.shape or g.sensor not in new.rig["sensors"]:
            continue
        change, total = so3.value_change(o.value, g.value), joint_covariance(old, [o]) + joint_covariance(new, [g])
        std = np.sqrt(np.diag(total))
        drifts.append(
            GroupDifference(
                g.sensor, g.name, g.labels, g.unit, tuple(change.tolist()), tuple(std.tolist()), sigmas(change, total)
            )
        )
    return drifts


# Result of a check as sentences, and as JSON.

_EXTRINSICS = ("rotation", "translation")
_NO_SOLUTION = "the new recording has no solution with the calibration fixed."


def lines(check: Check) -> list[str]:
    """Lines to print: residuals, changes, notes on the new result, and the verdict as the last line."""
    text_lines = []
    if check.fits[1]:
        text_lines.append(
            "Residuals on the new recording with the calibration fixed (in the calibration, calibrated anew):"
        )
        text_lines += [f"  {line}" for line in _fit_lines(check.fits)]
    elif check.new is not None:
        text_lines.append(f"Residuals: {_NO_SOLUTION}")
    if check.comparison is not None:
        text_lines.append("Changes from the calibration (A) to the new recording (B):")
        for d in sorted(check.tested, key=lambda d: d not in check.changed):
            text_lines.append(f"  {'CHANGED' if d in check.changed else 'same   '}  {sentence(d, check.comparison)}")
    return [*text_lines, *_notes(check), verdict(check)]


def check_html(check: Check, title: str) -> str:
    """The check as one HTML document. title: names of the calibration and the recording."""
    trust = {"valid": "good", "changed": "bad", "cannot say": "care"}[check.validity]
    return changes_html(
        check.comparison,
        check.tested,
        check.changed,
        title=title,
        question="Is the calibration still valid?",
        answer=verdict(check),
        trust=trust,
        notes=_notes(check),
        residuals=_fit_lines(check.fits) or ([] if check.new is None else [_NO_SOLUTION]),
    )


def _notes(check: Check) -> list[str]:
    notes = () if check.new is None else check.new.reasons
    return [f"Note on the new recording: {n}" for n in notes if n != check.reason]


def verdict(check: Check) -> str:
    """One sentence: valid; changed, with the sensors and sigmas; or cannot say, with the reason."""
    if check.reason:
        return f"Cannot say: {check.reason}"
    if check.changed:
        return f"Changed: {'; '.join(named(check))}. Calibrate again."
    if check.unknown:
        return (
            f"Cannot say: the new recording does not determine {', '.join(check.unknown)}; all else is unchanged. "
            "Record longer, with more motion."
        )
    untested = f" Not tested, as the rig file fixes them: {', '.join(check.untested)}." if check.untested else ""
    return f"Valid: no parameter changed by more than {check.limit:.1f} sigma.{untested}"


def named(check: Check) -> list[str]:
    """A few words on each change. If one sensor moved relative to all others, its pose is named once; other changes
    follow."""
    poses = [d for d in check.changed if d.what in _EXTRINSICS]
    words = []
    if poses:
        moved = _moved_sensor(check.tested, poses)
        if moved:
            words.append(f"the pose of {moved} ({_most([d for d in poses if moved in (d.sensor, d.frame)])})")
        else:
            pairs = dict.fromkeys((d.sensor, d.frame) for d in poses)
            words += [
                f"the pose of {s} relative to {f} ({_most([d for d in poses if (d.sensor, d.frame) == (s, f)])})"
                for s, f in pairs
            ]
    rest = [d for d in check.changed if d.what not in _EXTRINSICS]
    return [*words, *(f"the {d.what} of {d.sensor} ({_most([d])})" for d in rest)]


def check_json(check: Check) -> str:
    """The check as JSON."""
    plain: dict[str, Any] = {
        "validity": check.validity,
        "sentence": verdict(check),
        "limit_sigma": check.limit,
        "changed": [f"{d.sensor} {d.what}" for d in check.changed],
        "not_determined": list(check.unknown),
        "not_tested": list(check.untested),
        "notes": [] if check.new is None else list(check.new.reasons),
        "drifts": [dataclasses.asdict(d) for d in check.drifts],
        "differences": [dataclasses.asdict(d) for d in check.tested],
        "residuals": dict(
            zip(("calibration", "fixed", "new"), ([_plain_fit(f) for f in fits] for fits in check.fits), strict=True)
        ),
    }
    return printable(json_text(plain))


def _moved_sensor(differences: Sequence[Difference], changed: Sequence[Difference]) -> str:
    """The sensor that is part of every changed pose and of no unchanged one; "" unless there is exactly one."""
    pairs = {(d.sensor, d.frame) for d in differences if d.what in _EXTRINSICS}
    off = {(d.sensor, d.frame) for d in changed}
    named = {name for pair in off for name in pair}
    candidates = [n for n in sorted(named) if all((n in pair) == (pair in off) for pair in pairs)]
    return candidates[0] if len(candidates) == 1 else ""


def _most(changed: Sequence[Difference]) -> str:
    known = [d.sigmas for d in changed if d.sigmas is not None]
    return f"{max(known):.1f} sigma" if known else "beyond the tolerance"


def _fit_lines(fits: tuple[tuple[SensorFit, ...], ...]) -> list[str]:
    by_kind = [{(f.sensor, f.kind): f for f in one} for one in fits]
    fit_lines = []
    for key, fixed in by_kind[1].items():
        others = [one[key] for one in (by_kind[0], by_kind[2]) if key in one]
        words = f"{fixed.sensor} {fixed.kind}: chi^2 per degree of freedom {chi2_words(fixed)}"
        words += f" ({', '.join(chi2_words(f) for f in others)})"
        if fixed.rms is not None:
            words += f", RMS {rms_words(fixed)} ({', '.join(rms_words(f) for f in others)})"
        fit_lines.append(words)
    return fit_lines


def _plain_fit(f: SensorFit) -> dict[str, Any]:
    return dataclasses.asdict(f) | {"chi2_per_dof": f.chi2_per_dof}
