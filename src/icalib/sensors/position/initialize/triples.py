"""Second differences of positions over triples of fixes, and the same of the motion that the IMU's readings give.

With p'' = R_world_imu f - g z and the operator A[x] = (x_k - x_j) / h_2 - (x_j - x_i) / h_1 over fixes i, j, k,

    A[p_fix] = R_wg (A[D_f] - A[D_R] b_a) + R_wg A[R_gi] p_imu_sensor - g z (h_1 + h_2) / 2

where g is the IMU's frame at a reference instant, R_gi the gyroscope's rotation from there, D_f and D_R the double
integrals of R_gi f and R_gi. Velocity and origin have dropped out, and the frame of the fixes, which is levelled, is
the world.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from icalib.geometry import so3
from icalib.geometry.integrals import once_integrated, twice_integrated
from icalib.initialize.steps.lever_arm import Triples
from icalib.motion.imu_data import ImuData, clear_of

# Between the fixes of a triple. Noise of 2 cm makes 5 cm/s in a row, a walk's or a car's motion some 1 m/s; gyroscopes
# drift by less than a degree in it.
STEP_S = 1.0
LONGEST_STEPS = 1.6  # STEP_S, or steps between slow fixes; longer ones hold a gap
MARGIN_S = 0.2  # of readings beside the fixes of a window, for the derivative by the time offset


def triples_of(t: np.ndarray) -> Triples:
    """All of fixes at increasing t (N,) s that are about STEP_S apart, or neighbours of slower fixes."""
    usual = float(np.median(np.diff(t))) if len(t) > 1 else STEP_S
    step = max(STEP_S, usual)
    i = np.arange(len(t))
    j = np.searchsorted(t, t + step - 0.1 * usual)
    k = np.searchsorted(t, t[np.minimum(j, len(t) - 1)] + step - 0.1 * usual)
    good = k < len(t)
    i, j, k = i[good], j[good], k[good]
    near = np.maximum(t[j] - t[i], t[k] - t[j]) < LONGEST_STEPS * step
    return Triples.at(t, i[near], j[near], k[near])


def recorded(imu: ImuData, triples: Triples, t: np.ndarray) -> Triples:
    """The triples, of fixes at t (N,) s on the IMU's clock, over which the IMU ran without a gap."""
    begin, end = t[triples.i] - MARGIN_S, t[triples.k] + MARGIN_S
    inside = (begin >= imu.seconds[0]) & (end <= imu.seconds[-1])
    return triples.some(inside & clear_of((*imu.gaps, *imu.seams), begin, end))


@dataclass(frozen=True)
class Carried:
    """What the readings of a window give, at their stamps (N,) s: R_gi (N, 3, 3); turned (N, 3, 3), its integral from
    the reference instant on [s]; columns (N, c) whose double integrals are wanted, with their first and second
    integrals from the first stamp: R_gi f, and but for `alone` R_gi and hat(R_gi f) times `turned`, row by row."""

    seconds: np.ndarray
    rotation: np.ndarray
    rate: np.ndarray
    turned: np.ndarray
    columns: np.ndarray
    first: np.ndarray
    second: np.ndarray

    @classmethod
    def of(
        cls, imu: ImuData, span: tuple[float, float], reference: float, bias: np.ndarray, alone: bool = False
    ) -> Carried:
        """Of the readings over `span` s, with a gyroscope's bias (3,) rad/s."""
        a, b = (int(k) for k in imu.interval(np.array(span)))
        own = slice(max(a - 1, 0), b + 3)
        s, gyro, accel = imu.seconds[own], imu.gyro[own], imu.accel[own]
        dt = np.diff(s)
        rate = 0.5 * (gyro[1:] + gyro[:-1]) - bias
        R = np.empty((len(s), 3, 3))
        R[0] = np.eye(3)
        so3.chain(so3.exp_many(rate * dt[:, None]), R)
        at = int(np.clip(np.searchsorted(s, reference), 0, len(s) - 1))
        R = np.ascontiguousarray(R[at].T @ R)
        turned = once_integrated(R.reshape(len(s), 9), dt).reshape(-1, 3, 3)
        turned -= turned[at]
        force = np.einsum("nij,nj->ni", R, accel)
        columns = force
        if not alone:
            J_bias = so3.hat_many(force) @ turned
            columns = np.concatenate([force, R.reshape(-1, 9), J_bias.reshape(-1, 9)], axis=1)
        first = once_integrated(columns, dt)
        second = twice_integrated(columns, first, dt)
        return cls(s, R, rate, turned, columns, first, second)

    def _interval(self, t: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        j = np.clip(np.searchsorted(self.seconds, t, side="right") - 1, 0, len(self.seconds) - 2)
        return j, t - self.seconds[j]

    def rotation_at(self, t: np.ndarray) -> np.ndarray:
        """(n, 3, 3) R_gi at times t (n,)."""
        j, tau = self._interval(t)
        return self.rotation[j] @ so3.exp_many(self.rate[j] * tau[:, None])

    def turned_at(self, t: np.ndarray) -> np.ndarray:
        """(n, 3, 3) the integral of R_gi at times t (n,)."""
        j, tau = self._interval(t)
        return self.turned[j] + self.rotation[j] * tau[:, None, None]

    def doubles_at(self, t: np.ndarray) -> np.ndarray:
        """(n, c) double integrals of the columns at times t (n,)."""
        j, tau = self._interval(t)
        tau = tau[:, None]
        return self.second[j] + self.first[j] * tau + 0.5 * self.columns[j] * tau**2
