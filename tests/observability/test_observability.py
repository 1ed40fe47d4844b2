"""Verdicts where many sensors share what the data leave open."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any, cast

import numpy as np
from tests.cases import each

from icalib.observability.determination import Observability, RecordingTraits, observe, sparse_basis
from icalib.result import Verdict
from icalib.rig import ParameterSpec
from icalib.rig.rig import ALL_SPECS

SPECS = {spec.name: spec for spec in ALL_SPECS}  # a name that an IMU and a camera share is the camera's
SENSORS = ("cam0", "cam1", "cam2", "lidar0", "wheel0")


def specs_of(names: tuple[str, ...]) -> list[ParameterSpec]:
    return [SPECS[name.rsplit(".", 2)[1]] for name in names]


def shared(worth: float, converged: bool = True) -> Any:
    """Five sensors whose turns against each other are known to 0.1 tolerances, and a sixth column to 0.1: open is the
    turn of all five together, of which the guess is worth so many tolerances."""
    n = len(SENSORS)
    fixed_directions = np.append(np.ones(n), 0.0)[:, None] / np.sqrt(n)
    by_data, by_guess = np.full(n + 1, 0.01), np.append(np.full(n, worth**2 / n), 0.0)
    estimate = SimpleNamespace(outcome=SimpleNamespace(converged=converged))
    return cast(
        Any,
        SimpleNamespace(
            fixed_directions=fixed_directions,
            variances=(by_data, by_guess),
            covariance=np.diag(by_data + by_guess),
            estimate=estimate,
        ),
    )


def verdicts_of(found: Observability) -> tuple[Verdict, ...]:
    return found.verdicts(np.arange(len(found.spread)), found.spread)


@each(("worth", "verdict"), [(50.0, "unobservable"), (1.0, "determined"), (10.0, "weak")])
def test_what_five_share_is_as_open_as_the_guess_is_wide(worth: float, verdict: str):
    """A fifth of a direction each: the share alone would let none of them be open."""
    names = tuple(f"{s}.rotation.z" for s in SENSORS) + ("cam0.time_offset.time_offset",)
    found = observe(shared(worth), names, specs_of(names))
    assert verdicts_of(found) == (verdict,) * len(SENSORS) + ("determined",)
    (sentence,) = found.unobservable
    assert all(s in sentence for s in SENSORS[:4]) and "turn the rig" in sentence


def test_names_stand_in_the_order_of_the_rig_and_say_nothing_twice():
    names = ("left_cam.translation.z", "left_cam.time_offset.time_offset", "wheel0.baseline.baseline")
    for first, last in ((0.75, 0.65), (0.65, 0.75)):
        fixed_directions = np.array([first, 0.1, last])[:, None]
        found = shared(50.0)
        found.fixed_directions = fixed_directions / np.linalg.norm(fixed_directions)
        found.variances, found.covariance = (np.zeros(3), np.full(3, 2500.0)), np.eye(3)
        (sentence,) = observe(found, names, specs_of(names), RecordingTraits(on_wheels=True)).unobservable
        assert sentence.startswith("left_cam translation z with wheel0 baseline: not determined by this motion; ")
    found.fixed_directions = np.array([0.0, 1.0, 0.0])[:, None]
    assert observe(found, names, specs_of(names)).unobservable[0].startswith("left_cam time offset: ")


@each(
    ("parameter", "recorded", "advice"),
    [
        ("cam0.distortion.k1", RecordingTraits(), "by these images; show the target in the corners of the image"),
        (
            "cam0.distortion.k1",
            RecordingTraits(has_target=False),
            "points of the scene pass through the corners of the image",
        ),
        ("cam0.translation.x", RecordingTraits(has_target=False), "this motion; turn the rig briskly about every axis"),
        (
            "cam0.translation.x",
            RecordingTraits(at_rest=True),
            "by these places; show the target in more places, tilted",
        ),
        ("wheel0.translation.z", RecordingTraits(on_wheels=True, has_target=False), "turn, and drive over ramps"),
    ],
)
def test_the_missing_motion_is_that_of_the_sensor(parameter, recorded, advice):
    found = shared(50.0)
    found.fixed_directions, found.covariance = np.ones((1, 1)), np.eye(1)
    found.variances = np.zeros(1), np.full(1, 2500.0)
    (sentence,) = observe(found, (parameter,), specs_of((parameter,)), recorded).unobservable
    assert advice in sentence


def test_an_answer_that_did_not_converge_determines_nothing():
    names = tuple(f"{s}.rotation.z" for s in SENSORS) + ("cam0.time_offset.time_offset",)
    found = observe(shared(1.0, converged=False), names, specs_of(names))
    assert verdicts_of(found) == ("unobservable",) * 5 + ("too uncertain",)


def test_above_ten_tolerances_the_larger_part_of_the_variance_decides():
    """By the guess a parameter is unobservable, by the data it is too uncertain; in the null space it is unobservable
    however well the guess is known."""
    names = tuple(f"{s}.rotation.z" for s in SENSORS) + ("cam0.time_offset.time_offset",)
    found = shared(50.0)
    guess = 40.0**2 * np.ones(6)
    found.variances = np.array([0.5, 0.9, 1.1, 100.0, 0.0, 0.0]) * guess, guess * [1.0, 1.0, 1.0, 1.0, 1.0, 1e-6]
    found.fixed_directions = np.array([0.1, 0.1, 0.1, 0.1, 0.0, 0.98])[:, None]
    seen = observe(found, names, specs_of(names))
    assert verdicts_of(seen) == ("unobservable",) * 2 + ("too uncertain",) * 2 + ("unobservable",) * 2


def test_the_basis_of_named_directions_depends_on_their_span_alone():
    rng = np.random.default_rng(0)
    for _ in range(20):
        directions = np.linalg.qr(rng.standard_normal((9, 3)))[0]
        turn = np.linalg.qr(rng.standard_normal((3, 3)))[0]
        a, b = sparse_basis(directions), sparse_basis(directions @ turn)
        np.testing.assert_allclose(np.abs(a.T @ b), np.eye(3), atol=1e-6)
