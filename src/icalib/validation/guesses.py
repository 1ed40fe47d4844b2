"""Notes on initial guesses of the rig file that the data contradict, with likely mistakes."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np

from icalib.estimate.problem.groups import groups_of
from icalib.estimate.problem.inputs import Inputs
from icalib.geometry import so3
from icalib.geometry.cameras import camera_model
from icalib.initialize.steps.contradicted_guesses import is_contradicted
from icalib.result import ParameterGroup
from icalib.rig import LENS, Camera
from icalib.sensors.camera.spec import INTRINSICS
from icalib.sensors.parameter_spec import display_unit
from icalib.validation.looks_like import looks_like
from icalib.validation.stated import scaled

GRID = 12  # rays along each side of an image


def guess_notes(inputs: Inputs, groups: Sequence[ParameterGroup]) -> Iterator[str]:
    """One sentence for each initial guess that the estimate contradicts, see `is_contradicted`. For lenses it is one
    whose projections are more than the prior uncertainty of the intrinsics off."""
    groups_by_key = {(g.sensor, g.name): g for g in groups}
    for sensor, name, parameter in groups_of(inputs.user_rig or inputs.rig):
        group, guess = groups_by_key.get((sensor.name, name)), parameter.value
        if group is None or guess is None or parameter.mode != "free" or "undetermined" in group.verdict:
            continue
        if isinstance(sensor, Camera) and name in LENS:
            far = lens_off(sensor, name, groups_by_key) > INTRINSICS.prior_sigma
        else:
            far = is_contradicted(sensor.spec(name), guess, group.value)
        if far:
            rotation = groups_by_key.get((sensor.name, "rotation"))
            R_imu_sensor = None if rotation is None else rotation.value
            yield _sentence(group, guess) + looks_like(
                inputs.rig, (sensor.name, name), guess, group.value, R_imu_sensor
            )


def lens_off(camera: Camera, name: str, groups_by_key: dict[tuple[str, str], ParameterGroup]) -> float:
    """RMS shift [px] of projections over the image if the group `name` of the estimated lens is replaced by its
    guess."""
    model, values = camera_model(camera.model), {part: groups_by_key[camera.name, part].value for part in LENS}
    guess = np.concatenate(list((values | {name: getattr(camera, name).value}).values()))
    sides = [np.linspace(0.0, n - 1.0, GRID) for n in camera.resolution]
    uv = np.stack(np.meshgrid(*sides), axis=-1).reshape(-1, 2)
    rays, has_ray = model.unproject(np.concatenate(list(values.values())), uv)
    guess_uv, is_projected = model.project(guess, rays)
    both = has_ray & is_projected
    return float(np.sqrt(np.mean(((guess_uv - uv)[both] ** 2).sum(axis=1)))) if both.any() else np.inf


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
