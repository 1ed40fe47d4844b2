"""Figures of an inspection as plain data and JSON, in SI units."""

from __future__ import annotations

import dataclasses
from typing import Any

import numpy as np

from icalib.base.text_files import json_text
from icalib.geometry.targets import Scene
from icalib.tools.inspection.facts import CameraSource, Inspection, StreamFacts
from icalib.tools.inspection.timing import overlap_s
from icalib.tools.inspection.views import GRID


def figures(inspection: Inspection) -> dict[str, Any]:
    """The inspection as dicts, lists, numbers and text. Names of figures that are not in SI units end with the unit."""
    return {
        "recording": inspection.recording,
        "verdict": inspection.verdict,
        "findings": [dataclasses.asdict(f) for f in inspection.findings],
        "topics": [_stream(s) for s in inspection.streams],
        "cameras": {c.name: _camera(inspection, c.name) for c in inspection.sources.cameras},
        "imus": {n: {"topic": t.name} | _plain(inspection.imus.get(n)) for n, t in inspection.sources.imus.items()},
        "imu": inspection.imu,
        "others": {
            n: {"type": s.kind, "topic": s.topic.name} | _plain(inspection.facts.get(n))
            for n, s in inspection.sources.others.items()
        },
        "frames": [dataclasses.asdict(f) for f in inspection.frames],
        "left_out": dict(inspection.sources.left_out),
        "target": _target(inspection),
        "notes": list(inspection.notes),
    }


def figures_json(inspection: Inspection) -> str:
    """`figures` as the text of a JSON file."""
    return json_text(figures(inspection)) + "\n"


def _stream(stream: StreamFacts) -> dict[str, Any]:
    """One topic: its entry in the index, and the statistics of its stamps."""
    topic = dataclasses.asdict(stream.topic)
    return topic | {"timing": _plain(stream.timing) or None, "problem": stream.problem}


def _camera(inspection: Inspection, name: str) -> dict[str, Any]:
    source = next(c for c in inspection.sources.cameras if c.name == name)
    info = inspection.infos.get(name)
    view = inspection.views.get(name)
    return {
        "images": source.images.name if source.images else None,
        "corners": source.corners.name if source.corners else None,
        "others": list(source.others),
        **_plain(inspection.images.get(name)),
        "overlap_with_imu_s": _overlap(inspection, source),
        "camera_info": _plain(info) or None,
        "target": (_plain(view) | {"grid": list(GRID)}) if view else None,
    }


def _overlap(inspection: Inspection, source: CameraSource) -> float | None:
    """Overlap of the stamps of camera and IMU [s]; negative: the gap between them; None without one of the two."""
    camera = inspection.stream(source.topic).timing
    imu = inspection.stream(inspection.sources.imus[inspection.imu]).timing if inspection.imu else None
    return overlap_s(camera, imu) if camera and imu else None


def _target(inspection: Inspection) -> dict[str, Any] | None:
    if inspection.target is None:
        return None
    target = inspection.target.target
    fields = {"type": target.type, "targets": target.plain()} if isinstance(target, Scene) else target.plain()
    return fields | {"file": inspection.target.file}


def _plain(value: Any) -> dict[str, Any]:
    """The fields of a dataclass, arrays as lists; {} for None."""
    if value is None:
        return {}
    return {k: v.tolist() if isinstance(v, np.ndarray) else v for k, v in dataclasses.asdict(value).items()}
