"""Trajectory of the IMU from the fixes of a position sensor and the IMU's readings alone.

Candidate time offsets come from `clock`. Kabsch on specific forces gives the attitude in the window with most
horizontal motion. Gauss-Newton on second differences gives biases, lever arm and offset while the window grows. Further
windows follow on both sides, with the lever arm of the first.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from icalib.errors import EstimationError
from icalib.initialize.steps.initializer import OtherMotionError
from icalib.initialize.steps.lever_arm import Triples
from icalib.initialize.steps.rate_correlation import closest_of_equals
from icalib.initialize.steps.single_recording import KnownExtrinsics
from icalib.motion.imu_data import ImuData
from icalib.sensors.position.initialize.attitude import (
    MAX_TRIPLE_NOISE,
    MIN_JERK_CORRELATION,
    MIN_WINDOW_TRIPLES,
    SIGNAL_RATE_HZ,
    Fix,
    IntegratedReadings,
    WindowFit,
    WindowPrior,
    WindowUnknowns,
    change_of_acceleration,
    first_unknowns,
    fit_window,
    likely_offsets,
    recorded,
    sigmas,
)

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
    offsets = _candidate_offsets(imu, fix, known)
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


def _candidate_offsets(imu: ImuData, fix: Fix, known: KnownExtrinsics) -> list[float]:
    """Time offsets to be tried [s]: the known one, or the highest correlations."""
    if known.offset is not None:
        return [known.offset]
    likely = [s.samples / SIGNAL_RATE_HZ for s in likely_offsets(imu, fix) if s.correlation > MIN_JERK_CORRELATION]
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
