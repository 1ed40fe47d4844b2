"""Wheels of a differential drive against the motion between neighbouring nodes: two factors.

`IncrementFactor`, the default: what each wheel has turned, and that the vehicle moves neither sideways nor off the
ground beyond a slip density. `RelativePoseFactor`: paper (27)-(28), a planar pose integrated from the wheels.

Both look at stretches between two fixed instants of the wheels' clock (`wheel_intervals`). Only where these lie on the
clock of the IMU, and so the states' poses there, moves with the time offset.

The frame of the wheels has x forward, y to the left, z up, its origin midway between them. Their parameters are the
blocks rotation, translation (R_imu_wheel, p_imu_wheel), time_offset, radii (left, right) and baseline, the distance
between the wheels.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import ClassVar

import numpy as np

from icalib.estimation.arrowhead import Piece
from icalib.estimation.imu_data import ImuData
from icalib.estimation.poses import Poses, motion_at, poses_at
from icalib.estimation.row_sums import Into, Weighing, add_rows
from icalib.estimation.sensors import Whitened
from icalib.estimation.state import Layout, State
from icalib.estimation.wheel_intervals import (
    Instants,
    WheelIntervals,
    choose_intervals,
    pose_intervals,
    quadrature,
)
from icalib.estimation.wheel_kernels import (
    Rows,
    Track,
    Wheels,
    increment_rows,
    relative_rows,
)
from icalib.estimation.wheel_poses import RelativePoses, preintegrated
from icalib.measurements import WheelPoses

OWN = ("rotation", "translation", "time_offset", "radii", "baseline")


@dataclass(frozen=True)
class WheelNoise:
    """Densities: of each wheel's angle, rad/sqrt(s); of slip sideways and off the ground, m/sqrt(s). The robust loss of
    each whitened row, and where it bends, in standard deviations."""

    wheel: float
    sideways: float = 5e-3
    upwards: float = 5e-3
    loss: str = "none"
    loss_scale: float = 2.5


@dataclass(frozen=True)
class IncrementFactor:
    """Both wheels' increments over n intervals. With Theta = Log(R(s_0)^T R(s_1)), D the integral of R(t)^T v(t) along
    the `inertial` scheme, X = R_wheel_imu (D + Theta x p_imu_wheel) and T = R_wheel_imu Theta, the rows of an interval
    of length dt are

        (e_1 X -+ b/2 e_3 T) / r - turned, over wheel sqrt(dt)     left, right
        e_2 X, e_3 X, over sideways sqrt(dt), upwards sqrt(dt)

    X and T stand for integrals of rates; Theta differs from that of the angular rate w by dt^3 / 12 |w x w'|: 1e-5 rad
    where a vehicle on a ramp turns at 1 rad/s and pitches at 1 rad/s^2, over 50 ms.
    """

    kinds: ClassVar[dict[str, slice]] = {
        "wheels": slice(0, 2), "sideways slip": slice(2, 3), "upwards slip": slice(3, 4),
    }  # fmt: skip
    units: ClassVar[dict[str, str]] = {"wheels": "rad", "sideways slip": "m", "upwards slip": "m"}

    name: str
    intervals: WheelIntervals
    measured: np.ndarray  # (n, 4): what the wheels turned, rad; slip, which nobody measured: 0 m
    whitening: np.ndarray  # (n, 4, 4)
    instants: Instants
    imu: ImuData
    gravity: float
    noise: WheelNoise
    layout: Layout

    @classmethod
    def build(
        cls,
        name: str,
        seconds: np.ndarray,
        angles: np.ndarray,
        imu: ImuData,
        gravity: float,
        noise: WheelNoise,
        layout: Layout,
        state: State,
    ) -> IncrementFactor:
        """From angles (N, 2) rad that the wheels, left and right, have turned at stamps seconds (N,) since the first on
        the wheels' clock. Chooses the intervals at the time offset and the nodes of `state`."""
        found = wheel_intervals(name, seconds, imu, state)
        scale = np.array([noise.wheel, noise.wheel, noise.sideways, noise.upwards])
        root_dt = np.sqrt(seconds[found.last] - seconds[found.first])
        whitening = np.eye(4) / (scale * root_dt[:, None])[:, :, None]
        measured = np.zeros((len(root_dt), 4))
        measured[:, :2] = angles[found.last] - angles[found.first]
        return cls(name, found, measured, whitening, quadrature(seconds, found), imu, gravity, noise, layout)

    def with_imu(self, imu: ImuData) -> IncrementFactor:
        """See `SensorFactor`."""
        return replace(self, imu=imu)

    def output(self) -> Whitened:
        """Empty arrays for `accumulate` to fill."""
        return Whitened.empty(len(self.measured), 4)

    def count(self, out: Whitened, kind: str) -> int:
        """Intervals times the rows of `kind`."""
        return out.residual[:, self.kinds[kind]].size

    def rms(self, out: Whitened, kind: str) -> tuple[float, str]:
        """Of the residuals of `kind`."""
        return _rms(out, self.whitening, self.kinds[kind]), self.units[kind]

    def accumulate(
        self,
        state: State,
        piece: Piece,
        out: Whitened,
        sums: bool = True,
        curved: bool = False,
        noise: np.ndarray | None = None,
    ) -> float:
        """Fills `out` for the intervals in `piece`, and adds them to its sums where `sums` are wanted.

        Returns half the robust chi^2. `curved`: J^T J has the true curvature of the robust loss, not its weights alone.
        `noise` (n, 4), white, stands in for the whitened residuals where given.
        """
        own = _in_piece(self.intervals, piece)
        start = self.instants.start[own.start : own.stop + 1]
        seen = slice(int(start[0]), int(start[-1]))
        times, node = self.instants.times[seen] + _offset(self.name, state), self.instants.node[seen]
        free = self.layout.is_free(self.imu.name, "intrinsics")
        poses, moving = motion_at(times, node, state, self.imu, self.gravity, free)
        rows = Rows.empty(len(start) - 1, 4, poses.by_imu.shape[2], sums)
        wheels = _wheels(self.name, state)
        increment_rows(
            start - start[0], self.instants.weight[seen], _track(node, poses), moving, wheels, self.measured[own], rows
        )
        return _add(self, own, rows, self.whitening, Into(piece, out, sums, curved, noise))


@dataclass(frozen=True)
class RelativePoseFactor:
    """Planar poses of the wheels over n intervals, paper (27)-(28):

        e_3 Log(R_wheel(k)_wheel(k+1)) - yaw
        Lambda [R_wheel_imu R_imu(k)_world (p(k+1) + R_world_imu(k+1) p_imu_wheel - p(k)) + p_wheel_imu] - (x, y)

    whitened jointly. The measured pose follows radii and baseline to first order; build it anew from pass to pass. It
    is that of planar motion: on ramps consistent for intervals up to 0.05 s only. And since the measured yaw, noise and
    all, is what the baseline scales, the baseline comes out too long, by the share of that noise in yaw^2 (errors in
    variables): the shorter the intervals, the more.
    """

    kinds: ClassVar[dict[str, slice]] = {"yaw": slice(0, 1), "path": slice(1, 3)}
    units: ClassVar[dict[str, str]] = {"yaw": "rad", "path": "m"}

    name: str
    seconds: np.ndarray  # (N,) stamps since the first on the wheels' clock
    intervals: WheelIntervals
    poses: RelativePoses
    imu: ImuData
    gravity: float
    noise: WheelNoise
    layout: Layout

    @classmethod
    def of_poses(
        cls, stream: WheelPoses, imu: ImuData, gravity: float, noise: WheelNoise, layout: Layout, state: State
    ) -> RelativePoseFactor:
        """Of relative poses that were measured as such: they say nothing of radii and baseline."""
        found = pose_intervals(imu, state.seconds, state.starts, stream.seconds + _offset(stream.name, state))
        k = found.first
        W = np.linalg.inv(np.linalg.cholesky(stream.covariance[k]))
        poses = RelativePoses(stream.pose[k], np.zeros((len(k), 3, 3)), W, np.zeros(3))
        return cls(stream.name, stream.seconds, found, poses, imu, gravity, noise, layout)

    @property
    def whitening(self) -> np.ndarray:
        return self.poses.W

    @classmethod
    def build(
        cls,
        name: str,
        seconds: np.ndarray,
        angles: np.ndarray,
        imu: ImuData,
        gravity: float,
        noise: WheelNoise,
        layout: Layout,
        state: State,
    ) -> RelativePoseFactor:
        """See IncrementFactor.build; integrated at the radii and the baseline of `state`. Of the slip densities it uses
        `sideways`."""
        found = wheel_intervals(name, seconds, imu, state)
        poses = preintegrated(seconds, angles, found, drive_of(name, state), noise.wheel, noise.sideways)
        return cls(name, seconds, found, poses, imu, gravity, noise, layout)

    def with_imu(self, imu: ImuData) -> RelativePoseFactor:
        """See `SensorFactor`."""
        return replace(self, imu=imu)

    def output(self) -> Whitened:
        """Empty arrays for `accumulate` to fill."""
        return Whitened.empty(len(self.poses.z), 3)

    def count(self, out: Whitened, kind: str) -> int:
        """Intervals times the rows of `kind`."""
        return out.residual[:, self.kinds[kind]].size

    def rms(self, out: Whitened, kind: str) -> tuple[float, str]:
        """Of the residuals of `kind`."""
        return _rms(out, self.whitening, self.kinds[kind]), self.units[kind]

    def accumulate(
        self,
        state: State,
        piece: Piece,
        out: Whitened,
        sums: bool = True,
        curved: bool = False,
        noise: np.ndarray | None = None,
    ) -> float:
        """See IncrementFactor.accumulate; `noise` is (n, 3)."""
        own = _in_piece(self.intervals, piece)
        i, z = self.intervals, self.poses
        times = np.concatenate([self.seconds[i.first[own]], self.seconds[i.last[own]]]) + _offset(self.name, state)
        node = np.concatenate([i.node[own], i.node[own] + 1])
        free = self.layout.is_free(self.imu.name, "intrinsics")
        poses = poses_at("inertial", times, node, state, self.imu, self.gravity, free)
        rows = Rows.empty(len(times) // 2, 3, poses.by_imu.shape[2], sums)
        relative_rows(_track(node, poses), _wheels(self.name, state), z.z[own], z.J[own], z.drive0, rows)
        return _add(self, own, rows, z.W, Into(piece, out, sums, curved, noise))


def wheel_intervals(name: str, seconds: np.ndarray, imu: ImuData, state: State) -> WheelIntervals:
    """The intervals of the wheels `name`, stamped at `seconds` (N,), at their time offset and the nodes in `state`."""
    return choose_intervals(imu, state.seconds, state.starts, seconds + _offset(name, state))


def drive_of(name: str, state: State) -> np.ndarray:
    """(3,) left radius, right radius, baseline [m] of the wheels `name`."""
    return np.concatenate([state.values[name, "radii"], state.values[name, "baseline"]])


def _offset(name: str, state: State) -> float:
    return float(state.values[name, "time_offset"][0])


def _wheels(name: str, state: State) -> Wheels:
    rotation = np.ascontiguousarray(state.values[name, "rotation"])
    return Wheels(rotation, state.values[name, "translation"], drive_of(name, state))


def _track(node: np.ndarray, poses: Poses) -> Track:
    return Track(node, poses.rotation, poses.position, poses.rate, poses.velocity, poses.by_node, poses.by_imu)


def _rms(out: Whitened, whitening: np.ndarray, rows: slice) -> float:
    residual = np.linalg.solve(whitening, out.residual[:, :, None])[:, rows, 0]
    return float(np.sqrt(np.mean(residual**2)))


def _in_piece(intervals: WheelIntervals, piece: Piece) -> slice:
    """The intervals of which both nodes lie in `piece`."""
    i0, i1 = np.searchsorted(intervals.node, [piece.first, piece.last])
    return slice(int(i0), int(i1))


def _add(
    factor: IncrementFactor | RelativePoseFactor, own: slice, rows: Rows, whitening: np.ndarray, into: Into
) -> float:
    """Adds the rows of intervals `own`."""
    by = Weighing(whitening[own], factor.noise.loss, factor.noise.loss_scale)
    columns = factor.layout.columns(factor.name, *OWN)
    return add_rows(rows, own, factor.intervals.node[own], columns, factor.layout, factor.imu, by, into)
