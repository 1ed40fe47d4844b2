"""Cameras that are swapped in the rig file, or that have the intrinsics of another camera."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from itertools import combinations

import numpy as np

from icalib.geometry import so3
from icalib.observability.fixed_lens import LensStep
from icalib.result import ParameterGroup
from icalib.rig import Camera
from icalib.sensors.camera.spec import INTRINSICS
from icalib.sensors.sensor import ROTATION, TRANSLATION

GIVEN = (ROTATION, TRANSLATION, INTRINSICS)
FAR = 0.5  # prior standard deviations of initial guesses: 5 cm, 3 deg, 8 px
MUCH_NEARER = 0.3  # ratio of the distances of swapped to unswapped values, below which cameras count as swapped
OTHER_LENS, CLEARLY = 0.015, 3.0  # least change of an intrinsic parameter: relative to fx, and in standard deviations
NEARER = 0.5  # ratio of the largest differences in fx, fy, cx, cy [px], below which another camera is named


def mixed_up(cameras: Sequence[Camera], groups: Sequence[ParameterGroup]) -> Iterator[str]:
    """Sentences on pairs of cameras that seem to be swapped: the estimate of each is near the stated values of the
    other."""
    estimates = {(g.sensor, g.name): g.value for g in groups}
    for a, b in combinations(cameras, 2):
        distances = _distance(a, estimates, a.name), _distance(b, estimates, b.name)
        crossed_distances = _distance(a, estimates, b.name), _distance(b, estimates, a.name)
        if max(distances) > FAR and max(crossed_distances) < MUCH_NEARER * max(distances):
            yield (
                f"{a.name} and {b.name} seem to be swapped: the pose and lens of each fit what the rig file gives of "
                "the other. Correct their topics or paths, or the values in the rig file."
            )


def other_lens(cameras: Sequence[Camera], steps: Sequence[LensStep], factor: float) -> Iterator[tuple[str, str, float]]:
    """Cameras whose fixed intrinsics contradict the data: name, sentence, and gain in chi^2 if they are free. factor:
    the largest empirical factor, which multiplies formal standard deviations."""
    given = {c.name: c.intrinsics.value for c in cameras}
    for lens_step in steps:
        value = given[lens_step.camera]
        assert value is not None
        off = np.abs(lens_step.step)
        clearly = off > np.maximum(OTHER_LENS * value[0], CLEARLY * factor * lens_step.std)
        if clearly.any():
            where = ", ".join(
                f"{name} {old + step:.1f} and not {old:.1f}"
                for name, old, step, far in zip(("fx", "fy", "cx", "cy"), value, lens_step.step, clearly, strict=True)
                if far
            )
            nearer = [
                n
                for n, v in given.items()
                if v is not None and max(abs(value + lens_step.step - v)) < NEARER * max(off)
            ]
            hint = f" Those of {nearer[0]} are nearer." if nearer else ""
            sentence = (
                f"the intrinsics of {lens_step.camera} that the rig file fixes do not fit its images, which want "
                f"{where}: check that they are this camera's, at this resolution, or leave them free.{hint}"
            )
            yield lens_step.camera, sentence, float(((lens_step.step / lens_step.std) ** 2).max())


def _distance(camera: Camera, estimates: dict[tuple[str, str], np.ndarray], name: str) -> float:
    """Largest distance between the estimate of the camera `name` and the stated values of `camera`, in prior standard
    deviations of a guess."""
    distance = 0.0
    for spec in GIVEN:
        given, value = getattr(camera, spec.name).value, estimates.get((name, spec.name))
        if given is None or value is None:
            continue
        off = so3.value_change(given, value)
        distance = max(distance, float(np.linalg.norm(off)) / spec.prior_sigma)
    return distance
