"""Time offset and rotation between a camera and the IMU, from angular rates alone."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from icalib.errors import EstimationError
from icalib.estimation.imu_data import ImuData
from icalib.first_guess.correlation import best_shift
from icalib.first_guess.target_poses import TargetPoses
from icalib.geometry import so3
from icalib.measurements import CornerStream

GRID_HZ = 100.0
LONGEST_STEP_S = 0.25  # images further apart do not give an angular rate
SHORTEST_OVERLAP_S = 4.0
LEAST_CORRELATION = 0.7
LARGEST_UNEXPLAINED = 0.6  # of the angular rate, at an offset that was given
CLOCKS_AGREE_S = 0.01  # of the time offsets that two recordings show
CLEARLY_BETTER = 0.5  # of what another offset leaves unexplained
STILL_RAD_S = 0.03
_SAME_RECORDING = "check that both come from the same recording, overlap in time, and are in rad/s"
LEAST_SECOND_AXIS = 0.05  # of the spread of rates about the first
ROUNDS = 12
DEGREES = 180.0 / np.pi


@dataclass(frozen=True)
class CameraRates:
    """Mean angular rates between neighbouring images: start, end (n,) camera clock [s]; rate (n, 3) camera axes
    [rad/s]; least_correlation: with the IMU's, below which the two do not match."""

    start: np.ndarray
    end: np.ndarray
    rate: np.ndarray
    least_correlation: float = LEAST_CORRELATION


@dataclass(frozen=True)
class Alignment:
    """offset: t_imu - t_camera, both since their clock's first stamp [s]; R_imu_cam; gyro_bias (3,) rad/s."""

    offset: float
    rotation: np.ndarray
    gyro_bias: np.ndarray
    given: bool = False  # offset and rotation are the rig file's, and as good as these


def camera_rates(stream: CornerStream, poses: TargetPoses) -> CameraRates:
    """Angular rates from consecutive good poses. Raises EstimationError where there are hardly any."""
    t = stream.seconds
    index = np.flatnonzero(poses.ok)
    if len(index) < 2:
        raise EstimationError(
            f"{stream.name}: the target was located in {len(index)} of {len(t)} images; check the target, the "
            f"camera model "
            "and the intrinsics in the rig file."
        )
    a, b = index[:-1], index[1:]
    near = t[b] - t[a] <= LONGEST_STEP_S
    a, b = a[near], b[near]
    if len(a) < 20:
        raise EstimationError(
            f"{stream.name}: too few neighbouring images show the target; record for at least ten seconds."
        )
    turn = so3.log_many(np.ascontiguousarray(poses.rotation[a].transpose(0, 2, 1) @ poses.rotation[b]))
    return CameraRates(t[a], t[b], turn / (t[b] - t[a])[:, None])


def align(imu: ImuData, name: str, rates: CameraRates, given_offset: float | None) -> Alignment:
    """Offset, rotation and gyro bias. Raises EstimationError where the rates do not match at any shift."""
    _check_motion(imu, name, rates)
    offset = _correlate(imu, name, rates) if given_offset is None else given_offset
    if not _covered(imu, rates, offset).any():
        raise _no_overlap(imu, name)
    found = _refine(imu, rates, offset, given_offset is not None)
    _check_scale(imu, name, rates, found)
    _check_offset(imu, name, rates, found, given_offset is not None)
    return found


def _covered(imu: ImuData, rates: CameraRates, offset: float) -> np.ndarray:
    """(n,) bool: image intervals within the IMU's recording and none of its gaps."""
    start, end = rates.start + offset, rates.end + offset
    inside = (start >= imu.seconds[0]) & (end <= imu.seconds[-1])
    for a, b in imu.gaps:
        inside &= (end <= a) | (start >= b)
    return inside


def _check_offset(imu: ImuData, name: str, rates: CameraRates, found: Alignment, given: bool) -> None:
    """An offset at which the two do not turn alike is wrong, or the recordings do not belong together."""
    unexplained = _unexplained(imu, rates, found)
    if unexplained > LARGEST_UNEXPLAINED:
        where = "with the time_offset in the rig file" if given else "at any shift of their clocks"
        advice = "correct it, or leave it out to have it found" if given else _SAME_RECORDING
        raise EstimationError(
            f"the motion of {name} does not match that of {imu.name} {where} ({unexplained:.0%} of the angular rate is "
            f"unexplained); {advice}."
        )


def _unexplained(imu: ImuData, rates: CameraRates, found: Alignment) -> float:
    """Share of the angular rate that the camera did not see."""
    inside = _covered(imu, rates, found.offset)
    seen = rates.rate[inside] @ found.rotation.T
    middle = (0.5 * (rates.start + rates.end) + found.offset)[inside]
    gyro = np.stack([np.interp(middle, imu.seconds, imu.gyro[:, k]) for k in range(3)], axis=1) - found.gyro_bias
    return float(np.median(np.linalg.norm(gyro - seen, axis=1)) / np.median(np.linalg.norm(gyro, axis=1)))


def better_offset(imu: ImuData, name: str, rates: CameraRates, expected: float) -> float | None:
    """The offset at which the two turn alike, where it is clearly another than the `expected` one; else None."""
    try:
        own = align(imu, name, rates, None)
    except EstimationError:
        return None  # the motion does not show it
    if abs(own.offset - expected) < CLOCKS_AGREE_S:
        return None
    if not _covered(imu, rates, expected).any():
        return own.offset
    there = _unexplained(imu, rates, _refine(imu, rates, expected, True))
    return own.offset if _unexplained(imu, rates, own) < CLEARLY_BETTER * there else None


def _motion(imu: ImuData, rates: CameraRates) -> tuple[float, float]:
    """RMS rate of the IMU about its median, and the median rate of the camera, rad/s."""
    spread = np.sqrt(((imu.gyro - np.median(imu.gyro, axis=0)) ** 2).sum(axis=1).mean())
    return float(spread), float(np.sqrt(np.median((rates.rate**2).sum(axis=1))))


def _check_motion(imu: ImuData, name: str, rates: CameraRates) -> None:
    spread, seen = _motion(imu, rates)
    if spread < STILL_RAD_S and seen < 3.0 * STILL_RAD_S:
        raise EstimationError(
            f"the recording is motionless ({imu.name} turns at {spread:.4f} rad/s RMS, {name} at {seen:.4f}); "
            f"record again "
            "while turning the rig about all axes in front of the target."
        )


def _grid(t: np.ndarray, x: np.ndarray, covered: np.ndarray, length: float) -> tuple[np.ndarray, np.ndarray]:
    """x on a regular grid from 0 to `length`, and a mask of where it is known."""
    grid = np.arange(int(length * GRID_HZ) + 1) / GRID_HZ
    mask = np.interp(grid, t, covered.astype(float)) > 0.99
    return np.interp(grid, t, x), mask


def _correlate(imu: ImuData, name: str, rates: CameraRates) -> float:
    """Offset [s] at the peak of the masked, normalised cross-correlation of |w| over all shifts."""
    bias = np.median(imu.gyro, axis=0)
    a, mask_a = _grid(
        imu.seconds, np.linalg.norm(imu.gyro - bias, axis=1), np.ones(len(imu.seconds), bool), imu.seconds[-1]
    )  # fmt: skip
    grid = np.arange(len(a)) / GRID_HZ
    for start, end in imu.gaps:
        mask_a &= (grid <= start) | (grid >= end)
    middle = 0.5 * (rates.start + rates.end)
    near = np.diff(middle, append=middle[-1]) < LONGEST_STEP_S
    b, mask_b = _grid(middle, np.linalg.norm(rates.rate, axis=1), near, middle[-1])
    found = best_shift(a, mask_a, b, mask_b, SHORTEST_OVERLAP_S * GRID_HZ)
    if not found.correlation > rates.least_correlation:
        raise EstimationError(
            f"the motion of {name} does not match that of {imu.name} at any shift of their clocks (best correlation "
            f"{max(found.largest, 0.0):.2f}); check that both come from the same recording, overlap in time, "
            f"and are in rad/s."
        )
    return found.samples / GRID_HZ


def _kabsch(w_imu: np.ndarray, w_cam: np.ndarray, weight: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """R and bias with w_imu = R w_cam + bias: means removed, then an SVD."""
    total = weight.sum()
    mi, mc = weight @ w_imu / total, weight @ w_cam / total
    U, _, Vt = np.linalg.svd(((w_imu - mi) * weight[:, None]).T @ (w_cam - mc))
    D = np.diag([1.0, 1.0, np.sign(np.linalg.det(U @ Vt))])
    R = U @ D @ Vt
    return R, mi - R @ mc


def _refine(imu: ImuData, rates: CameraRates, offset: float, keep_offset: bool) -> Alignment:
    """Gauss-Newton on the offset, Kabsch on rotation and bias in turn; rates are means over each image interval."""
    angle = np.zeros((len(imu.seconds), 3))
    angle[1:] = np.cumsum(0.5 * (imu.gyro[1:] + imu.gyro[:-1]) * np.diff(imu.seconds)[:, None], axis=0)

    def at(x: np.ndarray, t: np.ndarray) -> np.ndarray:
        return np.stack([np.interp(t, imu.seconds, x[:, k]) for k in range(3)], axis=1)

    R, bias, residual = np.eye(3), np.zeros(3), np.zeros_like(rates.rate)
    for _ in range(ROUNDS):
        start, end = rates.start + offset, rates.end + offset
        inside = _covered(imu, rates, offset).astype(float)
        span = (end - start)[:, None]
        mean = (at(angle, end) - at(angle, start)) / span
        slope = (at(imu.gyro, end) - at(imu.gyro, start)) / span
        weight = inside
        for _ in range(3):
            R, bias = _kabsch(mean, rates.rate, weight)
            residual = mean - rates.rate @ R.T - bias
            size = np.linalg.norm(residual, axis=1)
            weight = inside * (size < 5.0 * np.median(size[inside > 0.0]) + 1e-9)
        if keep_offset:
            break
        step = -float((weight @ (slope * residual)).sum() / (weight @ slope**2).sum())
        offset += float(np.clip(step, -0.02, 0.02))
        if abs(step) < 1e-6:
            break
    return Alignment(offset, R, bias)


def turns_about_two_axes(imu: ImuData, rates: CameraRates, found: Alignment) -> bool:
    """Whether the camera turned about more than one axis, and the IMU with it: of a target far away a camera alone
    sees turns that are noise. Else its rotation about that axis stays open."""
    middle = (0.5 * (rates.start + rates.end) + found.offset)[_covered(imu, rates, found.offset)]
    gyro = np.stack([np.interp(middle, imu.seconds, imu.gyro[:, k]) for k in range(3)], axis=1)
    return all(_second_axis(w) >= LEAST_SECOND_AXIS for w in (rates.rate, gyro))


def _second_axis(rate: np.ndarray) -> float:
    """The spread of rates (n, 3) about their second axis over that about the first."""
    _, spread, _ = np.linalg.svd(rate - rate.mean(axis=0), full_matrices=False)
    return float(spread[1] / spread[0])


def check_axes(imu: ImuData, rates: CameraRates, found: Alignment, name: str) -> None:
    """Raises EstimationError where the camera turned about one axis only."""
    if not turns_about_two_axes(imu, rates, found):
        raise EstimationError(
            f"{name} turned about one axis only, and its rotation about that axis is not determined; turn the rig "
            "about two more axes, or give rotation in the rig file."
        )


def better_given(imu: ImuData, name: str, rates: CameraRates, found: Alignment, offset: float) -> Alignment:
    """`found`, or what a guess of the `offset` makes of it where the two turn alike there far better: rates about one
    axis fit the other way round, too."""
    if not _covered(imu, rates, offset).any():
        return found
    other = as_given(imu, name, rates, offset, found.rotation)
    return other if _unexplained(imu, rates, other) < CLEARLY_BETTER * _unexplained(imu, rates, found) else found


def as_given(imu: ImuData, name: str, rates: CameraRates, offset: float, rotation: np.ndarray) -> Alignment:
    """An alignment with this offset and rotation, whatever the motion: only the gyro bias is found. Raises
    EstimationError where clocks do not overlap."""
    inside = _covered(imu, rates, offset)
    if not inside.any():
        raise _no_overlap(imu, name)
    middle = (0.5 * (rates.start + rates.end) + offset)[inside]
    gyro = np.stack([np.interp(middle, imu.seconds, imu.gyro[:, k]) for k in range(3)], axis=1)
    return Alignment(offset, rotation, np.median(gyro - rates.rate[inside] @ rotation.T, axis=0), given=True)


def contradicts(imu: ImuData, rates: CameraRates, given: Alignment) -> bool:
    """Whether the two turn, but not alike, even allowing for what a guess is off."""
    spread, seen = _motion(imu, rates)
    return (spread >= STILL_RAD_S or seen >= 3.0 * STILL_RAD_S) and _unexplained(
        imu, rates, given
    ) > LARGEST_UNEXPLAINED


def _no_overlap(imu: ImuData, name: str) -> EstimationError:
    return EstimationError(
        f"with the time_offset in the rig file no image of {name} falls within the recording of {imu.name}; correct "
        "it, or leave it out to have it found."
    )


def _check_scale(imu: ImuData, name: str, rates: CameraRates, found: Alignment) -> None:
    """The two must turn equally fast: a ratio of 57 is degrees."""
    inside = _covered(imu, rates, found.offset)
    middle = (0.5 * (rates.start + rates.end) + found.offset)[inside]
    gyro = np.stack([np.interp(middle, imu.seconds, imu.gyro[:, k]) for k in range(3)], axis=1)
    ratio = _median_size(gyro) / max(_median_size(rates.rate[inside]), 1e-9)
    if 0.8 < ratio < 1.25:
        return
    cause = (
        "its angular rate looks like deg/s; convert it to rad/s" if 0.8 < ratio / DEGREES < 1.25 else "check its units"
    )
    raise EstimationError(f"{imu.name} turns {ratio:.3g} times as fast as {name}: {cause}.")


def _median_size(rate: np.ndarray) -> float:
    """Median length of rates about their own median: a bias has no say."""
    return float(np.median(np.linalg.norm(rate - np.median(rate, axis=0), axis=1)))
