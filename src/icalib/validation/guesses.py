"""Notes on initial guesses of the rig file that the data contradict, with likely mistakes."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np

from icalib.estimate.problem.groups import groups_of
from icalib.estimate.problem.inputs import Inputs
from icalib.geometry import so3
from icalib.initialize.steps.contradicted_guesses import is_contradicted
from icalib.result import ParameterGroup
from icalib.result.verdict import UNUSABLE
from icalib.sensors import call_kind
from icalib.sensors.parameter_spec import display_unit
from icalib.validation.looks_like import looks_like
from icalib.validation.stated import scaled


def guess_notes(inputs: Inputs, groups: Sequence[ParameterGroup]) -> Iterator[str]:
    """One sentence for each initial guess that the estimate contradicts, by the kind of sensor or `is_contradicted`."""
    groups_by_key = {(g.sensor, g.name): g for g in groups}
    for sensor, name, parameter in groups_of(inputs.user_rig or inputs.rig):
        group, guess = groups_by_key.get((sensor.name, name)), parameter.value
        if group is None or guess is None or parameter.mode != "free" or {*UNUSABLE} & {*group.verdict}:
            continue
        far = call_kind(sensor.sensor_type, "assess", "is_far_guess", sensor, name, groups_by_key)
        if far is None:
            far = is_contradicted(sensor.spec(name), guess, group.value)
        if far:
            rotation = groups_by_key.get((sensor.name, "rotation"))
            R_imu_sensor = None if rotation is None else rotation.value
            yield _sentence(group, guess) + looks_like(
                inputs.rig, (sensor.name, name), guess, group.value, R_imu_sensor
            )


def _sentence(group: ParameterGroup, guess: np.ndarray) -> str:
    """A sentence with the guess and the estimate, or their difference for rotations and time offsets."""
    what = f"the guess of {group.name.replace('_', ' ')} of {group.sensor}"
    if group.name == "rotation":
        off = np.rad2deg(np.linalg.norm(so3.log(np.ascontiguousarray(guess.T @ group.value))))
        return f"{what} is {off:.1f} deg from what the data show, which alone count."
    unit, scale = display_unit(group.unit)
    unit = f" {unit}" if unit else ""
    if group.name == "time_offset":
        off = guess - group.value
        return f"{what} is {scaled(np.abs(off), scale)}{unit} from what the data show, which alone count."
    estimate_text = f"{scaled(group.value, scale)}{unit}"
    return f"{what}, {scaled(guess, scale)}{unit}, is far from what the data show, {estimate_text}, which alone count."
