"""One point and one scan in a hundred are wrong: no result moves by more than one of its standard deviations."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from icalib.data.measurements import LidarStream
from icalib.geometry import so3
from icalib.pipeline import calibrate_measurements
from icalib.result import Calibration
from icalib.rig import Lidar
from icalib.sensors.lidar.read import in_seconds
from icalib.sensors.lidar.read.point_clouds import Sieve, checked_lidar, sifted
from icalib.sensors.lidar.read.point_times import selected
from icalib.tools.simulation import Simulation, rig_for, simulate

RNG = np.random.default_rng(0)


@pytest.fixture(scope="module")
def drive(robot) -> Simulation:
    """A LiDAR and an IMU."""
    return simulate(robot("3d", 13.0, "l", 200), 1)


def damaged(lidar: LidarStream) -> LidarStream:
    """A third of a per cent of the points has a time that ran below zero, a third one of another scan, a third lies
    anywhere; one scan is early, one late, one of another year, one comes after the next, two come twice."""
    x = replace(lidar, stamps_ns=lidar.stamps_ns.copy(), offset_s=lidar.offset_s.copy(), xyz=lidar.xyz.copy())
    kind = RNG.integers(0, 300, len(x.xyz))
    x.offset_s[kind == 0] += np.float32(4.2949)
    x.offset_s[kind == 1] += RNG.uniform(-0.1, 0.1, int((kind == 1).sum())).astype(np.float32)
    x.xyz[kind == 2] = RNG.uniform(-6.0, 6.0, (int((kind == 2).sum()), 3))
    x.stamps_ns[[30, 75, 100]] += np.array([-30_000_000, 25_000_000, 10**17])
    order = np.insert(np.arange(len(x.stamps_ns)), [12, 90], [11, 88])
    order[[50, 51]] = order[[51, 50]]
    return selected(x, order)


def calibrated(simulation: Simulation, lidar: LidarStream) -> tuple[Calibration, tuple[str, ...]]:
    """From what a reader makes of the scans, of which nobody knows what lies on which plane."""
    sensor = Lidar("lidar0", "")
    stream, _ = in_seconds(lidar.unassociated(), sensor, "here")
    stream, notes = checked_lidar(sifted(stream, Sieve(sensor.min_range_m, sensor.max_range_m)), "here")
    measurements = simulation.measurements.with_streams(stream)
    return calibrate_measurements(rig_for(simulation.scenario), measurements), notes


def test_no_result_moves_by_a_standard_deviation(drive):
    """Four of 103 scans are more than one in a hundred."""
    lidar = drive.measurements.lidars[0]
    own = replace(lidar, offset_s=lidar.offset_s.copy(), xyz=lidar.xyz.copy(), plane=lidar.plane.copy())
    (clean, nothing), (found, notes) = calibrated(drive, own), calibrated(drive, damaged(lidar))
    assert nothing == ()
    assert [n.split("scans ")[1].split(",")[0] for n in notes] == [
        "that repeat an earlier one exactly were dropped",
        "are out of order",
        "have a stamp that does not fit their neighbours' and were removed",
        "are stamped more than 5% of a period too early or too late relative to their neighbours and were removed",
    ]
    for a, b in zip(clean.groups, found.groups, strict=True):
        if a.sensor != "lidar0":
            continue
        moved = so3.log(a.value.T @ b.value) if a.name == "rotation" else b.value - a.value
        assert (np.abs(moved) < a.std).all(), (a.name, moved / a.std)
        np.testing.assert_allclose(b.std, a.std, rtol=0.1)
