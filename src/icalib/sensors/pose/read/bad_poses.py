"""Wrong poses among good ones: no poses at all, copies of earlier poses, and poses off the path of the others.

Poses are cut into pieces at jumps. The path is the heaviest chain of pieces that go on from each other (dynamic
programming): a chain may leave pieces out, or pay for a jump that stays.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from icalib.geometry import so3

FARTHEST_M = 1e9  # from the origin of any frame: the Earth's radius is 6e6
_JUMP_M, _JUMP_RAD = 0.05, 0.05  # beyond the steps before and after, and
_BRISK = 10.0  # m/s^2, rad/s^2: a motion may change so fast from pose to pose, or
_JUMP_TIMES = 20.0  # the median of all steps beyond theirs
_LASTING_SHARE = 0.1  # of all poses: more are not left out for one jump less
_MOST_PIECES_BACK = 200
_COPIED_WITHIN_S = 1.0
_MOVING_SHARE = 0.2  # of the usual speed: slower, a pose that is repeated is one of a thing that stands still
_GAP_STEPS = 2.0  # a longer step is a gap, over which the motion may have changed


@dataclass(frozen=True)
class ContinuousPoses:
    """on (N,): the poses of the path; jumps (M,) first pose after each; size_m, size_rad: of the largest; lasting_m:
    how far the jumps that stay in the path add up; longest_s: between poses of the path, of time left out."""

    on: np.ndarray
    jumps: np.ndarray
    size_m: float
    size_rad: float
    lasting_m: float
    longest_s: float


def are_poses(rotation: np.ndarray, position: np.ndarray) -> np.ndarray:
    """(N,) whether rotations (N, 3, 3) and positions (N, 3) are finite and somewhere on Earth."""
    values = np.hstack([position, rotation.reshape(-1, 9)])
    return np.logical_and.reduce(np.abs(values) < FARTHEST_M, axis=1)


def stale_copies(seconds: np.ndarray, rotation: np.ndarray, position: np.ndarray) -> np.ndarray:
    """(N,) whether a pose repeats an earlier one in every digit while the sensor moves: a tracker that is lost, or a
    driver that sends its last pose again. Without noise a thing that stands still repeats itself, too: slowly left."""
    before = _same_before(np.hstack([position, rotation.reshape(-1, 9)]))
    copy = (before >= 0) & (seconds - seconds[before] <= _COPIED_WITHIN_S)
    own = np.flatnonzero(~copy)
    if len(own) == len(seconds) or len(own) < 3:
        return np.zeros(len(seconds), dtype=bool)
    first = np.arange(len(seconds))
    for i in np.flatnonzero(copy).tolist():
        first[i] = first[before[i]]
    after = np.searchsorted(own, np.arange(len(seconds)), side="right")
    # At the end no pose follows: the step to the pose that is repeated tells whether it stopped there.
    ends = after == len(own)
    a = np.where(ends, np.maximum(first - 1, 0), first)
    b = np.where(ends, first, own[np.minimum(after, len(own) - 1)])
    step = np.maximum(seconds[b] - seconds[a], 1e-9)
    stale = np.zeros(len(seconds), dtype=bool)
    for way in (np.linalg.norm(position[b] - position[a], axis=1), _angles(rotation, a, b)):
        usual = float(np.median((way / step)[own[:-1]]))
        stale |= (usual > 0.0) & (way / step > _MOVING_SHARE * usual)
    return stale & copy


def _same_before(rows: np.ndarray) -> np.ndarray:
    """(N,) the last earlier row that is the same in every digit, -1 if there is none."""
    words = np.ascontiguousarray(rows).view(np.uint64)
    odd = np.random.default_rng(0).integers(1, 2**63, words.shape[1], dtype=np.uint64) * np.uint64(2) + np.uint64(1)
    key = (words * odd).sum(axis=1, dtype=np.uint64)
    order = np.argsort(key, kind="stable")
    same = (words[order[1:]] == words[order[:-1]]).all(axis=1)
    before = np.full(len(rows), -1)
    before[order[1:][same]] = order[:-1][same]
    return before


def path_of(seconds: np.ndarray, rotation: np.ndarray, position: np.ndarray) -> ContinuousPoses:
    """The path of poses (N,), and where they jump."""
    step, n = np.diff(seconds), len(seconds)
    way, turn = _Steps.of(np.diff(position, axis=0), step, _JUMP_M), _Steps.of(_turns(rotation), step, _JUMP_RAD)
    jump = way.jump | turn.jump
    if not jump.any():
        return ContinuousPoses(np.ones(n, dtype=bool), np.empty(0, np.int64), 0.0, 0.0, 0.0, 0.0)

    def moved(i: np.ndarray, j: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        return way.left(seconds[j] - seconds[i], position[j] - position[i], i, j)

    def apart(i: np.ndarray, j: np.ndarray) -> np.ndarray:
        turned = so3.log_many(np.ascontiguousarray(rotation[i].transpose(0, 2, 1) @ rotation[j]))
        return moved(i, j)[1] | turn.left(seconds[j] - seconds[i], turned, i, j)[1]

    cuts = np.concatenate([[0], np.flatnonzero(jump) + 1, [n]])
    chain = _heaviest(cuts, _LASTING_SHARE * n, apart)
    on = np.zeros(n, dtype=bool)
    for k in chain.tolist():
        on[cuts[k] : cuts[k + 1]] = True
    left, lasts = moved(cuts[chain[:-1] + 1] - 1, cuts[chain[1:]])
    own = np.flatnonzero(on)
    ends = np.concatenate([[0], own, [n - 1]])
    missing = np.diff(seconds[ends])[np.diff(ends) > 1]
    return ContinuousPoses(
        on,
        np.flatnonzero(jump) + 1,
        float(way.size[jump].max()),
        float(turn.size[jump].max()),
        float(np.linalg.norm(left[lasts].sum(axis=0))),
        float(missing.max(initial=0.0)),
    )


@dataclass(frozen=True)
class _Steps:
    """Steps from pose to pose, of positions or rotations: size (N - 1,) beyond the neighbouring steps, and which are
    jumps; limit of what is none; rate (N, 3) about each pose, and the fastest without jumps; usual_s: of a step."""

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
        limit = max(least, _BRISK * usual**2, _JUMP_TIMES * float(np.median(size)))
        gap = step >= _GAP_STEPS * usual
        jump, rate = (size > limit) & ~gap, change / step[:, None]
        steady = np.flatnonzero(~jump & ~gap)
        fastest = float(np.linalg.norm(rate[steady], axis=1).max(initial=0.0))
        jump |= gap & (size > limit + 2.0 * fastest * step)
        if len(steady):  # about a jump the rate is that of the steps before and after
            rate = np.stack([np.interp(np.arange(len(rate)), steady, own) for own in rate[steady].T], axis=1)
        rate = _medians(np.concatenate([rate[:1], rate]))
        return cls(size, jump, limit, rate, fastest, usual)

    def left(self, dt: np.ndarray, change: np.ndarray, i: np.ndarray, j: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """What steady motion leaves (n, 3) of the change (n, 3) from poses i to j over dt (n,) s, and whether it is a
        jump (n,)."""
        left = change - 0.5 * (self.rate[i] + self.rate[j]) * dt[:, None]
        allowed = self.limit + self.fastest * np.maximum(dt - 1.5 * self.usual_s, 0.0)
        return left, np.linalg.norm(left, axis=1) > allowed


def _heaviest(cuts: np.ndarray, price: float, apart: Callable[[np.ndarray, np.ndarray], np.ndarray]) -> np.ndarray:
    """Numbers, in order, of the pieces (M,) of the chain with most poses, less the `price` of each jump in it; piece k
    has the poses from cuts[k] to cuts[k + 1]."""
    m = len(cuts) - 1
    best, before = np.diff(cuts).astype(float), np.full(m, -1)
    for k in range(1, m):
        earlier = np.arange(max(0, k - _MOST_PIECES_BACK), k)
        worth = best[earlier] - price * apart(cuts[earlier + 1] - 1, np.full(len(earlier), cuts[k]))
        top = int(np.argmax(worth))
        if worth[top] > 0.0:
            best[k] += worth[top]
            before[k] = earlier[top]
    chain = [int(np.argmax(best))]
    while before[chain[-1]] >= 0:
        chain.append(int(before[chain[-1]]))
    return np.array(chain[::-1])


def _medians(steps: np.ndarray) -> np.ndarray:
    """Of each of steps (n, 3), the median of it and its neighbours, two on each side."""
    padded = np.pad(steps, ((2, 2), (0, 0)), mode="reflect")
    return np.median(np.stack([padded[k : k + len(steps)] for k in range(5)]), axis=0)


def _turns(rotation: np.ndarray) -> np.ndarray:
    """(N - 1, 3) what each pose turned from the one before, about axes of the sensor, rad."""
    return so3.log_many(np.ascontiguousarray(rotation[:-1].transpose(0, 2, 1) @ rotation[1:]))


def _angles(rotation: np.ndarray, a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """(n,) rad from rotations a to rotations b."""
    turns = so3.log_many(np.ascontiguousarray(rotation[a].transpose(0, 2, 1) @ rotation[b]))
    return np.linalg.norm(turns, axis=1)
