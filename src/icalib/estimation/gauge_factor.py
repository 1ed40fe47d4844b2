"""Where the world's origin is and which way x points, in a rig without a target: the first node is held there.

A target's frame is the world's; planes and points have none of their own, and turning all about gravity or moving
it changes no measurement. Four whitened residuals hold a recording's first node: position, and e3^T Log(R R_0^T), the
turn about gravity. They act on what is free only, so their sizes change no calibration.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from icalib.estimation.arrowhead import Piece
from icalib.estimation.state import NODE, State
from icalib.geometry import so3


@dataclass(frozen=True)
class Gauge:
    """Holds `node`, a recording's first, at rotation (3, 3) R_world_imu, but for its tilt, and position (3,)."""

    sigma: ClassVar[np.ndarray] = np.array([1e-3] * 4)  # m, rad

    node: int
    rotation: np.ndarray
    position: np.ndarray

    def residual(self, state: State) -> tuple[np.ndarray, np.ndarray]:
        """Whitened residual (4,) and its Jacobian (4, 15) by the node."""
        R = state.rotation[self.node]
        error = so3.log(np.ascontiguousarray(R @ self.rotation.T))
        J = np.zeros((4, NODE))
        J[:3, 3:6] = np.eye(3)
        J[3, :3] = (so3.left_jacobian_inverse(error) @ R)[2]
        r = np.append(state.position[self.node] - self.position, error[2])
        return r / self.sigma, J / self.sigma[:, None]

    def accumulate(self, state: State, piece: Piece, sums: bool = True, residual: np.ndarray | None = None) -> float:
        """Adds to the sums of `piece` if the node lies in it, its last aside, with `residual` in place of its own.
        Returns half its chi^2."""
        if not piece.first <= self.node < piece.last:
            return 0.0
        r, J = self.residual(state)
        r = r if residual is None else residual
        if sums:
            k = self.node - piece.first
            piece.diagonal[k] += J.T @ J
            piece.side[k, :, -1] += J.T @ r
        return 0.5 * float(r @ r)
