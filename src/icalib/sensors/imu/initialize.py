"""Initial guess of IMUs that are mounted on another one: from the readings of both alone.

Angular rates give time offset and rotation R. Specific forces then give the lever arm p and the difference b of the
accelerometer biases, R b_mounted - b_body, by linear least squares. With the body's angular rate w, whose bias is not
corrected,

    R f_mounted - f_body = dw/dt x p + w x (w x p) + b
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
    joined_states,
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
# A changed unit or axis is named as the cause only below this unexplained share of the rates: noise leaves far less,
# and chance in a few seconds far more.
MAX_RATE_RESIDUAL_OF_CAUSE = 0.05
# Residual over measured specific force, RMS, above which the accelerometers measured different motions.
MAX_UNEXPLAINED_FORCE = 0.5
COMPARED_READINGS = 1000  # of two IMUs, to find copies
MIN_SHARE_OF_COPIES = 0.9  # of the readings; two IMUs have next to none in common


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
        values = start_values(inputs, {})
        keyframes = keyframes_for(inputs, keyframe_times(inputs, values))
        parts = np.split(keyframes, first_keyframes(inputs.imu, keyframes)[1:])
        states = [_dead_reckoned(single_recording(inputs, k), t - inputs.parts[k].begin) for k, t in enumerate(parts)]
        state = joined_states(inputs, states, values)
        return replace(state, values=start_values(inputs, self.place(inputs, state, inputs.rig.further_imus)))

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
    first, second = (np.sort(np.abs(s.gyro), axis=1) for s in (a, b))
    rows = {row.tobytes() for row in second if row.any()}
    same = [row.tobytes() in rows for row in first[:COMPARED_READINGS]]
    return bool(np.mean(same) > MIN_SHARE_OF_COPIES)


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


class _SideBySide(NamedTuple):
    """Means over n successive intervals of `step` s in which both IMUs ran: angular rates and specific forces (n, 3),
    each in its own axes."""

    step: float
    rate_body: np.ndarray
    rate_mounted: np.ndarray
    force_body: np.ndarray
    force_mounted: np.ndarray


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
    """Time offset, rotation, and difference of the gyroscope biases in the axes of the body. About an axis that the
    motion does not show, the rotation follows from the direction of gravity."""
    rates = _rates(pair.mounted)
    try:
        alignment = align_rates(pair.body, pair.mounted.name, rates, given_offset)
    except EstimationError as error:
        raise _explained(pair, rates, given_offset) or error from error
    if turns_about_two_axes(pair.body, rates, alignment):
        return alignment
    both = _side_by_side(pair, alignment.offset)
    scales = 1.0 / _rms(both.rate_body), 1.0 / _rms(both.force_body)
    body = np.vstack([scales[0] * both.rate_body, scales[1] * both.force_body])
    of_mounted = np.vstack([scales[0] * both.rate_mounted, scales[1] * both.force_mounted])
    R, _ = kabsch(
        body, of_mounted, np.ones(len(body))
    )  # gravity stays, as the means of rates and forces together are removed
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
            if unexplained_share(pair.body, changed, alignment) < MAX_RATE_RESIDUAL_OF_CAUSE:
                return EstimationError(sentence)
    return None


def _step(*imus: ImuData) -> float:
    """STEP_S, or the duration of two readings of the slowest IMU [s]."""
    return max(STEP_S, *(2.0 * float(np.median(np.diff(imu.seconds))) for imu in imus))


def _rates(imu: ImuData) -> SensorRates:
    """Mean angular rates over intervals of `_step`, outside gaps."""
    edges = np.arange(imu.seconds[0], imu.seconds[-1], _step(imu))
    start, end = edges[:-1], edges[1:]
    inside = imu.covers(start, end)
    start, end = start[inside], end[inside]
    return SensorRates(start, end, MeanRates.of(imu).over(start, end))


def _side_by_side(pair: _ImuPair, offset: float) -> _SideBySide:
    """Means of the readings of both, at the time offset `offset` [s]."""
    begin = max(pair.body.seconds[0], pair.mounted.seconds[0] + offset)
    stop = min(pair.body.seconds[-1], pair.mounted.seconds[-1] + offset)
    edges = np.arange(begin, stop, _step(*pair))
    start, end = edges[:-1], edges[1:]
    inside = pair.body.covers(start, end) & pair.mounted.covers(start - offset, end - offset)
    start, end = start[inside], end[inside]
    spans = (pair.body, start, end), (pair.mounted, start - offset, end - offset)
    rates = (MeanRates.of(imu).over(a, b) for imu, a, b in spans)
    return _SideBySide(_step(*pair), *rates, *(_mean_forces(imu, a, b) for imu, a, b in spans))


def _mean_forces(imu: ImuData, start: np.ndarray, end: np.ndarray) -> np.ndarray:
    """Mean specific forces (n, 3) over intervals from start to end (n,) s."""
    integral = once_integrated(imu.accel, np.diff(imu.seconds))
    return (interpolated(imu.seconds, integral, end) - interpolated(imu.seconds, integral, start)) / (end - start)[
        :, None
    ]


def _lever_arm(pair: _ImuPair, name: str, R: np.ndarray, offset: float) -> np.ndarray:
    """p_body_mounted (3,) m by least squares, with a prior about zero. R: R_body_mounted. Raises EstimationError if the
    accelerometers measured different motions."""
    both = _side_by_side(pair, offset)
    slope = np.gradient(both.rate_body, both.step, axis=0)  # wrong only in the few rows beside a gap
    turn = so3.hat_many(np.ascontiguousarray(both.rate_body))
    by_arm = so3.hat_many(np.ascontiguousarray(slope)) + turn @ turn
    A = np.concatenate([by_arm, np.tile(np.eye(3), (len(slope), 1, 1))], axis=2).reshape(-1, 6)
    difference = both.force_mounted @ R.T - both.force_body
    scatter = _rms(difference - difference.mean(axis=0)) / np.sqrt(3.0)
    prior = scatter / ARM_SIGMA_M * np.eye(3, 6)
    x = np.linalg.lstsq(np.vstack([A, prior]), np.append(difference.ravel(), np.zeros(3)), rcond=None)[0]
    residual, force = difference - (A @ x).reshape(-1, 3), both.force_body - both.force_body.mean(axis=0)
    if _rms(residual) > MAX_UNEXPLAINED_FORCE * _rms(force) + 3.0 * _force_noise(pair, both.step):
        raise _other_accelerometer(name, pair.body.name, _rms(both.force_mounted) / _rms(both.force_body))
    return x[:3]


def _other_accelerometer(name: str, body: str, size: float) -> EstimationError:
    """The error of accelerometers that do not match. size: specific force of the mounted IMU over that of the body."""
    is_other_unit = not 0.5 < size < 2.0
    return EstimationError(
        f"the gyroscopes of {name} and {body} match, but their accelerometers do not: that of {name} "
        f"{f'measures {size:.2g} times as much' if is_other_unit else 'has other axes'}; correct "
        f"{'accel_unit' if is_other_unit else 'accel_axes'} of {name} in the rig file."
    )


def _force_noise(pair: _ImuPair, step: float) -> float:
    """RMS length [m/s^2] of the noise of the difference of two mean specific forces."""
    density = sum(float(np.median(imu.variance[:, 1])) for imu in pair)
    return float(np.sqrt(3.0 * density / step))


def _rms(vectors: np.ndarray) -> float:
    """RMS length of vectors (n, 3)."""
    return float(np.sqrt((vectors**2).sum(axis=1).mean()))


def _dead_reckoned(inputs: Inputs, keyframes: np.ndarray) -> State:
    """The motion in one recording, from rest at the origin, by the readings alone. Assumes zero mean angular rate and a
    mean specific force that points up. The state has no calibration parameters."""
    imu = inputs.imu
    assert imu is not None
    bias = np.concatenate([imu.gyro.mean(axis=0), np.zeros(3)])
    gyro_rotation = GyroRotation.integrate(imu, bias[:3])
    force = np.einsum("nij,nj->ni", gyro_rotation.rotation, imu.accel)
    Q = levelling_rotation(-force.mean(axis=0))
    acceleration = SignalIntegrals.of(imu, force @ Q.T - np.array([0.0, 0.0, inputs.rig.gravity]))
    velocity, position = acceleration.at(keyframes)
    rotation = Q @ gyro_rotation.at(keyframes)
    return State(keyframes, rotation, position, velocity, np.tile(bias, (len(keyframes), 1)), {})
