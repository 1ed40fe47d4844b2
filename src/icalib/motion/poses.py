"""The estimated motion at the time of a measurement: poses, sweeps of a LiDAR, time offsets, keyframes."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from icalib.base.compiled import njit
from icalib.data.measurements import Stream
from icalib.geometry import so3
from icalib.geometry.small import mul3
from icalib.motion.imu_data import SAME_INSTANT_S, ImuData, clear_of
from icalib.motion.integration import (
    ImuMotion,
    bias_of,
    corrected,
    empty_prefix,
    integrate_from_keyframe,
    keyframes_of,
    place,
    place_in_interval,
    propagation_query,
    readings_of,
    rotation_of,
)
from icalib.motion.integration_step import (
    AT_INTRINSICS,
    AT_J,
    AT_P,
    AT_V,
    J_STRIDE,
    ROW_G,
    ROW_H,
    RUN_SIZE,
    correction,
    fill_intrinsics,
)
from icalib.optim.state import KEYFRAME_DIM, Key, Layout, State
from icalib.rig import Scheme
from icalib.rig.scene import GRAVITY, WORLD

# Pose of the IMU at the time of a measurement: three schemes behind one function, `poses_at`.
#
#     inertial    IMU readings integrated from the nearest keyframe to t, forwards or backwards
#     kinematic   constant angular rate and velocity from the nearest keyframe, iCalib paper (8)-(9)
#     pose        between the two neighbouring keyframes, iCalib paper (10)-(12); position interpolated linearly
#
# A measurement stays assigned to its keyframe while the solver runs; only its time moves with the time offset.


@dataclass(frozen=True)
class Poses:
    """IMU poses at n instants with Jacobians. Rows of the Jacobians: rotation (on the right), position (world).

    rotation (n, 3, 3), position (n, 3) m; rate (n, 3) body rad/s and velocity (n, 3) world m/s, the time derivative;
    J_keyframe, J_next (n, 6, 15): by the keyframe and, for `pose` alone, the next one (else of length 0); J_imu (n, 6,
    24 or 0): by the IMU intrinsics.
    """

    rotation: np.ndarray
    position: np.ndarray
    rate: np.ndarray
    velocity: np.ndarray
    J_keyframe: np.ndarray
    J_next: np.ndarray
    J_imu: np.ndarray


class VelocityDerivatives(NamedTuple):
    """Derivatives of the velocity in `Poses` (world, m/s), in the `inertial` scheme.

    acceleration (n, 3) world m/s^2: by time; J_keyframe (n, 3, 15), J_imu (n, 3, 24 or 0): by the keyframe and the IMU
    intrinsics. All of length 0 if not wanted.
    """

    acceleration: np.ndarray
    J_keyframe: np.ndarray
    J_imu: np.ndarray

    @classmethod
    def empty(cls, n: int, n_imu: int) -> VelocityDerivatives:
        """Arrays for n instants and `n_imu` intrinsics, Jacobians zero."""
        return cls(np.empty((n, 3)), np.zeros((n, 3, KEYFRAME_DIM)), np.zeros((n, 3, n_imu)))


def assign_keyframes(scheme: Scheme, keyframes: np.ndarray, times: np.ndarray, forwards: bool = False) -> np.ndarray:
    """Keyframe (n,) of each time: the nearest one. For `pose`, or if motion is propagated `forwards` only (see
    `ImuData`), the one before."""
    after = np.clip(np.searchsorted(keyframes, times + SAME_INSTANT_S), 1, len(keyframes) - 1)
    if scheme == "pose" or forwards:
        return after - 1
    return after - (times - keyframes[after - 1] < keyframes[after] - times + SAME_INSTANT_S)


@njit(cache=True, nogil=True)
def _velocity(i, R, run, force, g, at, derivatives):
    """Fills entry i of `derivatives`: acceleration, and Jacobians of the velocity, at instant i of `at`. run:
    increments since the keyframe (see `integration_step`); R: rotation of the keyframe; force: specific force at the
    instant."""
    first = 0 * i  # first row of the Jacobians; not a literal, see `_fill_pose`
    _fill_start(i, first, R, run, AT_J + 3 * J_STRIDE, derivatives.J_keyframe, derivatives.J_imu)
    _fill_turn(i, first, R, run, AT_V, derivatives.J_keyframe)
    for a in range(3):
        row = at.rotation[i, a, 0], at.rotation[i, a, 1], at.rotation[i, a, 2]
        derivatives.acceleration[i, a] = row[0] * force[0] + row[1] * force[1] + row[2] * force[2]
        derivatives.J_keyframe[i, a, 6 + a] = 1.0
    derivatives.acceleration[i, 2] -= g


@njit(cache=True, nogil=True)
def _fill_pose(i, dt, R, run, Jn, Jx):
    """Fills entry i of the pose Jacobians Jn (keyframe) and Jx (intrinsics) from increments `run` (see
    `integration_step`). dt: elapsed time; R: rotation of the keyframe."""
    first = 0 * i  # not a literal: numba would compile the callees once more for a literal type
    _fill_start(i, first + 3, R, run, AT_J + 6 * J_STRIDE, Jn, Jx)
    _fill_turn(i, first + 3, R, run, AT_P, Jn)
    for a in range(3):
        Jn[i, 3 + a, 3 + a] = 1.0
        Jn[i, 3 + a, 6 + a] = dt
        for c in range(3):
            Jn[i, a, c] = run[3 * c + a]
        for c in range(6):
            Jn[i, a, 9 + c] = run[AT_J + J_STRIDE * a + c]
        for c in range(Jx.shape[2]):
            Jx[i, a, c] = run[AT_J + J_STRIDE * a + 6 + c]


@njit(cache=True, nogil=True)
def _fill_turn(i, r, R, run, o, Jn):
    """Rows r.. of Jn[i], by the rotation R of the keyframe, of an increment d (3,) = run[o:] in its axes: -R hat(d)."""
    d = run[o], run[o + 1], run[o + 2]
    for a in range(3):
        R0, R1, R2 = R[3 * a], R[3 * a + 1], R[3 * a + 2]
        Jn[i, r + a, 0] = R2 * d[1] - R1 * d[2]
        Jn[i, r + a, 1] = R0 * d[2] - R2 * d[0]
        Jn[i, r + a, 2] = R1 * d[0] - R0 * d[1]


@njit(cache=True, nogil=True)
def _fill_start(i, r, R, x, o, Jn, Jx):
    """Rows r.. of Jn[i] and Jx[i], by biases and intrinsics: R times three rows of J, which start at x[o]."""
    for a in range(3):
        R0, R1, R2 = R[3 * a], R[3 * a + 1], R[3 * a + 2]
        for c in range(6):
            Jn[i, r + a, 9 + c] = R0 * x[o + c] + R1 * x[o + J_STRIDE + c] + R2 * x[o + 2 * J_STRIDE + c]
        for c in range(Jx.shape[2]):
            Jx[i, r + a, c] = R0 * x[o + 6 + c] + R1 * x[o + J_STRIDE + 6 + c] + R2 * x[o + 2 * J_STRIDE + 6 + c]


@njit(cache=True, nogil=True)
def _inertial(query, keyframes, readings, intrinsics, at, Jn, Jx, derivatives):
    """The `inertial` scheme for `query`: fills `at`, a `ImuMotion`, and, unless they are empty, Jacobians and
    `derivatives`."""
    width = 6 + Jx.shape[2] if len(Jn) else 0
    by, prefix, run = correction(intrinsics), empty_prefix(), np.empty(RUN_SIZE)
    for i in query.order:
        k, t = query.keyframe[i], query.times[i]
        t0, bias = keyframes.seconds[k], bias_of(keyframes.bias, k)
        rate, force = integrate_from_keyframe(k, t0, t, query.first[i], bias, readings, by, prefix, run, width)
        place(i, t - t0, k, keyframes, run, rate, at)
        if len(Jn):
            _fill_pose(i, t - t0, rotation_of(keyframes, k), run, Jn, Jx)
        if len(derivatives.acceleration):
            _velocity(i, rotation_of(keyframes, k), run, force, keyframes.gravity, at, derivatives)


@njit(cache=True, nogil=True)
def _kinematic(times, keyframe, first, keyframes, readings, intrinsics, at, Jn, Jx):
    """The `kinematic` scheme: fills `at`, an `ImuMotion`, and Jacobians by keyframe (Jn) and IMU intrinsics (Jx). first
    (n,): interval of the readings that holds the keyframe of each instant."""
    by, run, turn = correction(intrinsics), np.zeros(RUN_SIZE), np.empty(3)
    for i in range(len(times)):
        k, j, t = keyframe[i], first[i], readings.t
        dt = times[i] - keyframes.seconds[k]
        at_keyframe = place_in_interval(t, j, keyframes.seconds[k])
        w, f = corrected(readings, j, at_keyframe, bias_of(keyframes.bias, k), by)
        for a in range(3):
            turn[a] = w[a] * dt
        increment, Jr = so3.exp(turn), so3.right_jacobian(turn)
        if Jx.shape[2]:
            fill_intrinsics(w, f, by, run)
        _place_at_constant_velocity(i, dt, k, keyframes, increment, w, at)
        _fill_kinematic(i, dt, increment, Jr, by, run, Jn, Jx)


@njit(cache=True, nogil=True)
def _place_at_constant_velocity(i, dt, k, keyframes, increment, rate, at):
    """Fills entry i of `at`, an `ImuMotion`, from keyframe k. increment (3, 3): rotation over the elapsed time dt; rate
    (3,): body rate."""
    R, p, v = keyframes.rotation, keyframes.position, keyframes.velocity
    for a in range(3):
        at.rate[i, a] = rate[a]
        at.velocity[i, a] = v[k, a]
        at.position[i, a] = p[k, a] + v[k, a] * dt
        for c in range(3):
            at.rotation[i, a, c] = (
                R[k, a, 0] * increment[0, c] + R[k, a, 1] * increment[1, c] + R[k, a, 2] * increment[2, c]
            )  # fmt: skip


@njit(cache=True, nogil=True)
def _fill_kinematic(i, dt, increment, Jr, by, run, Jn, Jx):
    """Fills entry i of the Jacobians of the `kinematic` scheme. Jr (3, 3): right Jacobian of the `increment`; by: see
    `correction`; run: holds the derivatives of the rate by the intrinsics."""
    for a in range(3):
        Jn[i, 3 + a, 3 + a] = 1.0
        Jn[i, 3 + a, 6 + a] = dt
        for c in range(3):
            Jn[i, a, c] = increment[c, a]
            for d in range(3):
                Jn[i, a, 9 + c] -= dt * Jr[a, d] * by[ROW_G, 3 * d + c]
                Jn[i, a, 12 + c] -= dt * Jr[a, d] * by[ROW_H, 3 * d + c]
        for c in range(Jx.shape[2]):
            by_w = run[AT_INTRINSICS + c], run[AT_INTRINSICS + J_STRIDE + c], run[AT_INTRINSICS + 2 * J_STRIDE + c]
            Jx[i, a, c] = dt * (Jr[a, 0] * by_w[0] + Jr[a, 1] * by_w[1] + Jr[a, 2] * by_w[2])


@njit(cache=True, nogil=True)
def _between(times, keyframe, keyframes, at, Jn, Jm):
    """The `pose` scheme: fills `at`, an `ImuMotion`, and Jacobians by keyframe (Jn) and the next one (Jm)."""
    t, R, p = keyframes.seconds, keyframes.rotation, keyframes.position
    for i in range(len(times)):
        k = keyframe[i]
        span = t[k + 1] - t[k]
        s = (times[i] - t[k]) / span
        R01 = np.ascontiguousarray(R[k].T) @ R[k + 1]
        phi = so3.log(R01)
        increment = so3.exp(s * phi)
        J_next = s * (so3.right_jacobian(s * phi) @ so3.right_jacobian_inverse(phi))
        back = J_next @ np.ascontiguousarray(R01.T)
        at.rotation[i] = R[k] @ increment
        for a in range(3):
            at.rate[i, a] = phi[a] / span
            at.velocity[i, a] = (p[k + 1, a] - p[k, a]) / span
            at.position[i, a] = p[k, a] + s * (p[k + 1, a] - p[k, a])
            Jn[i, 3 + a, 3 + a] = 1.0 - s
            Jm[i, 3 + a, 3 + a] = s
            for c in range(3):
                Jn[i, a, c] = increment[c, a] - back[a, c]
                Jm[i, a, c] = J_next[a, c]


def poses_of_keyframes(keyframe: np.ndarray, state: State) -> Poses:
    """IMU poses at keyframes, with zero rate and velocity. In a rig without IMU measurements are at keyframes, and time
    offsets have no effect."""
    n = len(keyframe)
    J_keyframe, still = np.zeros((n, 6, KEYFRAME_DIM)), np.zeros((n, 3))
    J_keyframe[:, range(6), range(6)] = 1.0
    nothing = np.zeros((0, 6, KEYFRAME_DIM))
    return Poses(
        state.rotation[keyframe], state.position[keyframe], still, still, J_keyframe, nothing, np.zeros((n, 6, 0))
    )


def poses_at(
    scheme: Scheme, times: np.ndarray, keyframe: np.ndarray, state: State, imu: ImuData, gravity: float, imu_free: bool
) -> Poses:
    """IMU poses at `times` (n,) seconds on the IMU clock, each from its `keyframe` (n,), see `assign_keyframes`.
    gravity [m/s^2]; imu_free: whether IMU intrinsics are estimated."""
    n, n_imu = len(times), _n_intrinsics(state, imu) if imu_free else 0
    if scheme == "inertial":
        return _propagated(_empty(n, n, n_imu), times, keyframe, state, imu, gravity, VelocityDerivatives.empty(0, 0))
    at, keyframes, J_keyframe = ImuMotion.empty(n), keyframes_of(state, gravity), np.zeros((n, 6, KEYFRAME_DIM))
    J_next = np.zeros((n if scheme == "pose" else 0, 6, KEYFRAME_DIM))
    J_imu = np.zeros((n, 6, n_imu))
    if scheme == "pose":
        _between(times, keyframe, keyframes, at, J_keyframe, J_next)
    else:
        first, intrinsics = imu.interval(state.seconds[keyframe]), state.values[imu.name, "intrinsics"]
        _kinematic(times, keyframe, first, keyframes, readings_of(imu), intrinsics, at, J_keyframe, J_imu)
    return Poses(*at, J_keyframe, J_next, J_imu)


def poses_without_jacobians(
    times: np.ndarray, keyframe: np.ndarray, state: State, imu: ImuData, gravity: float
) -> Poses:
    """The `inertial` poses of `poses_at`, with Jacobians of length 0."""
    return _propagated(_empty(len(times), 0, 0), times, keyframe, state, imu, gravity, VelocityDerivatives.empty(0, 0))


def poses_and_velocity_derivatives(
    times: np.ndarray, keyframe: np.ndarray, state: State, imu: ImuData, gravity: float, imu_free: bool
) -> tuple[Poses, VelocityDerivatives]:
    """The `inertial` poses of `poses_at`, and derivatives of their velocities."""
    n, n_imu = len(times), _n_intrinsics(state, imu) if imu_free else 0
    derivatives = VelocityDerivatives.empty(n, n_imu)
    return _propagated(_empty(n, n, n_imu), times, keyframe, state, imu, gravity, derivatives), derivatives


def _n_intrinsics(state: State, imu: ImuData) -> int:
    """Number of IMU intrinsics, 24."""
    return len(state.values[imu.name, "intrinsics"])


def _empty(n: int, n_jacobians: int, n_imu: int) -> Poses:
    """Arrays for n `inertial` poses; n_jacobians: n, or 0 for no Jacobians. n_imu: number of IMU intrinsics that are
    estimated."""
    J_imu = np.zeros((n_jacobians, 6, n_imu))
    return Poses(*ImuMotion.empty(n), np.zeros((n_jacobians, 6, KEYFRAME_DIM)), np.zeros((0, 6, KEYFRAME_DIM)), J_imu)


def _propagated(
    out: Poses,
    times: np.ndarray,
    keyframe: np.ndarray,
    state: State,
    imu: ImuData,
    gravity: float,
    derivatives: VelocityDerivatives,
) -> Poses:
    """Fills `out` with the `inertial` poses, and `derivatives` with derivatives of the velocity unless it is empty;
    returns `out`."""
    query, keyframes = propagation_query(state, times, keyframe, imu), keyframes_of(state, gravity)
    at = ImuMotion(out.rotation, out.position, out.rate, out.velocity)
    intrinsics = state.values[imu.name, "intrinsics"]
    _inertial(query, keyframes, readings_of(imu), intrinsics, at, out.J_keyframe, out.J_imu, derivatives)
    return out


# Motion of the IMU between the keyframes of a state: nearest keyframes of measurements, poses and twists of a LiDAR.


def gravity_of(state: State, stated: float) -> float:
    """Magnitude of gravity [m/s^2] at `state`; `stated` where a state of the first guess has none."""
    return float(state.values.get((WORLD, GRAVITY.name), [stated])[0])


@dataclass(frozen=True)
class EstimatedMotion:
    """Motion of the IMU between the keyframes of `state`.

    gravity [m/s^2]: a constant within a pass, unlike that of the IMU factor. Sensors are 25 ms from a keyframe at most;
    its standard deviation of 0.02 m/s^2 moves them by 6 um before the next pass. IMU gaps up to max_gap_s are
    bridged.
    """

    state: State
    imu: ImuData
    gravity: float
    max_gap_s: float

    def near_keyframes(self, stream: Stream, within_s: float) -> tuple[np.ndarray, np.ndarray]:
        """Measurements of `stream` within `within_s` of a keyframe and outside long gaps of the IMU: their indices
        (n,), sorted by keyframe, and the keyframes (n,)."""
        times = instants(stream, self.state.values)
        keyframe = assign_keyframes("inertial", self.state.seconds, times, self.imu.forwards)
        near = np.abs(times - self.state.seconds[keyframe]) <= within_s
        indices = np.flatnonzero(near & usable(self.imu, times, self.max_gap_s))
        indices = indices[np.argsort(keyframe[indices], kind="stable")]
        return indices, keyframe[indices]


class Sweep(NamedTuple):
    """Poses and twists of a LiDAR at n instants: R_world_lidar (n, 3, 3), p_world_lidar (n, 3) [m], rate [rad/s] and
    velocity [m/s] (n, 3) in LiDAR axes."""

    rotation: np.ndarray
    position: np.ndarray
    rate: np.ndarray
    velocity: np.ndarray


@njit(cache=True, nogil=True)
def _to_lidar(R_il, p_il, R, p, rate, velocity):
    """Transforms poses, rates and velocities of the IMU to those of the LiDAR, in place. R_il, p_il: T_imu_lidar. Rates
    and velocities end in LiDAR axes."""
    for i in range(len(R)):
        w0, w1, w2 = rate[i, 0], rate[i, 1], rate[i, 2]
        lever = (w1 * p_il[2] - w2 * p_il[1], w2 * p_il[0] - w0 * p_il[2], w0 * p_il[1] - w1 * p_il[0])
        velocity_i = np.empty(3)
        for a in range(3):
            velocity_i[a] = lever[a]
            for c in range(3):
                velocity_i[a] += R[i, c, a] * velocity[i, c]
                p[i, a] += R[i, a, c] * p_il[c]
        for a in range(3):
            rate[i, a] = R_il[0, a] * w0 + R_il[1, a] * w1 + R_il[2, a] * w2
            velocity[i, a] = R_il[0, a] * velocity_i[0] + R_il[1, a] * velocity_i[1] + R_il[2, a] * velocity_i[2]
        rotation = mul3(R[i], R_il)
        for a in range(3):
            for c in range(3):
                R[i, a, c] = rotation[a, c]


def sweep(drive: EstimatedMotion, name: str, times: np.ndarray, near: np.ndarray | None = None) -> Sweep:
    """Poses and twists of LiDAR `name` at `times` (n,) on the IMU clock, integrated from the keyframes nearest to
    these, or to `near` (n,)."""
    state, imu = drive.state, drive.imu
    keyframe = assign_keyframes("inertial", state.seconds, times if near is None else near, imu.forwards)
    imu_at = poses_without_jacobians(times, keyframe, state, imu, drive.gravity)
    R_il, p_il = state.values[name, "rotation"], state.values[name, "translation"]
    poses = Sweep(imu_at.rotation, imu_at.position, imu_at.rate, imu_at.velocity)
    _to_lidar(np.ascontiguousarray(R_il), p_il, *poses)
    return poses


# Motion of the IMU that is already estimated, for aligning further sensors to it.

MAX_KEYFRAME_DISTANCE_S = 0.15  # covers a LiDAR scan of 10 Hz whose keyframe is at its start


def are_near_keyframes(keyframes: np.ndarray, times: np.ndarray) -> np.ndarray:
    """(n,) whether there is a keyframe within MAX_KEYFRAME_DISTANCE_S of each time (n,)."""
    k = np.clip(np.searchsorted(keyframes, times), 1, len(keyframes) - 1)
    return np.minimum(np.abs(times - keyframes[k - 1]), np.abs(times - keyframes[k])) < MAX_KEYFRAME_DISTANCE_S


def is_known(keyframes: np.ndarray, times: np.ndarray) -> np.ndarray:
    """(n,) whether the motion is known at each time (n,) on the IMU clock: between keyframes and near one of them."""
    return are_near_keyframes(keyframes, times) & (times >= keyframes[0]) & (times <= keyframes[-1])


def imu_poses(motion: EstimatedMotion, times: np.ndarray) -> Poses:
    """Poses of the IMU at times (n,) on its clock, integrated from the nearest keyframes."""
    keyframe = assign_keyframes("inertial", motion.state.seconds, times, motion.imu.forwards)
    return poses_at("inertial", times, keyframe, motion.state, motion.imu, motion.gravity, False)


# Time offsets of sensor clocks against the clock of the body: one, or one per recording if the clock restarts.
#
#     t_body = t + time_offset + clock_rate (t - t_mid)        t: sensor's time since its first stamp
#
# The value of time_offset is (1,) or (R,) s, that of clock_rate (1,) ppm. t_mid (R,) is the value of the key MIDDLE,
# which is no parameter: one for each recording, since joined recordings are moved. Without it, as in an initial guess,
# the rate is zero.

MIDDLE = "middle of the clock"
PPM = 1e-6

RECORDING_MARGIN_S = 5.0  # a measurement may precede its stamp by as much; recordings are further apart


def instants(stream: Stream, values: Mapping[Key, np.ndarray], seconds: np.ndarray | None = None) -> np.ndarray:
    """Times (n,) on the clock of the body. seconds (n,): times since the first stamp of the stream, by default those of
    its stamps."""
    t = stream.seconds if seconds is None else seconds
    joins = np.array([1e-9 * (ns - stream.origin_ns) for ns in stream.joins_ns]) - RECORDING_MARGIN_S
    return t + _offsets(values, stream.name, np.searchsorted(joins, t, side="right"), t)


def clock_numbers(state: State, name: str, keyframe: np.ndarray) -> np.ndarray:
    """Number (n,) of the time offset that applies to measurements at `keyframe` (n,)."""
    return _recordings(state, keyframe) * (len(state.values[name, "time_offset"]) > 1)


def offset_at(state: State, name: str, keyframe: np.ndarray, seconds: np.ndarray) -> np.ndarray:
    """Time offset (n,) s, with the drift, of a sensor's measurements at `keyframe` (n,) and `seconds` (n,) on its
    clock."""
    return _offsets(state.values, name, _recordings(state, keyframe), seconds)


def drift_at(state: State, name: str, keyframe: np.ndarray, seconds: np.ndarray) -> np.ndarray:
    """Derivative (n,) of `offset_at` by the clock rate [s/ppm]."""
    middle = state.values.get((name, MIDDLE))
    return np.zeros(len(seconds)) if middle is None else PPM * (seconds - middle[_recordings(state, keyframe)])


def seconds_at(state: State, name: str) -> np.ndarray:
    """Time (K,) s of each keyframe on the clock of a sensor, since its first stamp."""
    keyframe = np.arange(len(state.seconds))
    t = state.seconds - state.values[name, "time_offset"][clock_numbers(state, name, keyframe)]
    if (name, MIDDLE) not in state.values:
        return t
    middle = state.values[name, MIDDLE][_recordings(state, keyframe)]
    return middle + (t - middle) / pace_of(state, name)


def pace_of(state: State, name: str) -> float:
    """Seconds of the body's clock for one of the clock of a sensor."""
    return 1.0 + PPM * float(state.values[name, "clock_rate"][0]) if (name, MIDDLE) in state.values else 1.0


def _recordings(state: State, keyframe: np.ndarray) -> np.ndarray:
    """Number (n,) of the recording of each keyframe (n,)."""
    return np.searchsorted(state.starts, keyframe, side="right") - 1


def _offsets(values: Mapping[Key, np.ndarray], name: str, recording: np.ndarray, seconds: np.ndarray) -> np.ndarray:
    """Time offsets (n,) s at `seconds` (n,) on the clock of a sensor in the recordings number `recording` (n,)."""
    of_clocks, middle = values[name, "time_offset"], values.get((name, MIDDLE))
    offset = of_clocks[recording * (len(of_clocks) > 1)]
    if middle is None:
        return offset
    return offset + PPM * values[name, "clock_rate"][0] * (seconds - middle[recording])


def slices_by_clock(state: State, name: str, keyframe: np.ndarray) -> Iterator[tuple[int, slice]]:
    """For each time offset, its number and the slice of measurements at `keyframe` (n,), sorted, that it applies to."""
    if len(state.values[name, "time_offset"]) == 1:
        yield 0, slice(0, len(keyframe))
        return
    edges = np.searchsorted(keyframe, (*state.starts, len(state.seconds)))
    for k, (a, b) in enumerate(zip(edges[:-1], edges[1:], strict=True)):
        if a < b:
            yield k, slice(int(a), int(b))


def pose_columns(layout: Layout, name: str, clock: int = 0) -> np.ndarray:
    """Calibration columns (8,) of a sensor's rotation, translation, time offset number `clock` or the only one, and
    clock rate. Those of a rotation or rate that it does not have are -1."""
    offset = layout.columns(name, "time_offset")
    offset_column = offset[clock if len(offset) > 1 else 0]
    rotation = layout.columns(name, "rotation") if layout.has(name, "rotation") else np.full(3, -1)
    translation = layout.columns(name, "translation")
    rate = layout.columns(name, "clock_rate") if layout.has(name, "clock_rate") else np.full(1, -1)
    return np.concatenate([rotation, translation, [offset_column], rate])


# Placement of keyframes: at every distinct image instant, and evenly spaced between distant ones.

MERGED_WITHIN_S = 2e-3  # images closer in time share a keyframe
SPACING_SLACK = 0.1  # of the spacing: intervals longer by up to this get no keyframe, so that jitter adds none


def place_keyframes(imu: ImuData, image_times: list[np.ndarray], spacing: float, max_gap: float) -> np.ndarray:
    """Keyframe times (K,), seconds on the IMU clock: all image instants, none further apart than 1.1 `spacing` s.

    IMU gaps up to `max_gap` seconds have keyframes too; longer ones, and intervals between recordings, have none.
    """
    times = np.sort(np.concatenate(image_times))
    instants = distinct(times[usable(imu, times, max_gap)])
    parts = [_filled(recorded, spacing) for recorded in np.split(instants, first_keyframes(imu, instants)[1:])]
    keyframes = np.concatenate(parts)
    return keyframes[clear_of(_long_gaps(imu, max_gap), keyframes, keyframes)]


def _filled(times: np.ndarray, spacing: float) -> np.ndarray:
    """Sorted `times` (n,) with evenly spaced instants inserted where they are further apart than 1.1 `spacing`."""
    apart = np.diff(times)
    steps = np.maximum(np.ceil(apart / spacing - SPACING_SLACK), 1.0).astype(np.int64)
    last = np.cumsum(steps)
    k = np.arange(1, steps.sum() + 1) - np.repeat(last - steps, steps)
    filled = np.append(times[:1], np.repeat(times[:-1], steps) + k * np.repeat(apart / steps, steps))
    filled[last] = times[1:]
    return filled


def first_keyframes(imu: ImuData | None, keyframes: np.ndarray) -> tuple[int, ...]:
    """Index of the first keyframe of each recording, in `keyframes` (K,) s; (0,) without an IMU."""
    seams = () if imu is None else imu.seams
    return (0, *(int(k) for k in np.searchsorted(keyframes, [end for end, _ in seams], side="right")))


def distinct(times: np.ndarray) -> np.ndarray:
    """The first of each group of sorted `times` within MERGED_WITHIN_S of one another."""
    return times[np.diff(times, prepend=-np.inf) > MERGED_WITHIN_S]


def spaced(seconds: np.ndarray, spacing: float) -> np.ndarray:
    """The first of `seconds` (n,), increasing, in each interval of length `spacing` [s]; and the last of all."""
    k = np.flatnonzero(np.diff(np.floor(seconds / spacing + 1e-6), prepend=-1.0))
    return seconds[np.append(k, len(seconds) - 1)] if k[-1] < len(seconds) - 1 else seconds[k]


def usable(imu: ImuData, times: np.ndarray, max_gap: float) -> np.ndarray:
    """(n,) whether the IMU has readings at each time; gaps up to `max_gap` seconds count as readings."""
    inside = (times >= imu.seconds[0]) & (times <= imu.seconds[-1])
    return inside & clear_of((*_long_gaps(imu, max_gap), *imu.seams), times, times)


def _long_gaps(imu: ImuData, max_gap: float) -> list[tuple[float, float]]:
    return [(a, b) for a, b in imu.gaps if b - a > max_gap]
