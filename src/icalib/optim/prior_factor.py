"""Gaussian priors on lasting parameters, and a very broad one on the biases of each recording's first keyframe."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from icalib.geometry import so3
from icalib.optim.arrowhead import Piece
from icalib.optim.state import Block, State

# Keeps the biases defined where nothing else does (a motionless stretch); far wider than any IMU's turn-on bias.
FIRST_BIAS_SIGMA = np.array([0.5] * 3 + [3.0] * 3)


@dataclass(frozen=True)
class Prior:
    """residual = (x - value) / sigma; for rotations Log(value^T R) / sigma, Jacobian J_r^-1 / sigma."""

    block: Block
    value: np.ndarray
    sigma: np.ndarray

    def residual(self, state: State) -> tuple[np.ndarray, np.ndarray]:
        """Whitened residual (n,) and its Jacobian (n, n)."""
        x = state.values[self.block.key]
        if self.block.kind == "rotation":
            error = so3.log(np.ascontiguousarray(self.value.T @ x))
            return error / self.sigma, so3.right_jacobian_inverse(error) / self.sigma[:, None]
        return (x - self.value) / self.sigma, np.diag(1.0 / self.sigma)

    def accumulate(self, state: State, piece: Piece, sums: bool = True) -> float:
        """Adds the prior to the sums of `piece`; returns half its chi^2."""
        r, J = self.residual(state)
        columns = self.block.columns
        if sums:
            piece.calib[np.ix_(columns, columns)] += J.T @ J
            piece.calib[columns, -1] += J.T @ r
            piece.calib[-1, columns] += J.T @ r
        return 0.5 * float(r @ r)


def sums_of_priors(priors: Sequence[Prior], state: State, n_calib: int) -> tuple[float, np.ndarray, np.ndarray]:
    """Half the chi^2 of `priors`, and their gradient (B,) and information (B, B) on the calibration parameters."""
    piece = Piece.zeros(0, 0, n_calib)
    cost = sum(p.accumulate(state, piece) for p in priors)
    return cost, piece.calib[:-1, -1], piece.calib[:-1, :-1]


def without_priors(information: np.ndarray, priors: Sequence[Prior], state: State) -> np.ndarray:
    """(B, B) the calibration parameters' information at `state` less that of `priors`."""
    return information - sums_of_priors(priors, state, len(information))[2]


def variance_of_priors(known: np.ndarray, priors: Sequence[Prior], state: State) -> np.ndarray:
    """(B,) variances that errors of the means of `priors` contribute to an estimate in which the priors count: the
    diagonal of K W K, with W the information of the priors and K = `known` (B, B) what leads from the normal equations
    to the estimate: the inverse of its information."""
    information = sums_of_priors(priors, state, len(known))[2]
    return np.einsum("ij,jk,ki->i", known, information, known, optimize=True)


def accumulate_bias_prior(
    state: State, piece: Piece, sums: bool = True, centre: np.ndarray | None = None, keyframe: int = 0
) -> float:
    """The broad prior on the biases of `keyframe`, a recording's first, about `centre` (6,) or zero. Returns half its
    chi^2."""
    r = (state.bias[keyframe] - (0.0 if centre is None else centre)) / FIRST_BIAS_SIGMA
    if sums:
        index, k = np.arange(9, 15), keyframe - piece.first
        piece.diagonal[k, index, index] += 1.0 / FIRST_BIAS_SIGMA**2
        piece.side[k, 9:15, -1] += r / FIRST_BIAS_SIGMA
    return 0.5 * float(r @ r)
