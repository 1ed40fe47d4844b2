"""Joint states of a robot as arrays."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from icalib.data.messages import HasMessages, all_messages
from icalib.errors import RecordingError


@dataclass(frozen=True)
class JointStream:
    """Joint states: stamps_ns (N,) int64; position [rad or m], velocity, effort (N, joints), NaN where not sent;
    columns in the order of `names`."""

    names: tuple[str, ...]
    stamps_ns: np.ndarray
    position: np.ndarray
    velocity: np.ndarray
    effort: np.ndarray


def read_joints(bag: HasMessages, topic: str) -> JointStream:
    """All JointState messages of `topic`; a message may contain only some of the joints. Raises RecordingError as
    `BagRecording.messages`, and for an array whose length differs from that of the names."""
    stamps_ns, messages = all_messages(bag, topic, "joints")
    names = tuple(dict.fromkeys(name for m in messages for name in m.name))
    column = {name: k for k, name in enumerate(names)}
    values = np.full((3, len(messages), len(names)), np.nan)
    for row, m in enumerate(messages):
        columns = [column[name] for name in m.name]
        for quantity, array in enumerate((m.position, m.velocity, m.effort)):
            if len(array) not in (0, len(columns)):
                raise RecordingError(
                    f"{bag.root} {topic}: the message at {stamps_ns[row]} ns has {len(columns)} joints, but "
                    f"{len(array)} values; correct the driver."
                )
            if len(array):
                values[quantity, row, columns] = array
    return JointStream(names, stamps_ns, *values)
