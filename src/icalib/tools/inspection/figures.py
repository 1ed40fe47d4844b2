"""Figures of an inspection as plain data and JSON, in SI units."""

from __future__ import annotations

import dataclasses
from typing import Any

from icalib.base.text_files import json_text
from icalib.geometry.targets import Scene
from icalib.tools.inspection.facts import Inspection, StreamFacts
from icalib.tools.inspection.kinds import inspectors, plain


def figures(inspection: Inspection) -> dict[str, Any]:
    """The inspection as dicts, lists, numbers and text. Names of figures that are not in SI units end with the unit."""
    return {
        "recording": inspection.recording,
        "verdict": inspection.verdict,
        "findings": [dataclasses.asdict(f) for f in inspection.findings],
        "topics": [_stream(s) for s in inspection.streams],
        **_sensors(inspection),
        "frames": [dataclasses.asdict(f) for f in inspection.frames],
        "left_out": dict(inspection.sources.left_out),
        "target": _target(inspection),
        "notes": list(inspection.notes),
    }


def figures_json(inspection: Inspection) -> str:
    """`figures` as the text of a JSON file."""
    return json_text(figures(inspection)) + "\n"


def _sensors(inspection: Inspection) -> dict[str, Any]:
    """The sections with figures of the sensors; there is one for each kind, if only empty."""
    sections: dict[str, Any] = {"cameras": {}, "imus": {}, "imu": inspection.imu, "others": {}}
    for name, source in inspection.sources.sensors.items():
        kind = inspectors()[source.kind]
        sections[kind.section][name] = kind.figures(inspection, name)
    return sections


def _stream(stream: StreamFacts) -> dict[str, Any]:
    """One topic: its entry in the index, and the statistics of its stamps."""
    topic = dataclasses.asdict(stream.topic)
    return topic | {"timing": plain(stream.timing) or None, "problem": stream.problem}


def _target(inspection: Inspection) -> dict[str, Any] | None:
    if inspection.target is None:
        return None
    target = inspection.target.target
    fields = {"type": target.type, "targets": target.plain()} if isinstance(target, Scene) else target.plain()
    return fields | {"file": inspection.target.file}
