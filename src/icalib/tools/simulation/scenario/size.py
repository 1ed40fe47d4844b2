"""Refuses scenarios whose measurements do not fit in memory: the simulator keeps all of them."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from math import ceil

from icalib.errors import RigError
from icalib.tools.simulation.scenario.scenario import Scenario

# Limits for all sensors together. Each corresponds to about 1 GB with intermediate arrays; memory is proportional.
MOST_INSTANTS = 5_000_000  # readings, images and scans: an IMU at 200 Hz for 7 h
MOST_POINTS = 100_000_000  # corners, tracked points and points of scans: 16 rings of 1800 steps at 8 Hz for 7 min
_LARGEST_COUNT = 1e18  # larger counts are clipped, so that products stay finite


@dataclass(frozen=True)
class _Rate:
    """Amount of measurements of a sensor. rate_hz: measurements per second; count: points per measurement; instants,
    points: nouns for the two in messages."""

    name: str
    rate_hz: float
    instants: str
    count: int = 0
    points: str = "points"


def refuse_large(scenario: Scenario) -> None:
    """Raises RigError, naming the largest sensor, if all sensors together exceed `MOST_INSTANTS` or `MOST_POINTS`."""
    rates = list(_rates(scenario))
    instants = [min(r.rate_hz * scenario.duration_s, _LARGEST_COUNT) for r in rates]
    points = [n * r.count for n, r in zip(instants, rates, strict=True)]
    _refuse(instants, [(r.name, r.instants) for r in rates], "readings, images and scans", MOST_INSTANTS)
    _refuse(points, [(r.name, r.points) for r in rates], "corners and points", MOST_POINTS)


def _refuse(counts: list[float], names: list[tuple[str, str]], of_all: str, most: int) -> None:
    """Raises RigError if the sum of `counts` exceeds `most`. counts: of each sensor; names: its name, and the noun for
    what is counted; of_all: noun for all sensors."""
    total = sum(counts)
    if total <= most:
        return
    count, (name, what) = max(zip(counts, names, strict=True))
    if count > most:
        sentence = f"{name} would measure {_words(count)} {what}"
    else:
        sentence = f"the sensors would measure {_words(total)} {of_all} together, {name} {_words(count)} of them"
    raise RigError(f"{sentence}, and {most:,} are the most that are simulated; lower its rate, or the duration.")


def _words(count: float) -> str:
    """The count as text, with all digits below 1e9: rounded, counts near a limit would look equal to it."""
    return f"{ceil(count):,}" if count < 1e9 else f"{count:.2g}"


def _rates(scenario: Scenario) -> Iterator[_Rate]:
    yield _Rate("imu0", scenario.imu_rate_hz, "readings")
    corners = len(scenario.target.points) if scenario.board else 0
    tracked = scenario.features.per_image if scenario.features else 0
    for camera in scenario.cameras:
        yield _Rate(camera.name, camera.rate_hz, "images", corners + tracked, "corners and points")
    for sensor in scenario.sensors:
        yield _Rate(sensor.name, sensor.rate_hz, sensor.measures, sensor.points)
