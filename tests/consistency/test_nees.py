"""The formal covariance is honest: mean NEES of every block inside its chi^2 bounds, over many simulated recordings."""

from __future__ import annotations

from typing import Literal

import pytest

from icalib.tools.simulation import handheld, rig_for

ImuQuality = Literal["datasheet", "noisy"]
CONFIGURATIONS = [(a, i) for a in (False, True) for i in ("datasheet", "noisy")]


def check(consistency, asynchronous: bool, imu: ImuQuality, seeds: range, probability: float) -> None:
    scenario = handheld(12.0, asynchronous=asynchronous, imu=imu)
    rig = rig_for(scenario, intrinsics="start", distortion="start")
    found = consistency(scenario, rig, seeds, probability)
    print({block: (round(c.mean, 3), round(c.low, 3), round(c.high, 3)) for block, c in found.items()})
    assert {block: c for block, c in found.items() if not c.consistent} == {}


@pytest.mark.parametrize(("asynchronous", "imu"), [(False, "datasheet"), (True, "noisy")])
def test_a_few_recordings(consistency, asynchronous: bool, imu: ImuQuality):
    # So few seeds that only a gross fault shows; the bounds are wide so that chance has no part in it.
    check(consistency, asynchronous, imu, range(6), 0.9999)


@pytest.mark.full
@pytest.mark.parametrize(("asynchronous", "imu"), CONFIGURATIONS)
def test_fifty_recordings(consistency, asynchronous: bool, imu: ImuQuality):
    check(consistency, asynchronous, imu, range(50), 0.95)
