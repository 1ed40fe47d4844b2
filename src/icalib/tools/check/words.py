"""Result of a check as sentences, and as JSON."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from typing import Any

from icalib.base.files import json_text, printable
from icalib.result import SensorFit
from icalib.result.quantities import chi2_words, rms_words
from icalib.tools.check.check import Check
from icalib.tools.comparison.compare import Difference
from icalib.tools.comparison.words import sentence

_EXTRINSICS = ("rotation", "translation")


def lines(check: Check) -> list[str]:
    """Lines to print: residuals, changes, notes on the new result, and the verdict as the last line."""
    text_lines = []
    if check.fits[1]:
        text_lines.append(
            "Residuals on the new recording with the calibration fixed (in the calibration, calibrated anew):"
        )
        text_lines += [f"  {line}" for line in _fit_lines(check.fits)]
    elif check.new is not None:
        text_lines.append("Residuals: the new recording has no solution with the calibration fixed.")
    if check.comparison is not None:
        text_lines.append("Changes from the calibration (A) to the new recording (B):")
        for d in sorted(check.tested, key=lambda d: d not in check.changed):
            text_lines.append(f"  {'CHANGED' if d in check.changed else 'same   '}  {sentence(d, check.comparison)}")
    notes = () if check.new is None else check.new.reasons
    return [*text_lines, *(f"Note on the new recording: {n}" for n in notes if n != check.reason), verdict(check)]


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
