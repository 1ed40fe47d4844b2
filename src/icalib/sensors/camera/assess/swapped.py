"""Cameras that are swapped in the rig file."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from itertools import combinations

import numpy as np

from icalib.geometry import so3
from icalib.observability.cause import Cause
from icalib.result import ParameterGroup
from icalib.rig import Camera
from icalib.sensors.camera.spec import INTRINSICS
from icalib.sensors.sensor import ROTATION, TRANSLATION

GIVEN = (ROTATION, TRANSLATION, INTRINSICS)
FAR = 0.5  # prior standard deviations of initial guesses: 5 cm, 3 deg, 8 px
MUCH_NEARER = 0.3  # ratio of the distances of swapped to unswapped values, below which cameras count as swapped


def swapped_cameras(cameras: Sequence[Camera], groups: Sequence[ParameterGroup]) -> Iterator[Cause]:
    """Pairs of cameras that seem to be swapped: the estimate of each is near the stated values of the other."""
    estimates = {(g.sensor, g.name): g.value for g in groups}
    for a, b in combinations(cameras, 2):
        distances = _distance(a, estimates, a.name), _distance(b, estimates, b.name)
        crossed_distances = _distance(a, estimates, b.name), _distance(b, estimates, a.name)
        if max(distances) > FAR and max(crossed_distances) < MUCH_NEARER * max(distances):
            sentence = (
                f"{a.name} and {b.name} seem to be swapped: the pose and lens of each fit what the rig file gives of "
                "the other. Correct their topics or paths, or the values in the rig file."
            )
            yield Cause(sentence, np.inf, True)


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
