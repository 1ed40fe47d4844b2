"""Forward jumps of clocks, such as when GPS or the network sets a clock during the recording.

Stamps before and after a jump are valid, but hours may lie between them. The time offset of a sensor differs before and
after the jump, so only one segment is used. No array may grow with the time that a jump spans.
"""

from __future__ import annotations

from collections.abc import Sequence
from itertools import pairwise

import numpy as np

from icalib.data.stamps.clocks import usual_step
from icalib.data.stamps.sections import S, Stamped, section
from icalib.errors import RecordingError

JUMP_S = 600.0  # a longer step is a jump of the clock, not a pause
LONGEST_S = 6 * 3600.0  # longest calibration: memory grows with the time between first and last stamp
JUMP_STEPS = 1000.0  # a jump also exceeds this many typical steps, so that slow streams may have long pauses
_FARTHEST_NS = 2**62  # largest absolute stamp, so that differences fit in int64


class ClockJumps:
    """Cuts the streams of one recording at clock jumps, and keeps one segment of each.

    The first stream with jumps keeps its longest segment. Streams with the same number of jumps are assumed to share
    its clock, and keep the segment of the same index. notes: sentences on cuts. longest_s: largest permitted length.
    """

    def __init__(self, longest_s: float = np.inf) -> None:
        self.notes: tuple[str, ...] = ()
        self._longest_s = longest_s
        self._kept: dict[int, int] = {}  # which part, by how many there are

    def cut(self, stream: S, what: str) -> S:
        """The kept segment of `stream`; the stream itself if its clock does not jump. what: its name in messages.

        Raises RecordingError for stamps beyond +-2^62 ns, and for a segment longer than `longest_s`.
        """
        _refuse_far(stream.stamps_ns, what)
        cuts = _cuts(stream.stamps_ns)
        parts = list(pairwise(cuts))
        if len(parts) < 2:
            self._refuse_long(stream, what)
            return stream
        longest = int(np.argmax([_seconds(stream, *part) for part in parts]))
        kept = parts[self._kept.setdefault(len(parts), longest)]
        self.notes += (_note(stream, what, cuts, kept),)
        stream = section(stream, *kept)
        self._refuse_long(stream, what)
        return stream

    def _refuse_long(self, stream: Stamped, what: str) -> None:
        if len(stream.stamps_ns) and (length := _seconds(stream, 0, len(stream.stamps_ns))) > self._longest_s:
            raise RecordingError(
                f"{what}: the stamps span {length / 3600.0:.4g} h, and a calibration takes at most "
                f"{self._longest_s / 3600.0:g} h; choose a part with --from and --to."
            )


def longest_part(stamps_ns: np.ndarray) -> tuple[slice, int]:
    """The longest segment without jumps of stamps (N,), and the number of jumps."""
    parts = list(pairwise(_cuts(stamps_ns)))
    best = max(parts, key=lambda part: stamps_ns[part[1] - 1] - stamps_ns[part[0]] if part[1] else 0)
    return slice(*best), len(parts) - 1


def _cuts(stamps_ns: np.ndarray) -> list[int]:
    """Indices at which segments without jumps begin, followed by the number of stamps N."""
    if len(stamps_ns) < 2:
        return [0, len(stamps_ns)]
    limit_ns = max(JUMP_S * 1e9, JUMP_STEPS * usual_step(stamps_ns))
    return [0, *(np.flatnonzero(np.diff(stamps_ns) > limit_ns) + 1).tolist(), len(stamps_ns)]


def _refuse_far(stamps: np.ndarray, what: str) -> None:
    far = (stamps > _FARTHEST_NS) | (stamps < -_FARTHEST_NS)
    if far.any():
        raise RecordingError(
            f"{what}: the stamp {stamps[np.argmax(far)]} ns is more than a hundred years from 1970; correct "
            "the clock, or remove the row."
        )


def _seconds(stream: Stamped, begin: int, end: int) -> float:
    return float(stream.stamps_ns[end - 1] - stream.stamps_ns[begin]) * 1e-9


def _note(stream: Stamped, what: str, cuts: Sequence[int], kept: tuple[int, int]) -> str:
    stamps = stream.stamps_ns
    jump = cuts[1]
    more = f" (and {len(cuts) - 3} more times)" if len(cuts) > 3 else ""
    return (
        f"{what}: the clock jumps forward by {_seconds(stream, jump - 1, jump + 1):.6g} s{more} after the "
        f"stamp {stamps[jump - 1]} ns, {_seconds(stream, 0, jump):.6g} s from the start. Only the "
        f"{_seconds(stream, *kept):.6g} s from {stamps[kept[0]]} ns on are used; choose another part with "
        "--from and --to."
    )
