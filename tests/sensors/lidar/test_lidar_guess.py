"""Where the solver starts with a LiDAR of which the rig file has a guess: what turns show is nearer, and the guess
stays what it is for whatever the data leave open."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from icalib.geometry import so3
from icalib.initialize.rig_guess import guess_of_rig
from icalib.initialize.trajectories import ExtrinsicsGuess
from icalib.sensors.parameter import Mode, Parameter
from icalib.tools.simulation import rig_for

TURN_RAD, LATE_S = 0.15, 0.03
AWAY = so3.exp(np.array([0.0, TURN_RAD, 0.0]))


def guessed(robot, mode: Mode = "free", mode_of_clock: Mode = "free"):
    """The rig with a LiDAR whose rotation and time offset are off, and what it has of them."""
    rig, true = rig_for(robot.sim.scenario), robot.truth()
    rotation, offset = true.rotation @ AWAY, robot.sim.truth.time_offset["lidar0"] + LATE_S
    lidar = replace(
        rig.lidars[0],
        rotation=Parameter(mode, rotation),
        translation=Parameter("free", true.position),
        time_offset=Parameter(mode_of_clock, np.array([offset])),
    )
    return rig.with_(lidars=(lidar,)), rotation


def started(robot, rig):
    """The start's and the guess's rotation and time offset."""
    inputs, state, guess = guess_of_rig(rig, [robot.sim.measurements])
    assert inputs.guess is not None
    np.testing.assert_array_equal(inputs.guess.values["lidar0", "rotation"], guess["lidar0", "rotation"])
    names = ("rotation", "time_offset")
    return tuple(tuple(values["lidar0", name] for name in names) for values in (state.values, guess))


def test_turns_show_where_to_start_and_the_guess_stays(free_robot):
    rig, given = guessed(free_robot)
    (rotation, offset), (guess, clock) = started(free_robot, rig)
    turn, _, late = free_robot.errors(ExtrinsicsGuess(rotation, np.zeros(3), offset[0]))
    assert np.linalg.norm(turn) < 0.2
    assert abs(late) < 1e-3
    np.testing.assert_array_equal(guess, given)
    assert clock[0] == pytest.approx(free_robot.truth().offset + LATE_S, abs=1e-9)


def test_what_the_rig_file_is_sure_of_is_not_replaced(free_robot):
    """Both contradict the gyroscope too little to be refused."""
    rig, _ = guessed(free_robot, mode_of_clock="fixed")
    (_, offset), (_, clock) = started(free_robot, rig)
    assert offset[0] == clock[0] == pytest.approx(free_robot.truth().offset + LATE_S, abs=1e-9)
    rig, given = guessed(free_robot, mode="fixed")
    (rotation, _), (guess, _) = started(free_robot, rig)
    np.testing.assert_array_equal(rotation, given)
    np.testing.assert_array_equal(guess, given)


def test_turns_about_one_axis_show_too_little(robot):
    """Of the rotation about that axis they show nothing, so the guess is where to start."""
    flat = robot(16.0, 1, example="table2-planar")
    rig, given = guessed(flat)
    (rotation, offset), (guess, _) = started(flat, rig)
    np.testing.assert_array_equal(rotation, given)
    np.testing.assert_array_equal(guess, given)
    assert offset[0] == pytest.approx(flat.truth().offset + LATE_S, abs=1e-9)
