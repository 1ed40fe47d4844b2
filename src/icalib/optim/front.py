"""Frontal elimination of a chain whose keyframes share features, each seen from many keyframes (iCalib paper (15),
Schur complement).

`front_plan.py` chooses the elimination order; `front_kernels.py` and `front_substitution.py` have the compiled steps.
The cost of a step grows with the square of the number of features in the front.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from icalib.optim.front_kernels import FrontChain, Sizes, eliminate_all, rotate_keyframes
from icalib.optim.front_plan import FeatureSums, Plan
from icalib.optim.front_substitution import substitute_all
from icalib.optim.state import KEYFRAME_DIM


@dataclass(frozen=True)
class PieceFeatures:
    """Features of a `Piece`: their sums, the elimination plan, and the workspace `workspace` of the factors. Each
    elimination overwrites the last one's factors, because writing to freshly mapped memory would cost more than the
    elimination."""

    sums: FeatureSums
    plan: Plan
    workspace: np.ndarray

    @classmethod
    def of(cls, sums: FeatureSums, plan: Plan) -> PieceFeatures:
        """The features with a new workspace."""
        return cls(sums, plan, np.empty(_sizes(plan, sums.side.shape[2]).start[-1]))

    def widened(self, n_calib: int) -> PieceFeatures:
        """The same features with more calibration columns, `n_calib` in all. New columns and the gradient are zero."""
        side = self.sums.side
        wide = np.zeros((*side.shape[:2], n_calib + 1))
        wide[:, :, : side.shape[2] - 1] = side[:, :, :-1]
        return PieceFeatures.of(self.sums._replace(side=wide), self.plan)


@dataclass(frozen=True)
class Eliminated:
    """Result of the elimination: plan and sizes; turn (n, 15, 15), the orthogonal transform of each keyframe;
    workspace: holds the factors of all steps; remaining (15 or 0 + B + 1, same), upper triangle: the system of the kept
    keyframe, calibration parameters and gradient."""

    plan: Plan
    sizes: Sizes
    turn: np.ndarray
    workspace: np.ndarray
    remaining: np.ndarray

    @property
    def rows(self) -> int:
        """Number of eliminated unknowns, without the features that a single step sees."""
        return int(self.sizes.uncoupled.sum() + self.sizes.coupled.sum() + self.sizes.dying.sum())

    def substitute(self, calib: np.ndarray, white: np.ndarray, chain: np.ndarray) -> None:
        """Back substitution of m right-hand sides: fills chain (n, 15, m), whose kept keyframe is an input.

        calib (B + 1, m): steps of the calibration parameters, and in the last row the factor of the gradient. white
        (rows, m): further right-hand sides after forward substitution.
        """
        substitute_all(self.plan, self.sizes, self.turn, self.workspace, calib, white, chain)


def _sizes(plan: Plan, n_calib: int) -> Sizes:
    """Numbers of rows and columns that the factors of every step have, see `Sizes`, and where they start in the
    workspace. The shapes are those in `step_factors`."""
    coupled = np.add.reduceat(np.append(plan.coupled[plan.keyframes.values], 0), plan.keyframes.start[:-1])
    counts = np.diff(plan.keyframes.start)
    coupled[counts == 0] = 0
    uncoupled, dying, wide = KEYFRAME_DIM * counts - coupled, 3 * np.diff(plan.dying.start), n_calib + 3 * plan.alive
    lengths = (uncoupled + coupled) ** 2 + dying * (dying + coupled) + uncoupled * (KEYFRAME_DIM + n_calib)
    lengths += (coupled + dying) * (KEYFRAME_DIM + wide)
    return Sizes(uncoupled, coupled, dying, wide, np.concatenate([[0], np.cumsum(lengths)]))


def eliminate(
    features: PieceFeatures, diagonal: np.ndarray, upper: np.ndarray, side: np.ndarray, forwards: bool, keep: bool
) -> Eliminated | None:
    """Eliminates all keyframes and features of a piece, but for a kept end keyframe; None if the sums are not positive
    definite. The factors are in the workspace of `features`."""
    plan, sums, n_calib = features.plan, features.sums, side.shape[2]
    sizes = _sizes(plan, n_calib)
    widest = int(sizes.wide.max())
    turn, workspace = np.empty_like(diagonal), features.workspace
    chain = FrontChain(diagonal, upper, side, forwards, turn, np.empty_like(sums.pose), np.empty_like(sums.next_pose))
    rotate_keyframes(plan, sums, turn, chain.pose, chain.next_pose)
    front, carry = np.zeros((widest, widest)), np.zeros((KEYFRAME_DIM, KEYFRAME_DIM + widest))
    if not eliminate_all(plan, sizes, sums, chain, workspace, front, carry):
        return None
    if not keep:
        return Eliminated(plan, sizes, turn, workspace, front[:n_calib, :n_calib].copy())
    remaining = np.zeros((KEYFRAME_DIM + n_calib, KEYFRAME_DIM + n_calib))
    remaining[:KEYFRAME_DIM], remaining[KEYFRAME_DIM:, KEYFRAME_DIM:] = (
        carry[:, : KEYFRAME_DIM + n_calib],
        front[:n_calib, :n_calib],
    )
    return Eliminated(plan, sizes, turn, workspace, remaining)
