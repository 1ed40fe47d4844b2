"""Gaussian priors on calibration parameters, and a broad prior on the biases at the first keyframe of each
recording."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from icalib.geometry import so3
from icalib.optim.arrowhead import Piece
from icalib.optim.state import Block, State

# Standard deviations of gyroscope [rad/s] and accelerometer [m/s^2] biases, far wider than the turn-on bias of any IMU.
# The prior keeps biases defined without motion.
FIRST_BIAS_SIGMA = np.array([0.5] * 3 + [3.0] * 3)


@dataclass(frozen=True)
class Prior:
    """Gaussian prior on one block: mean `value` and `sigma` (n,), SI units or px.

    The residual is (x - value) / sigma. For rotations it is Log(value^T R) / sigma, with the Jacobian J_r^-1 / sigma.
    """

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
        """Adds the prior to the sums of `piece`, unless only the cost is wanted; returns half its chi^2."""
        r, J = self.residual(state)
        columns = self.block.columns
        if sums:
            piece.calib[np.ix_(columns, columns)] += J.T @ J
            piece.calib[columns, -1] += J.T @ r
            piece.calib[-1, columns] += J.T @ r
        return 0.5 * float(r @ r)


def sums_of_priors(priors: Sequence[Prior], state: State, n_calib: int) -> tuple[float, np.ndarray, np.ndarray]:
    """Half the chi^2 of `priors` at `state`, and their gradient (B,) and information (B, B) on the calibration
    parameters."""
    piece = Piece.zeros(0, 0, n_calib)
    cost = sum(p.accumulate(state, piece) for p in priors)
    return cost, piece.calib[:-1, -1], piece.calib[:-1, :-1]


def without_priors(information: np.ndarray, priors: Sequence[Prior], state: State) -> np.ndarray:
    """Information (B, B) of the calibration parameters at `state`, with that of `priors` subtracted."""
    return information - sums_of_priors(priors, state, len(information))[2]


def variance_of_priors(covariance: np.ndarray, priors: Sequence[Prior], state: State) -> np.ndarray:
    """Variances (B,) that errors of the prior means contribute to the diagonal of the covariance `covariance` (B, B):
    diag(C W C) with C = `covariance` and the information W of `priors`. Measurement noise contributes the rest."""
    information = sums_of_priors(priors, state, len(covariance))[2]
    return np.einsum("ij,jk,ki->i", covariance, information, covariance, optimize=True)


def accumulate_bias_prior(
    state: State, piece: Piece, sums: bool = True, centre: np.ndarray | None = None, keyframe: int = 0
) -> float:
    """Adds the broad prior on the biases at `keyframe`, with mean `centre` (6,) or zero, to `piece`; returns half its
    chi^2."""
    r = (state.bias[keyframe] - (0.0 if centre is None else centre)) / FIRST_BIAS_SIGMA
    if sums:
        index, k = np.arange(9, 15), keyframe - piece.first
        piece.diagonal[k, index, index] += 1.0 / FIRST_BIAS_SIGMA**2
        piece.side[k, 9:15, -1] += r / FIRST_BIAS_SIGMA
    return 0.5 * float(r @ r)
