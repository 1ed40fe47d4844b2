"""The clock of a result: recordings one after another with a second between them, whatever their own clocks show."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from icalib.data.joining import Part
from icalib.result import RecordingSpan

PAUSE_S = 1.0


@dataclass(frozen=True)
class Timeline:
    """The recordings on the joined clock of the estimate and on the clock of the result. moved (n,): what to add to
    times of the first to get those of the second [s], by recording."""

    parts: tuple[Part, ...]
    spans: tuple[RecordingSpan, ...]
    moved: np.ndarray

    @classmethod
    def of(cls, parts: tuple[Part, ...], image_times: list[np.ndarray], body: str) -> Timeline:
        """image_times: of each camera's images, on the joined clock. body: the sensor whose clock that is."""
        spans, moved = [], np.zeros(len(parts))
        for k, part in enumerate(parts):
            first, last = _extent(part, image_times, body)
            moved[k] = spans[-1].end + PAUSE_S - first if spans else 0.0
            origin_ns = part.measurements.origin_ns + round(1e9 * (first - part.begin))
            spans.append(RecordingSpan(part.name, first + moved[k], last + moved[k], origin_ns))
        return cls(parts, tuple(spans), moved)

    def shown(self, seconds: np.ndarray, recording: np.ndarray) -> np.ndarray:
        """(n,) times of the result from joined times (n,) of the recordings (n,) [s]."""
        return seconds + self.moved[recording]

    def recordings_of(self, stream: str) -> np.ndarray:
        """(N,) the recording of each stamp of a stream, given by its key."""
        counts = [p.own[stream].stop - p.own[stream].start for p in self.parts]
        return np.repeat(np.arange(len(counts)), counts)

    def recording_of(self, seconds: np.ndarray) -> np.ndarray:
        """(n,) the recording that each of the joined seconds lies in, at all of which the IMU was running."""
        return np.searchsorted([p.begin for p in self.parts[1:]], seconds, side="right")

    def words(self, second: float) -> str:
        """Name of an instant of the joined clock in a sentence. The IMU must have been running."""
        k = int(self.recording_of(np.array(second)))
        own = f"{second - self.parts[k].begin:.3f} s"
        return own if len(self.parts) == 1 else f"{own} of {self.parts[k].name}"


def _extent(part: Part, image_times: list[np.ndarray], body: str) -> tuple[float, float]:
    """The first and the last instant of a recording at which anything was measured, on the joined clock."""
    own = [part.own[c.key] for c in part.measurements.cameras]
    images = [t[rows] for t, rows in zip(image_times, own, strict=True)]
    if not images or part.measurements.imu is not None:  # else the clock is that of a camera
        images.append(part.begin + part.measurements.streams[body].seconds)
    times = np.concatenate(images)
    return float(times.min()), float(times.max())
