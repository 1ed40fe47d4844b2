"""Clocks that run at another rate than that of the IMU, one sensor of each kind."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from tests.consistency.cases import Case, Check, Run, known, parameters, planes_found
from tests.consistency.recordings import T_IMU_MOCAP, make_robot
from tests.remarks import names

from icalib.pipeline import calibrate_measurements
from icalib.rig import Parameter, Rig
from icalib.sensors.pose.simulate import SimPoses
from icalib.sensors.position.simulate import SimPositions
from icalib.tools.simulation import Scenario, Simulation, handheld, rig_for, simulate

RATE_PPM = 100.0
PARTS = ("rotation", "translation", "time_offset")


def drifting(scenario: Scenario, ppm: float = RATE_PPM, first: int = 0) -> Scenario:
    """Clocks run fast and slow in turn, from the sensor number `first` on."""
    mounted = [*scenario.cameras, *scenario.sensors]
    signs = [0.0 if k < first else (-1.0) ** k for k in range(len(mounted))]
    moved = [replace(s, clock_rate_ppm=sign * ppm) for s, sign in zip(mounted, signs, strict=True)]
    n = len(scenario.cameras)
    return replace(scenario, cameras=tuple(moved[:n]), sensors=tuple(moved[n:]))


def by_hand(*sensors: SimPoses | SimPositions, seconds: float = 20.0, cameras: int = 0) -> Scenario:
    scenario = handheld(seconds)
    return replace(scenario, cameras=scenario.cameras[:cameras], sensors=sensors)


POSES = SimPoses("mocap0", T_IMU_MOCAP, rotation_noise=1e-3, position_noise=5e-4, rate_hz=100.0)
FIXES = SimPositions("gnss0", T_IMU_MOCAP, position_noise=5e-3, rate_hz=10.0)


def rates_free(simulation: Simulation) -> Rig:
    rig = rig_for(simulation.scenario)
    return rig.with_sensors(*(replace(s, clock_rate=Parameter()) for s in rig.mounted))


def rates_within(ppm: float, *sensors: str) -> Check:
    """The rates of the `sensors` have standard deviations below `ppm`, and notes if they are clear."""

    def check(run: Run) -> None:
        for sensor in sensors:
            assert run.result.std(sensor, "clock_rate")[0] < ppm, run.result.std(sensor, "clock_rate")
        assert names(run.result.notes).count("clock_rate_estimated") == len(sensors) * (5.0 * ppm < RATE_PPM)
        assert not {"clock_drifts", "residuals_unexplained"} & {*names(run.result.reasons)}

    return check


def with_segments(simulation: Simulation) -> Rig:
    rig = rig_for(simulation.scenario)
    return replace(rig, settings=replace(rig.settings, segments=8))


def rates_are_estimated(run: Run) -> None:
    for sensor in ("cam0", "lidar0", "wheel0"):
        rate = run.result.group(sensor, "clock_rate")
        assert rate.std[0] < 30.0 and abs(abs(rate.value[0]) - RATE_PPM) < 4.0 * rate.std[0]


def no_rates(run: Run) -> None:
    assert all(g.mode == "fixed" for g in run.result.groups if g.name == "clock_rate")


CASES: dict[str, Case] = {
    "camera, LiDAR and wheels": Case(
        lambda: simulate(drifting(make_robot("3d", 20.0, "clw")), 0),
        [known(), rates_within(19.0, "cam0", "lidar0", "wheel0")],
        rates_free,
        planes_found,
    ),
    "poses, whose rate the recording shows": Case(
        lambda: simulate(drifting(by_hand(POSES)), 1), [known(), rates_within(10.0, "mocap0")], with_segments
    ),
    "camera, LiDAR and wheels, whose rates the recording shows": Case(
        lambda: simulate(drifting(make_robot("3d", 20.0, "clw")), 0),
        [known(), rates_are_estimated],
        with_segments,
        planes_found,
        full=True,
    ),
    "no clock drifts": Case(
        lambda: simulate(make_robot("3d", 20.0, "clw"), 0), [known(), no_rates], with_segments, planes_found, full=True
    ),
    "poses": Case(lambda: simulate(drifting(by_hand(POSES)), 1), [known(), rates_within(10.0, "mocap0")], rates_free),
    "positions": Case(
        lambda: simulate(drifting(by_hand(FIXES, seconds=40.0)), 2), [known(), rates_within(40.0, "gnss0")], rates_free
    ),
}


@pytest.mark.parametrize("case", parameters(CASES))
def test_a_case(case: Case) -> None:
    case.verify()


def test_standard_deviations_are_those_with_a_known_rate() -> None:
    """To a factor of 1.5, of all that is asked for."""
    simulation = simulate(drifting(handheld(12.0)), 3)
    free, held = rates_free(simulation), rig_for(simulation.scenario)
    rates = (Parameter("fixed", simulation.truth.values[c.name]["clock_rate"]) for c in held.cameras)
    held = held.with_(cameras=tuple(replace(c, clock_rate=r) for c, r in zip(held.cameras, rates, strict=True)))
    a, b = (calibrate_measurements(rig, simulation.measurements) for rig in (free, held))
    for sensor in ("cam0", "cam1"):
        for part in PARTS:
            assert (a.std(sensor, part) < 1.5 * b.std(sensor, part)).all()
            np.testing.assert_allclose(a.value(sensor, part), b.value(sensor, part), atol=3e-4)


def test_without_noise_rates_are_exact_to_their_prior() -> None:
    """Each prior of 0 +- 50 ppm pulls by the squared ratio of the standard deviations; the cameras share errors."""
    simulation = simulate(drifting(handheld(12.0, noiseless=True), 20.0), 4)
    result = calibrate_measurements(rates_free(simulation), simulation.measurements)
    for sensor in ("cam0", "cam1"):
        rate, std = result.value(sensor, "clock_rate")[0], result.std(sensor, "clock_rate")[0]
        true = simulation.truth.values[sensor]["clock_rate"][0]
        assert abs(rate - true) < 3.0 * abs(true) * (std / 50.0) ** 2


def test_a_clock_drifts_from_one_recording_to_the_next() -> None:
    """The second recording begins a minute after the first, on the same clocks."""
    pause_s, rate, seconds = 60.0, 40.0, 8.0
    first, second = (simulate(drifting(handheld(seconds), rate), seed) for seed in (5, 6))
    later = []
    for name, stream in second.measurements.streams.items():
        pace = 1.0 + 1e-6 * float(second.truth.values[name].get("clock_rate", np.zeros(1))[0])
        later.append(replace(stream, stamps_ns=stream.stamps_ns + round(1e9 * pause_s / pace)))
    both = [first.measurements, second.measurements.with_streams(*later)]
    result = calibrate_measurements(rates_free(first), both)
    for sensor in ("cam0", "cam1"):
        true = first.truth.values[sensor]
        middle = true["time_offset"] + 1e-6 * true["clock_rate"] * 0.5 * pause_s
        for name, value in (("clock_rate", true["clock_rate"]), ("time_offset", middle)):
            off = result.value(sensor, name) - value
            assert (np.abs(off) < 4.0 * result.group(sensor, name).std_formal).all(), (sensor, name, off)
        assert result.std(sensor, "clock_rate")[0] < 0.5
