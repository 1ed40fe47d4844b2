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


def figures(found: Inspection) -> dict[str, Any]:
    """The inspection as dicts, lists, numbers and text. Names of figures that are not in SI units end with the unit."""
    return {
        "recording": found.recording,
        "verdict": found.verdict,
        "findings": [dataclasses.asdict(f) for f in found.findings],
        "topics": [_stream(s) for s in found.streams],
        "cameras": {c.name: _camera(found, c.name) for c in found.sources.cameras},
        "imus": {n: {"topic": t.name} | _plain(found.imus.get(n)) for n, t in found.sources.imus.items()},
        "imu": found.imu,
        "others": {
            n: {"type": s.kind, "topic": s.topic.name} | _plain(found.facts.get(n))
            for n, s in found.sources.others.items()
        },
        "frames": [dataclasses.asdict(f) for f in found.frames],
        "left_out": dict(found.sources.left_out),
        "target": _target(found),
        "notes": list(found.notes),
    }


def figures_json(found: Inspection) -> str:
    """`figures` as the text of a JSON file."""
    return json_text(figures(found)) + "\n"


def _stream(stream: StreamFacts) -> dict[str, Any]:
    """One topic: its entry in the index, and the statistics of its stamps."""
    topic = dataclasses.asdict(stream.topic)
    return topic | {"timing": _plain(stream.timing) or None, "problem": stream.problem}


def _camera(found: Inspection, name: str) -> dict[str, Any]:
    source = next(c for c in found.sources.cameras if c.name == name)
    info = found.infos.get(name)
    view = found.views.get(name)
    return {
        "images": source.images.name if source.images else None,
        "corners": source.corners.name if source.corners else None,
        "others": list(source.others),
        **_plain(found.images.get(name)),
        "overlap_with_imu_s": _overlap(found, source),
        "camera_info": _plain(info) or None,
        "target": (_plain(view) | {"grid": list(GRID)}) if view else None,
    }


def _overlap(found: Inspection, source: CameraSource) -> float | None:
    """Overlap of the stamps of camera and IMU [s]; negative: the gap between them; None without one of the two."""
    camera = found.stream(source.topic).timing
    imu = found.stream(found.sources.imus[found.imu]).timing if found.imu else None
    return overlap_s(camera, imu) if camera and imu else None


def _target(found: Inspection) -> dict[str, Any] | None:
    if found.target is None:
        return None
    target = found.target.target
    fields = {"type": target.type, "targets": target.plain()} if isinstance(target, Scene) else target.plain()
    return fields | {"file": found.target.file}


def _plain(value: Any) -> dict[str, Any]:
    """The fields of a dataclass, arrays as lists; {} for None."""
    if value is None:
        return {}
    return {k: v.tolist() if isinstance(v, np.ndarray) else v for k, v in dataclasses.asdict(value).items()}
