"""Findings on a recording: what is wrong or missing for a calibration, and what to do."""

from __future__ import annotations

from collections.abc import Iterator
from typing import get_args

from icalib.tools.inspection.facts import Finding, Inspection
from icalib.tools.inspection.kinds import Subject, inertial, inspectors
from icalib.tools.inspection.sensors import missing_sensors
from icalib.tools.inspection.unread import unread

_ORDER = ("problem", "warning", "hint")


def findings(inspection: Inspection) -> tuple[Finding, ...]:
    """All findings: problems, then warnings, then hints."""
    every = [*missing_sensors(inspection), *unread(inspection)]
    for subject in get_args(Subject):
        every += _jumps(inspection) if subject == "gaps" else ()
        for kind in reversed(inspectors().values()):  # first of sensors that are compared with the IMU
            every += kind.checks[subject](inspection) if subject in kind.checks else ()
    return tuple(sorted(every, key=lambda f: _ORDER.index(f.severity)))


def _jumps(inspection: Inspection) -> Iterator[Finding]:
    """Warnings on clocks that jump."""
    imus = {inspection.sources.sensors[name].topic for name in inertial(inspection)}  # their notes name jumps already
    for stream in inspection.streams:
        if stream.timing is not None and stream.timing.jumps and stream.topic not in imus:
            yield Finding(
                "warning",
                f"{stream.topic.name}: the clock jumps forward; the longest part between jumps is used, "
                f"{stream.timing.duration_s:.1f} s, unless --from and --to choose another.",
            )
