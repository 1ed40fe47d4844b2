"""The motion of the IMU from the fixes of a position sensor and the IMU's readings, and nothing else.

The time offset comes from `clock`. In the window with most horizontal motion specific forces give the attitude, by
Kabsch. Gauss-Newton over second differences gives the biases, the lever arm and the offset, while the window grows.
Further windows follow on both sides, the lever arm as it was found.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from icalib.errors import EstimationError
from icalib.initialize.steps.lever_arm import Triples
from icalib.initialize.steps.single_recording import KnownExtrinsics
from icalib.motion.imu_data import ImuData
from icalib.sensors.position.initialize.attitude import FEWEST, Fitted, Fix, Unknowns, first_attitude, fit, sigmas
from icalib.sensors.position.initialize.clock import GRID_HZ, LEAST_CORRELATION, likely_offsets
from icalib.sensors.position.initialize.triples import Carried, recorded, triples_of

HALF_S = 10.0  # half of the first window: a gyroscope's bias turns by some degrees in it, Kabsch bears that
MOST_HALF_S = 60.0  # and of the last: biases are taken as constant in it
DOUBTFUL_LEFT, MIRRORED = 0.15, 0.5  # from there on east and north are swapped, and seen if that leaves half as much
LARGEST_LEFT = 0.3  # of second differences: another motion leaves 0.4 or more
TRIED = 4  # offsets
# Between windows that follow one another: what the gyroscope's drift may add, and how much biases change.
NEXT_ROTATION, NEXT_GYRO_BIAS, NEXT_ACCEL_BIAS = 0.1, 5e-3, 0.1  # rad, rad/s, m/s^2
KNOWN_ARM, KNOWN_OFFSET = 1e-3, 0.01  # m, s: a clock may drift by 20 ppm
MOTIONLESS = 0.02  # m/s^2, RMS of accelerations over a second: accelerometers drift by as much
MORE_THAN_NOISE = 1.5  # times what noise makes of accelerations: less shows nothing
VELOCITY_STEP_S = 0.25  # to both sides: fixes are noisy


@dataclass(frozen=True)
class MotionWindow:
    """begin, end: of the fixes in it, on the IMU's clock [s]."""

    begin: float
    end: float
    at: Unknowns


@dataclass(frozen=True)
class PositionMotion:
    """windows in order, without a gap; best: what the largest of them showed; fix: the fixes."""

    imu: ImuData
    fix: Fix
    best: Fitted
    windows: tuple[MotionWindow, ...]

    def at(self, keyframes: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
        """R_frame_imu (K, 3, 3), p_frame_imu, velocity (K, 3), biases (K, 6) at `keyframes` (K,) s on the IMU's
        clock."""
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
                carried = Carried.of(self.imu, span, w.at.reference, w.at.gyro_bias, alone=True)
                R[k] = w.at.R_wg @ carried.rotation_at(t[k])
                bias[k] = np.concatenate([w.at.gyro_bias, w.at.accel_bias])
        return R, bias


def motion_from_fixes(imu: ImuData, name: str, fix: Fix, gravity: float, known: KnownExtrinsics) -> PositionMotion:
    """Raises EstimationError, one sentence, where fixes and readings do not belong together or do not move."""
    triples = triples_of(fix.t)
    if len(triples.i) < FEWEST:
        raise EstimationError(
            f"{name}: only {len(triples.i)} groups of three fixes about a second apart are usable, and {FEWEST} are "
            "needed; record for longer, or lower least_status in the rig file."
        )
    offsets, rms = _offsets(imu, fix, known), _moves_evenly(fix, triples)
    if not offsets:
        raise _motionless(name, rms) if rms is not None else _unlike(imu, name, 1.0, False)
    found = [one for x in offsets if (one := _tried(imu, fix, triples, x, gravity, known)) is not None]
    if not found:
        raise EstimationError(
            f"{name}: too few of its fixes fall within the recording of {imu.name}; check that both come from the same "
            "recording, or the time_offset in the rig file."
        )
    best, window = min(found, key=lambda one: one[0].left)
    if best.left > LARGEST_LEFT and rms is not None:
        raise _motionless(name, rms)
    if best.left > DOUBTFUL_LEFT:
        other = replace(fix, position=fix.position[:, [1, 0, 2]])
        tried = [one for x in offsets if (one := _tried(imu, other, triples, x, gravity, known)) is not None]
        mirrored = min((one[0].left for one in tried), default=np.inf) < MIRRORED * best.left
        if mirrored or best.left > LARGEST_LEFT:
            raise _unlike(imu, name, best.left, mirrored)
    usable = recorded(imu, triples, fix.t + best.at.offset)
    return PositionMotion(imu, fix, best, _all_windows(imu, fix, usable, (best, window), gravity))


def _unlike(imu: ImuData, name: str, left: float, mirrored: bool) -> EstimationError:
    told = f"{name}: {imu.name} does not explain {left:.0%} of its acceleration at any time offset"
    if mirrored:
        return EstimationError(
            f"{told}, but does where east and north are swapped; correct the order of latitude and longitude, or of x "
            "and y, by `columns: [...]` in the rig file."
        )
    return EstimationError(
        f"{told}; check that both are on the same vehicle, and units and axes of {imu.name} (accel_unit, gyro_unit)."
    )


def _motionless(name: str, rms: float) -> EstimationError:
    return EstimationError(
        f"{name}: its fixes are motionless or move evenly (accelerations of {rms:.2g} m/s^2, no more than noise); "
        "record again while speeding up, braking and turning."
    )


def _offsets(imu: ImuData, fix: Fix, known: KnownExtrinsics) -> list[float]:
    """Those to be tried, likely ones first."""
    if known.offset is not None:
        return [known.offset]
    found = likely_offsets(imu, fix)
    return [s.samples / GRID_HZ for s in found if s.correlation > LEAST_CORRELATION][:TRIED]


def _moves_evenly(fix: Fix, triples: Triples) -> float | None:
    """The RMS of accelerations [m/s^2], where these are no more than noise that fourth differences of the fixes, of
    which motion has little, show; else None."""
    acceleration = triples.second(fix.position) / triples.half[:, None]
    fourth = np.diff(fix.position, n=4, axis=0)
    rms, noise = (float(np.sqrt(np.median((x**2).sum(axis=1)))) for x in (acceleration, fourth))
    by_noise = noise / np.sqrt(70.0) * np.sqrt(6.0) / float(np.median(triples.half)) ** 2  # sums of squared binomials
    return rms if rms < MORE_THAN_NOISE * by_noise or rms < MOTIONLESS else None


def _tried(
    imu: ImuData, fix: Fix, triples: Triples, offset: float, gravity: float, known: KnownExtrinsics
) -> tuple[Fitted, tuple[float, float]] | None:
    """What the largest window about the one with most motion shows, and the window on the sensor's clock; None where
    there are too few triples."""
    usable = recorded(imu, triples, fix.t + offset)
    if len(usable.i) < FEWEST:
        return None
    middle = fix.t[usable.j]
    moved = np.concatenate([[0.0], np.cumsum((usable.second(fix.position)[:, :2] ** 2).sum(axis=1))])
    inside = np.searchsorted(middle, middle + 2.0 * HALF_S, side="right")
    begin = int(np.argmax(moved[inside] - moved[:-1]))
    centre = 0.5 * float(middle[begin] + middle[inside[begin] - 1])
    half, arm = HALF_S, known.position
    own = _within(fix, usable, centre - half, centre + half)
    if len(own.i) < FEWEST:
        own = usable
    R = first_attitude(imu, fix, own, centre + offset, offset, gravity)
    start = prior = Unknowns(centre + offset, R, np.zeros(3), np.zeros(3), np.zeros(3) if arm is None else arm, offset)
    sigma = sigmas()
    if arm is not None:
        sigma[9:12] = KNOWN_ARM
    if known.offset is not None:
        sigma[12] = KNOWN_OFFSET
    while True:
        fitted = fit(imu, fix, own, start, replace(prior, R_wg=start.R_wg), sigma, gravity)
        window = centre - half, centre + half
        if half >= MOST_HALF_S or len(own.i) == len(usable.i):
            return fitted, window
        half, start = min(2.0 * half, MOST_HALF_S), fitted.at
        own = _within(fix, usable, centre - half, centre + half)


def _within(fix: Fix, triples: Triples, begin: float, end: float) -> Triples:
    middle = fix.t[triples.j]
    return triples.some((middle >= begin) & (middle <= end))


def _all_windows(
    imu: ImuData, fix: Fix, usable: Triples, best: tuple[Fitted, tuple[float, float]], gravity: float
) -> tuple[MotionWindow, ...]:
    """The best window, and those on both sides up to the ends of the IMU's recording."""
    fitted, (begin, end) = best
    offset = fitted.at.offset
    windows = [MotionWindow(begin + offset, end + offset, fitted.at)]
    while windows[-1].end < imu.seconds[-1]:
        windows.append(_next(imu, fix, usable, windows[-1], MOST_HALF_S, gravity))
    while windows[0].begin > imu.seconds[0]:
        windows.insert(0, _next(imu, fix, usable, windows[0], -MOST_HALF_S, gravity))
    return tuple(windows)


def _next(imu: ImuData, fix: Fix, usable: Triples, last: MotionWindow, length: float, gravity: float) -> MotionWindow:
    """The window after `last`, or before it where the length [s] is negative; as the gyroscope carries the attitude
    where there are too few fixes."""
    begin, end = (last.end, last.end + length) if length > 0.0 else (last.begin + length, last.begin)
    reference = float(np.clip(0.5 * (begin + end), imu.seconds[0], imu.seconds[-1]))
    span = min(reference, last.at.reference), max(reference, last.at.reference)
    carried = Carried.of(imu, span, last.at.reference, last.at.gyro_bias, alone=True)
    R = last.at.R_wg @ carried.rotation_at(np.array([reference]))[0]
    start = replace(last.at, reference=reference, R_wg=R)
    own = _within(fix, usable, begin - start.offset, end - start.offset)
    if len(own.i) < FEWEST:
        return MotionWindow(begin, end, start)
    sigma = sigmas(KNOWN_ARM, KNOWN_OFFSET)
    sigma[:9] = np.repeat([NEXT_ROTATION, NEXT_GYRO_BIAS, NEXT_ACCEL_BIAS], 3)
    found = fit(imu, fix, own, start, start, sigma, gravity)
    return MotionWindow(begin, end, found.at if found.left < 1.0 else start)
