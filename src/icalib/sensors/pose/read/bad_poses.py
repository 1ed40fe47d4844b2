"""Detects bad poses: invalid poses, copies of earlier poses, and poses off the trajectory.

Poses are cut into pieces at jumps. The trajectory is the chain of continuous pieces with most poses, found by dynamic
programming. A chain may omit pieces, or accept a jump at a cost.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from scipy.ndimage import median_filter

from icalib.geometry import so3
from icalib.geometry.small import lagrange_weights

MAX_COORDINATE_M = 1e9  # larger coordinates are invalid; the Earth's radius is 6e6 m
# A step is a jump if its difference from neighbouring steps exceeds all three of these:
_MIN_JUMP_M, _MIN_JUMP_RAD = 0.05, 0.05
_MAX_ACCELERATION = 10.0  # m/s^2, rad/s^2; multiplied by the squared median time step
_JUMP_MEDIANS = 20.0  # in medians of this difference over all steps
_MIN_KEPT_SHARE = 0.1  # cost of a jump in a chain, as a share of all poses: no more poses are omitted to avoid it
_MAX_OMITTED_PIECES = 200  # largest number of consecutive omitted pieces; limits the computing time
_MAX_COPY_AGE_S = 1.0  # longest time between a pose and its copy
_MIN_MOVING_SPEED = 0.2  # share of the median speed; a slower sensor may be at rest and repeat its pose
_MIN_GAP_STEPS = 2.0  # in median time steps; over a longer step the motion may have changed


@dataclass(frozen=True)
class ContinuousPoses:
    """The trajectory among N poses. on (N,) bool: whether a pose is on it; jumps (M,): index of the first pose after
    each jump; size_m, size_rad: size of the largest jump; net_jump_m: length of the sum of jumps that stay in the
    trajectory [m]; longest_s: longest gap that omitted poses leave [s]."""

    on: np.ndarray
    jumps: np.ndarray
    size_m: float
    size_rad: float
    net_jump_m: float
    longest_s: float


def are_poses(rotation: np.ndarray, position: np.ndarray) -> np.ndarray:
    """(N,) bool: whether rotations (N, 3, 3) and positions (N, 3) [m] are finite and plausible."""
    values = np.hstack([position, rotation.reshape(-1, 9)])
    return np.logical_and.reduce(np.abs(values) < MAX_COORDINATE_M, axis=1)


def stale_copies(seconds: np.ndarray, rotation: np.ndarray, position: np.ndarray) -> np.ndarray:
    """(N,) bool: whether a pose equals an earlier one in every digit while the sensor moves. A lost tracker, or a
    driver that repeats its last pose, causes such copies. A noise-free sensor at rest repeats its pose as well, so that
    the speed afterwards decides."""
    before = _same_before(np.hstack([position, rotation.reshape(-1, 9)]))
    copy = (before >= 0) & (seconds - seconds[before] <= _MAX_COPY_AGE_S)
    new = np.flatnonzero(~copy)
    if len(new) == len(seconds) or len(new) < 3:
        return np.zeros(len(seconds), dtype=bool)
    first = np.arange(len(seconds))
    for i in np.flatnonzero(copy).tolist():
        first[i] = first[before[i]]
    after = np.searchsorted(new, np.arange(len(seconds)), side="right")
    # If no new pose follows, the step to the repeated pose decides.
    ends = after == len(new)
    a = np.where(ends, np.maximum(first - 1, 0), first)
    b = np.where(ends, first, new[np.minimum(after, len(new) - 1)])
    step = np.maximum(seconds[b] - seconds[a], 1e-9)
    stale = np.zeros(len(seconds), dtype=bool)
    for change in (np.linalg.norm(position[b] - position[a], axis=1), _angles(rotation, a, b)):
        usual = float(np.median((change / step)[new[:-1]]))
        stale |= (usual > 0.0) & (change / step > _MIN_MOVING_SPEED * usual)
    return stale & copy


def _same_before(rows: np.ndarray) -> np.ndarray:
    """(N,) index of the last earlier row that equals each row (N, k) in every digit; -1 if there is none."""
    words = np.ascontiguousarray(rows).view(np.uint64)
    odd = np.random.default_rng(0).integers(1, 2**63, words.shape[1], dtype=np.uint64) * np.uint64(2) + np.uint64(1)
    key = (words * odd).sum(axis=1, dtype=np.uint64)
    order = np.argsort(key, kind="stable")
    same = (words[order[1:]] == words[order[:-1]]).all(axis=1)
    before = np.full(len(rows), -1)
    before[order[1:][same]] = order[:-1][same]
    return before


def continuous_poses(seconds: np.ndarray, rotation: np.ndarray, position: np.ndarray) -> ContinuousPoses:
    """The trajectory and the jumps among N poses at seconds (N,)."""
    step, n = np.diff(seconds), len(seconds)
    shift = _Steps.of(np.diff(position, axis=0), step, _MIN_JUMP_M)
    turn = _Steps.of(_rotation_steps(rotation), step, _MIN_JUMP_RAD)
    jump = shift.jump | turn.jump
    if not jump.any():
        return ContinuousPoses(np.ones(n, dtype=bool), np.empty(0, np.int64), 0.0, 0.0, 0.0, 0.0)

    def excess_shift(i: np.ndarray, j: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Displacement (n, 3) from poses i to j beyond steady motion, and whether it is a jump."""
        return shift.excess(seconds[j] - seconds[i], position[j] - position[i], i, j)

    def apart(i: np.ndarray, j: np.ndarray) -> np.ndarray:
        """(n,) whether position or rotation jump between poses i and j."""
        turned = so3.log_many(np.ascontiguousarray(rotation[i].transpose(0, 2, 1) @ rotation[j]))
        return excess_shift(i, j)[1] | turn.excess(seconds[j] - seconds[i], turned, i, j)[1]

    cuts = np.concatenate([[0], np.flatnonzero(jump) + 1, [n]])
    chain = _longest_chain(cuts, _MIN_KEPT_SHARE * n, apart)
    on = np.repeat(np.isin(np.arange(len(cuts) - 1), chain), np.diff(cuts))
    excess, is_jump = excess_shift(cuts[chain[:-1] + 1] - 1, cuts[chain[1:]])
    return ContinuousPoses(
        on,
        np.flatnonzero(jump) + 1,
        float(shift.size[jump].max()),
        float(turn.size[jump].max()),
        float(np.linalg.norm(excess[is_jump].sum(axis=0))),
        _longest_gap(seconds, on),
    )


def _longest_gap(seconds: np.ndarray, on: np.ndarray) -> float:
    """Longest time [s] that omitted poses, those that are not `on` (N,) bool, leave without a pose; 0 if none are
    omitted."""
    ends = np.concatenate([[0], np.flatnonzero(on), [len(seconds) - 1]])
    return float(np.diff(seconds[ends])[np.diff(ends) > 1].max(initial=0.0))


@dataclass(frozen=True)
class _Steps:
    """Steps between successive poses, of positions [m] or rotations [rad]. size (N - 1,): difference from the median of
    neighbouring steps; jump (N - 1,) bool; limit: largest size of a step that is not a jump; rate (N, 3): rate around
    each pose [m/s, rad/s]; fastest: largest rate without jumps; usual_s: median time step [s]."""

    size: np.ndarray
    jump: np.ndarray
    limit: float
    rate: np.ndarray
    fastest: float
    usual_s: float

    @classmethod
    def of(cls, change: np.ndarray, step: np.ndarray, least: float) -> _Steps:
        usual = float(np.median(step))
        size = np.linalg.norm(change - _medians(change), axis=1)
        limit = max(least, _MAX_ACCELERATION * usual**2, _JUMP_MEDIANS * float(np.median(size)))
        gap = step >= _MIN_GAP_STEPS * usual
        jump, rate = (size > limit) & ~gap, change / step[:, None]
        steady = np.flatnonzero(~jump & ~gap)
        fastest = float(np.linalg.norm(rate[steady], axis=1).max(initial=0.0))
        jump |= gap & (size > limit + 2.0 * fastest * step)
        if len(steady):  # at a jump, the rate is interpolated from the steps before and after
            rate = np.stack([np.interp(np.arange(len(rate)), steady, r) for r in rate[steady].T], axis=1)
        rate = _medians(np.concatenate([rate[:1], rate]))
        return cls(size, jump, limit, rate, fastest, usual)

    def excess(self, dt: np.ndarray, change: np.ndarray, i: np.ndarray, j: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Change (n, 3) between poses i and j, given with its duration dt (n,) [s], minus that of motion at constant
        rate; and whether it is a jump (n,) bool."""
        excess = change - 0.5 * (self.rate[i] + self.rate[j]) * dt[:, None]
        allowed = self.limit + self.fastest * np.maximum(dt - 1.5 * self.usual_s, 0.0)
        return excess, np.linalg.norm(excess, axis=1) > allowed


def _longest_chain(cuts: np.ndarray, price: float, apart: Callable[[np.ndarray, np.ndarray], np.ndarray]) -> np.ndarray:
    """Indices (k,), increasing, of the pieces in the best chain: most poses minus the `price` of each jump in it. Piece
    k has the poses cuts[k]:cuts[k + 1]. apart: whether a jump lies between poses (n,) and (n,)."""
    m = len(cuts) - 1
    best, before = np.diff(cuts).astype(float), np.full(m, -1)
    for k in range(1, m):
        earlier = np.arange(max(0, k - _MAX_OMITTED_PIECES), k)
        length = best[earlier] - price * apart(cuts[earlier + 1] - 1, np.full(len(earlier), cuts[k]))
        top = int(np.argmax(length))
        if length[top] > 0.0:
            best[k] += length[top]
            before[k] = earlier[top]
    chain = [int(np.argmax(best))]
    while before[chain[-1]] >= 0:
        chain.append(int(before[chain[-1]]))
    return np.array(chain[::-1])


def _medians(steps: np.ndarray) -> np.ndarray:
    """(n, 3) running medians of steps (n, 3) with a window of 5."""
    padded = np.pad(steps, ((2, 2), (0, 0)), mode="reflect")
    return np.median(np.stack([padded[k : k + len(steps)] for k in range(5)]), axis=0)


def _rotation_steps(rotation: np.ndarray) -> np.ndarray:
    """(N - 1, 3) rotation vectors between successive poses, in axes of the sensor [rad]."""
    return so3.log_many(np.ascontiguousarray(rotation[:-1].transpose(0, 2, 1) @ rotation[1:]))


def _angles(rotation: np.ndarray, a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """(n,) rotation angles [rad] between poses with indices a (n,) and b (n,)."""
    turns = so3.log_many(np.ascontiguousarray(rotation[a].transpose(0, 2, 1) @ rotation[b]))
    return np.linalg.norm(turns, axis=1)


# Detects single outliers among poses (Hampel filter).
#
# The distance of a pose from a cubic through two poses on each side is compared with the running median of such
# distances. An outlier distorts the cubics of its neighbours as well, so that poses with large distances are only
# candidates. Candidates and their neighbours are then compared with a cubic through other poses. A single outlier is
# far from this cubic, and its neighbours are close to it. Where the motion changes suddenly, such as at the start of a
# robot, all of them are far from it.

_OUTLIER_MEDIANS = 6.0  # in median distances: about 9 standard deviations, which noise does not reach
_MEDIAN_WINDOW = 51  # window in poses, as motion and noise change over a recording
_MIN_OUTLIER = (1e-3, 1e-3)  # m, rad; least distance of an outlier, for poses without noise
# Largest distance of an outlier's neighbours, as a share of its distance, or of the limit.
_MAX_NEIGHBOUR_DISTANCE, _MAX_NEIGHBOUR_LIMIT = 0.2, 0.5
_MAX_CUBIC_STEPS = 12.0  # in median steps, from first to last of the four poses; longer cubics are inaccurate
_EVEN_VARIANCE = 1.0 + 34.0 / 36.0  # ratio of the variances of a distance and of a pose, for five evenly spaced poses
_MAX_OUTLIERS = 0.1  # share of all poses; if there are more, none is a single outlier


def single_outliers(seconds: np.ndarray, rotation: np.ndarray, position: np.ndarray) -> np.ndarray:
    """(N,) bool: poses that are far from the motion between their neighbours, while the neighbours are not.

    All False with fewer than _MEDIAN_WINDOW poses, or if more than a share of _MAX_OUTLIERS were outliers."""
    n = len(seconds)
    wrong = np.zeros(n, dtype=bool)
    if n < _MEDIAN_WINDOW:
        return wrong
    poses, everything = (seconds, rotation, position), np.arange(n)
    far = _distances(poses, everything, everything)[0]
    usual = np.maximum(median_filter(far, size=(_MEDIAN_WINDOW, 1), mode="nearest"), np.median(far, axis=0))
    limit = np.maximum(_OUTLIER_MEDIANS * usual, _MIN_OUTLIER)
    candidate = (far > limit).any(axis=1)
    if not candidate.any() or candidate.sum() > 5.0 * _MAX_OUTLIERS * n:
        return wrong
    at = np.flatnonzero(candidate)
    rows = np.unique(np.clip(np.concatenate([at - 1, at, at + 1]), 0, n - 1))
    far[rows], size = _distances(poses, np.flatnonzero(~candidate), rows)
    limit[rows] *= size[:, None]
    beside = np.maximum(far[np.maximum(at - 1, 0)], far[np.minimum(at + 1, n - 1)])
    alone = beside <= np.maximum(_MAX_NEIGHBOUR_DISTANCE * far[at], _MAX_NEIGHBOUR_LIMIT * limit[at])
    wrong[at] = ((far[at] > limit[at]) & alone).any(axis=1)
    return wrong if wrong.sum() <= _MAX_OUTLIERS * n else np.zeros(n, dtype=bool)


def _distances(
    poses: tuple[np.ndarray, np.ndarray, np.ndarray], knots: np.ndarray, rows: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Distances (n, 2) [m, rad] of the poses with indices `rows` (n,) from a cubic through the two nearest of `knots`
    (m,) on each side. The distance is 0 if there are fewer knots. The second value (n,) is the ratio of their noise to
    that for evenly spaced poses."""
    t, R, p = poses
    left, right = np.searchsorted(knots, rows), np.searchsorted(knots, rows, side="right")
    has_knots = (left >= 2) & (right <= len(knots) - 2)
    left, right = np.clip(left, 2, len(knots)), np.clip(right, 0, len(knots) - 2)
    beside = knots[np.stack([left - 2, left - 1, right, right + 1])]
    has_knots &= t[beside[3]] - t[beside[0]] < _MAX_CUBIC_STEPS * np.median(np.diff(t))
    weight = np.where(
        has_knots, lagrange_weights(np.where(has_knots, t[beside] - t[rows], np.arange(1.0, 5.0)[:, None])), 0.0
    )
    off = p[rows] - np.einsum("kn,kni->ni", weight, p[beside])
    turns = [so3.log_many(np.ascontiguousarray(R[rows].transpose(0, 2, 1) @ R[k])) for k in beside]
    turned = np.einsum("kn,kni->ni", weight, np.stack(turns))
    far = np.stack([np.linalg.norm(off, axis=1), np.linalg.norm(turned, axis=1)], axis=1)
    return far * has_knots[:, None], np.sqrt((1.0 + (weight**2).sum(axis=0)) / _EVEN_VARIANCE)
