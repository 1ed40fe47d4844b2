"""Initial guess of position sensors: the trajectory from fixes and IMU, or lever arm, time offset and frame on a known
trajectory.

A position sensor on a known trajectory: time offset by correlation, frame and lever arm by least squares.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np

from icalib.data.measurements import Measurements
from icalib.errors import EstimationError
from icalib.estimate.estimate import first_pass
from icalib.estimate.inputs import Inputs, origin_difference
from icalib.estimate.problem import keyframe_times, keyframes_for, motion_of, start_values
from icalib.geometry import so3
from icalib.initialize.initializer import (
    BY_POSITIONS,
    InitialGuess,
    Initializer,
    InputsWithMotion,
    KnownExtrinsics,
    MotionSource,
    OtherMotionError,
    Values,
    converted_offset,
    fullest_recording,
    known_value,
    merged_values,
    naming_recording,
    single_recording,
    state_of_recording,
    stated_values,
    states_from_best,
)
from icalib.initialize.lever_arm import Triples
from icalib.initialize.rate_correlation import best_shifts, closest_of_equals
from icalib.model.sensor_model import frame_of
from icalib.motion.imu_data import ImuData
from icalib.motion.poses import EstimatedMotion, Poses, imu_poses, is_known
from icalib.optim.state import State
from icalib.rig import Rig
from icalib.rig.scene import FRAME_ROTATION, FRAME_TRANSLATION, FRAME_YAW
from icalib.sensors.position.frame import PositionFrame, frame_owner
from icalib.sensors.position.initialize.attitude import (
    ARM_SIGMA_M,
    MAX_TRIPLE_NOISE,
    MIN_JERK_CORRELATION,
    MIN_WINDOW_TRIPLES,
    OFFSET_SIGMA_S,
    PEAK_SPACING_S,
    SIGNAL_RATE_HZ,
    Fix,
    IntegratedReadings,
    WindowFit,
    WindowPrior,
    WindowUnknowns,
    change_of_acceleration,
    first_unknowns,
    fit_window,
    offsets_by_jerk,
    recorded,
    sigmas,
    varies,
)
from icalib.sensors.position.read import single_wrong
from icalib.sensors.position.residual import knot_keys
from icalib.sensors.position.spec import PositionSensor
from icalib.sensors.position.stream import PositionStream

GUESSED_GROUPS = ("translation", "time_offset")


class PositionInitializer(Initializer[PositionSensor]):
    """See `Initializer`. The first position sensor gives the trajectory if no other kind of sensor does. Position
    sensors on a known trajectory get lever arm, time offset and frame."""

    def prepared(self, rig: Rig, recordings: Sequence[Measurements]) -> Sequence[Measurements]:
        """With an IMU, the recordings without single wrong fixes, which would enlarge the estimated noise. Files are
        cleaned when they are read; this cleans measurements that were made in memory."""
        if rig.imu is None:
            return recordings
        streams = ((s.some(~single_wrong(s.seconds, s.position)) for s in m.of(PositionStream)) for m in recordings)
        return [m.with_streams(*good) for m, good in zip(recordings, streams, strict=True)]

    def motion_source(self, rig: Rig) -> MotionSource | None:
        """See `Initializer`. Positions need an IMU for the attitude, and a frame of their own for the world, which no
        other sensor and no target has."""
        framed = [s.name for s in rig.of(PositionSensor) if s.has_frame]
        return MotionSource(BY_POSITIONS, (framed[0],)) if rig.imu is not None and framed else None

    def trajectory(self, inputs: Inputs, fallback: Callable[[], InputsWithMotion]) -> State:
        sensor = inputs.rig.of(PositionSensor)[0]
        state = states_from_best(inputs, sensor, fullest_recording(inputs, sensor.name), _state_of_one)
        frames = _frames(inputs, sensor, [(np.eye(3), np.zeros(3))] * len(inputs.parts))
        return replace(state, values=state.values | frames)

    def refined(self, inputs: Inputs, source_inputs: Inputs, state: State) -> InitialGuess:
        state = first_pass(source_inputs, state)
        return inputs, state, state.values

    def place(self, inputs: Inputs, state: State, sensors: Sequence[PositionSensor]) -> Values:
        """See `Initializer`. Sensors with a frame come first, because sensors without one may share it."""
        out: Values = {}
        for sensor in sorted(sensors, key=lambda s: not s.has_frame):
            out |= _on_motion(inputs, replace(state, values=state.values | out), sensor)
        return out


INITIALIZER = PositionInitializer()


def _state_of_one(inputs: Inputs, extrinsics: KnownExtrinsics | None) -> State:
    """The state of one recording, with the frame of the fixes as world; extrinsics: found in another recording, or
    None."""
    assert inputs.imu is not None
    sensor = inputs.rig.of(PositionSensor)[0]
    known = extrinsics or _known_extrinsics(inputs, sensor)
    motion = motion_from_fixes(inputs.imu, sensor.name, _fix(inputs, sensor), inputs.rig.gravity, known)
    estimated = {
        (sensor.name, name): value
        for name, value in zip(GUESSED_GROUPS, (motion.best.at.arm, np.array([motion.best.at.offset])), strict=True)
    }
    values = start_values(inputs, merged_values(sensor, stated_values(inputs, sensor, GUESSED_GROUPS), estimated))
    keyframes = keyframes_for(inputs, keyframe_times(inputs, values))
    rotation, position, velocity, bias = motion.at(keyframes)
    return State(keyframes, rotation, position, velocity, bias, values)


def _on_motion(inputs: Inputs, state: State, sensor: PositionSensor) -> Values:
    """Lever arm, time offset and frames of one sensor on the trajectory of `state`. The recording with most fixes gives
    the lever arm, and the time offset unless the clock restarts."""
    recordings = [single_recording(inputs, k) for k in range(len(inputs.parts))]
    best = fullest_recording(inputs, sensor.name)
    placed: dict[int, PlacedSensor] = {}
    for k in sorted(range(len(recordings)), key=lambda k: k != best):
        extrinsics, frame = _known_extrinsics(recordings[k], sensor), None
        if k != best:
            offset = converted_offset(placed[best].offset, sensor.name, recordings[best], recordings[k])
            offset = extrinsics.offset if sensor.clock_restarts else offset
            extrinsics = KnownExtrinsics(position=placed[best].arm, offset=offset)
        if not sensor.has_frame:
            frame = PositionFrame.of(frame_owner(sensor), k, state.values)
        known = KnownPlace(_is_levelled(inputs, sensor), extrinsics.position, extrinsics.offset, frame)
        with naming_recording(inputs, k):
            motion = motion_of(recordings[k], state_of_recording(inputs, k, state))
            placed[k] = place(motion, sensor.name, _fix(recordings[k], sensor), known)
    clocks = range(len(recordings)) if sensor.clock_restarts else (best,)
    offsets = [converted_offset(placed[k].offset, sensor.name, recordings[k], inputs) for k in clocks]
    estimated = {
        (sensor.name, GUESSED_GROUPS[0]): placed[best].arm,
        (sensor.name, GUESSED_GROUPS[1]): np.array(offsets),
    }
    frames = _frames(inputs, sensor, [(placed[k].R_wf, placed[k].p_wf) for k in range(len(recordings))])
    return merged_values(sensor, stated_values(inputs, sensor, GUESSED_GROUPS), estimated) | frames


def _known_extrinsics(inputs: Inputs, sensor: PositionSensor) -> KnownExtrinsics:
    """Lever arm and time offset that the rig file fixes or gives as a prior."""
    known = {name: value for (_, name), value in stated_values(inputs, sensor, GUESSED_GROUPS).items()}
    known = {name: value for name, value in known.items() if known_value(getattr(sensor, name)) is not None}
    offset = known.get("time_offset")
    return KnownExtrinsics(position=known.get("translation"), offset=None if offset is None else float(offset[0]))


def _fix(inputs: Inputs, sensor: PositionSensor) -> Fix:
    stream = inputs.stream(sensor.name)
    assert isinstance(stream, PositionStream)
    return Fix(stream.seconds, stream.position, origin_difference(inputs.measurements, stream))


def _is_levelled(inputs: Inputs, sensor: PositionSensor) -> bool:
    """Whether the rotation of the sensor's frame in the world is a yaw alone."""
    return (frame_of(sensor.name, 0), FRAME_YAW.name) in {b.key for b in inputs.layout.blocks}


def _frames(inputs: Inputs, sensor: PositionSensor, frames: Sequence[tuple[np.ndarray, np.ndarray]]) -> Values:
    """Values of the sensor's frame in each recording, and zeros for the slow offset of the fixes. frames: R_world_frame
    (3, 3) and p_world_frame (3,) m of each recording. A shared frame has no values here."""
    out: Values = {}
    if sensor.position_random_walk:
        out |= {key: np.zeros(3) for k in range(len(frames)) for key in knot_keys(sensor.name, k, len(frames))}
    if not sensor.has_frame:
        return out
    levelled = _is_levelled(inputs, sensor)
    for k, (R, p) in enumerate(frames):
        name, value = (
            (FRAME_YAW.name, np.array([np.arctan2(R[1, 0], R[0, 0])])) if levelled else (FRAME_ROTATION.name, R)
        )
        out |= {(frame_of(sensor.name, k), name): value, (frame_of(sensor.name, k), FRAME_TRANSLATION.name): p}
    return out


SPEED_STEP_S = 1.0  # of mean speeds: noise of 2 cm makes 3 cm/s
MIN_SPEED_OVERLAP_S = 5.0  # s: shorter overlaps correlate by chance
MAX_SPEED_PEAKS = 4  # candidates
MIN_PLACED_FIXES = 8  # 24 rows for up to 10 unknowns
SCAN_STEP_S = 0.2  # of a grid of offsets: shorter than the motions of a rig
MAX_SCANNED_FIXES = 100  # bounds the time of a scan
MAX_PLACING_ROUNDS = 10
PLACING_STEP_TOLERANCE = 1e-6  # m, rad, s: of a Gauss-Newton step
MAX_FIX_MEDIANS = 4.0  # times the median residual; a fix with a larger one has no weight
MIN_FIX_SIGMA_M = 0.01  # of a residual, which contains errors of the trajectory
FREE_FRAME_SIGMA_RAD, FREE_FRAME_SIGMA_M = 10.0, 1e4  # of a frame of which nothing is known
KNOWN_SIGMA_M, KNOWN_SIGMA_RAD, KNOWN_SIGMA_S = 1e-3, 1e-6, 1e-4  # of known values: nearly fixed, and still regular
MAX_POSITION_MISFIT = 0.3  # median residual over the spread of the fixes: another motion leaves more


class PlacedSensor(NamedTuple):
    """Result of `place`. arm (3,): p_imu_sensor [m]; R_wf (3, 3): R_world_frame; p_wf (3,): p_world_frame [m]; offset:
    t_imu - t_sensor [s], each since its first stamp; misfit: median norm of the residuals over the median distance of
    the fixes from their median."""

    arm: np.ndarray
    R_wf: np.ndarray
    p_wf: np.ndarray
    offset: float
    misfit: float


@dataclass(frozen=True)
class KnownPlace:
    """Known values of a sensor. levelled: the rotation of its frame in the world is about z; arm (3,) m and offset [s]
    as in `PlacedSensor`; frame: the shared frame. None stands for an unknown value."""

    levelled: bool
    arm: np.ndarray | None = None
    offset: float | None = None
    frame: PositionFrame | None = None

    @property
    def turns(self) -> int:
        """Number of parameters of the frame's rotation."""
        return 1 if self.levelled else 3


def place(motion: EstimatedMotion, name: str, fix: Fix, known: KnownPlace) -> PlacedSensor:
    """Lever arm, frame and time offset of the sensor `name` from its fixes in one recording; motion: the trajectory in
    it. Raises EstimationError where the fixes are too few, or contradict the trajectory."""
    offsets = _candidate_offsets(motion, fix, known)
    candidates = [x for offset in offsets if (x := _placed(motion, fix, offset, known))]
    if min((x.misfit for x in candidates), default=np.inf) > MAX_POSITION_MISFIT and known.offset is None:
        candidates += [
            x for offset in _scanned_offsets(motion, fix, known) if (x := _placed(motion, fix, offset, known))
        ]
    if not candidates:
        raise OtherMotionError(
            f"{name}: too few of its fixes fall within the motion that the other sensors show; check that the clocks "
            "overlap, or the time_offset in the rig file."
        )
    best = closest_of_equals(((x.misfit, x.offset, x) for x in candidates), fix.same_clock, 0.0)
    assert best is not None
    if best.misfit > MAX_POSITION_MISFIT:
        hint = "check that both are on the same vehicle"
        if known.frame is not None:
            hint += ", and that its positions are in the frame that the rig file names"
        elif known.levelled:
            hint += ", or write frame: tilted if z of its frame does not point up"
        raise OtherMotionError(
            f"{name}: its fixes do not follow the motion that the other sensors show: at the best time offset the "
            f"median residual is {best.misfit:.0%} of their spread; {hint}."
        )
    return best


def _candidate_offsets(motion: EstimatedMotion, fix: Fix, known: KnownPlace) -> list[float]:
    """Candidate time offsets [s]: the known one, or that of one clock, peaks of the correlation of mean speeds, then of
    third differences with the IMU's readings. Speeds differ where the rig turns on the spot, by the lever arm."""
    if known.offset is not None:
        return [known.offset]
    by_acceleration = [fix.same_clock, *(x.samples / SIGNAL_RATE_HZ for x in offsets_by_jerk(motion.imu, fix))]
    state = motion.state
    motion_speeds = _speeds(state.seconds, state.position, np.zeros(len(state.seconds)))
    fix_speeds = _speeds(fix.t, fix.position, fix.run)
    if not (varies(*motion_speeds) and varies(*fix_speeds)):
        return by_acceleration
    overlap, spacing = MIN_SPEED_OVERLAP_S * SIGNAL_RATE_HZ, round(PEAK_SPACING_S * SIGNAL_RATE_HZ)
    peaks = best_shifts(motion_speeds, fix_speeds, overlap, MAX_SPEED_PEAKS, spacing)
    return [*(peak.samples / SIGNAL_RATE_HZ for peak in peaks), *by_acceleration]


def _scanned_offsets(motion: EstimatedMotion, fix: Fix, known: KnownPlace) -> list[float]:
    """Candidate time offsets [s] of a grid, at which frame and lever arm fit best. Correlations fail where the rig
    turns on the spot: the antenna then has other speeds and accelerations. Half of the fixes must be used."""
    some = np.linspace(0, len(fix.t) - 1, min(len(fix.t), MAX_SCANNED_FIXES)).astype(int)
    t, p, keyframes = fix.t[some], fix.position[some], motion.state.seconds
    tried: list[tuple[float, float]] = []
    for offset in np.arange(keyframes[0] - t[-1], keyframes[-1] - t[0], SCAN_STEP_S).tolist():
        ok = is_known(keyframes, t + offset)
        if ok.sum() < max(MIN_PLACED_FIXES, 0.5 * len(t)):
            continue
        at = imu_poses(motion, t[ok] + offset)
        x = _linear(at, p[ok], known, offset)
        r = at.position + at.rotation @ x.arm - p[ok] @ x.R_wf.T - x.p_wf
        tried.append((float(np.median(np.linalg.norm(r, axis=1))), offset))
    return [offset for _, offset in sorted(tried)[:MAX_SPEED_PEAKS]]


def _speeds(t: np.ndarray, p: np.ndarray, run: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Mean speeds (m,) over SPEED_STEP_S [m/s] of positions p (n, 3) at t (n,) s, at SIGNAL_RATE_HZ from 0 s on, and
    where they are known (m,): not across fixes of another `run` (n,)."""
    grid = np.arange(int(t[-1] * SIGNAL_RATE_HZ) + 1) / SIGNAL_RATE_HZ
    ends = [grid - 0.5 * SPEED_STEP_S, grid + 0.5 * SPEED_STEP_S]
    apart = max(2.5 * float(np.median(np.diff(t))), 1.5 / SIGNAL_RATE_HZ)
    after = [np.clip(np.searchsorted(t, x), 1, len(t) - 1) for x in ends]
    known = (ends[0] >= t[0]) & (ends[1] <= t[-1]) & (run[after[0] - 1] == run[after[1]])
    for k in after:
        known &= t[k] - t[k - 1] <= apart
    at = [np.stack([np.interp(x, t, p[:, k]) for k in range(3)], axis=1) for x in ends]
    return np.linalg.norm(at[1] - at[0], axis=1) / SPEED_STEP_S, known


@dataclass(frozen=True)
class _Unknowns:
    arm: np.ndarray
    R_wf: np.ndarray
    p_wf: np.ndarray
    offset: float

    def moved(self, d: np.ndarray, levelled: bool) -> _Unknowns:
        turn = np.array([0.0, 0.0, d[3]]) if levelled else d[3:6]
        o = 4 if levelled else 6
        return _Unknowns(
            self.arm + d[:3], so3.exp(turn) @ self.R_wf, self.p_wf + d[o : o + 3], self.offset + float(d[-1])
        )


def _placed(motion: EstimatedMotion, fix: Fix, offset: float, known: KnownPlace) -> PlacedSensor | None:
    """Robust Gauss-Newton from `_linear` at a candidate offset [s]; None if fixes are too few, or the offset moves by
    more than OFFSET_SIGMA_S."""
    t = fix.t + offset
    ok = is_known(motion.state.seconds, t - OFFSET_SIGMA_S) & is_known(motion.state.seconds, t + OFFSET_SIGMA_S)
    if ok.sum() < MIN_PLACED_FIXES:
        return None
    t, p = fix.t[ok], fix.position[ok]
    x = _linear(imu_poses(motion, t + offset), p, known, offset)
    start, sigma = x if known.arm is not None else replace(x, arm=np.zeros(3)), _sigmas(known)
    r = np.zeros((0, 3))
    for _ in range(MAX_PLACING_ROUNDS):
        r, J = _rows(motion, t, p, x, known.levelled)
        size = np.linalg.norm(r, axis=1)
        kept = size <= MAX_FIX_MEDIANS * np.median(size) + 1e-9
        row = max(MIN_FIX_SIGMA_M, float(np.median(size)))
        A, b = J[kept].reshape(-1, J.shape[2]) / row, -r[kept].ravel() / row
        away = np.zeros(len(sigma))
        away[:3], away[-1] = x.arm - start.arm, x.offset - start.offset
        step = np.linalg.solve(A.T @ A + np.diag(sigma**-2), A.T @ b - away / sigma**2)
        x = x.moved(step, known.levelled)
        if abs(x.offset - offset) > OFFSET_SIGMA_S:
            return None
        if np.abs(step).max() < PLACING_STEP_TOLERANCE:
            break
    spread = float(np.median(np.linalg.norm(p - np.median(p, axis=0), axis=1)))
    misfit = float(np.median(np.linalg.norm(r, axis=1))) / max(spread, 1e-9)
    return PlacedSensor(x.arm, x.R_wf, x.p_wf, x.offset, misfit)


def _sigmas(known: KnownPlace) -> np.ndarray:
    """(8 or 10,) standard deviations of the prior on lever arm, rotation and origin of the frame, and time offset."""
    arm = ARM_SIGMA_M if known.arm is None else KNOWN_SIGMA_M
    free = FREE_FRAME_SIGMA_RAD, FREE_FRAME_SIGMA_M
    turn, origin = free if known.frame is None else (KNOWN_SIGMA_RAD, KNOWN_SIGMA_M)
    offset = OFFSET_SIGMA_S if known.offset is None else KNOWN_SIGMA_S
    return np.repeat([arm, turn, origin, offset], [3, known.turns, 3, 1])


def _linear(at: Poses, p: np.ndarray, known: KnownPlace, offset: float) -> _Unknowns:
    """Frame and lever arm by linear least squares on p_imu + R_imu p_imu_sensor = M p + origin, fixes p (n, 3). The
    rotation is the one closest to M."""
    if known.frame is not None:
        return _linear_arm(at, p, known.frame, known.arm, offset)
    n, arm, levelled = len(p), known.arm, known.levelled
    A, b = np.zeros((n, 3, 15)), -at.position.copy()
    A[:, :, 12:] = -np.eye(3)
    if arm is None:
        A[:, :, :3] = at.rotation
    else:
        b -= at.rotation @ arm
    if levelled:  # M = (c, -s, 0; s, c, 0; 0, 0, 1)
        A[:, 0, 3], A[:, 0, 4], A[:, 1, 3], A[:, 1, 4] = -p[:, 0], p[:, 1], -p[:, 1], -p[:, 0]
        b[:, 2] += p[:, 2]
    else:
        for k in range(3):
            A[:, k, 3 + 3 * k : 6 + 3 * k] = -p
    weak = np.zeros((3, 15))
    weak[:, :3] = MIN_FIX_SIGMA_M / ARM_SIGMA_M * np.eye(3)
    x = np.linalg.lstsq(np.vstack([A.reshape(-1, 15), weak]), np.append(b.ravel(), np.zeros(3)), rcond=None)[0]
    if levelled:
        R = so3.exp(np.array([0.0, 0.0, np.arctan2(x[4], x[3])]))
    else:
        R = so3.closest_rotation(x[3:12].reshape(3, 3))
    lever_arm = x[:3] if arm is None else arm
    return _Unknowns(lever_arm, R, np.median(at.position + at.rotation @ lever_arm - p @ R.T, axis=0), offset)


def _linear_arm(at: Poses, p: np.ndarray, frame: PositionFrame, arm: np.ndarray | None, offset: float) -> _Unknowns:
    """As `_linear` in a known frame: the lever arm is the median of R_imu^T (R_wf p + p_wf - p_imu)."""
    if arm is None:
        apart = p @ frame.rotation.T + frame.position - at.position
        arm = np.median(np.einsum("nji,nj->ni", at.rotation, apart), axis=0)
    return _Unknowns(arm, frame.rotation, frame.position, offset)


def _rows(
    motion: EstimatedMotion, t: np.ndarray, p: np.ndarray, x: _Unknowns, levelled: bool
) -> tuple[np.ndarray, np.ndarray]:
    """Residuals (n, 3) m in world axes, and derivatives (n, 3, 8 or 10) by lever arm, rotation (on the left) and origin
    of the frame, and time offset."""
    at, turned = imu_poses(motion, t + x.offset), p @ x.R_wf.T
    r = at.position + at.rotation @ x.arm - turned - x.p_wf
    J_turn = so3.hat_many(np.ascontiguousarray(turned))
    spin = at.rotation @ np.cross(at.rate, x.arm)[:, :, None]
    J = [at.rotation, J_turn[:, :, 2:] if levelled else J_turn, np.tile(-np.eye(3), (len(t), 1, 1))]
    return r, np.concatenate([*J, at.velocity[:, :, None] + spin], axis=2)


# Trajectory of the IMU from the fixes of a position sensor and the IMU's readings alone.
#
# Candidate time offsets come from `clock`. Kabsch on specific forces gives the attitude in the window with most
# horizontal motion. Gauss-Newton on second differences gives biases, lever arm and offset while the window grows.
# Further windows follow on both sides, with the lever arm of the first.

FIRST_HALF_WINDOW_S = 10.0  # a gyroscope bias of 0.5 deg/s turns 5 degrees in it, which Kabsch tolerates
MAX_HALF_WINDOW_S = 60.0  # of the largest window: biases are modelled as constant in it
# A misfit above the first leads to a second fit with east and north swapped. They were swapped if that misfit is less
# than the second number times the first misfit.
SUSPICIOUS_MISFIT, MIRRORED_RATIO = 0.15, 0.5
MAX_ACCELERATION_MISFIT = 0.3  # largest `WindowFit.misfit` beside noise: fixes of another motion have 0.4 or more
MAX_OFFSETS_TRIED = 4  # candidates, by correlation
# Standard deviations between neighbouring windows: gyroscope drift over a window, and changes of biases.
NEXT_ROTATION_SIGMA_RAD, NEXT_GYRO_BIAS_SIGMA_RAD_S, NEXT_ACCEL_BIAS_SIGMA_M_S2 = 0.1, 5e-3, 0.1
KNOWN_ARM_SIGMA_M, KNOWN_OFFSET_SIGMA_S = 1e-3, 0.01  # a clock that drifts by 20 ppm has 10 ms in 500 s
MAX_NOISE_SHARE = 0.5  # of the change of acceleration that the IMU shows: more noise hides the lever arm
MAX_EVEN_NOISE = 0.7  # noise over size of second differences: with more, the fixes show no motion
VELOCITY_STEP_S = 0.25  # of central differences: noise of 2 cm makes 6 cm/s


@dataclass(frozen=True)
class MotionWindow:
    """A span of time with constant biases. begin, end: on the IMU's clock [s]; at: its estimated unknowns."""

    begin: float
    end: float
    at: WindowUnknowns


@dataclass(frozen=True)
class PositionMotion:
    """Trajectory of the IMU in the frame of the fixes. windows: in order of time, without gaps; best: fit of the first
    window, whose lever arm and time offset hold for all; fix: the fixes."""

    imu: ImuData
    fix: Fix
    best: WindowFit
    windows: tuple[MotionWindow, ...]

    def at(self, keyframes: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
        """R_frame_imu (K, 3, 3), p_frame_imu (K, 3) m, velocity (K, 3) m/s and biases (K, 6) at `keyframes` (K,)
        s on the IMU's clock."""
        t = self.fix.t + self.best.at.offset
        R, bias = self._attitude(keyframes)
        at_fixes, _ = self._attitude(t)
        p = self.fix.position - at_fixes @ self.best.at.arm

        def position(s: np.ndarray) -> np.ndarray:
            return np.stack([np.interp(s, t, p[:, k]) for k in range(3)], axis=1)

        velocity = (position(keyframes + VELOCITY_STEP_S) - position(keyframes - VELOCITY_STEP_S)) / (
            2.0 * VELOCITY_STEP_S
        )
        return R, position(keyframes), velocity, bias

    def _attitude(self, t: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """R_frame_imu (n, 3, 3) and biases (n, 6) at t (n,) s, in order."""
        R, bias = np.empty((len(t), 3, 3)), np.empty((len(t), 6))
        edges = np.searchsorted(t, [w.begin for w in self.windows[1:]])
        for w, k in zip(self.windows, np.split(np.arange(len(t)), edges), strict=True):
            if len(k):
                span = min(float(t[k[0]]), w.at.reference), max(float(t[k[-1]]), w.at.reference)
                integrated = IntegratedReadings.of(self.imu, span, w.at.reference, w.at.gyro_bias, forces_only=True)
                R[k] = w.at.R_wg @ integrated.rotation_at(t[k])
                bias[k] = np.concatenate([w.at.gyro_bias, w.at.accel_bias])
        return R, bias


def motion_from_fixes(imu: ImuData, name: str, fix: Fix, gravity: float, known: KnownExtrinsics) -> PositionMotion:
    """Trajectory of the IMU in the frame of the fixes. known: extrinsics and time offset of the rig file.

    Raises EstimationError where fixes and readings contradict each other, are too few, or have no acceleration."""
    triples = fix.triples
    if len(triples.i) < MIN_WINDOW_TRIPLES:
        raise EstimationError(
            f"{name}: only {len(triples.i)} groups of three fixes about a second apart are usable, and "
            f"{MIN_WINDOW_TRIPLES} are needed; record for longer, or lower least_status in the rig file."
        )
    offsets = _offsets_with_imu(imu, fix, known)
    fits = [one for x in offsets if (one := _fit_at_offset(imu, fix, triples, x, gravity, known)) is not None]
    closest = closest_of_equals(((one[0].misfit, one[0].at.offset, one) for one in fits), fix.same_clock, 0.0)
    if closest is None:
        raise OtherMotionError(
            f"{name}: too few of its fixes fall within the recording of {imu.name}; check that both come from the same "
            "recording, or the time_offset in the rig file."
        )
    best, window = closest
    if best.misfit > SUSPICIOUS_MISFIT:
        other = replace(fix, position=fix.position[:, [1, 0, 2]])
        tried = [one for x in offsets if (one := _fit_at_offset(imu, other, triples, x, gravity, known)) is not None]
        mirrored = min((one[0].misfit for one in tried), default=np.inf) < MIRRORED_RATIO * best.misfit
        _check_misfit(imu, name, fix, best.misfit, mirrored)
    usable = recorded(imu, triples, fix.t + best.at.offset)
    return PositionMotion(imu, fix, best, _all_windows(imu, fix, usable, (best, window), gravity))


def _offsets_with_imu(imu: ImuData, fix: Fix, known: KnownExtrinsics) -> list[float]:
    """Time offsets to be tried [s]: the known one, or the highest correlations."""
    if known.offset is not None:
        return [known.offset]
    likely = [s.samples / SIGNAL_RATE_HZ for s in offsets_by_jerk(imu, fix) if s.correlation > MIN_JERK_CORRELATION]
    return [*likely[:MAX_OFFSETS_TRIED], fix.same_clock]


def _check_misfit(imu: ImuData, name: str, fix: Fix, misfit: float, mirrored: bool) -> None:
    """Raises EstimationError if fixes and readings contradict each other, or the acceleration is no more than noise.
    Third differences over a second, of the IMU, show how much it changes."""
    sentence = f"{name}: {imu.name} does not explain {misfit:.0%} of its acceleration at any time offset"
    if mirrored:
        raise EstimationError(
            f"{sentence}, but does where east and north are swapped; correct the order of latitude and longitude, or "
            "of x and y, by `columns: [...]` in the rig file."
        )
    share = fix.noise_share(fix.triples)
    if misfit <= np.hypot(MAX_ACCELERATION_MISFIT, min(share, MAX_TRIPLE_NOISE)):
        return
    felt, by_noise, rate = change_of_acceleration(imu), np.sqrt(20.0) * fix.noise, 1.0 / np.median(np.diff(fix.t))
    if by_noise > MAX_NOISE_SHARE * felt:
        raise EstimationError(
            f"{name}: its fixes are too noisy for {imu.name} alone: {fix.noise:.2g} m at {rate:.2g} Hz change the "
            f"acceleration by {by_noise:.2g} m/s^2 in a second, and the motion changes it by {felt:.2g}. Use fixes of "
            "less noise (RTK), move faster, or add wheels or an odometry, which show the motion."
        )
    if share > MAX_EVEN_NOISE:
        raise EstimationError(
            f"{name}: its fixes are motionless or move evenly, beside noise of {fix.noise:.2g} m; record again while "
            "speeding up, braking and turning."
        )
    raise OtherMotionError(f"{sentence}; check that both come from the same recording of one vehicle.")


def _fit_at_offset(
    imu: ImuData, fix: Fix, triples: Triples, offset: float, gravity: float, known: KnownExtrinsics
) -> tuple[WindowFit, tuple[float, float]] | None:
    """Fit of a window that grows about the one with most horizontal motion, and its begin and end on the sensor's clock
    [s]; None where there are too few triples."""
    usable = recorded(imu, triples, fix.t + offset)
    if len(usable.i) < MIN_WINDOW_TRIPLES:
        return None
    middle = fix.t[usable.j]
    moved = np.concatenate([[0.0], np.cumsum((usable.second(fix.position)[:, :2] ** 2).sum(axis=1))])
    inside = np.searchsorted(middle, middle + 2.0 * FIRST_HALF_WINDOW_S, side="right")
    begin = int(np.argmax(moved[inside] - moved[:-1]))
    centre = 0.5 * float(middle[begin] + middle[inside[begin] - 1])
    half, arm = FIRST_HALF_WINDOW_S, known.position
    within = _within(fix, usable, centre - half, centre + half)
    if len(within.i) < MIN_WINDOW_TRIPLES:
        within = usable
    no, sigma = np.zeros(3), sigmas()
    mean = WindowUnknowns(centre + offset, np.eye(3), no, no, no if arm is None else arm, offset)
    if arm is not None:
        sigma[9:12] = KNOWN_ARM_SIGMA_M
    if known.offset is not None:
        sigma[12] = KNOWN_OFFSET_SIGMA_S
    start = first_unknowns(imu, fix, within, mean, sigma, gravity)
    while True:
        fitted = fit_window(imu, fix, within, start, WindowPrior(replace(mean, R_wg=start.R_wg), sigma), gravity)
        window = centre - half, centre + half
        if half >= MAX_HALF_WINDOW_S or len(within.i) == len(usable.i):
            return fitted, window
        half, start = min(2.0 * half, MAX_HALF_WINDOW_S), fitted.at
        within = _within(fix, usable, centre - half, centre + half)


def _within(fix: Fix, triples: Triples, begin: float, end: float) -> Triples:
    middle = fix.t[triples.j]
    return triples.some((middle >= begin) & (middle <= end))


def _all_windows(
    imu: ImuData, fix: Fix, usable: Triples, best: tuple[WindowFit, tuple[float, float]], gravity: float
) -> tuple[MotionWindow, ...]:
    """The best window, and further ones on both sides up to the ends of the IMU's recording."""
    fitted, (begin, end) = best
    offset = fitted.at.offset
    windows = [MotionWindow(begin + offset, end + offset, fitted.at)]
    while windows[-1].end < imu.seconds[-1]:
        windows.append(_next(imu, fix, usable, windows[-1], MAX_HALF_WINDOW_S, gravity))
    while windows[0].begin > imu.seconds[0]:
        windows.insert(0, _next(imu, fix, usable, windows[0], -MAX_HALF_WINDOW_S, gravity))
    return tuple(windows)


def _next(imu: ImuData, fix: Fix, usable: Triples, last: MotionWindow, length: float, gravity: float) -> MotionWindow:
    """The window after `last`, or before it where the length [s] is negative. With too few fixes its attitude is
    propagated by the gyroscope."""
    begin, end = (last.end, last.end + length) if length > 0.0 else (last.begin + length, last.begin)
    reference = float(np.clip(0.5 * (begin + end), imu.seconds[0], imu.seconds[-1]))
    span = min(reference, last.at.reference), max(reference, last.at.reference)
    integrated = IntegratedReadings.of(imu, span, last.at.reference, last.at.gyro_bias, forces_only=True)
    R = last.at.R_wg @ integrated.rotation_at(np.array([reference]))[0]
    start = replace(last.at, reference=reference, R_wg=R)
    within = _within(fix, usable, begin - start.offset, end - start.offset)
    if len(within.i) < MIN_WINDOW_TRIPLES:
        return MotionWindow(begin, end, start)
    sigma = sigmas(KNOWN_ARM_SIGMA_M, KNOWN_OFFSET_SIGMA_S)
    sigma[:9] = np.repeat([NEXT_ROTATION_SIGMA_RAD, NEXT_GYRO_BIAS_SIGMA_RAD_S, NEXT_ACCEL_BIAS_SIGMA_M_S2], 3)
    fit = fit_window(imu, fix, within, start, WindowPrior(start, sigma), gravity)
    return MotionWindow(begin, end, fit.at if fit.misfit < 1.0 else start)
