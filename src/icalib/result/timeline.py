"""The clock of a result: recordings follow one another with a pause of `PAUSE_S` between them."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from icalib.data.joining import Part
from icalib.result import RecordingSpan

PAUSE_S = 1.0


@dataclass(frozen=True)
class Timeline:
    """Conversion from the joined clock of the estimator to the clock of the result. parts, spans: the n recordings on
    the first and on the second. shift (n,): added to the times of each recording [s]."""

    parts: tuple[Part, ...]
    spans: tuple[RecordingSpan, ...]
    shift: np.ndarray

    @classmethod
    def of(cls, parts: tuple[Part, ...], image_times: Mapping[str, np.ndarray], body: str) -> Timeline:
        """Timeline of recordings `parts`. image_times: times of images on the joined clock [s], by the key of their
        stream. body: name of the sensor that defines the joined clock."""
        spans, shift = [], np.zeros(len(parts))
        for k, part in enumerate(parts):
            first, last = _extent(part, image_times, body)
            shift[k] = spans[-1].end + PAUSE_S - first if spans else 0.0
            origin_ns = part.measurements.origin_ns + round(1e9 * (first - part.begin))
            spans.append(RecordingSpan(part.name, first + shift[k], last + shift[k], origin_ns))
        return cls(parts, tuple(spans), shift)

    def on_result_clock(self, seconds: np.ndarray, recording: np.ndarray) -> np.ndarray:
        """(n,) times on the clock of the result, from times (n,) on the joined clock and recording indices (n,) [s]."""
        return seconds + self.shift[recording]

    def recordings_of(self, stream: str) -> np.ndarray:
        """(N,) index of the recording of each stamp of the stream with the key `stream`."""
        counts = [p.rows[stream].stop - p.rows[stream].start for p in self.parts]
        return np.repeat(np.arange(len(counts)), counts)

    def recording_of(self, seconds: np.ndarray) -> np.ndarray:
        """(n,) index of the recording in which each of `seconds` (n,) on the joined clock lies. The body sensor must
        have been running at these times."""
        return np.searchsorted([p.begin for p in self.parts[1:]], seconds, side="right")

    def words(self, second: float) -> str:
        """Text for an instant on the joined clock [s]: seconds since the start of its recording (the nearest image if
        it has no clock), and the name of that if there are several. The body sensor must have been running."""
        part = self.parts[int(self.recording_of(np.array(second)))]
        m, since = part.measurements, second - part.begin
        text = f"{since:.3f} s" if m.has_clock else f"image {m.cameras[0].nearest(since)}"
        return text if len(self.parts) == 1 else f"{text} of {part.name}"

    @property
    def can_be_cut(self) -> bool:
        """Whether --from and --to select a part: there is one recording, and it has a clock."""
        return len(self.parts) == 1 and self.parts[0].measurements.has_clock


def _extent(part: Part, image_times: Mapping[str, np.ndarray], body: str) -> tuple[float, float]:
    """Times of the first and the last measurement of a recording, on the joined clock [s]."""
    images = [times[part.rows[key]] for key, times in image_times.items()]
    if not images or part.measurements.imu is not None:  # else the clock is that of a camera
        images.append(part.begin + part.measurements.streams[body].seconds)
    times = np.concatenate(images)
    return float(times.min()), float(times.max())
