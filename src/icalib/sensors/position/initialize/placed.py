"""A position sensor on a known trajectory: time offset by correlation, frame and lever arm by least squares."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np

from icalib.geometry import so3
from icalib.initialize.steps.cross_correlation import best_shifts
from icalib.initialize.steps.initializer import OtherMotionError
from icalib.motion.known_motion import imu_poses, is_known
from icalib.motion.poses import Poses
from icalib.motion.sweep import EstimatedMotion
from icalib.sensors.position.frame import PositionFrame
from icalib.sensors.position.initialize.attitude import ARM_SIGMA_M, OFFSET_SIGMA_S, Fix
from icalib.sensors.position.initialize.clock import PEAK_SPACING_S, SIGNAL_RATE_HZ, likely_offsets, varies

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
    best = min(candidates, key=lambda x: x.misfit)
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
    """Candidate time offsets [s]: the known one, or peaks of the correlation of mean speeds, then of third differences
    with the IMU's readings. Speeds differ where the rig turns on the spot, by the lever arm."""
    if known.offset is not None:
        return [known.offset]
    by_acceleration = [shift.samples / SIGNAL_RATE_HZ for shift in likely_offsets(motion.imu, fix)]
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
