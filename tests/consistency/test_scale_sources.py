"""What shows how long a metre is: named where it is one source alone, and where two contradict each other."""

from __future__ import annotations

import re
from collections.abc import Callable
from dataclasses import replace
from types import ModuleType

import numpy as np
import pytest
from tests.remarks import named, names

from icalib.pipeline import calibrate_measurements
from icalib.result import Calibration
from icalib.rig import Parameter
from icalib.sensors.pose.simulate import SimPoses
from icalib.sensors.wheels.simulate import SimWheels
from icalib.tools.simulation import Scenario, handheld, simulate

OFF = 1.03  # true over stated lengths


@pytest.fixture(scope="module")
def program(benchmark_program: Callable[[str], ModuleType]) -> ModuleType:
    return benchmark_program("effects")


def stereo() -> Scenario:
    scenario = handheld(6.0)
    return replace(scenario, cameras=tuple(replace(c, time_offset_s=0.0, rate_hz=4.0) for c in scenario.cameras))


def mocap() -> Scenario:
    scenario = handheld(6.0)
    cameras = tuple(replace(c, rate_hz=10.0) for c in scenario.cameras[:1])
    return replace(scenario, cameras=cameras, sensors=(SimPoses("mocap0", np.eye(4), rate_hz=50.0),))


def calibrated(
    program: ModuleType, scenario: Scenario, *, imu: bool = False, wheels_known: bool = False
) -> Calibration:
    """With default priors, lenses known. A target of another size than stated, or if there is none poses of another
    scale."""
    wrong = replace(scenario, target_size=OFF)
    if not scenario.board:
        wrong = scenario.with_sensors(*(replace(p, scale=OFF) for p in scenario.of(SimPoses)))
    rig = program.rig_of(wrong, program.Kind(lambda: wrong, imu, (), "fixed"))
    if wheels_known:
        radii = Parameter("fixed", np.array(scenario.of(SimWheels)[0].radii))
        rig = rig.with_(wheels=tuple(replace(w, radii=radii) for w in rig.wheels))
    measured = simulate(wrong, 1).measurements
    return calibrate_measurements(rig, measured if imu else measured.without("imu0"))


@pytest.mark.parametrize(
    ("make", "source"),
    [
        (lambda _: stereo(), "the size of the target alone: 1 % error there is 1 % in every length here"),
        pytest.param(
            lambda p: p.camera_wheels(),
            "the size of the target alone: .* every length here",
            marks=pytest.mark.full,
        ),
        (lambda p: p.wheels_poses_imu(), "the positions of mocap0 alone: .* every length here"),
    ],
)
def test_one_source_alone_is_named(program: ModuleType, make: Callable[[ModuleType], Scenario], source: str):
    """Nothing shows that it is wrong."""
    found = calibrated(program, make(program))
    assert not found.wrong and not found.warnings
    assert re.search(f"from {source}", named("scale_from_one_source", found.notes)), found.notes


@pytest.mark.parametrize(
    ("make", "how", "both"),
    [
        (lambda _: mocap(), {}, "the size of the target and the positions of mocap0"),
        pytest.param(
            lambda p: p.camera_wheels(),
            {"wheels_known": True},
            "the size of the target and the stated sizes of wheel0",
            marks=pytest.mark.full,
        ),
        (lambda p: p.poses_imu(), {"imu": True}, "the positions of mocap0 and the accelerometer"),
    ],
)
def test_two_that_contradict_each_other_are_named(
    program: ModuleType, make: Callable[[ModuleType], Scenario], how: dict[str, bool], both: str
):
    found = calibrated(program, make(program), **how)
    assert found.verdict == "not usable"
    assert found.reasons[0].name == "lengths_contradict" and found.reasons[0].startswith(f"{both} contradict")


def test_lengths_that_agree_are_no_reason(program: ModuleType):
    scenario = mocap()
    rig = program.rig_of(scenario, program.Kind(mocap, False, (), "fixed"))
    found = calibrate_measurements(rig, simulate(scenario, 1).measurements.without("imu0"))
    assert not found.wrong
    assert "scale_from_one_source" not in names(found.notes)
