"""The two factors of wheels, between neighbouring keyframes.

`IncrementFactor`, the default, compares the angles that the wheels turned, or integrals of speed and yaw rate. Lateral
and vertical motion are modelled as slip noise. `RelativePoseFactor` compares a planar pose integrated from a left and a
right wheel: equations (27)-(28) of the iCalib paper.

Both use intervals between two stamps of the wheels' clock (`wheel_intervals`). The time offset shifts these stamps on
the clock of the IMU, and so changes the poses of the trajectory that they are compared with.

The wheel frame has x forward, y to the left, z up; its origin is midway between the wheels of the axle that is not
steered. The parameter blocks are rotation (R_imu_wheel), translation (p_imu_wheel), time_offset, and those of the kind
of wheels: for a pair radii (left, right) and baseline; see `drive_rows`.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Mapping
from dataclasses import dataclass
from typing import ClassVar, Literal, NamedTuple

import numpy as np

from icalib.data.measurements import WheelPoses, WheelStream
from icalib.geometry import so3
from icalib.motion.factor import (
    Extrinsics,
    FactorKey,
    Into,
    RobustNoise,
    RowFactor,
    Whitened,
    add_rows,
    in_chunks,
    relative_residuals,
)
from icalib.motion.imu_data import ImuData, StampIntervals, choose_intervals, pose_intervals
from icalib.motion.poses import (
    EstimatedMotion,
    Poses,
    VelocityDerivatives,
    drift_at,
    instants,
    offset_at,
    pace_of,
    poses_and_velocity_derivatives,
    poses_at,
    poses_without_jacobians,
    seconds_at,
    slices_by_clock,
)
from icalib.motion.sensor_pose import N_POSE_PARAMETERS, Kinematics, SensorPose, rows_at
from icalib.optim.arrowhead import Piece
from icalib.optim.rows import Rows
from icalib.optim.state import Layout, State
from icalib.rig import WheelKind, drive_names
from icalib.sensors.wheels.ground_factor import RelativePoses, preintegrated
from icalib.sensors.wheels.increment_kernels import (
    KINDS,
    N_DRIVE,
    UNIT,
    UNITS,
    Kinds,
    MotionSamples,
    WheelParameters,
    coefficients,
    increment_rows,
)

YAW_X_Y = slice(2, 5)  # planar rows among rotation x, y, z, position x, y, z of a relative pose


@dataclass(frozen=True)
class WheelNoise:
    """Noise densities of wheels, and the robust loss of each whitened row."""

    wheel: float  # of each wheel's angle [rad/sqrt(s)]
    lateral_slip: float = 5e-3  # m/sqrt(s)
    vertical_slip: float = 5e-3  # m/sqrt(s)
    loss: str = "none"
    loss_scale: float = 2.5  # standard deviations
    speed: float = 2e-3  # of distance, for a twist [m/sqrt(s)]
    yaw: float = 1e-2  # of yaw, for a twist [rad/sqrt(s)]
    steering: float = 1e-3  # of a steering angle [rad/sqrt(Hz)]


class WheelFactor(RowFactor, ABC):
    """Common base of both factors: n intervals with m rows each. name: name of the wheels."""

    name: str
    kind: WheelKind
    intervals: StampIntervals
    imu: ImuData
    noise: WheelNoise
    layout: Layout
    gravity: float

    @property
    @abstractmethod
    def W(self) -> np.ndarray:
        """(n, m, m) whitening matrices."""

    @property
    @abstractmethod
    def kinds(self) -> dict[str, slice]:
        """See `Factor`."""

    @property
    def key(self) -> FactorKey:
        """See `Factor`."""
        return self.name, "wheels"

    def output(self) -> Whitened:
        """See `Factor`."""
        return Whitened.empty(*self.W.shape[:2])

    def raw(self, out: Whitened) -> np.ndarray:
        """(n, m) residuals in the units of the rows."""
        return np.linalg.solve(self.W, out.residual[:, :, None])[:, :, 0]

    def raw_sigma(self) -> np.ndarray:
        """(n, m) marginal standard deviations of the rows; the covariance is (W^T W)^-1."""
        return np.linalg.norm(np.linalg.inv(self.W), axis=2)

    def accumulate(self, state: State, piece: Piece, out: Whitened, sums: bool = True, curved: bool = False) -> float:
        """Fills `out` for the intervals in `piece`, and adds them to the normal equations of `piece` if `sums`.

        Returns half the robust chi^2. `curved`: J^T J has the true curvature of the robust loss, not its weights alone.
        """
        into = Into(piece, out, sums, curved)
        first, last = np.searchsorted(self.intervals.keyframe, [piece.first, piece.last]).tolist()
        return sum(self._added(block, state, into) for block in in_chunks(slice(first, last)))

    @abstractmethod
    def _added(self, block: slice, state: State, into: Into) -> float:
        """Adds the intervals `block`; returns half their robust chi^2."""

    def _add(self, block: slice, rows: Rows, state: State, into: Into) -> float:
        """Adds the rows of the intervals `block` to the normal equations; returns half their robust chi^2. The
        calibration columns of the rows are those of the pose, then those of the drive parameters."""
        cost, keyframe = 0.0, self.intervals.keyframe[block]
        drive = self.layout.columns(self.name, *drive_names(self.kind))
        unit = self.imu.unit_columns(self.layout)
        drive = np.concatenate([drive, np.full(N_DRIVE - len(drive) - len(unit), -1), unit])
        kinematics = Kinematics.of(self)
        for clock, part in slices_by_clock(state, self.name, keyframe):
            columns = np.concatenate([kinematics.columns(clock), drive])
            of_clock = slice(block.start + part.start, block.start + part.stop)
            noise = RobustNoise(self.W[of_clock], self.noise.loss, self.noise.loss_scale)
            cost += add_rows(Rows(rows.residual[part], rows.J[part]), of_clock, keyframe[part], columns, noise, into)
        return cost


@dataclass(frozen=True)
class IncrementFactor(WheelFactor):
    """Increments of wheel angles, distance or yaw over n intervals.

    With Theta = Log(R(s_0)^T R(s_1)), D the integral of R(t)^T v(t) (poses propagated by the IMU, scheme `inertial`),
    X = R_wheel_imu (D + Theta x p_imu_wheel) and T = R_wheel_imu Theta, the rows of an interval of length dt are those
    of `drive_rows`. For a pair the rows and their standard deviations are

        (e_1 X -+ b/2 e_3 T) / r - angle     over wheel sqrt(dt)            left, right
        e_2 X                                over lateral_slip sqrt(dt)
        e_3 X                                over vertical_slip sqrt(dt)

    Assumption: Theta is the integral of the angular rate w. The error is dt^3 / 12 |w x w'|: 1e-5 rad in 50 ms for a
    vehicle on a ramp that turns at 1 rad/s and pitches at 1 rad/s^2.
    """

    units: ClassVar[Mapping[str, str]] = UNITS

    name: str
    kind: WheelKind
    intervals: StampIntervals
    measured: np.ndarray  # (n, 4): increments, for a pair angles [rad]; slip 0 m
    mean: np.ndarray  # (n, m - 1): see `coefficients`
    whitening: np.ndarray  # (n, 4, 4)
    instants: Instants
    imu: ImuData
    gravity: float
    noise: WheelNoise
    layout: Layout

    @property
    def W(self) -> np.ndarray:
        """See `WheelFactor`."""
        return self.whitening

    @property
    def kinds(self) -> Kinds:
        return KINDS[self.kind]

    @classmethod
    def build(
        cls,
        name: str,
        seconds: np.ndarray,
        integrals: np.ndarray,
        motion: EstimatedMotion,
        noise: WheelNoise,
        layout: Layout,
        kind: WheelKind = "pair",
        times: np.ndarray | None = None,
    ) -> IncrementFactor:
        """Chooses intervals between keyframes of `motion`, and computes measurements and noise over these.

        seconds (N,): stamps since the first, on the wheels' clock; integrals (N, m): see `integrals_of`, for a pair the
        angles of both wheels [rad]. times (N,): stamps on the IMU's clock; default: seconds plus the only time offset.
        """
        state, imu = motion.state, motion.imu
        intervals = wheel_intervals(name, seconds, imu, state, times)
        dt = seconds[intervals.last] - seconds[intervals.first]
        increments = integrals[intervals.last] - integrals[intervals.first]
        sigma = _row_sigma(kind, noise, dt, increments, drive_of(name, state, kind))
        whitening = np.eye(4) / sigma[:, :, None]
        measured = np.zeros((len(dt), 4))
        n_measured = 1 if kind == "steered" else 2
        measured[:, :n_measured] = increments[:, :n_measured]
        mean = increments[:, 1:] / dt[:, None]
        k = intervals.keyframe
        change = seconds_at(state, name)[k + 1] if imu.forwards else None
        instants = quadrature(seconds, intervals, change)
        return cls(name, kind, intervals, measured, mean, whitening, instants, imu, motion.gravity, noise, layout)

    def times(self, state: State) -> np.ndarray:
        """See `RowFactor`."""
        starts = self.instants.times[self.instants.start[:-1]]
        return starts + offset_at(state, self.name, self.intervals.keyframe, starts)

    def _added(self, block: slice, state: State, into: Into) -> float:
        start = self.instants.start[block.start : block.stop + 1]
        used = slice(int(start[0]), int(start[-1]))
        keyframe = self.instants.keyframe[used]
        seconds = self.instants.times[used]
        times = seconds + offset_at(state, self.name, keyframe, seconds)
        poses, velocities = _motion(self, times, keyframe, state, into.sums)
        rows = Rows.empty(len(start) - 1, 4, N_POSE_PARAMETERS + poses.J_imu.shape[2] + N_DRIVE, into.sums)
        drive = np.append(drive_of(self.name, state, self.kind), self.imu.unit_length(state))
        mount = np.ascontiguousarray(state.values[self.name, "rotation"]), state.values[self.name, "translation"]
        wheels = WheelParameters(*mount, drive, pace_of(state, self.name))
        c = coefficients(self.kind, wheels.drive, self.mean[block])
        samples = _samples(keyframe, poses, drift_at(state, self.name, keyframe, seconds))
        weights, measured = self.instants.weight[used], self.measured[block]
        increment_rows(start - start[0], weights, samples, velocities, wheels, c, measured, rows)
        return self._add(block, rows, state, into)


@dataclass(frozen=True)
class RelativePoseFactor(WheelFactor):
    """Relative planar poses of the wheels over n intervals, equations (27)-(28) of the iCalib paper, whitened jointly:

        e_3 Log(R_wheel(k)_wheel(k+1)) - yaw
        Lambda [R_wheel_imu R_imu(k)_world (p(k+1) + R_world_imu(k+1) p_imu_wheel - p(k)) + p_wheel_imu] - (x, y)

    Lambda takes x and y. The measured pose is linearised in radii and baseline about `RelativePoses.drive0`, so that
    each pass builds the factor anew. Assumption: planar motion; on ramps it holds only for intervals up to 0.05 s.

    The baseline scales a measured yaw that contains noise. Its estimate is therefore too long by the share of the noise
    in the mean squared yaw (errors in variables), which grows as intervals become shorter.
    """

    units: ClassVar[Mapping[str, str]] = {"yaw": "rad", "path": "m"}

    name: str
    seconds: np.ndarray  # (N,) stamps since the first on the wheels' clock
    intervals: StampIntervals
    poses: RelativePoses
    imu: ImuData
    gravity: float
    noise: WheelNoise
    layout: Layout
    kind: WheelKind = "pair"

    @classmethod
    def of_poses(
        cls, stream: WheelPoses, motion: EstimatedMotion, noise: WheelNoise, layout: Layout
    ) -> RelativePoseFactor:
        """The factor of recorded relative poses, which do not depend on radii and baseline. Their noise includes the
        propagated IMU noise between keyframes and stamps."""
        state, imu = motion.state, motion.imu
        times = instants(stream, state.values)
        intervals = pose_intervals(imu, state.seconds, state.starts, times)
        k = intervals.first
        ends = [(intervals.keyframe, times[k]), (intervals.keyframe + 1, times[intervals.last])]
        first, last = (poses_at("inertial", t, keyframe, state, imu, motion.gravity, False) for keyframe, t in ends)
        propagated = np.stack([np.abs(t - state.seconds[keyframe]) for keyframe, t in ends], axis=1)
        wheels = Extrinsics(state.values[stream.name, "rotation"], state.values[stream.name, "translation"])
        covariance = stream.covariance[k] + propagation_noise(first, last, propagated, wheels, imu)
        W = np.linalg.inv(np.linalg.cholesky(covariance))
        poses = RelativePoses(stream.pose[k], np.zeros((len(k), 3, 3)), W, np.zeros(3))
        return cls(stream.name, stream.seconds, intervals, poses, imu, motion.gravity, noise, layout)

    @classmethod
    def build(
        cls,
        name: str,
        seconds: np.ndarray,
        angles: np.ndarray,
        motion: EstimatedMotion,
        noise: WheelNoise,
        layout: Layout,
        times: np.ndarray | None = None,
    ) -> RelativePoseFactor:
        """See `IncrementFactor.build`. angles (N, 2) rad, integrated with the radii and the baseline of `motion`."""
        intervals = wheel_intervals(name, seconds, motion.imu, motion.state, times)
        drive = drive_of(name, motion.state)
        poses = preintegrated(seconds, angles, intervals, drive, noise.wheel, noise.lateral_slip)
        return cls(name, seconds, intervals, poses, motion.imu, motion.gravity, noise, layout)

    @property
    def W(self) -> np.ndarray:
        """See `WheelFactor`."""
        return self.poses.W

    @property
    def kinds(self) -> dict[str, slice]:
        """See `Factor`."""
        return {"yaw": slice(0, 1), "path": slice(1, 3)}

    def times(self, state: State) -> np.ndarray:
        """See `RowFactor`."""
        starts = self.seconds[self.intervals.first]
        return starts + offset_at(state, self.name, self.intervals.keyframe, starts)

    def _added(self, block: slice, state: State, into: Into) -> float:
        i, z, kinematics = self.intervals, self.poses, Kinematics.of(self)
        first = SensorPose.at(kinematics, self.seconds[i.first[block]], i.keyframe[block], state, into.sums)
        last = SensorPose.at(kinematics, self.seconds[i.last[block]], i.keyframe[block] + 1, state, into.sums)
        n, drive = len(z.z[block]), drive_of(self.name, state, self.kind)
        relative = relative_residuals(
            (first.rotation, last.rotation),
            (first.position, last.position),
            np.broadcast_to(np.eye(3), (n, 3, 3)),
            np.zeros((n, 3)),
            into.sums,
        )
        residual = relative.residual[:, YAW_X_Y] - z.z[block] - z.J_drive[block] @ (drive - z.drive0)
        J_pose = [np.ascontiguousarray(J[:, YAW_X_Y]) for J in relative.J_pose]
        J_drive = -z.J_drive[block] if into.sums else z.J_drive[:0]
        J_drive = np.pad(J_drive, ((0, 0), (0, 0), (0, 1)))  # recorded poses are in metres, not in the unit of length
        rows = rows_at(residual, J_pose, (first, last), J_drive)
        return self._add(block, rows, state, into)


def wheel_intervals(
    name: str, seconds: np.ndarray, imu: ImuData, state: State, times: np.ndarray | None = None
) -> StampIntervals:
    """The intervals of the wheels `name` between the stamps that are nearest to keyframes of `state`; seconds, times:
    see `IncrementFactor.build`."""
    if times is not None:
        return choose_intervals(imu, state.seconds, state.starts, times)
    (offset,) = state.values[name, "time_offset"]
    return choose_intervals(imu, state.seconds, state.starts, seconds + offset)


def drive_of(name: str, state: State, kind: WheelKind = "pair") -> np.ndarray:
    """Drive parameters (3,) of the wheels `name` in the order of `rig.DRIVES`, padded with zeros; for a pair left
    radius, right radius, baseline [m]."""
    drive = np.concatenate([state.values[name, group] for group in drive_names(kind)])
    return np.concatenate([drive, np.zeros(UNIT - len(drive))])


def _row_sigma(
    kind: WheelKind, noise: WheelNoise, dt: np.ndarray, integrals: np.ndarray, drive: np.ndarray
) -> np.ndarray:
    """Standard deviations (n, 4) of the rows of intervals of length dt (n,) [s]; integrals (n, m): over each.

    The steering row has two sources of noise: the lateral slip of the front wheels, and the lateral motion of the front
    axle, whose speed is v / cos(angle), due to an error of the steering angle.
    """
    first, second = {"pair": (noise.wheel, noise.wheel), "twist": (noise.speed, noise.yaw)}.get(
        kind, (noise.wheel, noise.lateral_slip)
    )
    sigma = np.array([first, second, noise.lateral_slip, noise.vertical_slip]) * np.sqrt(dt)[:, None]
    if kind == "steered":
        sigma[:, 1] = np.hypot(sigma[:, 1], noise.steering * drive[0] * np.sqrt(integrals[:, 3]))
    return sigma


def _motion(
    factor: IncrementFactor, times: np.ndarray, keyframe: np.ndarray, state: State, jacobians: bool
) -> tuple[Poses, VelocityDerivatives]:
    """Poses of the IMU at times (m,) on its clock, propagated from keyframe (m,), and the derivatives of its
    velocities; the latter are empty without `jacobians`."""
    if not jacobians:
        return poses_without_jacobians(times, keyframe, state, factor.imu, factor.gravity), VelocityDerivatives.empty(
            0, 0
        )
    free = factor.layout.is_free(factor.imu.name, "intrinsics")
    return poses_and_velocity_derivatives(times, keyframe, state, factor.imu, factor.gravity, free)


def _samples(keyframe: np.ndarray, p: Poses, drift: np.ndarray) -> MotionSamples:
    return MotionSamples(keyframe, p.rotation, p.position, p.rate, p.velocity, p.J_keyframe, p.J_imu, drift)


# Propagated IMU noise in recorded relative poses of wheels whose end points lie between keyframes.
#
# The pose of each end point is propagated by the IMU from its keyframe. The lateral noise of relative poses by
# equation (27) of the iCalib paper is tiny, as its model has no slip: 0.01 mm, as much as 20 ms of propagation. The
# noise of a relative pose therefore includes that of the propagation.


def propagation_noise(
    first: Poses, last: Poses, propagated: np.ndarray, wheels: Extrinsics, imu: ImuData
) -> np.ndarray:
    """Covariance (n, 3, 3) of yaw, x and y [rad, m, m] of n relative poses due to the noise of the IMU.

    first, last: poses of the IMU at both ends; propagated (n, 2): propagation time [s] from keyframe to each end.
    wheels: their extrinsics. With the noise densities g and a of gyroscope and accelerometer, the variance after t
    seconds is g^2 t for each angle and a^2 t^3 / 3 for each axis of position. Errors of the angles also rotate the
    lever arm.
    """
    R, p = wheels.R, wheels.p
    R_first_world = np.swapaxes(first.rotation, 1, 2)
    R_first_last = R_first_world @ last.rotation
    end = np.einsum("nij,nj->ni", R_first_world, last.position - first.position) + R_first_last @ p
    J_position_rotation = R.T @ so3.hat_many(end), -R.T @ R_first_last @ so3.hat_many(p)
    yaw = R.T[2]
    gyro, accel = np.median(imu.variance[:, :2], axis=0)
    out = np.zeros((len(propagated), 3, 3))
    for t, J_position, sign in zip(propagated.T, J_position_rotation, (-1.0, 1.0), strict=True):
        J = np.concatenate([np.broadcast_to(sign * yaw, (len(t), 1, 3)), J_position[:, :2]], axis=1)
        out += (gyro * t)[:, None, None] * J @ np.swapaxes(J, 1, 2)
        out += (accel * t**3 / 3.0)[:, None, None] * np.diag([0.0, 1.0, 1.0])
    return out


# Instants and weights of the quadrature that integrates the motion of wheels between two of their stamps.

# Largest length of a panel. The error of two Gauss points is u'''' h^5 / 4320: 0.01 mm for 20 Hz vibration of 3 m/s^2.
PANEL_S = 0.025


class Instants(NamedTuple):
    """The m instants at which the motion is evaluated for n intervals.

    start (n + 1,): interval i has the instants start[i]:start[i+1]: its begin, the quadrature points, its end. times
    (m,) [s] on the wheels' clock; keyframe (m,): keyframe from which the motion is propagated; weight (m,) [s]:
    quadrature weight, zero at begin and end.
    """

    start: np.ndarray
    times: np.ndarray
    keyframe: np.ndarray
    weight: np.ndarray


def quadrature(seconds: np.ndarray, intervals: StampIntervals, change: np.ndarray | None = None) -> Instants:
    """Instants with two Gauss points in each panel of at most PANEL_S; seconds (N,): the stamps of the wheels.

    change (n,) [s] on the wheels' clock: instants up to `change` are propagated from the first keyframe of the
    interval, later ones from the second; by default the middle of the interval.
    """
    begin = seconds[intervals.first]
    length = seconds[intervals.last] - begin
    # Each half of an interval is split into panels. Its instants are begin, two Gauss points per panel, and end.
    panels = np.maximum(np.ceil(0.5 * length / PANEL_S - 1e-6), 1.0).astype(np.int64)  # in half an interval
    start = np.concatenate([[0], np.cumsum(2 + 4 * panels)])
    interval = np.repeat(np.arange(len(begin)), np.diff(start))
    at = np.arange(start[-1]) - start[interval] - 1
    width = (0.5 * length / panels)[interval]
    panel, second = at // 2, at % 2
    times = begin[interval] + (panel + 0.5 + (second - 0.5) / np.sqrt(3.0)) * width
    weight = 0.5 * width
    change = begin + 0.5 * length if change is None else change
    keyframe = intervals.keyframe[interval] + (times > change[interval])
    # begin and end of the intervals have no weight: only poses are evaluated there
    times[start[:-1]], times[start[1:] - 1] = begin, seconds[intervals.last]
    keyframe[start[:-1]], keyframe[start[1:] - 1] = intervals.keyframe, intervals.keyframe + 1
    weight[start[:-1]] = weight[start[1:] - 1] = 0.0
    return Instants(start, times, keyframe, weight)


# Integrals of the rates that wheels report: angles, distance and yaw since the first stamp.

Sampling = Literal["interval-mean", "instantaneous"]
MAX_STEERING_RAD = 1.55  # 89 deg: limit of steering angles; 1 / cos is infinite at 90 deg


def integrated(seconds: np.ndarray, rates: np.ndarray, sampling: Sampling) -> np.ndarray:
    """Integrals (N, m) since the first stamp of rates (N, m) at seconds (N,).

    sampling "interval-mean": a rate is the mean over the interval that ends at its stamp, as computed from differences
    of ticks. "instantaneous": a rate is the value at its stamp (trapezoidal rule). The wrong choice shifts time by half
    an interval.
    """
    mean = rates[1:] if sampling == "interval-mean" else 0.5 * (rates[1:] + rates[:-1])
    integrals = np.zeros_like(rates, dtype=np.float64)
    np.cumsum(mean * np.diff(seconds)[:, None], axis=0, out=integrals[1:])
    return integrals


def integrals_of(stream: WheelStream) -> np.ndarray:
    """Integrals since the first stamp from which the increment factor takes its measurements, for each kind of wheels.

    pair (N, 2): angles that both wheels turned [rad]. twist (N, 2): distance [m], yaw [rad]. steered (N, 4): angle that
    the driven wheel turned [rad], integrals of cos and sin of the steering angle [s], and the integral of
    (rate of the wheel / cos)^2 [rad^2/s]. The variance of the steering row is proportional to the last.
    """
    integrals = integrated(stream.seconds, stream.rate, stream.sampling)
    if stream.kind != "steered":
        return integrals
    rate, steer = stream.rate[:, 0], np.clip(stream.rate[:, 1], -MAX_STEERING_RAD, MAX_STEERING_RAD)
    others = np.stack([np.cos(steer), np.sin(steer), (rate / np.cos(steer)) ** 2], axis=1)
    return np.concatenate([integrals[:, :1], integrated(stream.seconds, others, "instantaneous")], axis=1)
