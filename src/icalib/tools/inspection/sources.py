"""Finds the topics that are sensors, and names the sensors."""

from __future__ import annotations

import re
from collections.abc import Sequence

from icalib.data.recordings import TopicInfo
from icalib.tools.inspection.facts import Sources
from icalib.tools.inspection.kinds import Key, inspectors

_UNNAMEABLE = re.compile(r"[^A-Za-z0-9_-]+")


def find_sources(topics: Sequence[TopicInfo]) -> Sources:
    """The sensors among the topics with messages, each under a unique name derived from its topic."""
    filled = [t for t in topics if t.count]
    kinds = sorted(inspectors().values(), key=lambda kind: not kind.named_first)
    keyed = [(key, source, kind.prefix) for kind in kinds for key, source in kind.sources(filled)]
    names = _names([(key, prefix) for key, _, prefix in keyed])
    sensors = {name: source for name, (_, source, _) in zip(names, keyed, strict=True)}
    left_out = {topic: why for kind in kinds for topic, why in kind.left_out(filled, sensors).items()}
    return Sources(sensors, left_out)


def _names(sensors: list[tuple[Key, str]]) -> list[str]:
    """Unique names from the last parts of the sensors' keys, as few as make the names differ."""
    longest = max((len(key) for key, _ in sensors), default=1)
    names: list[str] = []
    for length in range(1, longest + 1):
        names = [_name(key[-length:], kind) for key, kind in sensors]
        if len(set(names)) == len(names):
            return names
    return [f"{name}_{k}" if name in names[:k] else name for k, name in enumerate(names)]


def _name(parts: Key, kind: str) -> str:
    name = _UNNAMEABLE.sub("_", "_".join(parts)).strip("_-")
    if not name:
        return f"{kind}0"
    return name if name[0].isalpha() else f"{kind}_{name}"
