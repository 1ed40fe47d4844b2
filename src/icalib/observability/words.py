"""What the data determine, in words: verdicts on parameters and on combinations of them."""

from __future__ import annotations

from collections.abc import Collection, Sequence
from dataclasses import dataclass

import numpy as np

from icalib.observability.determination import Determined
from icalib.result import Verdict
from icalib.result.verdict import by_size, in_null_space
from icalib.rig import ParameterSpec

NAMED = 0.2  # parts of a direction smaller than this are not named
MOST_NAMED = 4  # of the largest

EVERY_AXIS = "every axis"


@dataclass(frozen=True)
class Observability:
    """Covariance (B, B) formal; verdicts by calibration column; undetermined combinations as sentences.

    spread (B,): standard deviations in tolerances that the data alone give, consider covariance included.
    """

    covariance: np.ndarray
    verdicts: tuple[Verdict, ...]
    undetermined: tuple[str, ...]
    spread: np.ndarray


def observe(
    found: Determined,
    names: tuple[str, ...],
    specs: Sequence[ParameterSpec],
    on_wheels: bool = False,
    tracking: Collection[str] = (),
    axes: str = "",
) -> Observability:
    """Verdicts by what the data alone say; undetermined throughout where the solver did not converge.

    names: (B,) as in "cam0.translation.x". specs: (B,) the definitions of their groups. on_wheels: the rig drives on
    one of its sensors. tracking: names of cameras without a target. axes: about which the rig hardly turned, in words,
    or empty.
    """
    directions = sparse_basis(found.fixed_directions)
    verdicts: list[Verdict] = []
    for is_null, spread in zip(in_null_space(directions), found.spread, strict=True):
        is_undetermined = is_null or not found.estimate.outcome.converged
        verdicts.append("undetermined" if is_undetermined else by_size(spread))
    sentences = []
    for direction in directions.T:
        words, first = _words_of(direction, names)
        spec, sensor = specs[first], names[first].rsplit(".", 2)[0]
        motion = _missing_motion(spec, on_wheels, sensor in tracking).format(axes=axes or EVERY_AXIS)
        by = "these images" if spec.by_images else "this motion"
        sentences.append(f"{words}: not determined by {by}; {motion}.")
    return Observability(found.covariance, tuple(verdicts), tuple(sentences), found.spread)


def sparse_basis(directions: np.ndarray, rounds: int = 50) -> np.ndarray:
    """The same span as the orthonormal columns (B, m), turned so that each has few large entries (varimax, Kaiser
    1958)."""
    n, m = directions.shape if directions.size else (len(directions), 0)
    turn = np.eye(m)
    for _ in range(rounds if m > 1 else 0):
        L = directions @ turn
        U, _, Vt = np.linalg.svd(directions.T @ (L**3 - L * (L**2).mean(axis=0)))
        turn = U @ Vt
    return directions @ turn if m else np.zeros((n, 0))


def _words_of(direction: np.ndarray, names: tuple[str, ...]) -> tuple[str, int]:
    """The parameters that a direction (B,) moves most, in words, and the column of the first."""
    order = np.argsort(-np.abs(direction))
    # By the rig, not by size: where all move alike, noise would decide which comes first.
    parts = sorted(i for i in order[:MOST_NAMED] if abs(direction[i]) >= NAMED) or [order[0]]
    return " with ".join(_words(names[i]) for i in parts), int(order[0])


def _missing_motion(spec: ParameterSpec, on_wheels: bool, without_target: bool) -> str:
    """What would determine a parameter. A rig on wheels cannot turn about other axes; a camera without a target tracks
    points of the scene."""
    others = (spec.motion_without_target if without_target else "", spec.motion_on_wheels if on_wheels else "")
    return next(filter(None, others), spec.motion)


def _words(name: str) -> str:
    """A parameter's name as people say it; what is one number has no label of its own."""
    sensor, kind, label = name.rsplit(".", 2)
    own = kind if label == kind else f"{kind} {label}"
    return f"{sensor} {own.replace('_', ' ')}"
