"""How much a scenario measures: everything is held in memory at once."""

from __future__ import annotations

from collections.abc import Iterator

from icalib.errors import RigError
from icalib.simulation.scenario import Scenario

# Numbers of a sensor that are held: 1 GB or so with what is made on the way. Doubled, so is the memory.
MOST_INSTANTS = 5_000_000  # an IMU at 200 Hz for 7 h
MOST_POINTS = 100_000_000  # a LiDAR of 16 rings and 1800 steps at 8 Hz for 7 min
_OFTEN = 1e18  # beyond, numbers are no counts any more


def refuse_large(scenario: Scenario) -> None:
    """Raises RigError where a sensor measures more than is to be held in memory."""
    for name, what, rate_hz, each in _rates(scenario):
        instants = min(rate_hz * scenario.duration_s, _OFTEN)
        if instants > MOST_INSTANTS or instants * each > MOST_POINTS:
            count, most = (instants * each, MOST_POINTS) if each > 1 else (instants, MOST_INSTANTS)
            raise RigError(
                f"{name} would measure {count:.2g} {what}, and {most:.0e} are the most that are simulated; lower its "
                "rate, or the duration."
            )


def _rates(scenario: Scenario) -> Iterator[tuple[str, str, float, int]]:
    """Of each sensor its name, what it measures, how often [Hz], and how many of these at once."""
    yield "imu0", "readings", scenario.imu_rate_hz, 1
    corners = len(scenario.target.points) if scenario.board else 1
    for camera in scenario.cameras:
        tracked = scenario.features.per_image if scenario.features else 1
        yield camera.name, "corners and points", camera.rate_hz, max(corners, tracked)
    for lidar in scenario.lidars:
        yield lidar.name, "points", lidar.rate_hz, lidar.rings * lidar.azimuth_steps
    for sensor in (*scenario.wheels, *scenario.poses):
        yield sensor.name, "readings", sensor.rate_hz, 1
