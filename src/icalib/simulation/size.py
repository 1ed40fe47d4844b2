"""Refuses scenarios that measure more than fits in memory: the simulator holds all readings at once."""

from __future__ import annotations

from collections.abc import Iterator

from icalib.errors import RigError
from icalib.simulation.scenario import Scenario

# Of each sensor. Either takes about 1 GB with intermediate arrays; twice the number takes twice the memory.
MOST_INSTANTS = 5_000_000  # readings, images or scans: an IMU at 200 Hz for 7 h
MOST_POINTS = 100_000_000  # corners, tracked points or LiDAR points: 16 rings of 1800 steps at 8 Hz for 7 min
_LARGEST_COUNT = 1e18  # larger ones are cut to it, so that products stay finite


def refuse_large(scenario: Scenario) -> None:
    """Raises RigError, naming the sensor, where one measures more than `MOST_INSTANTS` or `MOST_POINTS`."""
    for name, what, rate_hz, points in _rates(scenario):
        instants = min(rate_hz * scenario.duration_s, _LARGEST_COUNT)
        if instants > MOST_INSTANTS or instants * points > MOST_POINTS:
            count, most = (instants * points, MOST_POINTS) if points > 1 else (instants, MOST_INSTANTS)
            raise RigError(
                f"{name} would measure {count:.2g} {what}, and {most:.0e} are the most that are simulated; lower its "
                "rate, or the duration."
            )


def _rates(scenario: Scenario) -> Iterator[tuple[str, str, float, int]]:
    """For each sensor: its name, what it measures, its rate [Hz], and how many points it measures at an instant."""
    yield "imu0", "readings", scenario.imu_rate_hz, 1
    corners = len(scenario.target.points) if scenario.board else 1
    for camera in scenario.cameras:
        tracked = scenario.features.per_image if scenario.features else 1
        yield camera.name, "corners and points", camera.rate_hz, max(corners, tracked)
    for lidar in scenario.lidars:
        yield lidar.name, "points", lidar.rate_hz, lidar.rings * lidar.azimuth_steps
    for sensor in (*scenario.wheels, *scenario.poses):
        yield sensor.name, "readings", sensor.rate_hz, 1
