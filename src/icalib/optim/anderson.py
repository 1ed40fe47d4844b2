"""Anderson acceleration of Gauss-Newton steps.

J^T J lacks the second derivatives of the residuals. Where residuals are large, and a parameter such as the time offset
of noisy wheels is known from small differences only, steps therefore converge linearly. The last few steps show how the
step changes as the state moves. Their combination that leaves the smallest step is taken (Anderson, J. ACM 12, 1965;
Walker and Ni, SIAM J. Numer. Anal. 49, 2011, equation (2.1) with all mixing parameters 1).
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

# earlier steps in use; the modes seen so far come in pairs of a parameter and the motion that follows it
MAX_EARLIER_STEPS = 3
SLOW_DECREASE_RATIO = 0.1  # of the predicted decrease before: steps that shrink faster converge well by themselves
MIN_SINGULAR_RATIO = 1e-6  # relative singular value, below which earlier steps are the same
MIN_ACCELERATED_GAIN = 0.5  # of what the plain step promises: an accelerated one must gain more


@dataclass
class Accelerator:
    """The last undamped steps: where each was taken from, relative to the one before, and what it was."""

    moves: list[np.ndarray] = field(default_factory=list)
    steps: list[np.ndarray] = field(default_factory=list)
    decrease: float = 0.0

    def slow(self, decrease: float) -> bool:
        """Whether plain steps, of which the next promises `decrease`, converge slowly."""
        return bool(self.moves) and decrease > SLOW_DECREASE_RATIO * self.decrease

    def step(self, chain: np.ndarray, calib: np.ndarray, decrease: float) -> tuple[np.ndarray, np.ndarray] | None:
        """The accelerated step, chain (K, 15) and calib (B,), for a plain one that promises `decrease`; None where
        plain steps converge well, or too few are known."""
        if not self.slow(decrease):
            return None
        now = np.concatenate([chain.ravel(), calib])
        scale = self._scale(chain, calib)
        changes = np.diff(np.array([*self.steps, now]), axis=0)
        share = np.linalg.lstsq((changes / scale).T, now / scale, rcond=MIN_SINGULAR_RATIO)[0]
        best = now - share @ (np.array(self.moves) + changes)
        return best[: chain.size].reshape(chain.shape), best[chain.size :]

    def note(self, plain: tuple[np.ndarray, np.ndarray], taken: tuple[np.ndarray, np.ndarray], decrease: float) -> None:
        """Remembers that in place of a `plain` step, which promised `decrease`, another or the same was `taken`."""
        self.steps.append(np.concatenate([x.ravel() for x in plain]))
        self.moves.append(np.concatenate([x.ravel() for x in taken]))
        self.steps, self.moves, self.decrease = (
            self.steps[-MAX_EARLIER_STEPS:],
            self.moves[-MAX_EARLIER_STEPS:],
            decrease,
        )

    def forget(self) -> None:
        """After a step that was damped, shortened or not taken."""
        self.steps, self.moves, self.decrease = [], [], 0.0

    @staticmethod
    def _scale(chain: np.ndarray, calib: np.ndarray) -> np.ndarray:
        """What each component of a step is compared with: the root mean square of its kind over all keyframes, so that
        units do not matter; the calibration parameters count as much as the chain."""
        by_kind = np.sqrt((chain**2).mean(axis=0)) * np.sqrt(len(chain))
        own = np.abs(calib)
        both = [np.tile(np.where(by_kind > 0.0, by_kind, 1.0), len(chain)), np.where(own > 0.0, own, 1.0)]
        return np.concatenate(both)
