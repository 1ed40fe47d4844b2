"""The factor of an IMU that is mounted on another one: its readings between its own poses at the keyframes.

Its rotation and position follow from those of the body, the first IMU, by extrinsics and time offset (`SensorPose`).
Its velocity is a state of its own, u = R_world_body^T (v - v_body), and so are its biases.

The body's angular rate and the lever arm also give the velocity. But a rate at one instant is a single noisy reading,
and two intervals would share its noise. With a free velocity the readings of each IMU enter once, in its own factor,
and it does not matter which IMU is the body. The lever arm shows in the rows of the position. A change of the time
offset or clock rate within a pass moves the poses, but not the velocity, which is free, nor the durations.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from icalib.base.compiled import njit
from icalib.geometry import so3
from icalib.motion.factor import FactorKey, Into, RobustNoise, RowFactor, Whitened, add_rows, rows_by_recording
from icalib.motion.imu_data import ImuData, clear_of, without_effects
from icalib.motion.poses import EstimatedMotion, gravity_of, pace_of, seconds_at
from icalib.motion.sensor_pose import Kinematics, SensorPose, add_pose_chain
from icalib.optim.arrowhead import FIRST_BIAS_SIGMA, Piece
from icalib.optim.rows import Rows
from icalib.optim.state import FURTHER_IMU_DIM, KEYFRAME_DIM, Layout, State
from icalib.rig.scene import GRAVITY, WORLD
from icalib.sensors.imu.residual import (
    KINDS,
    N_ROWS,
    Chain,
    Increments,
    bias_correction,
    fill_jacobians,
    fill_last_column,
    fill_residual,
    free_columns,
    free_groups,
    free_values,
    preintegrated_with_jacobians,
    state_change,
)

# Information [SI] on steps of velocity and biases at each keyframe: keeps them defined where there are no readings. Its
# standard deviations of 1 km/s, 1000 rad/s and 1000 m/s^2 are too wide for other effects.
WEAK_INFORMATION = 1e-6


@njit(cache=True, nogil=True)
def _linearise(first, last, chain, increments, dx, n_gravity, r, J):
    """Fills residuals r (m, 15), not whitened, of the intervals `first` to last - 1, and, unless it is empty, their
    Jacobians J (m, 15, 30 + p + n_gravity) by poses (position in the world), velocities and biases at both ends,
    p free parameters, and gravity. dx (p,): changes of these parameters since preintegration."""
    change = np.zeros(9)
    for k in range(first, last):
        R01, hv, hp = state_change(k, chain)
        bias_correction(k, chain, increments, dx, change)
        fill_residual(k, chain, increments, change, R01, hv, hp, r[k - first])
        if len(J):
            J_k = J[k - first]
            for i in range(9, N_ROWS):
                J_k[i, i], J_k[i, KEYFRAME_DIM + i] = -1.0, 1.0
            fill_jacobians(k, chain, increments, change, R01, hv, hp, r[k - first], J_k)
            if n_gravity:
                fill_last_column(k, chain, 1.0, r[k - first], J_k)


@dataclass(frozen=True)
class MountedImuFactor(RowFactor):
    """All intervals of one mounted IMU between neighbouring keyframes; the rows are those of `ImuFactor`.

    readings: of the mounted IMU, corrected for effects on them. imu, gravity: readings of the body, and gravity [m/s^2]
    where the state has none. seconds (K,): keyframes on its clock when the factor was built; pace: see `pace_of`, then.
    increments: W is zero where it has no readings, but for the biases. values0: free parameters then. state_column: of
    its velocity and biases in a keyframe.
    """

    readings: ImuData
    imu: ImuData
    gravity: float
    layout: Layout
    seconds: np.ndarray
    pace: float
    increments: Increments
    values0: np.ndarray
    starts: tuple[int, ...]

    @classmethod
    def build(cls, readings: ImuData, motion: EstimatedMotion, layout: Layout) -> MountedImuFactor:
        """Preintegrates all intervals in which the IMU ran, at the state of `motion`."""
        state, name = motion.state, readings.name
        seconds = seconds_at(state, name)
        intrinsics, bias = state.values[name, "intrinsics"], _imu_states(layout, state, name)[:, 3:]
        usable = readings.covers(seconds[:-1], seconds[1:]) & clear_of(readings.seams, seconds[:-1], seconds[1:])
        usable[np.array(state.starts[1:], dtype=np.int64) - 1] = False
        groups = free_groups(layout, name)
        readings, pace = without_effects(readings, state, bias[:, :3].mean(axis=0)), pace_of(state, name)
        at_pace = readings.at_pace(pace)
        increments = preintegrated_with_jacobians(at_pace, pace * seconds, usable, bias, intrinsics, groups)
        R = state.rotation @ state.values[name, "rotation"]
        # Zero residual without readings: Log of an arbitrary rotation may have no derivative.
        increments.dR[~usable] = (R[:-1].transpose(0, 2, 1) @ R[1:])[~usable]
        dt, bridged = np.diff(seconds), ~usable
        bridged[np.array(state.starts[1:], dtype=np.int64) - 1] = False  # recordings are independent
        for column, density in zip(range(9, N_ROWS), np.repeat(readings.walk, 3), strict=True):
            increments.W[bridged, column, column] = 1.0 / np.sqrt(density * dt[bridged])
        return cls(
            readings,
            motion.imu,
            motion.gravity,
            layout,
            seconds,
            pace,
            increments,
            free_values(state, name, groups),
            state.starts,
        )

    @property
    def name(self) -> str:
        return self.readings.name

    @property
    def key(self) -> FactorKey:
        return self.name, "readings"

    @property
    def kinds(self) -> dict[str, slice]:
        return KINDS

    @property
    def state_column(self) -> int:
        return _state_column(self.layout, self.name)

    def output(self) -> Whitened:
        """See `Factor`; K - 1 rows of 15."""
        return Whitened.empty(len(self.seconds) - 1, N_ROWS)

    def count(self, out: Whitened, kind: str) -> int:
        """See `RowFactor`; without readings, an interval counts for the bias walk only."""
        columns = self.kinds[kind]
        return int((self.increments.W[:, columns.start, columns.start] > 0.0).sum()) * (columns.stop - columns.start)

    def times(self, state: State) -> np.ndarray:
        """(K - 1,) time [s] of the keyframe at which each interval starts."""
        return state.seconds[:-1]

    def accumulate(self, state: State, piece: Piece, out: Whitened, sums: bool = True, curved: bool = False) -> float:
        """See `Factor`; `curved` has no effect, as there is no robust loss."""
        n = len(self.seconds)
        keyframes = np.arange(piece.first, piece.last + 1)
        at = SensorPose.at(Kinematics.of(self), self.seconds[keyframes], keyframes, state, sums)
        cost, into = self._accumulate_priors(state, piece, sums), Into(piece, out, sums, curved)
        chain = self._chain(state, keyframes, at)
        for clock, some in rows_by_recording(np.arange(n - 1), self.starts, n, piece):
            rows = self._rows(state, chain, at, (some, piece.first), sums)
            noise = RobustNoise(self.increments.W[some], "none", 1.0)
            cost += add_rows(rows, some, np.arange(some.start, some.stop), self._columns(clock), noise, into)
        return cost

    def _columns(self, clock: int) -> np.ndarray:
        """Calibration columns of the rows: pose, intrinsics of the body's IMU, free parameters of this one, gravity."""
        free = free_columns(self.layout, self.name)
        return np.concatenate([Kinematics.of(self).columns(clock), free, self._gravity_column])

    @property
    def _gravity_column(self) -> np.ndarray:
        key = WORLD, GRAVITY.name
        return self.layout.columns(*key) if self.layout.has(*key) else np.zeros(0, dtype=np.int64)

    def _chain(self, state: State, keyframes: np.ndarray, at: SensorPose) -> Chain:
        """The IMU's own states at the keyframes `keyframes`, in arrays (K, ...) of which only these are filled."""
        n, states = len(self.seconds), _imu_states(self.layout, state, self.name)
        R, p, v = np.zeros((n, 3, 3)), np.zeros((n, 3)), np.zeros((n, 3))
        R[keyframes], p[keyframes] = at.rotation, at.position
        v[keyframes] = state.velocity[keyframes] + np.einsum(
            "nij,nj->ni", state.rotation[keyframes], states[keyframes, :3]
        )
        bias = np.ascontiguousarray(states[:, 3:])
        return Chain(R, p, v, bias, self.pace * self.seconds, gravity_of(state, self.gravity))

    def _rows(self, state: State, chain: Chain, at: SensorPose, some: tuple[slice, int], jacobians: bool) -> Rows:
        """Rows of the intervals some[0]; some[1]: keyframe of the first pose in `at`."""
        (k, first), n_free, gravity = some, len(self.values0), self._gravity_column
        m = k.stop - k.start
        r = np.empty((m, N_ROWS))
        J_imu = np.zeros((m if jacobians else 0, N_ROWS, 2 * KEYFRAME_DIM + n_free + len(gravity)))
        dx = free_values(state, self.name, free_groups(self.layout, self.name)) - self.values0
        _linearise(k.start, k.stop, chain, self.increments, dx, len(gravity), r, J_imu)
        dim, n_pose = self.layout.keyframe_dim, at.n_calib
        J = np.zeros((len(J_imu), N_ROWS, 2 * dim + n_pose + n_free + len(gravity)))
        if jacobians:
            J[:, :, 2 * dim + n_pose :] = J_imu[:, :, 2 * KEYFRAME_DIM :]
            for end in range(2):
                keyframes = slice(k.start + end, k.stop + end)
                J_state = J_imu[:, :, KEYFRAME_DIM * end : KEYFRAME_DIM * (end + 1)]
                self._add_end(
                    state, keyframes, J_state, at.part(slice(keyframes.start - first, keyframes.stop - first)), end, J
                )
        return Rows(r, J)

    def _add_end(
        self, state: State, keyframes: slice, J_state: np.ndarray, at: SensorPose, end: int, J: np.ndarray
    ) -> None:
        """Adds to J the derivatives by one end of the intervals. J_state (m, 15, 15): by the IMU's own state there."""
        dim = self.layout.keyframe_dim
        J_pose = np.concatenate([J_state[:, :, :3], J_state[:, :, 3:6] @ at.rotation], axis=2)
        add_pose_chain(J_pose, at, dim * end, 2 * dim, J)
        first, R = dim * end + self.state_column, np.ascontiguousarray(state.rotation[keyframes])
        u = np.ascontiguousarray(_imu_states(self.layout, state, self.name)[keyframes, :3])
        J_velocity = J_state[:, :, 6:9] @ R
        J[:, :, first : first + 3] += J_velocity
        J[:, :, first + 3 : first + FURTHER_IMU_DIM] += J_state[:, :, 9:]
        J[:, :, dim * end + 6 : dim * end + 9] += J_state[:, :, 6:9]
        J[:, :, dim * end : dim * end + 3] -= J_velocity @ so3.hat_many(u)

    def _accumulate_priors(self, state: State, piece: Piece, sums: bool) -> float:
        """Adds the broad prior on the biases at the first keyframe of each recording in `piece`, with the biases at the
        start of the pass as its mean, and WEAK_INFORMATION at each keyframe. Returns half the chi^2 of the biases."""
        cost, o = 0.0, self.state_column
        bias = _imu_states(self.layout, state, self.name)[:, 3:]
        if sums:
            columns = range(o, o + FURTHER_IMU_DIM)
            piece.diagonal[:, columns, columns] += WEAK_INFORMATION
        for start in self.starts:
            if not piece.first <= start < piece.last:
                continue
            k, columns = start - piece.first, np.arange(o + 3, o + FURTHER_IMU_DIM)
            r = (bias[start] - self.increments.bias0[start]) / FIRST_BIAS_SIGMA
            cost += 0.5 * float(r @ r)
            if sums:
                piece.diagonal[k, columns, columns] += FIRST_BIAS_SIGMA**-2
                piece.side[k, columns, -1] += r / FIRST_BIAS_SIGMA
        return cost


# m/s, on each axis: standard deviation of the velocity of IMUs without any other sensor, as they are carried or driven.
# It keeps gravity and gyroscope biases determined.
SPEED_SIGMA_M_S = 10.0


@dataclass(frozen=True)
class SlowMotion(RowFactor):
    """Gaussian prior on the velocity at each keyframe, of mean 0 and standard deviation SPEED_SIGMA_M_S: IMUs alone do
    not measure it. starts: first keyframe of each recording."""

    name: str
    n_keyframes: int
    starts: tuple[int, ...]

    @property
    def key(self) -> FactorKey:
        return self.name, "speed"

    @property
    def kinds(self) -> dict[str, slice]:
        """Empty: a prior is not reported as residuals."""
        return {}

    def with_imu(self, imu: ImuData, state: State) -> SlowMotion:
        """The same prior, which does not depend on readings."""
        return self

    def output(self) -> Whitened:
        """Empty rows (K, 3)."""
        return Whitened.empty(self.n_keyframes, 3)

    def accumulate(self, state: State, piece: Piece, out: Whitened, sums: bool = True, curved: bool = False) -> float:
        """See `Factor`."""
        keyframe, cost, none = np.arange(self.n_keyframes), 0.0, np.zeros(0, dtype=np.int64)
        for _, some in rows_by_recording(keyframe, self.starts, self.n_keyframes, piece):
            rows = Rows.empty(some.stop - some.start, 3, 0, sums)
            rows.residual[:] = state.velocity[some]
            rows.J_keyframe[:, :, 6:9] = np.eye(3)
            at = rows.on_intervals(keyframe[some], self.n_keyframes)
            noise = RobustNoise(np.tile(np.eye(3) / SPEED_SIGMA_M_S, (len(at), 1, 1)), "none", 1.0)
            cost += add_rows(rows, some, at, none, noise, Into(piece, out, sums, curved))
        return cost


def _state_column(layout: Layout, name: str) -> int:
    """First column of the states of IMU `name` in a keyframe."""
    return KEYFRAME_DIM + FURTHER_IMU_DIM * layout.further_imus.index(name)


def _imu_states(layout: Layout, state: State, name: str) -> np.ndarray:
    """(K, 9) relative velocity [m/s] and biases of IMU `name`."""
    o = _state_column(layout, name) - KEYFRAME_DIM
    return state.further_imus[:, o : o + FURTHER_IMU_DIM]
