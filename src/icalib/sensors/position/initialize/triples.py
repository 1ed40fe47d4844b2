"""Second differences of positions over triples of fixes, and of the motion by the IMU's readings.

With p'' = R_world_imu f - g z and the operator A[x] = (x_k - x_j) / h_2 - (x_j - x_i) / h_1 over fixes i, j, k,

    A[p_fix] = R_wg (A[D_f] - A[D_R] b_a) + R_wg A[R_gi] p_imu_sensor - g z (h_1 + h_2) / 2

where g is the IMU's frame at a reference instant, R_gi the gyroscope's rotation from there, D_f and D_R the double
integrals of R_gi f and R_gi. Velocity and origin cancel. The world is the frame of the fixes, which is levelled.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from icalib.geometry import so3
from icalib.geometry.integrals import once_integrated, twice_integrated
from icalib.initialize.steps.lever_arm import Triples
from icalib.motion.imu_data import ImuData, clear_of

# s, between the fixes of a triple. A second difference has 5 cm/s by noise of 2 cm, and about 1 m/s by the motion of a
# walk or a car. A gyroscope drifts by less than a degree meanwhile.
TRIPLE_STEP_S = 1.0
MAX_TRIPLE_STEPS = 1.6  # times the step, TRIPLE_STEP_S or that of slower fixes: beyond it there is a gap
WINDOW_MARGIN_S = 0.2  # s of readings on both sides of the fixes of a window, as the time offset changes in the fit


def triples_of(t: np.ndarray) -> Triples:
    """All triples of fixes at increasing t (N,) s that are about TRIPLE_STEP_S apart; of slower fixes, neighbours."""
    usual = float(np.median(np.diff(t))) if len(t) > 1 else TRIPLE_STEP_S
    step = max(TRIPLE_STEP_S, usual)
    i = np.arange(len(t))
    j = np.searchsorted(t, t + step - 0.1 * usual)
    k = np.searchsorted(t, t[np.minimum(j, len(t) - 1)] + step - 0.1 * usual)
    good = k < len(t)
    i, j, k = i[good], j[good], k[good]
    near = np.maximum(t[j] - t[i], t[k] - t[j]) < MAX_TRIPLE_STEPS * step
    return Triples.at(t, i[near], j[near], k[near])


def recorded(imu: ImuData, triples: Triples, t: np.ndarray) -> Triples:
    """Those triples of fixes at t (N,) s on the IMU's clock during which the IMU has no gap."""
    begin, end = t[triples.i] - WINDOW_MARGIN_S, t[triples.k] + WINDOW_MARGIN_S
    inside = (begin >= imu.seconds[0]) & (end <= imu.seconds[-1])
    return triples.some(inside & clear_of((*imu.gaps, *imu.seams), begin, end))


@dataclass(frozen=True)
class IntegratedReadings:
    """Integrals of the readings of a window, at their stamps `seconds` (N,).

    rotation (N, 3, 3) R_gi; rate (N - 1, 3) rad/s between stamps; rotation_integral (N, 3, 3) s, of R_gi from the
    reference instant; columns (N, c), first, second: R_gi f, R_gi and hat(R_gi f) rotation_integral, flattened row by
    row, with their integrals and double integrals from the first stamp. With `forces_only` there is only R_gi f."""

    seconds: np.ndarray
    rotation: np.ndarray
    rate: np.ndarray
    rotation_integral: np.ndarray
    columns: np.ndarray
    first: np.ndarray
    second: np.ndarray

    @classmethod
    def of(
        cls, imu: ImuData, span: tuple[float, float], reference: float, bias: np.ndarray, forces_only: bool = False
    ) -> IntegratedReadings:
        """Of the readings within `span` s, corrected by a gyroscope bias (3,) rad/s; reference: instant of g [s]."""
        a, b = (int(k) for k in imu.interval(np.array(span)))
        within = slice(max(a - 1, 0), b + 3)
        s, gyro, accel = imu.seconds[within], imu.gyro[within], imu.accel[within]
        dt = np.diff(s)
        rate = 0.5 * (gyro[1:] + gyro[:-1]) - bias
        R = np.empty((len(s), 3, 3))
        R[0] = np.eye(3)
        so3.chain(so3.exp_many(rate * dt[:, None]), R)
        at = int(np.clip(np.searchsorted(s, reference), 0, len(s) - 1))
        R = np.ascontiguousarray(R[at].T @ R)
        rotation_integral = once_integrated(R.reshape(len(s), 9), dt).reshape(-1, 3, 3)
        rotation_integral -= rotation_integral[at]
        force = np.einsum("nij,nj->ni", R, accel)
        columns = force
        if not forces_only:
            J_bias = so3.hat_many(force) @ rotation_integral
            columns = np.concatenate([force, R.reshape(-1, 9), J_bias.reshape(-1, 9)], axis=1)
        first = once_integrated(columns, dt)
        second = twice_integrated(columns, first, dt)
        return cls(s, R, rate, rotation_integral, columns, first, second)

    def _interval(self, t: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        j = np.clip(np.searchsorted(self.seconds, t, side="right") - 1, 0, len(self.seconds) - 2)
        return j, t - self.seconds[j]

    def rotation_at(self, t: np.ndarray) -> np.ndarray:
        """(n, 3, 3) R_gi at t (n,) s."""
        j, tau = self._interval(t)
        return self.rotation[j] @ so3.exp_many(self.rate[j] * tau[:, None])

    def rotation_integral_at(self, t: np.ndarray) -> np.ndarray:
        """(n, 3, 3) s, integrals of R_gi from the reference instant to t (n,) s."""
        j, tau = self._interval(t)
        return self.rotation_integral[j] + self.rotation[j] * tau[:, None, None]

    def doubles_at(self, t: np.ndarray) -> np.ndarray:
        """(n, c) double integrals of `columns` at t (n,) s."""
        j, tau = self._interval(t)
        tau = tau[:, None]
        return self.second[j] + self.first[j] * tau + 0.5 * self.columns[j] * tau**2
