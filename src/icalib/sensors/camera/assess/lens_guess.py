"""Whether the guess of a lens is contradicted: by projections, as single coefficients are strongly correlated."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from icalib.geometry.cameras import camera_model
from icalib.optim.state import Key
from icalib.result import ParameterGroup
from icalib.rig import LENS, Camera
from icalib.sensors.camera.spec import INTRINSICS

GRID = 12  # rays along each side of an image


def is_far_guess(camera: Camera, name: str, groups_by_key: Mapping[Key, ParameterGroup]) -> bool | None:
    """Whether the guess of the group `name` of the lens projects points farther off than the prior uncertainty of the
    intrinsics; None for other groups."""
    return _lens_off(camera, name, groups_by_key) > INTRINSICS.prior_sigma if name in LENS else None


def _lens_off(camera: Camera, name: str, groups_by_key: Mapping[Key, ParameterGroup]) -> float:
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
