"""The ground factor: at every keyframe the wheel frame is parallel to a plane, with its origin at a constant height h.

With n (3,) the upward normal of the plane, q a point on it, R_k = R_world_imu and p_k = p_world_imu at keyframe k,
R = R_imu_wheel and p = p_imu_wheel, the rows of a keyframe are

    e_1, e_2 of (R_k R)^T n                  over tilt_noise         tilt of the frame against the plane [rad]
    n . (p_k + R_k p - q) - h                over bump_noise         height [m]
    (h - height) / sqrt(keyframes)           over height_sigma       the stated height [m]

The first three have independent noise at each keyframe: suspension and an uneven floor. The last rows of all keyframes
together make up one measurement of h with a constant error. The stated height is a measurement and not a prior, so that
the verdicts on observability include it.

Plane `level`: n = e_3, q the origin of the world. Plane `floor`: in each recording the plane with most LiDAR points
among those that are nearly level and below the IMU.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from math import cos, sin
from typing import ClassVar

import numpy as np

from icalib.base.compiled import njit
from icalib.geometry import planes
from icalib.geometry.small import inverse_cholesky
from icalib.motion.factor import FactorKey, Into, RobustNoise, RowFactor, Whitened, add_rows
from icalib.motion.imu_data import ImuData, StampIntervals
from icalib.optim.arrowhead import Piece
from icalib.optim.rows import Rows
from icalib.optim.state import Key, Layout, State
from icalib.rig import Ground
from icalib.sensors.wheels.spec import GROUND_HEIGHT

LEVEL = np.array([0.0, 0.0, 1.0, 0.0, 0.0, 0.0])  # normal and point of the plane z = 0 of the world
MIN_FLOOR_COSINE = np.cos(np.deg2rad(20.0))  # between the normal of a floor and the vertical; no ramp is as steep
MIN_BELOW_M = 0.02  # least distance of a floor below the mean position of the IMU; above the noise of plane positions
TILT, HEIGHT = "ground tilt", "ground height"
N_COLUMNS = 10  # calibration columns of a row: rotation 3, translation 3, height 1, plane 3


def floors(state: State, keys: tuple[Key, ...], points: np.ndarray, recording: np.ndarray) -> tuple[Key | None, ...]:
    """The key of the floor in each recording, None without one.

    keys: the P planes that LiDARs see; points (P,): LiDAR points on each; recording (P,): recording of each plane.
    """
    keys_of_floors = []
    for r, keyframes in enumerate(state.recordings):
        planes = np.flatnonzero(recording == r)
        middle = state.position[keyframes].mean(axis=0)
        below = [k for k in planes if _is_floor(state.values[keys[k]], middle)]
        keys_of_floors.append(keys[max(below, key=lambda k: points[k])] if below else None)
    return tuple(keys_of_floors)


def _is_floor(plane: np.ndarray, above: np.ndarray) -> bool:
    """True if the plane (6,), normal and point, is nearly level and below the point `above` (3,), all in the world
    frame."""
    n = plane[:3] * np.sign(plane[2])
    return bool(n[2] > MIN_FLOOR_COSINE and n @ (above - plane[3:]) > MIN_BELOW_M)


@dataclass(frozen=True)
class GroundFactor(RowFactor):
    """Four rows of the wheels `name` at n keyframes: two tilts, height, stated height; see the module. Rows whose noise
    `ground` does not state have infinite sigma.

    floor: the key of the plane in each recording; None for a level plane, or for a floor that no LiDAR sees.
    """

    units: ClassVar[Mapping[str, str]] = {TILT: "rad", HEIGHT: "m"}

    name: str
    ground: Ground
    floor: tuple[Key | None, ...]
    keyframes: np.ndarray  # (n,)
    starts: tuple[int, ...]
    layout: Layout

    @classmethod
    def build(
        cls, name: str, ground: Ground, floor: tuple[Key | None, ...], state: State, layout: Layout
    ) -> GroundFactor:
        """The factor at all keyframes of recordings with a plane, except the last keyframe of each."""
        used = [
            np.arange(r.start, r.stop - 1)
            for r, key in zip(state.recordings, floor, strict=True)
            if ground.plane == "level" or key is not None
        ]
        keyframes = np.concatenate([np.empty(0, dtype=np.int64), *used])
        return cls(name, ground, floor, keyframes, state.starts, layout)

    @property
    def key(self) -> FactorKey:
        return self.name, "ground"

    @property
    def kinds(self) -> dict[str, slice]:
        tilt = {TILT: slice(0, 2)} if self.ground.tilt_noise is not None else {}
        return tilt | ({HEIGHT: slice(2, 3)} if self.ground.height_sigma is not None else {})

    @property
    def sigma(self) -> np.ndarray:
        """(4,) standard deviations of the rows [rad, rad, m, m], infinite where `ground` states none."""
        tilt, height = self.ground.tilt_noise, self.ground.height_sigma
        bump = np.inf if height is None else self.ground.bump_noise
        once = np.inf if height is None else height * np.sqrt(len(self.keyframes))
        return np.array([*[np.inf if tilt is None else tilt] * 2, bump, once])

    def with_imu(self, imu: ImuData, state: State) -> GroundFactor:
        """See `Factor`; rows at keyframes do not depend on IMU readings."""
        return self

    def output(self) -> Whitened:
        return Whitened.empty(len(self.keyframes), 4)

    def times(self, state: State) -> np.ndarray:
        return state.seconds[self.keyframes]

    def raw(self, out: Whitened) -> np.ndarray:
        """(n, 4) residuals [rad, rad, m, m]; 0 in rows with infinite sigma."""
        return out.residual * np.where(np.isfinite(self.sigma), self.sigma, 0.0)

    def raw_sigma(self) -> np.ndarray:
        """(n, 4) standard deviations, see `sigma`."""
        return np.tile(self.sigma, (len(self.keyframes), 1))

    def accumulate(self, state: State, piece: Piece, out: Whitened, sums: bool = True, curved: bool = False) -> float:
        cost = 0.0
        ends = (*self.starts[1:], len(state.seconds))
        for begin, end, key in zip(self.starts, ends, self.floor, strict=True):
            low, high = np.searchsorted(self.keyframes, [max(begin, piece.first), min(end, piece.last)])
            if low >= high:
                continue
            block = slice(int(low), int(high))
            rows = self._rows(state, self.keyframes[block], None if key is None else state.values[key])
            whitening = np.tile(np.diag(1.0 / self.sigma), (high - low, 1, 1))
            by = RobustNoise(whitening, "none", 1.0)
            into = Into(piece, out, sums, curved)
            cost += add_rows(rows, block, self.keyframes[block], self._columns(key), by, into)
        return cost

    def _columns(self, key: Key | None) -> np.ndarray:
        """(10,) calibration columns: rotation 3, translation 3, height 1, plane 3; -1 if not estimated."""
        columns = np.full(N_COLUMNS, -1)
        columns[:6] = self.layout.columns(self.name, "rotation", "translation")
        if self.ground.height_sigma is not None:
            columns[6:7] = self.layout.columns(self.name, GROUND_HEIGHT.name)
        if key is not None:
            columns[7:] = self.layout.columns(*key)
        return columns

    def _rows(self, state: State, keyframes: np.ndarray, floor: np.ndarray | None) -> Rows:
        """Rows at `keyframes` (n,) and their Jacobians, not whitened; floor (6,): normal and point, None: level."""
        plane = LEVEL if floor is None else floor
        sign = 1.0 if plane[2] >= 0.0 else -1.0
        n, across = sign * plane[:3], sign * planes.tangents(np.ascontiguousarray(plane[:3]))
        R, p = state.values[self.name, "rotation"], state.values[self.name, "translation"]
        R_k = state.rotation[keyframes]
        up = np.einsum("kji,j->ki", R_k, n)  # normal in IMU axes
        from_plane = state.position[keyframes] + R_k @ p - plane[3:]
        h = state.values.get((self.name, GROUND_HEIGHT.name), np.zeros(1))[0]
        rows = Rows.empty(len(keyframes), 4, N_COLUMNS, True)
        J_calib, J_keyframe = rows.J_calib, rows.J_keyframe
        tilt = up @ R
        # R_k <- R_k Exp(d) changes up by up x d, and R <- R Exp(d) changes tilt by tilt x d.
        J_keyframe[:, :2, :3] = np.cross(R[:, :2].T, up[:, None])
        J_calib[:, :2, :3] = np.cross(np.eye(3)[:2], tilt[:, None])
        J_calib[:, :2, 7:9] = np.einsum("kji,tj->kit", R_k @ R[:, :2], across)
        J_keyframe[:, 2, :3] = np.cross(p, up)
        J_keyframe[:, 2, 3:6] = n
        J_calib[:, 2, 3:6] = up
        J_calib[:, 2, 7:9] = from_plane @ across.T
        J_calib[:, 2, 9] = -sign
        J_calib[:, 2:, 6] = [-1.0, 1.0]
        rows.residual[:] = np.column_stack(
            [tilt[:, :2], from_plane @ n - h, np.full(len(keyframes), h - self.ground.height)]
        )
        return rows


# Relative planar poses of a differential drive, preintegrated from its wheel angles: z_W of equation (27) of the
# iCalib paper.
#
# Poses are in the wheel frame at the first stamp of an interval. Rates are assumed constant from stamp to stamp, so
# that each step is an arc. With d_l, d_r the angles that the wheels turn and psi the yaw before the step:
#
#     dpsi = (r_r d_r - r_l d_l) / b    ds = (r_r d_r + r_l d_l) / 2
#     (dx, dy) = ds sinc(dpsi / 2) (cos, sin)(psi + dpsi / 2)


@dataclass(frozen=True)
class RelativePoses:
    """n relative planar poses (yaw, x, y) [rad, m, m].

    z (n, 3): poses at the parameters drive0 (3,): left radius, right radius, baseline [m]. J_drive (n, 3, 3):
    derivative of z by these parameters. W (n, 3, 3): whitens the error of z; W^T W is the inverse covariance.
    """

    z: np.ndarray
    J_drive: np.ndarray
    W: np.ndarray
    drive0: np.ndarray


@njit(cache=True, nogil=True)
def _sinc(h):
    """sin(h) / h and its derivative; Taylor series of both for small h."""
    if abs(h) < 1e-2:
        x = h * h
        return 1.0 - x / 6.0 * (1.0 - x / 20.0), -h / 3.0 * (1.0 - x / 10.0 * (1.0 - x / 28.0))
    s = sin(h) / h
    return s, (cos(h) - s) / h


@njit(cache=True, nogil=True)
def _arc(psi, turn, path, J_step):
    """Step (dx, dy) [m] of an arc with the yaw psi [rad] at its start, the yaw change `turn` [rad] and the length
    `path` [m]. Fills J_step (3, 2), the Jacobian of (yaw, x, y) by (turn, path)."""
    s, slope = _sinc(0.5 * turn)
    c, n = cos(psi + 0.5 * turn), sin(psi + 0.5 * turn)
    dx, dy = path * s * c, path * s * n
    J_step[0, 0], J_step[0, 1] = 1.0, 0.0
    J_step[1, 0], J_step[1, 1] = 0.5 * (path * slope * c - dy), s * c
    J_step[2, 0], J_step[2, 1] = 0.5 * (path * slope * n + dx), s * n
    return dx, dy


@njit(cache=True, nogil=True)
def _propagate(dx, dy, rows):
    """Propagates rows (3, m), derivatives of (yaw, x, y), over the step (dx, dy): an error of yaw moves the end
    point."""
    for j in range(rows.shape[1]):
        rows[1, j] -= dy * rows[0, j]
        rows[2, j] += dx * rows[0, j]


@njit(cache=True, nogil=True)
def _integrate(first, last, seconds, angles, drive, wheel_noise, slip_noise, z, J, P):
    """Fills the pose z (3,) from stamp `first` to `last`, its Jacobian J (3, 3) by the drive parameters and its
    covariance P (3, 3); noise densities in rad/sqrt(s) and m/sqrt(s)."""
    z[:], J[:], P[:] = 0.0, 0.0, 0.0
    J_step, J_drive, J_angle = np.empty((3, 2)), np.zeros((2, 3)), np.empty((2, 2))
    r_l, r_r, b = drive
    J_angle[0, 0], J_angle[0, 1], J_angle[1, 0], J_angle[1, 1] = -r_l / b, r_r / b, 0.5 * r_l, 0.5 * r_r
    for n in range(first, last):
        d_l, d_r, dt = angles[n + 1, 0] - angles[n, 0], angles[n + 1, 1] - angles[n, 1], seconds[n + 1] - seconds[n]
        turn, path = (r_r * d_r - r_l * d_l) / b, 0.5 * (r_r * d_r + r_l * d_l)
        J_drive[0, 0], J_drive[0, 1], J_drive[0, 2] = -d_l / b, d_r / b, -turn / b
        J_drive[1, 0], J_drive[1, 1] = 0.5 * d_l, 0.5 * d_r
        dx, dy = _arc(z[0], turn, path, J_step)
        slip = (0.0, -sin(z[0] + 0.5 * turn) * slip_noise, cos(z[0] + 0.5 * turn) * slip_noise)
        _propagate(dx, dy, J)
        _propagate(dx, dy, P)
        _propagate(dx, dy, P.T)
        for i in range(3):
            left_i = (J_step[i, 0] * J_angle[0, 0] + J_step[i, 1] * J_angle[1, 0]) * wheel_noise
            right_i = (J_step[i, 0] * J_angle[0, 1] + J_step[i, 1] * J_angle[1, 1]) * wheel_noise
            for j in range(3):
                J[i, j] += J_step[i, 0] * J_drive[0, j] + J_step[i, 1] * J_drive[1, j]
                left_j = (J_step[j, 0] * J_angle[0, 0] + J_step[j, 1] * J_angle[1, 0]) * wheel_noise
                right_j = (J_step[j, 0] * J_angle[0, 1] + J_step[j, 1] * J_angle[1, 1]) * wheel_noise
                P[i, j] += (left_i * left_j + right_i * right_j + slip[i] * slip[j]) * dt
        z[0] += turn
        z[1] += dx
        z[2] += dy


@njit(cache=True, nogil=True)
def _integrate_all(first, last, seconds, angles, drive, wheel_noise, slip_noise, z, J, W):
    """Fills z (n, 3), J (n, 3, 3) and W (n, 3, 3) of `RelativePoses` for n intervals."""
    P = np.empty((3, 3))
    for i in range(len(first)):
        _integrate(first[i], last[i], seconds, angles, drive, wheel_noise, slip_noise, z[i], J[i], P)
        inverse_cholesky(P, W[i])


def preintegrated(
    seconds: np.ndarray,
    angles: np.ndarray,
    intervals: StampIntervals,
    drive: np.ndarray,
    wheel_noise: float,
    slip_noise: float,
) -> RelativePoses:
    """Relative poses over n intervals from wheel angles (N, 2) rad at stamps seconds (N,); drive (3,) m as in
    `RelativePoses`.

    wheel_noise: density of each wheel's angle [rad/sqrt(s)]; slip_noise: density of lateral slip [m/sqrt(s)]. Both must
    be above zero: without slip the covariance of a short interval is singular, and the lateral variance of a long one
    is too small.
    """
    n = len(intervals.keyframe)
    z, J, W = np.empty((n, 3)), np.empty((n, 3, 3)), np.empty((n, 3, 3))
    drive0 = np.array(drive, dtype=np.float64)
    _integrate_all(intervals.first, intervals.last, seconds, angles, drive0, wheel_noise, slip_noise, z, J, W)
    return RelativePoses(z, J, W, drive0)
