"""Initial guess of IMUs that are mounted on another one: from the readings of both alone.

Angular rates give time offset and rotation. Specific forces then give the lever arm p and the difference b of the
accelerometer biases, by linear least squares: with the body's angular rate w,

    R f_mounted = f_body + dw/dt x p + w x (w x p) + b
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from icalib.data.measurements import ImuStream, Measurements
from icalib.errors import EstimationError
from icalib.estimate.inputs import Inputs
from icalib.estimate.problem import keyframe_times, keyframes_for, start_values
from icalib.geometry import so3
from icalib.geometry.small import once_integrated
from icalib.initialize.initializer import (
    BY_READINGS,
    Initializer,
    InputsWithMotion,
    MotionSource,
    Values,
    fullest_recording,
    known_extrinsics,
    merged_values,
    naming_recording,
    offset_of_each_clock,
    single_recording,
    stated_values,
)
from icalib.initialize.rate_alignment import (
    RateAlignment,
    align_rates,
    kabsch,
    turns_about_two_axes,
    unexplained_share,
)
from icalib.initialize.rate_correlation import GyroRotation, SensorRates, interpolated
from icalib.initialize.rate_regression import MeanRates
from icalib.initialize.trajectories import SignalIntegrals, levelling_rotation
from icalib.motion.imu_data import ImuData
from icalib.motion.poses import first_keyframes
from icalib.optim.state import State
from icalib.rig import ImuSensor, Rig
from icalib.sensors.sensor import MOUNTED_NAMES, mounted

STEP_S = 0.02  # s: over which readings are averaged; motion by hand changes more slowly
ARM_SIGMA_M = 0.5  # m: prior standard deviation of the lever arm about zero
# Unexplained share of the rates of an IMU that names a cause: noise leaves far less, chance in a few seconds far more.
MAX_UNEXPLAINED_RATE = 0.05
# Residual over measured specific force, RMS about the means, above which the accelerometers measured different motions.
MAX_UNEXPLAINED_FORCE = 0.7


class ImuInitializer(Initializer[ImuSensor]):
    """Initializer of IMUs that are mounted on another one. Without any other sensor, the body's readings alone give its
    motion; where it is does not matter then."""

    refined_alone = False

    def prepared(self, rig: Rig, recordings: Sequence[Measurements]) -> Sequence[Measurements]:
        """The recordings as they are. Raises EstimationError if two IMUs have the same readings."""
        for m in recordings:
            streams = m.of(ImuStream)
            for k, stream in enumerate(streams):
                for other in streams[:k]:
                    if _are_copies(stream, other):
                        raise EstimationError(
                            f"{stream.name} and {other.name} have the same readings, so they are one IMU; give the "
                            f"topic or path of {stream.name}, or remove it."
                        )
        return recordings

    def motion_source(self, rig: Rig) -> MotionSource | None:
        """The IMUs, if the rig has no other sensor."""
        return MotionSource(BY_READINGS, tuple(s.name for s in rig.mounted)) if rig.imus_alone else None

    def trajectory(self, inputs: Inputs, fallback: Callable[[], InputsWithMotion]) -> State:
        """The rotation by the body's gyroscope, and the position by integrating its accelerometer from rest."""
        imu = inputs.imu
        assert imu is not None
        values = start_values(inputs, {})
        keyframes = keyframes_for(inputs, keyframe_times(inputs, values))
        state = _dead_reckoned(imu, keyframes, inputs.rig.gravity, values)
        values = start_values(inputs, self.place(inputs, state, inputs.rig.further_imus))
        return replace(state, values=values)

    def place(self, inputs: Inputs, state: State, sensors: Sequence[ImuSensor]) -> Values:
        out: Values = {}
        for sensor in sensors:
            stated = stated_values(inputs, sensor)
            for spec in sensor.specs()[len(MOUNTED_NAMES) :]:
                value = getattr(sensor, spec.name).value
                out[sensor.name, spec.name] = np.zeros(spec.size) if value is None else value
            is_fixed = all(getattr(sensor, name).mode == "fixed" for name in MOUNTED_NAMES)
            out |= stated if is_fixed else merged_values(sensor, stated, _aligned_values(inputs, sensor))
        return out


INITIALIZER = ImuInitializer()


def _are_copies(a: ImuStream, b: ImuStream) -> bool:
    """Whether two streams have the same readings, whatever their stamps, and the order and signs of their axes."""
    n = min(len(a.gyro), len(b.gyro))
    first, second = (np.sort(np.abs(s.gyro[:n]), axis=1) for s in (a, b))
    return bool(np.array_equal(first, second) and first.any())


class _ImuPair(NamedTuple):
    """Readings of the body's IMU and of the mounted one."""

    body: ImuData
    mounted: ImuData


def _readings_of(inputs: Inputs, sensor: ImuSensor, recording: int) -> _ImuPair:
    """The readings in one recording."""
    single = single_recording(inputs, recording)
    stream = single.stream(sensor.name)
    assert single.imu is not None and isinstance(stream, ImuStream)
    return _ImuPair(single.imu, ImuData.build(stream, sensor.noise, sampling=sensor.sampling))


def _aligned_values(inputs: Inputs, sensor: ImuSensor) -> Values:
    """Extrinsics and time offsets of a mounted IMU, from the recording with most readings; if its clock restarts, a
    time offset from each recording. Raises EstimationError if the readings do not show them."""
    known = known_extrinsics(inputs, sensor)
    best = fullest_recording(inputs, sensor.name)
    with naming_recording(inputs, best):
        pair = _readings_of(inputs, sensor, best)
        alignment = _aligned(pair, known.offset if len(inputs.parts) == 1 else None)
        R = alignment.rotation if known.rotation is None else known.rotation
        p = _lever_arm(pair, sensor.name, R, alignment.offset)

    def offset(recording: int) -> float:
        return _aligned(_readings_of(inputs, sensor, recording), None).offset

    offsets = (
        offset_of_each_clock(inputs, sensor.name, offset, {best: alignment.offset})
        if inputs.clocks_of(sensor) > 1
        else np.array([alignment.offset])
    )
    return {(sensor.name, name): value for name, value in mounted(R, p, offsets).items()}


def _aligned(pair: _ImuPair, given_offset: float | None) -> RateAlignment:
    """Time offset, rotation and gyroscope bias of the mounted IMU. About an axis that the motion does not show, the
    rotation follows from the direction of gravity."""
    rates = _rates(pair.mounted)
    try:
        alignment = align_rates(pair.body, pair.mounted.name, rates, given_offset)
    except EstimationError as error:
        raise _explained(pair, rates, given_offset) or error from error
    if turns_about_two_axes(pair.body, rates, alignment):
        return alignment
    w, v, f, g = _side_by_side(pair, alignment.offset)
    (w, v), (f, g) = ((a / _rms(a), b / _rms(a)) for a, b in ((w, v), (f, g)))
    R, _ = kabsch(np.vstack([w, f]), np.vstack([v, g]), np.ones(2 * len(w)))
    return replace(alignment, rotation=R)


def _explained(pair: _ImuPair, rates: SensorRates, given_offset: float | None) -> EstimationError | None:
    """The error that tells why rates do not match, if they match in another unit or after one axis is reversed."""
    name, body = pair.mounted.name, pair.body.name
    hypotheses = (
        (np.array([1.0, 1.0, -1.0]), f"the gyroscope of {name} matches that of {body} only in left-handed axes; write "
        f"gyro_axes: [x, y, -z] of {name} in the rig file, and accel_axes to match, or the axes that its data sheet "
        "shows."),
        (np.full(3, np.pi / 180.0), f"the angular rate of {name} matches {body} if it is in deg/s; set gyro_unit: "
        f"deg/s of {name} in the rig file."),
    )  # fmt: skip
    for factor, sentence in hypotheses:
        with suppress(EstimationError):
            changed = replace(rates, rate=rates.rate * factor)
            alignment = align_rates(pair.body, name, changed, given_offset)
            if unexplained_share(pair.body, changed, alignment) < MAX_UNEXPLAINED_RATE:
                return EstimationError(sentence)
    return None


def _rates(imu: ImuData) -> SensorRates:
    """Mean angular rates over intervals of STEP_S, or of two readings of a slow IMU, outside gaps."""
    step = max(STEP_S, 2.0 * float(np.median(np.diff(imu.seconds))))
    edges = np.arange(imu.seconds[0], imu.seconds[-1], step)
    start, end = edges[:-1], edges[1:]
    inside = imu.covers(start, end)
    start, end = start[inside], end[inside]
    return SensorRates(start, end, MeanRates.of(imu).over(start, end))


def _side_by_side(pair: _ImuPair, offset: float) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Mean angular rates of the body's and the mounted IMU, and their mean specific forces, (n, 3) each in its own
    axes, over successive intervals of STEP_S in which both ran."""
    step = max(STEP_S, *(2.0 * float(np.median(np.diff(imu.seconds))) for imu in pair))
    begin, stop = (
        max(pair.body.seconds[0], pair.mounted.seconds[0] + offset),
        min(pair.body.seconds[-1], pair.mounted.seconds[-1] + offset),
    )
    edges = np.arange(begin, stop, step)
    start, end = edges[:-1], edges[1:]
    inside = pair.body.covers(start, end) & pair.mounted.covers(start - offset, end - offset)
    start, end = start[inside], end[inside]
    spans = (pair.body, start, end), (pair.mounted, start - offset, end - offset)
    w, v = (MeanRates.of(imu).over(a, b) for imu, a, b in spans)
    f, g = (_mean_forces(imu, a, b) for imu, a, b in spans)
    return w, v, f, g


def _mean_forces(imu: ImuData, start: np.ndarray, end: np.ndarray) -> np.ndarray:
    """Mean specific forces (n, 3) over intervals from start to end (n,) s."""
    integral = once_integrated(imu.accel, np.diff(imu.seconds))
    return (interpolated(imu.seconds, integral, end) - interpolated(imu.seconds, integral, start)) / (end - start)[
        :, None
    ]


def _lever_arm(pair: _ImuPair, name: str, R: np.ndarray, offset: float) -> np.ndarray:
    """p_body_mounted (3,) m by least squares, with a prior about zero. R: R_body_mounted. Raises EstimationError if the
    accelerometers measured different motions."""
    w, _, f, g = _side_by_side(pair, offset)
    step = max(STEP_S, *(2.0 * float(np.median(np.diff(imu.seconds))) for imu in pair))
    slope = np.gradient(w, step, axis=0)  # across a gap it is wrong, and few rows are
    W = so3.hat_many(np.ascontiguousarray(w))
    A = np.concatenate([so3.hat_many(np.ascontiguousarray(slope)) + W @ W, np.tile(np.eye(3), (len(w), 1, 1))], axis=2)
    b = g @ R.T - f
    about = b - b.mean(axis=0)
    if _rms(about) > MAX_UNEXPLAINED_FORCE * _rms(f - f.mean(axis=0)) + _force_noise(pair, step):
        is_other_unit = not 0.5 < _rms(g) / _rms(f) < 2.0
        raise EstimationError(
            f"the gyroscopes of {name} and {pair.body.name} match, but their accelerometers do not: that of {name} "
            f"{f'measures {_rms(g) / _rms(f):.2g} times as much' if is_other_unit else 'has other axes'}; correct "
            f"{'accel_unit' if is_other_unit else 'accel_axes'} of {name} in the rig file."
        )
    A, b = A.reshape(-1, 6), b.ravel()
    scatter = _rms(about) / np.sqrt(3.0)
    prior = scatter / ARM_SIGMA_M * np.eye(3, 6)
    return np.linalg.lstsq(np.vstack([A, prior]), np.append(b, np.zeros(3)), rcond=None)[0][:3]


def _force_noise(pair: _ImuPair, step: float) -> float:
    """Standard deviation [m/s^2] of the length of the difference of two mean specific forces, three times over."""
    density = sum(float(np.median(imu.variance[:, 1])) for imu in pair)
    return 3.0 * float(np.sqrt(3.0 * density / step))


def _rms(vectors: np.ndarray) -> float:
    """RMS length of vectors (n, 3)."""
    return float(np.sqrt((vectors**2).sum(axis=1).mean()))


def _dead_reckoned(imu: ImuData, keyframes: np.ndarray, gravity: float, values: Values) -> State:
    """The motion from rest at the origin, by the readings alone. The gyroscope turns about zero on average, and the
    mean specific force in the world points up."""
    bias = np.concatenate([imu.gyro.mean(axis=0), np.zeros(3)])
    R_start_imu = GyroRotation.integrate(imu, bias[:3])
    force = np.einsum("nij,nj->ni", R_start_imu.rotation, imu.accel)
    Q = levelling_rotation(-force.mean(axis=0))
    acceleration = SignalIntegrals.of(imu, force @ Q.T - np.array([0.0, 0.0, gravity]))
    velocity, position = acceleration.at(keyframes)
    rotation = Q @ R_start_imu.at(keyframes)
    starts = first_keyframes(imu, keyframes)
    return State(keyframes, rotation, position, velocity, np.tile(bias, (len(keyframes), 1)), values, starts)
