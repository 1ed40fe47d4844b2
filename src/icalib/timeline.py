"""The clock of a result: recordings one after another with a second between them, whatever their own clocks say."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from icalib.calibration import RecordingSpan
from icalib.joining import Part
from icalib.measurements import Measurements

PAUSE_S = 1.0


@dataclass(frozen=True)
class Timeline:
    """Where recordings stand on the joined clock that was estimated on, and in the result."""

    parts: tuple[Part, ...]
    spans: tuple[RecordingSpan, ...]

    @classmethod
    def of(cls, parts: tuple[Part, ...]) -> Timeline:
        spans, start = [], 0.0
        for part in parts:
            end = start + _length(part.measurements)
            spans.append(RecordingSpan(part.name, start, end, part.measurements.origin_ns))
            start = end + PAUSE_S
        return cls(parts, tuple(spans))

    def shown(self, seconds: np.ndarray, recording: np.ndarray) -> np.ndarray:
        """(n,) seconds of the result from joined ones, each of a recording (n,)."""
        moved = np.array([s.start - p.begin for s, p in zip(self.spans, self.parts, strict=True)])
        return seconds + moved[recording]

    def of_images(self, camera: int) -> np.ndarray:
        """(M,) the recording of each image of a camera, given by its number."""
        counts = [p.images[camera].stop - p.images[camera].start for p in self.parts]
        return np.repeat(np.arange(len(counts)), counts)

    def words(self, second: float) -> str:
        """How a sentence names an instant of the joined clock at which the IMU was running."""
        k = int(np.searchsorted([p.begin for p in self.parts[1:]], second, side="right"))
        own = f"{second - self.parts[k].begin:.3f} s"
        return own if len(self.parts) == 1 else f"{own} of {self.parts[k].name}"


def _length(measurements: Measurements) -> float:
    """Seconds from the first stamp of the body's clock to its last; without an IMU to the last image of any camera."""
    if measurements.imu is not None:
        return float(measurements.imu.seconds[-1])
    return max(float(c.seconds[-1]) for c in measurements.cameras)
