"""Initial guess of wheels on a known trajectory, and the trajectory by dead reckoning for rigs without an IMU."""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial

import numpy as np

from icalib.data.measurements import Measurements, PositionStream, WheelPoses, WheelStream
from icalib.errors import EstimationError
from icalib.estimate.inputs import Inputs
from icalib.estimate.problem import motion_of
from icalib.geometry import so3
from icalib.initialize.initializer import (
    BY_DEAD_RECKONING,
    BodyTrajectory,
    Initializer,
    MotionSource,
    SmoothMotion,
    Values,
    has_guesses,
    is_contradicted,
    merged_values,
    offset_of_each_clock,
    possible_verticals,
    refuse_far_off,
    single_recording,
    stated_values,
)
from icalib.initialize.smooth_trajectory import SmoothTrajectory
from icalib.motion.factor import Extrinsics
from icalib.motion.imu_data import ImuData, clear_of
from icalib.motion.poses import imu_poses, instants, is_known
from icalib.optim.state import Key, State
from icalib.rig import Rig, Wheels
from icalib.sensors.sensor import CLOCK_RATE, TIME_OFFSET, TRANSLATION, mounted
from icalib.sensors.wheels.initialize.drive_guess import (
    ReversedYawError,
    WheelRates,
    drive_guess,
    wheel_offset,
    wheel_rates,
)
from icalib.sensors.wheels.initialize.path_on_fixes import fixes_of, paths_on_fixes, wheel_path
from icalib.sensors.wheels.residual import integrals_of
from icalib.sensors.wheels.spec import REVERSED_YAW


class WheelInitializer(Initializer[Wheels]):
    """Guesses the parameters of wheels from the trajectory of other sensors. In rigs without an IMU and other sensors
    that show the motion, the trajectory comes from dead reckoning on a flat floor."""

    asks_for_vertical = True
    # Turn rates are known by the wheels alone. A prior as tight as the motion would shrink them and enlarge the
    # baseline: by 0.7 % in simulated drives, by 0.15 % with a factor of 10, below 0.05 % with this one.
    prior_factor = 100.0

    def place(self, inputs: Inputs, state: State, sensors: Sequence[Wheels]) -> Values:
        return wheel_values(inputs, state, sensors)

    def motion_source(self, rig: Rig) -> MotionSource | None:
        return MotionSource(BY_DEAD_RECKONING, (rig.wheels[0].name,)) if rig.imu is None else None

    def body_poses(self, rig: Rig, recordings: Sequence[Measurements]) -> BodyTrajectory:
        """See `Initializer`. Positions of a point of the vehicle bound the drift, and determine sizes of the wheels."""
        wheels, streams = rig.wheels[0], [m.wheels[0] for m in recordings]
        if fixes := [fixes_of(s) for m in recordings for s in m.of(PositionStream)[:1]]:
            return BodyTrajectory(*paths_on_fixes(wheels, streams, fixes))
        return BodyTrajectory([wheel_path(wheels, stream) for stream in streams])

    def longest_spacing(self, rig: Rig, recordings: Sequence[Measurements], motion: SmoothMotion) -> float:
        noise = [
            wheel_noise(wheels, [m.wheels[k] for m in recordings], motion.paths) for k, wheels in enumerate(rig.wheels)
        ]
        return min(motion.spacing_for_increments(turn, distance) for distance, turn in noise)


INITIALIZER = WheelInitializer()


# Initial guess of wheels on a known trajectory: time offset, extrinsics and drive parameters.

SIMPSON_WEIGHTS = np.array([1.0, 4.0, 1.0]) / 6.0  # of start, middle and end of an interval


def wheel_values(inputs: Inputs, state: State, sensors: Sequence[Wheels]) -> dict[Key, np.ndarray]:
    """Parameters of `sensors`, from the rig file or else from the trajectory in `state`.

    Raises EstimationError if the rig file lacks some and the trajectory does not determine them.
    """
    out: dict[Key, np.ndarray] = {}
    for wheels in sensors:
        stream = inputs.stream(wheels.name)
        assert isinstance(stream, (WheelStream, WheelPoses))
        out |= _wheels(inputs, state, wheels, stream)
    return out


def _wheels(inputs: Inputs, state: State, wheels: Wheels, stream: WheelStream | WheelPoses) -> dict[Key, np.ndarray]:
    """As `wheel_values`, for one set of wheels. Values of the rig file are kept unless the trajectory contradicts
    them."""
    names = [spec.name for spec in wheels.specs() if spec != CLOCK_RATE]
    known = stated_values(inputs, wheels, names)
    if isinstance(stream, WheelPoses):
        known |= {(wheels.name, spec.name): np.ones(spec.size) for spec in wheels.drive_specs}
    complete = len(known) == len(names)
    if complete and isinstance(stream, WheelPoses) and not has_guesses(wheels, stated_values(inputs, wheels, names)):
        return known
    clock = wheels.name, "time_offset"
    offset = known.get(clock)
    try:
        estimated = _from_trajectory(
            inputs, state, wheels, stream, None if wheels.time_offset.mode == "free" else offset
        )
        if not complete and offset is not None and not is_contradicted(TIME_OFFSET, offset, estimated[clock]):
            estimated = _from_trajectory(inputs, state, wheels, stream, offset)
    except EstimationError:
        if complete:
            return known
        if offset is None:
            raise
        estimated = _from_trajectory(inputs, state, wheels, stream, offset)
    translation = wheels.name, "translation"
    stated = known.get(translation)
    level = estimated[translation] if stated is None else _at_height_of(inputs, state, stated, estimated[translation])
    refuse_far_off(wheels, estimated | {translation: level})
    if stated is not None and not is_contradicted(TRANSLATION, stated, level):
        estimated[translation] = stated
    return merged_values(wheels, known, estimated)


def _at_height_of(inputs: Inputs, state: State, stated: np.ndarray, lever_arm: np.ndarray) -> np.ndarray:
    """`lever_arm` (3,) m, moved along the vertical to the height of `stated` (3,), as motion on a floor
    does not determine the height."""
    up = possible_verticals(inputs, state).candidates[0]
    up = up / np.linalg.norm(up)
    return lever_arm + up * (up @ (stated - lever_arm))


def _from_trajectory(
    inputs: Inputs,
    state: State,
    wheels: Wheels,
    stream: WheelStream | WheelPoses,
    offset: np.ndarray | None,
) -> dict[Key, np.ndarray]:
    """Parameters of wheels from the trajectory; offset (1,) s: the known time offset.

    Both directions of the vertical are tried if nothing shows which is up. Raises EstimationError if neither fits.
    """
    assert inputs.imu is not None
    if isinstance(stream, WheelPoses):
        return _from_relative_poses(inputs, state, stream, offset)
    rates = wheel_rates(wheels.name, stream.seconds, integrals_of(stream), stream.kind)
    up = possible_verticals(inputs, state)
    failed: list[EstimationError] = []
    for candidate in up.candidates:
        values = _attempt(inputs, state, stream, rates, candidate, offset)
        if not isinstance(values, EstimationError):
            return values
        failed.append(values)
    other = _attempt(inputs, state, stream, rates, -up.candidates[0], offset) if up.level_sensor else failed[0]
    if not isinstance(other, EstimationError):
        raise EstimationError(
            f"{wheels.name}: {REVERSED_YAW[rates.kind]}. If z of the frame of {up.level_sensor} points down, write "
            f"level: false for {up.level_sensor} instead."
        )
    # The yaw is reversed with the wrong vertical; the cause is what fails with the other.
    raise next((error for error in (*failed, other) if not isinstance(error, ReversedYawError)), failed[0])


def _attempt(
    inputs: Inputs, state: State, stream: WheelStream, rates: WheelRates, up: np.ndarray, offset: np.ndarray | None
) -> dict[Key, np.ndarray] | EstimationError:
    """As `_from_rates`, but returns the error instead of raising it."""
    try:
        return _from_rates(inputs, state, stream, rates, up, offset)
    except EstimationError as error:
        return error


def _from_rates(
    inputs: Inputs, state: State, stream: WheelStream, rates: WheelRates, up: np.ndarray, offset: np.ndarray | None
) -> dict[Key, np.ndarray]:
    """Parameters of wheels that report rates; up (3,): the vertical in IMU axes. Raises EstimationError as
    `drive_guess`."""
    assert inputs.imu is not None
    name = stream.name
    if offset is None and inputs.sensor(name).clock_restarts:
        offset = offset_of_each_clock(inputs, name, partial(_offset_alone, inputs, name, up))
    elif offset is None:
        offset = np.array([wheel_offset(inputs.imu, up, name, rates)])
    clock = {(name, "time_offset"): offset}
    start, end = instants(stream, clock, rates.start), instants(stream, clock, rates.end)
    inside, rate, velocity = _means(inputs, state, start, end)
    drive = drive_guess(name, rates.rate[inside], rate, velocity, up, rates.kind)
    values = mounted(drive.extrinsics.R, drive.extrinsics.p, offset) | drive.values
    return {(name, group): value for group, value in values.items()}


def _offset_alone(inputs: Inputs, name: str, up: np.ndarray, recording: int) -> float:
    """Time offset [s] in one recording, relative to the first stamps of it; up (3,): the vertical in IMU axes."""
    single = single_recording(inputs, recording)
    stream = single.stream(name)
    assert single.imu is not None and isinstance(stream, WheelStream)
    return wheel_offset(single.imu, up, name, wheel_rates(name, stream.seconds, integrals_of(stream), stream.kind))


def _from_relative_poses(
    inputs: Inputs, state: State, stream: WheelPoses, offset: np.ndarray | None
) -> dict[Key, np.ndarray]:
    """Extrinsics and time offset of wheels that report relative poses."""
    assert inputs.imu is not None
    if offset is None:
        offset = np.array([poses_offset(inputs.imu, stream)])
    times = stream.seconds + offset[0]  # relative poses come from a single recording
    inside, rate, velocity = _means(inputs, state, times[:-1], times[1:])
    extrinsics = extrinsics_guess(stream, inside, rate, velocity)
    values = mounted(extrinsics.R, extrinsics.p, offset)
    return {(stream.name, name): np.ascontiguousarray(value) for name, value in values.items()}


def _means(
    inputs: Inputs, state: State, start: np.ndarray, end: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Mean motion of the IMU over intervals from start to end (m,) s on its clock, by Simpson's rule.

    Returns a mask (m,) of the n intervals within the trajectory and outside gaps of the IMU; and for these the means
    (n, 3) of rate [rad/s], without bias, and velocity [m/s] in IMU axes. Raises EstimationError if there are none.
    """
    assert inputs.imu is not None
    motion = motion_of(inputs, state)
    inside = is_known(state.seconds, start) & is_known(state.seconds, end)
    inside &= clear_of(inputs.imu.gaps, start, end)  # poses in gaps are extrapolated
    if not inside.any():
        raise EstimationError(
            "no reading of the wheels falls within the recording of the other sensors; check the clocks, or "
            "time_offset in the rig file."
        )
    start, end = start[inside], end[inside]
    times = np.stack([start, 0.5 * (start + end), end], axis=1).ravel()
    poses = imu_poses(motion, times)
    velocity = np.einsum("nji,nj->ni", poses.rotation, poses.velocity)
    rate, speed = (np.einsum("k,nki->ni", SIMPSON_WEIGHTS, x.reshape(-1, 3, 3)) for x in (poses.rate, velocity))
    return inside, rate, speed


# Initial guess of wheels that report relative planar poses (equation (27) of the iCalib paper).
#
# The time offset follows from correlation, the extrinsics from linear least squares. Over a short interval, with u and
# w the velocity and rate of the IMU in its own axes, and r_k the columns of R_imu_wheel,
#
#     yaw' = r_3 w        (x', y') = r_k u + (p_imu_wheel x r_k) w,  k = 1, 2

CORRELATION_HZ = 100.0  # grid of the correlation; Gauss-Newton refines its peak
MIN_EXPLAINED = 0.5  # least share of the variance of the yaw rate that the gyroscope explains at the right offset
MIN_SINGULAR_RATIO = 0.02  # relative to the largest singular value; smaller ones are noise and are truncated
MAX_REFINEMENTS = 6  # Gauss-Newton steps of the time offset
OFFSET_STEP_S = 0.02  # largest of these steps: two samples of the grid
N_PEAKS = 30  # peaks of the correlation that are compared by the data in their overlap


def yaw_rates(stream: WheelPoses) -> tuple[np.ndarray, np.ndarray]:
    """Midpoints (K,) [s] of the intervals on the clock of the stream, and mean yaw rates (K,) [rad/s] over the
    intervals."""
    t = stream.seconds
    return 0.5 * (t[1:] + t[:-1]), stream.pose[:, 0] / np.diff(t)


def poses_offset(imu: ImuData, stream: WheelPoses) -> float:
    """Time offset [s] to add to the clock of the wheels to get the clock of the IMU, both since their first stamp.

    At this offset a linear combination of the gyroscope's axes explains the yaw rate best. Raises EstimationError if
    less than MIN_EXPLAINED of its variance is explained.
    """
    middle, yaw = yaw_rates(stream)
    grid = np.arange(int(imu.seconds[-1] * CORRELATION_HZ) + 1) / CORRELATION_HZ
    wheel_grid = np.arange(int(middle[0] * CORRELATION_HZ), int(middle[-1] * CORRELATION_HZ) + 1) / CORRELATION_HZ
    gyro = np.stack([np.interp(grid, imu.seconds, g) for g in imu.gyro.T])
    turned = np.interp(wheel_grid, middle, yaw)
    offset, explained = _best_shift(gyro - gyro.mean(axis=1, keepdims=True), turned - turned.mean())
    if explained < MIN_EXPLAINED:
        raise EstimationError(
            f"the yaw rate of {stream.name} does not match that of {imu.name} at any time offset "
            f"({explained:.0%} of it explained); check that both come from the same recording, and turn more."
        )
    offset -= wheel_grid[0]
    angle = np.zeros_like(imu.gyro)
    np.cumsum(0.5 * (imu.gyro[1:] + imu.gyro[:-1]) * np.diff(imu.seconds)[:, None], axis=0, out=angle[1:])
    for _ in range(MAX_REFINEMENTS):
        inside = intervals_inside(imu, stream, offset)
        start, end = (t[inside] + offset for t in (stream.seconds[:-1], stream.seconds[1:]))
        mean, slope = ((_at(end, imu, x) - _at(start, imu, x)) / (end - start)[:, None] for x in (angle, imu.gyro))
        A = np.column_stack([mean, np.ones(len(mean))])
        axis = _least_squares(A, yaw[inside])
        change = slope @ axis[:3]
        step = change @ (yaw[inside] - A @ axis) / max(change @ change, 1e-12)
        offset += float(np.clip(step, -OFFSET_STEP_S, OFFSET_STEP_S))
    return offset


def _at(t: np.ndarray, imu: ImuData, x: np.ndarray) -> np.ndarray:
    """x (N, 3), given at the stamps of the IMU, interpolated at t (n,) [s]; returns (n, 3)."""
    return np.stack([np.interp(t, imu.seconds, column) for column in x.T], axis=1)


def extrinsics_guess(stream: WheelPoses, inside: np.ndarray, rate: np.ndarray, velocity: np.ndarray) -> Extrinsics:
    """Extrinsics of the wheels from relative poses and the motion of the IMU.

    inside (K,) bool: the n intervals that are used. rate [rad/s], velocity [m/s] (n, 3): means over each interval for
    the IMU, in IMU axes.
    """
    pose, dt = stream.pose[inside], np.diff(stream.seconds)[inside]
    half = 0.5 * pose[:, 0]
    c, s = np.cos(half), np.sin(half)
    x, y = c * pose[:, 1] + s * pose[:, 2], c * pose[:, 2] - s * pose[:, 1]  # in axes at half the yaw
    up = _least_squares(np.column_stack([rate, np.ones(len(rate))]), pose[:, 0] / dt)[:3]
    moving = np.column_stack([velocity, rate])
    ahead, left = (_least_squares(moving, displacement / dt) for displacement in (x, y))
    R = so3.closest_rotation(np.stack([ahead[:3], left[:3], up]))
    rows = np.concatenate([-_cross(R[0]), -_cross(R[1])])  # p x r = -r x p
    return Extrinsics(R.T, _least_squares(rows, np.concatenate([ahead[3:], left[3:]])))


def _least_squares(A: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Minimum-norm solution x (k,) of A x = b with singular values below MIN_SINGULAR_RATIO truncated."""
    return np.linalg.lstsq(A, b, rcond=MIN_SINGULAR_RATIO)[0]


def _cross(v: np.ndarray) -> np.ndarray:
    """The cross-product matrix (3, 3) of v."""
    return np.array([[0.0, -v[2], v[1]], [v[2], 0.0, -v[0]], [-v[1], v[0], 0.0]])


def _best_shift(gyro: np.ndarray, yaw: np.ndarray) -> tuple[float, float]:
    """Offset [s] of yaw rates (m,) against gyro (3, n), both on the grid, and the explained share of the variance of
    yaw rates."""
    n, m = gyro.shape[1], len(yaw)
    size = 1 << (n + m - 1).bit_length()
    product = np.fft.irfft(np.fft.rfft(gyro, size) * np.conj(np.fft.rfft(yaw, size)), size)
    lag = np.arange(-(m - 1), n)
    c = product[:, lag]
    count = np.minimum(n, lag + m) - np.maximum(0, lag)
    explained = np.einsum("kl,kl->l", c, np.linalg.pinv(gyro @ gyro.T / n, rcond=MIN_SINGULAR_RATIO) @ c) / count
    likely = np.where(count >= 0.5 * min(n, m), explained / (count * yaw.var()), 0.0)
    peaks = np.flatnonzero((likely[1:-1] >= likely[:-2]) & (likely[1:-1] >= likely[2:])) + 1
    # The correlation uses the covariance of the gyroscope over the recording; peaks are compared by that of the
    # overlap.
    best = max(peaks[np.argsort(-likely[peaks])[:N_PEAKS]], key=lambda k: _significance(gyro, yaw, int(lag[k])))
    return float(lag[best]) / CORRELATION_HZ, _explained(gyro, yaw, int(lag[best]))


def _explained(gyro: np.ndarray, yaw: np.ndarray, lag: int) -> float:
    """Share of the variance of yaw rates (m,) that gyro (3, n) explains in the overlap, `lag` samples apart."""
    a, b = max(0, -lag), min(len(yaw), gyro.shape[1] - lag)
    A, y = np.column_stack([gyro[:, a + lag : b + lag].T, np.ones(b - a)]), yaw[a:b]
    left = y - A @ _least_squares(A, y)
    return 1.0 - float(left.var() / max(y.var(), 1e-12))


def _significance(gyro: np.ndarray, yaw: np.ndarray, lag: int) -> float:
    """The correlation at `lag` as Fisher's z times the square root of the overlap: significance in standard
    deviations."""
    count = min(len(yaw), gyro.shape[1] - lag) - max(0, -lag)
    return float(np.arctanh(np.sqrt(np.clip(_explained(gyro, yaw, lag), 0.0, 0.999999))) * np.sqrt(count))


def intervals_inside(imu: ImuData, stream: WheelPoses, offset: float) -> np.ndarray:
    """(K,) bool: the interval lies within the recording of the IMU and outside its gaps. offset: time offset [s]."""
    return imu.covers(stream.seconds[:-1] + offset, stream.seconds[1:] + offset)


# Noise densities of distance and yaw of wheels, before their sizes are known.


def wheel_noise(wheels: Wheels, streams: Sequence[object], paths: Sequence[SmoothTrajectory]) -> tuple[float, float]:
    """Noise densities of distance [m/sqrt(s)] and yaw [rad/sqrt(s)]; zeros if unknown.

    Radius and radius over baseline of a pair are approximated by ratios of RMS values: speed and angular rate of the
    trajectories `paths`, over those of the wheels. These ratios do not depend on the time offset.
    """
    if wheels.kind == "twist":
        return wheels.speed_noise, wheels.yaw_noise
    rates = [s.rate for s in streams if isinstance(s, WheelStream) and s.kind == "pair"]
    if not rates:
        return 0.0, 0.0
    rate = np.concatenate(rates)
    speed, turn = (np.concatenate([getattr(p, name)[p.near] for p in paths]) for name in ("velocity", "rate"))
    rolled, apart = _rms(rate.mean(axis=1)), _rms(rate[:, 1] - rate[:, 0])
    if not (rolled > 0.0 and apart > 0.0):
        return 0.0, 0.0
    radius, per_baseline = _rms(speed) / rolled, _rms(turn) / apart
    return wheels.wheel_noise * radius / np.sqrt(2.0), wheels.wheel_noise * np.sqrt(2.0) * per_baseline


def _rms(x: np.ndarray) -> float:
    """Root mean square of numbers (n,) or of the lengths of vectors (n, 3)."""
    return float(np.sqrt((x.reshape(len(x), -1) ** 2).sum(axis=1).mean()))
