"""Verdicts on parameters, and sentences on unobservable combinations of parameters."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.linalg import qr

from icalib.observability.determination import Determined
from icalib.result import Verdict
from icalib.result.verdict import by_size, in_null_space
from icalib.rig import ParameterSpec

NAMED = 0.2  # entry of a unit direction below which its parameter is not named
MOST_NAMED = 4  # parameters of a direction that are named, those with the largest entries

EVERY_AXIS = "every axis"


@dataclass(frozen=True)
class Observability:
    """covariance (B, B): formal. unobservable: one sentence for each unobservable direction.

    spread (B,): standard deviations in tolerances that the data alone give, consider covariance included; infinite if
    the solver did not converge. in_null_space, by_guess (B,): whether the parameter lies largely in the null space;
    whether errors of the guess are most of its variance.
    """

    covariance: np.ndarray
    unobservable: tuple[str, ...]
    spread: np.ndarray
    in_null_space: np.ndarray
    by_guess: np.ndarray

    def verdicts(self, columns: np.ndarray, sizes: np.ndarray) -> tuple[Verdict, ...]:
        """(n,) verdicts on the parameters of `columns` (n,) with standard deviations of `sizes` (n,) tolerances."""
        entries = zip(self.in_null_space[columns], self.by_guess[columns], sizes.tolist(), strict=True)
        return tuple("unobservable" if is_null else by_size(size, bool(guess)) for is_null, guess, size in entries)


def observe(
    determined: Determined,
    names: tuple[str, ...],
    specs: Sequence[ParameterSpec],
    on_wheels: bool = False,
    has_target: bool = True,
    axes: str = "",
) -> Observability:
    """Observability from the spread of the data alone.

    names (B,): such as "cam0.translation.x". specs (B,): definition of each column's group. on_wheels: the rig drives
    on one of its sensors. has_target: the rig has a target. axes: text that names the axes about which the rig hardly
    turned, or empty.
    """
    directions = sparse_basis(determined.fixed_directions)
    by_data, by_guess = determined.variances
    spread = np.sqrt(by_data + by_guess) if determined.estimate.outcome.converged else np.full(len(by_data), np.inf)
    sentences = []
    for direction in directions.T:
        words, first = _words_of(direction, names)
        spec = specs[first]
        motion = _missing_motion(spec, on_wheels, has_target).format(axes=axes or EVERY_AXIS)
        by = "these images" if spec.by_images else "this motion"
        sentences.append(f"{words}: not determined by {by}; {motion}.")
    return Observability(determined.covariance, tuple(sentences), spread, in_null_space(directions), by_guess > by_data)


def sparse_basis(directions: np.ndarray, rounds: int = 50) -> np.ndarray:
    """(B, m) basis of the span of the orthonormal `directions` (B, m), rotated so that each column has few large
    entries (varimax, Kaiser 1958). It begins at a basis that depends on the span alone."""
    n, m = directions.shape if directions.size else (len(directions), 0)
    turn = qr(directions.T, pivoting=True)[0] if m else np.eye(0)
    for _ in range(rounds if m > 1 else 0):
        L = directions @ turn
        U, _, Vt = np.linalg.svd(directions.T @ (L**3 - L * (L**2).mean(axis=0)))
        turn = U @ Vt
    return directions @ turn if m else np.zeros((n, 0))


def _words_of(direction: np.ndarray, names: tuple[str, ...]) -> tuple[str, int]:
    """Text that names the parameters with the largest entries in `direction` (B,), and the column of the largest
    one."""
    order = np.argsort(-np.abs(direction))
    # In the order of the columns, not by size: equal entries would be ordered by noise.
    parts = sorted(i for i in order[:MOST_NAMED] if abs(direction[i]) >= NAMED) or [order[0]]
    return " with ".join(_words(names[i]) for i in parts), int(order[0])


def _missing_motion(spec: ParameterSpec, on_wheels: bool, has_target: bool) -> str:
    """Text on the motion that would make the parameter observable. It depends on two limits: a rig on wheels cannot
    turn about every axis, and without a target, points of the scene are tracked."""
    others = ("" if has_target else spec.motion_without_target, spec.motion_on_wheels if on_wheels else "")
    return next(filter(None, others), spec.motion)


def _words(name: str) -> str:
    """Readable form of a column's name. The label is left out if the parameter is a single number."""
    sensor, kind, label = name.rsplit(".", 2)
    parameter = kind if label == kind else f"{kind} {label}"
    return f"{sensor} {parameter.replace('_', ' ')}"
