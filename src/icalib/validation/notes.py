"""Notes on recordings and sensors, one sentence each."""

from __future__ import annotations

from collections.abc import Iterator

from icalib.estimate.estimate import Estimate
from icalib.estimate.problem.inputs import Inputs
from icalib.result.timeline import Timeline
from icalib.sensors import call_all_kinds


def notes(inputs: Inputs, estimate: Estimate, timeline: Timeline) -> Iterator[str]:
    """Notes on the recordings, then on each kind of sensor."""
    for k, span in enumerate(timeline.spans if len(timeline.spans) > 1 else (), 1):
        number, m = f"recording {k}", timeline.parts[k - 1].measurements
        name = number if span.name == number else f"{number}, {span.name}"
        timed = f"{span.end - span.start:.1f} s from {span.origin_ns} ns on"
        yield f"{name}: {timed if m.has_clock else f'{len(m.reference.stamps_ns)} images'}."
    yield from inputs.measurements.notes
    yield from call_all_kinds("assess", "notes", inputs, estimate, timeline)
