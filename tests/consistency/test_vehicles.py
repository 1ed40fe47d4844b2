"""Wheels beside a camera, a pose sensor or both, with and without an IMU: on hills, on a flat floor, on a line."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scipy.stats import chi2
from tests.consistency.cases import (
    Case,
    Run,
    body_is,
    fits,
    have,
    heights_at_the_guess,
    is_silent_on,
    is_usable,
    known,
    leaves_open,
    no_imu,
    notes,
    parameters,
    roll_at_the_guess,
    std_below,
    warns,
)
from tests.consistency.recordings import (
    MOUNTS,
    PAPER,
    T_OTHER,
    ideal_imu,
    make_robot,
    mocap,
    moving,
    reporting,
    steady,
    without_imu,
)
from tests.typed import not_none

from icalib.data.measurements import PoseStream
from icalib.export.formats import write_outputs
from icalib.initialize.assumed_motion import _with_rate
from icalib.pipeline import calibrate_measurements
from icalib.result import load_calibration
from icalib.rig import Ground, Rig
from icalib.sensors.camera.initialize.target_with_imu import initial_guess
from icalib.sensors.wheels.simulate import SimWheels
from icalib.tools.simulation import Scenario, Simulation, load_scenario, rig_for, simulate, with_drawn_guess

HEIGHT_M = 2e-3  # of what was measured of the floor
LEVEL = Ground("level", 5e-3, 0.0, HEIGHT_M, 2e-3)
RADII = "wheel0.radii"


def beside_mocap(example: str, seconds: float = 20.0) -> Scenario:
    return make_robot(example, seconds, "w").with_sensors(mocap())


def following(example: str) -> Scenario:
    """A camera that follows points, and wheels."""
    scenario = load_scenario(PAPER / f"table2-{example}.yaml")
    cameras = tuple(replace(c, corner_noise_px=0.5) for c in scenario.cameras[:1])
    return replace(scenario, duration_s=15.0, cameras=cameras, sensors=scenario.of(SimWheels))


def following_beside_mocap() -> Simulation:
    scenario = load_scenario(PAPER / "table2-3d.yaml")
    camera = replace(scenario.cameras[0], corner_noise_px=0.3)
    return ideal_imu(replace(scenario, duration_s=8.0, cameras=(camera,), sensors=(mocap(),)))


def sliding(degrees: float) -> Scenario:
    scenario = make_robot("ramp", 30.0, "cw")
    return replace(scenario, motion=replace(scenario.motion, sideslip_deg=degrees))


def two_mocaps(**second) -> Scenario:
    return make_robot("3d", 12.0, "").with_sensors(mocap("slam0", T_OTHER, **second), mocap())


POOR = {"rotation_noise": 0.01, "position_noise": 0.01, "time_offset_s": -0.02, "rate_hz": 30.0}


# Rig files.


def alone(simulation: Simulation) -> Rig:
    return rig_for(simulation.scenario).with_(imu=None)


def alone_with_free_lens(simulation: Simulation) -> Rig:
    return rig_for(simulation.scenario, intrinsics="free", distortion="free").with_(imu=None)


def sizes(treated: str) -> Callable[[Simulation], Rig]:
    """Of the camera nothing is known; radii and baseline are free, fixed, or guessed."""

    def rig(simulation: Simulation) -> Rig:
        modes = {"intrinsics": "free", "distortion": "free", "radii": treated, "baseline": treated}
        return rig_for(simulation.scenario, **modes).with_(imu=None)  # pyright: ignore[reportArgumentType]

    return rig


def scales_with_priors(simulation: Simulation) -> Rig:
    rig = alone(simulation)
    poses = tuple(replace(p, scale_sigma=1e-3) for p in rig.poses)
    return steady(rig.with_(target=replace(rig.target, size_sigma=2e-3), poses=poses))


def without_slip(simulation: Simulation) -> Rig:
    return steady(rig_for(simulation.scenario))


def drawn(simulation: Simulation) -> Rig:
    """Guesses of extrinsics and clocks 5 deg, 5 cm and 20 ms off."""
    return with_drawn_guess(rig_for(simulation.scenario), simulation.scenario, 0, only=MOUNTS)


def drawn_without_slip(simulation: Simulation) -> Rig:
    return steady(with_drawn_guess(rig_for(simulation.scenario), simulation.scenario, 4))


def on_level_ground(simulation: Simulation) -> Rig:
    """The height of the wheels' frame over the target's origin was measured."""
    truth, (wheels,) = simulation.truth, simulation.scenario.of(SimWheels)
    wheel = truth.position[0] + truth.R_world_imu[0] @ wheels.T_imu_sensor[:3, 3]
    ground = replace(LEVEL, height=float(wheel[2] - truth.T_world_bodies[0, 2, 3]))
    rig = drawn(simulation)
    return rig.with_(wheels=tuple(replace(w, ground=ground) for w in rig.wheels))


# Checks.


def target_was_out_of_sight(run: Run) -> None:
    assert np.diff(run.simulation.measurements.cameras[0].seconds).max() > 13.0


def scale_is_its_prior(run: Run) -> None:
    """And the sizes of the wheels follow it."""
    (scale,) = (g for g in run.result.groups if g.name in ("scale", "size"))
    assert scale.value[0] == pytest.approx(1.0, abs=0.05 * scale.std_formal[0])
    groups = [run.result.group("wheel0", name) for name in ("radii", "baseline")]
    columns = np.concatenate([not_none(g.columns) for g in groups])
    errors = np.concatenate([g.value - run.simulation.truth.values["wheel0"][g.name] for g in groups])
    assert errors @ np.linalg.solve(run.result.covariance[np.ix_(columns, columns)], errors) < chi2.ppf(0.999, 3)


def is_upright(run: Run) -> None:
    """Roll and pitch of the wheels to 0.03 deg, and so the baseline."""
    have("determined", "wheel0.rotation.x", "wheel0.rotation.y", "wheel0.baseline")(run)
    turn, true = run.result.group("wheel0", "rotation"), run.simulation.truth.T_imu_sensor["wheel0"][:3, :3]
    assert np.rad2deg(np.abs((true.T @ turn.value)[[1, 2], [2, 0]])).max() < 0.03
    assert np.rad2deg(turn.std_formal[:2]).max() < 0.03
    baseline = run.simulation.truth.values["wheel0"]["baseline"]
    assert abs(run.result.group("wheel0", "baseline").value[0] - baseline[0]) < 1.5e-3


CASES: dict[str, Case] = {
    # With an IMU, on hills.
    "camera and wheels": Case(lambda: simulate(make_robot("ramp", 30.0, "cw"), 0), [known()], without_slip),
    "speed and yaw rate": Case(
        lambda: simulate(reporting(make_robot("ramp", 30.0, "cw"), "twist"), 0),
        [known(), have("determined", "wheel0.scales")],
        without_slip,
        full=True,
    ),
    "steered front wheels": Case(
        lambda: simulate(reporting(make_robot("ramp", 30.0, "cw"), "steering"), 0),
        [known(), have("determined", "wheel0.radius", "wheel0.wheelbase", "wheel0.steering_offset")],
        without_slip,
    ),
    # At the slip density that rigs have if they say nothing; 1.25 deg are 10 mm/s RMS.
    "wheels that slide sideways": Case(lambda: simulate(sliding(1.25), 0), [known()]),
    # With an IMU, on a flat floor and on a straight line.
    "a flat floor": Case(
        lambda: simulate(make_robot("planar", 20.0, "cw"), 0),
        [known(), heights_at_the_guess, roll_at_the_guess],
        drawn,
    ),
    "a flat floor that is stated": Case(
        lambda: simulate(make_robot("planar", 20.0, "cw"), 0),
        [is_upright, known(), leaves_open("cam0.translation.z", "wheel0.translation.z")],
        on_level_ground,
        full=True,
    ),
    "hills where a flat floor is stated": Case(
        lambda: simulate(make_robot("ramp", 20.0, "cw"), 0),
        [
            fits("ground tilt", 10.0, np.inf, "wheel0"),
            fits("ground height", 10.0, np.inf, "wheel0"),
            warns("ground_not_even", 2),
        ],
        on_level_ground,
    ),
    # Once the board was turned by 334 deg, from where there is no way back, and the radii were open by 3 m.
    "a straight line before a board": Case(
        lambda: simulate(moving(make_robot("planar", 30.0, "cw", 300), "straight-line"), 4),
        [known(), have("determined", RADII)],
        drawn_without_slip,
    ),
    # Without an IMU.
    "wheels and motion capture": Case(
        lambda: ideal_imu(beside_mocap("ramp")),
        [
            known(10),
            body_is("mocap0"),
            have("fixed", "mocap0.rotation"),
            have("determined", RADII),
            std_below(RADII, 3e-5),
            notes("smooth_motion_assumed"),
            is_silent_on("imu_noise_stated"),
        ],
        alone,
        no_imu,
    ),
    "wheels and motion capture on a flat floor": Case(
        lambda: ideal_imu(beside_mocap("planar")),
        [known(), leaves_open("wheel0.rotation.x", "wheel0.translation.z")],
        alone,
        no_imu,
        full=True,
    ),
    "a camera with a target and wheels": Case(
        lambda: ideal_imu(make_robot("ramp", 20.0, "cw")),
        [known(10), body_is("cam0"), have("fixed", "cam0.time_offset"), std_below(RADII, 1e-4)],
        alone,
        no_imu,
    ),
    # Nothing is made up of the 14 s between.
    "a target that is out of sight for long": Case(
        lambda: ideal_imu(make_robot("ramp", 20.0, "cw"), 3),
        [target_was_out_of_sight, known(10)],
        alone,
        no_imu,
        full=True,
    ),
    "hand-eye calibration": Case(
        lambda: ideal_imu(two_mocaps(time_offset_s=-0.02, rate_hz=30.0)),
        [known(7), have("determined", "mocap0.rotation"), std_below("mocap0.rotation", np.deg2rad(0.05))],
        alone,
        no_imu,
    ),
    # As a target that is seen from far.
    "the body's poses are half a degree and a centimetre off": Case(
        lambda: ideal_imu(two_mocaps(**POOR)), [known(7), body_is("slam0")], alone, no_imu, full=True
    ),
    "tracked points and motion capture from nothing": Case(
        following_beside_mocap, [known(7 + 8), body_is("mocap0")], alone_with_free_lens, no_imu
    ),
    # The size of the scene is as the rig file has the wheels'.
    "tracked points and wheels of guessed size": Case(
        lambda: simulate(following("planar"), 1),
        [known(), body_is("cam0"), have("determined", "cam0.intrinsics"), have("unobservable", RADII)],
        sizes("start"),
        no_imu,
    ),
    "tracked points and wheels of known size": Case(
        lambda: simulate(following("planar"), 2),
        [known(), have("determined", "cam0.intrinsics"), have("fixed", RADII)],
        sizes("fixed"),
        no_imu,
        full=True,
    ),
    # With slip in metres, 300 s once ended at a scale of 0.9949, five standard deviations, and was not usable.
    "a size of the target that nothing shows": Case(
        lambda: ideal_imu(make_robot("ramp", 20.0, "cw"), 1),
        [scale_is_its_prior, is_usable],
        scales_with_priors,
        no_imu,
    ),
    "a scale of poses that nothing shows": Case(
        lambda: ideal_imu(beside_mocap("ramp", 300.0), 1),
        [scale_is_its_prior, is_usable],
        scales_with_priors,
        no_imu,
        full=True,
    ),
    # Refused.
    "one arc all the time": Case(
        lambda: ideal_imu(moving(beside_mocap("planar"), "arc")),
        rig=alone,
        seen=no_imu,
        refused="the yaw rate was nearly constant",
    ),
    "tracked points and wheels on hills": Case(
        lambda: simulate(following("ramp"), 1),
        rig=sizes("start"),
        seen=no_imu,
        refused="determines the motion on a flat floor only",
    ),
    "tracked points and wheels of unknown size": Case(
        lambda: simulate(following("planar"), 1), rig=sizes("free"), seen=no_imu, refused="give its radii and baseline"
    ),
}


@pytest.mark.parametrize("case", parameters(CASES))
def test_a_case(case: Case) -> None:
    case.verify()


def test_a_result_without_imu_is_saved_and_loaded(tmp_path: Path) -> None:
    rig, measurements, _ = without_imu(beside_mocap("ramp", 12.0))
    result = calibrate_measurements(rig, measurements)
    write_outputs(result, tmp_path)
    assert "T_mocap0_sensor" in (tmp_path / "calibration.yaml").read_text()
    again = load_calibration(tmp_path)
    assert again.body == "mocap0" and again.imu is None
    np.testing.assert_array_equal(again.T_imu_sensor("wheel0"), result.T_imu_sensor("wheel0"))


def test_a_target_far_away_shows_the_lever_arm() -> None:
    """What one image has wrong of its rotation moves its position by five metres as much."""
    off = []
    for seed in range(4):
        simulation = simulate(make_robot("ramp", 20.0, "c"), seed)
        found = initial_guess(rig_for(simulation.scenario), simulation.measurements).cameras["cam0"]
        off.append(found.position - simulation.truth.T_imu_sensor["cam0"][:3, 3])
    assert np.sqrt(np.mean(np.square(off))) < 0.1


@pytest.mark.parametrize(("hz", "slow"), [(5.0, True), (20.0, False)])
def test_the_rate_of_the_sensor_that_shows_the_motion_is_named(hz: float, slow: bool) -> None:
    """Where another sensor does not match it. `assumed motion` is no sensor that a user knows."""
    poses = PoseStream("mocap0", np.arange(20) * round(1e9 / hz), np.tile(np.eye(3), (20, 1, 1)), np.zeros((20, 3)))
    words = _with_rate("the motion of cam0 does not match that of assumed motion at any time offset.", poses)
    assert words.startswith(f"the motion of cam0 does not match that of mocap0 at {hz:g} Hz at any time offset.")
    assert ("Record at 20 Hz" in words) == slow
