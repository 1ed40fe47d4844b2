"""Anderson acceleration of Gauss-Newton steps.

J^T J lacks the second derivatives of the residuals. Steps therefore converge linearly where residuals are large and a
parameter is weakly observable, such as the time offset of noisy wheels. Differences of the last steps approximate how
the step changes with the state. The accelerated step is their combination with the smallest predicted step (Anderson,
J. ACM 12, 1965; Walker and Ni, SIAM J. Numer. Anal. 49, 2011, equation (2.1) with all mixing parameters 1).
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

# Number of earlier steps in use. Slow modes come in pairs: a parameter, and the motion that compensates it.
MAX_EARLIER_STEPS = 3
SLOW_DECREASE_RATIO = 0.1  # predicted over last predicted decrease: below it, plain steps converge fast enough
MIN_SINGULAR_RATIO = 1e-6  # relative singular value: below it, earlier steps are collinear
MIN_ACCELERATED_GAIN = 0.5  # of the plain step's predicted decrease: an accelerated step must gain more


@dataclass
class Accelerator:
    """History of the last undamped steps. moves: displacement to the next state; steps: Gauss-Newton step from the same
    state; decrease: predicted decrease of half the chi^2 by the last step."""

    moves: list[np.ndarray] = field(default_factory=list)
    steps: list[np.ndarray] = field(default_factory=list)
    decrease: float = 0.0

    def slow(self, decrease: float) -> bool:
        """True if plain steps converge slowly. decrease: predicted decrease of half the chi^2 by the next step."""
        return bool(self.moves) and decrease > SLOW_DECREASE_RATIO * self.decrease

    def step(self, chain: np.ndarray, calib: np.ndarray, decrease: float) -> tuple[np.ndarray, np.ndarray] | None:
        """Accelerated step, chain (K, 15) and calib (B,), from the plain step and its predicted `decrease`. None if
        plain steps converge well or no earlier step is known."""
        if not self.slow(decrease):
            return None
        now = np.concatenate([chain.ravel(), calib])
        scale = self._scale(chain, calib)
        changes = np.diff(np.array([*self.steps, now]), axis=0)
        share = np.linalg.lstsq((changes / scale).T, now / scale, rcond=MIN_SINGULAR_RATIO)[0]
        best = now - share @ (np.array(self.moves) + changes)
        return best[: chain.size].reshape(chain.shape), best[chain.size :]

    def note(self, plain: tuple[np.ndarray, np.ndarray], step: tuple[np.ndarray, np.ndarray], decrease: float) -> None:
        """Records the `plain` step, its predicted `decrease`, and the step `step`: the plain or the accelerated one."""
        self.steps.append(np.concatenate([x.ravel() for x in plain]))
        self.moves.append(np.concatenate([x.ravel() for x in step]))
        self.steps, self.moves, self.decrease = (
            self.steps[-MAX_EARLIER_STEPS:],
            self.moves[-MAX_EARLIER_STEPS:],
            decrease,
        )

    def forget(self) -> None:
        """Drops all steps, after one that was damped, shortened or rejected."""
        self.steps, self.moves, self.decrease = [], [], 0.0

    @staticmethod
    def _scale(chain: np.ndarray, calib: np.ndarray) -> np.ndarray:
        """Scale (15 K + B,) of each component of a step, which makes the fit independent of units: the root mean square
        over all keyframes times sqrt(K) for the chain, the magnitude for calibration parameters."""
        by_kind = np.sqrt((chain**2).mean(axis=0)) * np.sqrt(len(chain))
        magnitude = np.abs(calib)
        scales = [np.tile(np.where(by_kind > 0.0, by_kind, 1.0), len(chain)), np.where(magnitude > 0.0, magnitude, 1.0)]
        return np.concatenate(scales)
