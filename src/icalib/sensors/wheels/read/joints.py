"""Joints of a robot, in arrays."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from icalib.data.messages.streams import HasMessages, all_messages
from icalib.errors import RecordingError


@dataclass(frozen=True)
class JointStream:
    """Joints by name: stamps_ns (N,) int64; position [rad or m], velocity, effort (N, names), NaN where not sent."""

    names: tuple[str, ...]
    stamps_ns: np.ndarray
    position: np.ndarray
    velocity: np.ndarray
    effort: np.ndarray


def read_joints(bag: HasMessages, topic: str) -> JointStream:
    """All JointState of `topic`; a message may name some of the joints only. Raises RecordingError as
    `BagRecording.messages`, and for an array that is not as long as the names."""
    stamps_ns, found = all_messages(bag, topic, "joints")
    names = tuple(dict.fromkeys(name for m in found for name in m.name))
    column = {name: k for k, name in enumerate(names)}
    values = np.full((3, len(found), len(names)), np.nan)
    for row, m in enumerate(found):
        there = [column[name] for name in m.name]
        for quantity, array in enumerate((m.position, m.velocity, m.effort)):
            if len(array) not in (0, len(there)):
                raise RecordingError(
                    f"{bag.root} {topic}: the message at {stamps_ns[row]} ns has {len(there)} joints, but "
                    f"{len(array)} values; correct the driver."
                )
            if len(array):
                values[quantity, row, there] = array
    return JointStream(names, stamps_ns, *values)
