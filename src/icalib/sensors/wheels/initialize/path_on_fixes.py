"""Dead reckoning that follows positions of a point of the vehicle, such as GNSS fixes, on a flat floor.

The fixes take out the drift of the wheels and determine their sizes. In the plane, as complex numbers, dead reckoning
gives the position P and yaw T at time t, with a factor r on distances, a factor k on turns, and a bend c [rad/m] of the
path: T = k T_0 + c r s at the distance s. A point with lever arm l is at

    q(t) = r P(t; k, c) + l exp(i T(t)),    fix j: exp(i psi_w) q(t_j + d) + o_w

psi_w and o_w belong to a window w of the path, and follow the drift. Gauss-Newton finds ln r, ln k, c, l and d, common
to all windows; psi_w and o_w are the best ones for each value of these (variable projection).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import NamedTuple

import numpy as np

from icalib.data.measurements import PositionStream, WheelPoses, WheelStream
from icalib.errors import EstimationError
from icalib.geometry import so3
from icalib.initialize.initializer import Values, merged_values
from icalib.initialize.rate_correlation import MaskedSignal, best_shifts, closest_of_equals
from icalib.initialize.smooth_trajectory import BodyPoses
from icalib.rig import Wheels
from icalib.sensors.parameter import fixed
from icalib.sensors.wheels.residual import integrals_of

SIGNAL_HZ = 20.0  # of correlated signals: Gauss-Newton refines the time offset
STEP_S = 1.0  # over which mean speeds and turns are taken: noise of 2 cm makes 3 cm/s
MIN_OVERLAP_S, PEAK_SPACING_S, MAX_PEAKS = 5.0, 0.3, 4  # of a correlation; candidates by each
MIN_SPEED_RATIO = 0.3  # of the median speed: slower fixes show no course
WINDOW_S, MIN_WINDOW_FIXES = 10.0, 8  # mean time of a window, and mean number of its fixes
MAX_ROUNDS, STEP_TOLERANCE = 15, 1e-5  # of Gauss-Newton
N_BENDING = 3  # the first of the unknowns, which change the path by dead reckoning
MAX_MEDIANS = 4.0  # times the median residual; a fix with a larger one has no weight
DIFFERENCE = 1e-4  # half a step of central differences, of each unknown
MAX_MISFIT = 0.15  # median residual over median distance from the centre of a window: another motion leaves more
MIN_SIGMA_M = 0.01  # of a residual
PRIOR_SIGMA = np.array([0.3, 0.3, 0.1, 2.0, 2.0, 0.3])  # of the unknowns about their start: 1, 1, rad/m, m, m, s


class Fixes(NamedTuple):
    """t (n,) s since the first stamp of the sensor, `origin_ns`; z (n,) complex: x + i y of its positions [m]."""

    t: np.ndarray
    z: np.ndarray
    origin_ns: int = 0


def fixes_of(stream: PositionStream) -> Fixes:
    return Fixes(stream.seconds, stream.position[:, 0] + 1j * stream.position[:, 1], stream.origin_ns)


class PathOnFixes(NamedTuple):
    """Poses of the wheel frame in the frame of the fixes, in the plane z = 0, and factors of distances and turns."""

    poses: BodyPoses
    distance_factor: float
    turn_factor: float


class _DriftFit(NamedTuple):
    """Result of `_fitted`. misfit: median residual [m]; spread: median distance of fixes from the mean of their window
    [m]; unknowns (6,): ln r, ln k, c [rad/m], l [m], d [s]; fixes: those
    within the recording of the wheels; window (n,) int: the window of each."""

    misfit: float
    spread: float
    unknowns: np.ndarray
    fixes: Fixes
    window: np.ndarray


def paths_on_fixes(
    wheels: Wheels, streams: Sequence[WheelStream | WheelPoses], fixes: Sequence[Fixes]
) -> tuple[list[BodyPoses], Values]:
    """Poses of the wheel frame in each recording, and values of the drive parameters. Values of the rig file are kept,
    except guesses that contradict the recording with most fixes. Raises EstimationError as `path_on_fixes`."""
    sized = with_sizes(wheels)
    paths = [
        path_on_fixes(wheels.name, planar_steps(sized, stream), f, (f.origin_ns - stream.origin_ns) * 1e-9)
        for stream, f in zip(streams, fixes, strict=True)
    ]
    _, r, k = paths[int(np.argmax([len(f.t) for f in fixes]))]
    factors = _size_factors(wheels, r, k)
    stated, estimated = {}, {}
    for spec in wheels.drive_specs:
        key, value = (wheels.name, spec.name), getattr(wheels, spec.name).value
        stated |= {} if value is None else {key: np.asarray(value, dtype=np.float64)}
        estimated[key] = getattr(sized, spec.name).value * factors.get(spec.name, 1.0)
    return [path.poses for path in paths], merged_values(wheels, stated, estimated)


def _size_factors(wheels: Wheels, r: float, k: float) -> dict[str, np.ndarray]:
    """Factors on the sizes of the wheels by name, for factors r on distances and k on turns. Distances are as the size
    of a wheel, turns as this size over the length between wheels. Scales of speed and yaw rate are the factors."""
    sizes = [spec.name for spec in wheels.drive_specs if spec.is_positive]
    return {sizes[0]: np.array([r, k])} if len(sizes) == 1 else dict(zip(sizes, np.array([r, r / k]), strict=True))


def path_on_fixes(name: str, steps: PlanarSteps, fixes: Fixes, same_clock: float = 0.0) -> PathOnFixes:
    """The path of the wheels `name` that follows the fixes. same_clock: the time offset [s] of stamps by one clock,
    which decides between offsets that fit equally well. Raises EstimationError if their motion does not match at any
    time offset."""
    starts = _starts(steps, fixes, same_clock)
    fits = [fit for start in starts if (fit := _fitted(steps, fixes, start)) is not None]
    best = closest_of_equals(((fit.misfit, fit.unknowns[5], fit) for fit in fits), same_clock, MIN_SIGMA_M)
    if best is None or best.misfit > MAX_MISFIT * best.spread:
        raise EstimationError(
            f"{name}: its speeds and turns do not match those of the positions at any time offset; check that both are "
            "from the same vehicle and overlap in time, and drive curves."
        )
    return PathOnFixes(_followed(steps, best), *np.exp(best.unknowns[:2]).tolist())


def _starts(steps: PlanarSteps, fixes: Fixes, same_clock: float) -> list[np.ndarray]:
    """Start values (6,) of the unknowns at peaks of the correlation of speeds and of turns, and at `same_clock`."""
    grid = np.arange(0.0, steps.seconds[-1] - 2.0 * STEP_S, 1.0 / SIGNAL_HZ)
    ahead = _changes(grid, steps.seconds, steps.distance)
    turn = _changes(grid + 0.5 * STEP_S, steps.seconds, steps.yaw)
    (speed, seen), (course, moving) = _fix_signals(fixes)
    known, apart = np.ones(len(grid), dtype=bool), round(PEAK_SPACING_S * SIGNAL_HZ)
    shifts = {
        peak.samples
        for a, b in ((ahead, (speed, seen)), (turn, (course, moving)))
        if len(grid) and b[1].any()
        for peak in best_shifts((a, known), b, MIN_OVERLAP_S * SIGNAL_HZ, MAX_PEAKS, apart)
    }
    same, starts = round(same_clock * SIGNAL_HZ), []
    if -len(speed) < same < len(grid):
        shifts.add(same)
    for shift in sorted(shifts):
        j = np.arange(max(0, -shift), min(len(speed), len(grid) - shift))
        r, k = _slope(ahead[j + shift], speed[j], seen[j]), _slope(turn[j + shift], course[j], moving[j])
        if r > 0.0 and k > 0.0:
            factors = np.log([r, k]) if steps.scaled else np.zeros(2)
            starts.append(np.array([*factors, 0.0, 0.0, 0.0, shift / SIGNAL_HZ]))
    return starts


def _changes(grid: np.ndarray, t: np.ndarray, x: np.ndarray) -> np.ndarray:
    """Changes of x (n,), given at t (n,) s, over STEP_S from each instant of `grid`."""
    return np.interp(grid + STEP_S, t, x) - np.interp(grid, t, x)


def _fix_signals(fixes: Fixes) -> tuple[MaskedSignal, MaskedSignal]:
    """Distances over STEP_S [m], known between fixes close in time; and changes of course from each such step to the
    next [rad], known while the vehicle moves."""
    grid = np.arange(0.0, fixes.t[-1] - 2.0 * STEP_S, 1.0 / SIGNAL_HZ)
    step, after = _changes(grid, fixes.t, fixes.z), _changes(grid + STEP_S, fixes.t, fixes.z)
    gap = np.interp(grid + STEP_S, fixes.t[1:], np.diff(fixes.t))
    seen = gap <= max(2.5 * float(np.median(np.diff(fixes.t))), STEP_S)
    speed = np.abs(step)
    slow = MIN_SPEED_RATIO * np.median(speed[seen]) if seen.any() else np.inf
    moving = seen & (np.minimum(speed, np.abs(after)) > slow)
    return (speed, seen), (np.angle(after * np.conj(step)), moving)


def _slope(x: np.ndarray, y: np.ndarray, used: np.ndarray) -> float:
    """Slope of y (n,) over x (n,) through zero."""
    return float(x[used] @ y[used] / max(x[used] @ x[used], 1e-12))


def _fitted(steps: PlanarSteps, fixes: Fixes, start: np.ndarray) -> _DriftFit | None:
    """Robust Gauss-Newton from `start` (6,); None if too few fixes fall within the recording of the wheels."""
    t = fixes.t + start[5]
    inside = (t > steps.seconds[0]) & (t < steps.seconds[-1])
    if inside.sum() < 2 * MIN_WINDOW_FIXES:
        return None
    fixes, x = fixes._replace(t=fixes.t[inside], z=fixes.z[inside]), start
    window = _windows(steps, fixes, start[5])
    sigma = PRIOR_SIGMA * ([1.0] * 6 if steps.scaled else [1e-6, 1e-6, 1e-6, 1.0, 1.0, 1.0])
    size = np.zeros(0)
    for _ in range(MAX_ROUNDS):
        bent = _bent(steps, x)
        r = _residual(steps, bent, fixes, window, x)[0]
        size = np.abs(r)
        kept, row = size <= MAX_MEDIANS * np.median(size), max(MIN_SIGMA_M, float(np.median(size)))
        ends = [
            [_residual(steps, _bent(steps, x + d) if k < N_BENDING else bent, fixes, window, x + d)[0] for d in (h, -h)]
            for k, h in enumerate(DIFFERENCE * np.eye(6))
        ]
        J = np.stack([(a - b)[kept] / (2.0 * DIFFERENCE) for a, b in ends], axis=1)
        A, b = np.vstack([np.real(J), np.imag(J)]) / row, np.append(np.real(r[kept]), np.imag(r[kept])) / row
        step = -np.linalg.solve(A.T @ A + np.diag(sigma**-2), A.T @ b + (x - start) / sigma**2)
        x = x + step
        if np.abs(step).max() < STEP_TOLERANCE:
            break
    away = fixes.z - (_sums(window, fixes.z) / np.bincount(window))[window]
    return _DriftFit(float(np.median(size)), float(np.median(np.abs(away))), x, fixes, window)


def _windows(steps: PlanarSteps, fixes: Fixes, offset: float) -> np.ndarray:
    """(n,) int: the window of each fix. All windows cover the same distance, so that each contains motion."""
    path = np.interp(fixes.t + offset, steps.seconds, steps.distance)
    share = (path - path[0]) / max(path[-1] - path[0], 1e-9)
    count = max(1, int(min((fixes.t[-1] - fixes.t[0]) / WINDOW_S, len(path) / MIN_WINDOW_FIXES)))
    return np.unique(np.minimum((share * count).astype(int), count - 1), return_inverse=True)[1]


def _residual(
    steps: PlanarSteps, bent: tuple[np.ndarray, np.ndarray], fixes: Fixes, window: np.ndarray, x: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Residuals (n,) m, complex, at the unknowns x (6,), where the path is `bent`; psi (w,) rad and o (w,) m, complex,
    of the windows."""
    (yaw, position), t = bent, fixes.t + x[5]
    q = np.interp(t, steps.seconds, position) + (x[3] + 1j * x[4]) * np.exp(1j * np.interp(t, steps.seconds, yaw))
    q_mean, z_mean = (_sums(window, values) / np.bincount(window) for values in (q, fixes.z))
    dq, dz = q - q_mean[window], fixes.z - z_mean[window]
    psi = np.angle(_sums(window, np.conj(dq) * dz))
    return np.exp(1j * psi)[window] * dq - dz, psi, z_mean - np.exp(1j * psi) * q_mean


def _bent(steps: PlanarSteps, x: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Yaw and position by dead reckoning at the unknowns x (6,), see `PlanarSteps.path`."""
    return steps.path(float(np.exp(x[0])), float(np.exp(x[1])), float(x[2]))


def _sums(window: np.ndarray, values: np.ndarray) -> np.ndarray:
    """Sums (w,) of complex values (n,) over the windows."""
    return np.bincount(window, np.real(values)) + 1j * np.bincount(window, np.imag(values))


def _followed(steps: PlanarSteps, fit: _DriftFit) -> BodyPoses:
    """The path with psi and o of the windows. Between the centres of two windows both give a position; weights change
    linearly with the distance from one to the other."""
    yaw, position = bent = _bent(steps, fit.unknowns)
    _, psi, o = _residual(steps, bent, fit.fixes, fit.window, fit.unknowns)
    path = np.interp(fit.fixes.t + fit.unknowns[5], steps.seconds, steps.distance)
    centre = np.bincount(fit.window, path) / np.bincount(fit.window)
    share = np.interp(steps.distance, centre, np.arange(len(centre)))
    before = np.minimum(share.astype(int), max(len(centre) - 2, 0))
    after, share = np.minimum(before + 1, len(centre) - 1), share - before
    psi = np.unwrap(psi)
    first, second = (np.exp(1j * psi[w]) * position + o[w] for w in (before, after))
    turned = yaw + (1.0 - share) * psi[before] + share * psi[after]
    return planar_poses(steps.seconds, turned, (1.0 - share) * first + share * second)


# Trajectory of a rig without an IMU: dead reckoning by wheels on a flat floor.


@dataclass(frozen=True)
class PlanarSteps:
    """Steps between n + 1 stamps, seconds (n + 1,). turn (n,) rad; along (n,) complex: displacement [m] in the wheel
    frame at the earlier stamp, x + i y. scaled: whether sizes of the wheels scale them."""

    seconds: np.ndarray
    turn: np.ndarray
    along: np.ndarray
    scaled: bool

    @cached_property
    def yaw(self) -> np.ndarray:
        """(n + 1,) rad, relative to the first stamp."""
        return np.append(0.0, np.cumsum(self.turn))

    @cached_property
    def distance(self) -> np.ndarray:
        """(n + 1,) m: length of the path since the first stamp."""
        return np.append(0.0, np.cumsum(np.abs(self.along)))

    @cached_property
    def advance(self) -> np.ndarray:
        """(n + 1,) m: as `distance`, but decreasing while the vehicle drives backwards."""
        return np.append(0.0, np.cumsum(np.copysign(np.abs(self.along), np.real(self.along))))

    def path(
        self, distance_factor: float = 1.0, turn_factor: float = 1.0, bend: float = 0.0
    ) -> tuple[np.ndarray, np.ndarray]:
        """Yaw (n + 1,) rad and position (n + 1,) m, complex, relative to the first stamp, by dead reckoning. bend: yaw
        per distance [rad/m] that the readings lack, as for steering with an offset or unequal radii."""
        yaw = turn_factor * self.yaw + bend * distance_factor * self.advance
        chords = self.along * np.exp(1j * (yaw[:-1] + 0.5 * (np.diff(yaw) - self.turn)))
        return yaw, distance_factor * np.append(0.0, np.cumsum(chords))


def wheel_path(wheels: Wheels, stream: WheelStream | WheelPoses) -> BodyPoses:
    """Poses of the wheel frame at the stamps, relative to the first pose, in the plane z = 0.

    Raises EstimationError if the rig file does not state the sizes of the wheels.
    """
    return planar_poses(stream.seconds, *planar_steps(wheels, stream).path())


def planar_poses(seconds: np.ndarray, yaw: np.ndarray, position: np.ndarray) -> BodyPoses:
    """Poses in the plane z = 0 at seconds (n,): yaw (n,) rad, position (n,) m, complex."""
    points = np.stack([np.real(position), np.imag(position), np.zeros(len(position))], axis=1)
    return BodyPoses(seconds, so3.exp_many(yaw[:, None] * [0.0, 0.0, 1.0]), points)


def with_sizes(wheels: Wheels) -> Wheels:
    """The wheels with 1 m, or 1, for each size that the rig file does not state, and no steering offset."""
    unknown = [spec for spec in wheels.drive_specs if getattr(wheels, spec.name).value is None]
    return replace(wheels, **{spec.name: fixed(np.full(spec.size, float(spec.is_positive))) for spec in unknown})


def planar_steps(wheels: Wheels, stream: WheelStream | WheelPoses) -> PlanarSteps:
    """The steps between the stamps. Raises EstimationError if the rig file does not state the sizes of the wheels."""
    if isinstance(stream, WheelPoses):
        return PlanarSteps(stream.seconds, stream.pose[:, 0], stream.pose[:, 1] + 1j * stream.pose[:, 2], False)
    turned = np.diff(integrals_of(stream), axis=0)
    if stream.kind == "pair":
        path = turned * _size(wheels, "radii")
        ahead, yaw = path.mean(axis=1), (path[:, 1] - path[:, 0]) / _size(wheels, "baseline")[0]
    elif stream.kind == "twist":
        scales = np.ones(2) if wheels.scales.value is None else wheels.scales.value
        ahead, yaw = (turned * scales).T
    else:
        offset = 0.0 if wheels.steering_offset.value is None else float(wheels.steering_offset.value[0])
        ahead = turned[:, 0] * _size(wheels, "radius")[0]
        steer = np.arctan2(turned[:, 2], turned[:, 1]) + offset
        yaw = ahead * np.tan(steer) / _size(wheels, "wheelbase")[0]
    half = 0.5 * yaw  # the displacement is the chord of an arc
    return PlanarSteps(stream.seconds, yaw, ahead * np.sinc(half / np.pi) * np.exp(1j * half), True)


def _size(wheels: Wheels, name: str) -> np.ndarray:
    """The stated value of the parameter `name`. Raises EstimationError if the rig file has none."""
    value = getattr(wheels, name).value
    if value is None:
        raise EstimationError(
            f"without IMU, target and pose sensor only {wheels.name} determines the scale; give its "
            f"{' and '.join(spec.name for spec in wheels.drive_specs)} in the rig file, or add one of these sensors."
        )
    return np.asarray(value, dtype=np.float64)
