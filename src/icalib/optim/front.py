"""Frontal elimination of a chain whose keyframes share features, each seen from many keyframes (iCalib paper (15),
Schur complement).

The elimination order comes first; `front_kernels.py` has the compiled steps.
The cost of a step grows with the square of the number of features in the front.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from icalib.base.compiled import njit
from icalib.geometry.blas import solve_upper
from icalib.optim.front_kernels import FrontChain, Sizes, eliminate_all, rotate_keyframes, step_factors
from icalib.optim.state import POSE_DIM


@dataclass(frozen=True)
class PieceFeatures:
    """Features of a `Piece`: their sums, the elimination plan, and the workspace `workspace` of the factors. Each
    elimination overwrites the last one's factors, because writing to freshly mapped memory would cost more than the
    elimination."""

    sums: FeatureSums
    plan: Plan
    workspace: np.ndarray

    @classmethod
    def of(cls, sums: FeatureSums, plan: Plan) -> PieceFeatures:
        """The features with a new workspace."""
        return cls(sums, plan, np.empty(_sizes(plan, sums.side.shape[2], sums.dim).start[-1]))

    def widened(self, n_calib: int) -> PieceFeatures:
        """The same features with more calibration columns, `n_calib` in all. New columns and the gradient are zero."""
        side = self.sums.side
        wide = np.zeros((*side.shape[:2], n_calib + 1))
        wide[:, :, : side.shape[2] - 1] = side[:, :, :-1]
        return PieceFeatures.of(self.sums._replace(side=wide), self.plan)


@dataclass(frozen=True)
class Eliminated:
    """Result of the elimination: plan and sizes; turn (n, D, D), the orthogonal transform of each keyframe;
    workspace: holds the factors of all steps; remaining (D or 0 + B + 1, same), upper triangle: the system of the kept
    keyframe, calibration parameters and gradient."""

    plan: Plan
    sizes: Sizes
    turn: np.ndarray
    workspace: np.ndarray
    remaining: np.ndarray

    @property
    def rows(self) -> int:
        """Number of eliminated unknowns, without the features that a single step sees."""
        return int(self.sizes.uncoupled.sum() + self.sizes.coupled.sum() + self.sizes.dying.sum())

    def substitute(self, calib: np.ndarray, white: np.ndarray, chain: np.ndarray) -> None:
        """Back substitution of m right-hand sides: fills chain (n, D, m), whose kept keyframe is an input.

        calib (B + 1, m): steps of the calibration parameters, and in the last row the factor of the gradient. white
        (rows, m): further right-hand sides after forward substitution.
        """
        substitute_all(self.plan, self.sizes, self.turn, self.workspace, calib, white, chain)


def _sizes(plan: Plan, n_calib: int, dim: int) -> Sizes:
    """Numbers of rows and columns that the factors of every step have, see `Sizes`, and where they start in the
    workspace. The shapes are those in `step_factors`."""
    coupled = np.add.reduceat(np.append(plan.coupled[plan.keyframes.values], 0), plan.keyframes.start[:-1])
    counts = np.diff(plan.keyframes.start)
    coupled[counts == 0] = 0
    uncoupled, dying, wide = dim * counts - coupled, 3 * np.diff(plan.dying.start), n_calib + 3 * plan.alive
    lengths = (uncoupled + coupled) ** 2 + dying * (dying + coupled) + uncoupled * (dim + n_calib)
    lengths += (coupled + dying) * (dim + wide)
    return Sizes(uncoupled, coupled, dying, wide, np.concatenate([[0], np.cumsum(lengths)]))


def eliminate(
    features: PieceFeatures, diagonal: np.ndarray, upper: np.ndarray, side: np.ndarray, forwards: bool, keep: bool
) -> Eliminated | None:
    """Eliminates all keyframes and features of a piece, but for a kept end keyframe; None if the sums are not positive
    definite. The factors are in the workspace of `features`."""
    plan, sums, dim, n_calib = features.plan, features.sums, *side.shape[1:]
    sizes = _sizes(plan, n_calib, dim)
    widest = int(sizes.wide.max())
    turn, workspace = np.empty_like(diagonal), features.workspace
    chain = FrontChain(diagonal, upper, side, forwards, turn, np.empty_like(sums.pose), np.empty_like(sums.next_pose))
    rotate_keyframes(plan, sums, turn, chain.pose, chain.next_pose)
    front, carry = np.zeros((widest, widest)), np.zeros((dim, dim + widest))
    if not eliminate_all(plan, sizes, sums, chain, workspace, front, carry):
        return None
    if not keep:
        return Eliminated(plan, sizes, turn, workspace, front[:n_calib, :n_calib].copy())
    remaining = np.zeros((dim + n_calib, dim + n_calib))
    remaining[:dim], remaining[dim:, dim:] = (
        carry[:, : dim + n_calib],
        front[:n_calib, :n_calib],
    )
    return Eliminated(plan, sizes, turn, workspace, remaining)


# Elimination order of the keyframes of a piece and the features seen from them, chosen by cost.
#
# Keyframes are eliminated in groups, from one end of the piece to the other. A feature that a single group sees is
# eliminated before that group. Any other feature joins the front with the first group that sees it and leaves with the
# last one. So the result is exact for tracks of any length. A larger group keeps more features out of the front, but
# has fewer of them leave at its end.

GROUP_SIZES = (4, 8, 12, 16, 24, 32)  # keyframes of a group
# Costs in units of one multiplication in the products of the front, measured on one machine. Groups of half or twice
# the best size cost 10 % more, so the values are uncritical.
SMALL_PRODUCT_COST = 3.0  # multiplication in a small factorisation or triangular solve
FRONT_MOVE_COST, FACTOR_MOVE_COST = 2.0, 32.0  # moving a number of the front, of the factors
STEP_COST = 3e5  # overhead of a step's calls
NO_TRACK_ENDS = np.zeros(0, dtype=np.int64)


class FeatureSums(NamedTuple):
    """Terms of features in the normal equations of a `Piece`: diagonal (T, 3, 3); side (T, 3, B + 1), feature with
    calibration parameters, its gradient in the last column; block (E, 3, p), feature with the camera's pose, for each
    pair of feature and image.

    pose (I, p, D), Jacobian of a camera's pose by the keyframe of its image; next_pose (I or 0, p, D), by the next
    keyframe. p is 6, or more if an image has several poses, those of a rolling shutter. track and
    image (E,) of the pairs, keyframe (I,) of the images, all counted from the first of the piece.
    """

    diagonal: np.ndarray
    side: np.ndarray
    block: np.ndarray
    pose: np.ndarray
    next_pose: np.ndarray
    track: np.ndarray
    image: np.ndarray
    keyframe: np.ndarray

    @classmethod
    def zeros(
        cls,
        n_tracks: int,
        track: np.ndarray,
        image: np.ndarray,
        keyframe: np.ndarray,
        shape: tuple[int, ...],
        by_next: bool = False,
        knots: int = 1,
    ) -> FeatureSums:
        """Sums of `n_tracks` features, all zero. shape: (D, B + 1). by_next: whether poses also depend on the next
        keyframe. knots: poses of an image."""
        pose = np.zeros((len(keyframe), POSE_DIM * knots, shape[0]))
        return cls(
            np.zeros((n_tracks, 3, 3)),
            np.zeros((n_tracks, 3, shape[1])),
            np.zeros((len(track), 3, POSE_DIM * knots)),
            pose,
            pose.copy() if by_next else pose[:0],
            track,
            image,
            keyframe,
        )

    @property
    def dim(self) -> int:
        """D, the dimensions of a keyframe."""
        return self.pose.shape[2]

    def clear(self) -> None:
        """Sets the terms of features to zero; the Jacobians of poses stay."""
        for a in (self.diagonal, self.side, self.block):
            a[:] = 0.0


class Lists(NamedTuple):
    """One list of integers per step; that of step g is values[start[g]:start[g + 1]]."""

    start: np.ndarray
    values: np.ndarray

    @classmethod
    def of(cls, lists: list[np.ndarray]) -> Lists:
        """The lists, concatenated."""
        sizes = [len(x) for x in lists]
        values = np.concatenate([*lists, np.zeros(0, dtype=np.int64)]).astype(np.int64)
        return cls(np.concatenate([[0], np.cumsum(sizes)]).astype(np.int64), values)

    @classmethod
    def sorted_by(cls, step: np.ndarray, values: np.ndarray, n_steps: int) -> Lists:
        """Lists of `values` (n,), each in the list of its `step` (n,); those of step -1 are left out."""
        order = np.argsort(step, kind="stable")
        start = np.searchsorted(step[order], np.arange(n_steps + 1))
        return cls((start - start[0]).astype(np.int64), values[order][start[0] :].astype(np.int64))


class Plan(NamedTuple):
    """Steps of the elimination. Each eliminates its keyframes, in order; after (G,): the next keyframe, -1 for none.

    coupled (K,): number of a keyframe's rotated dimensions that involve features. Features in the front have slots
    0..alive (G,). At the start of a step some move from slots `leave` to `enter`, then `born` ones join in slots
    `born_at`; at its end those in slots `dying` are eliminated. pair: pairs of the step's images with features in slots
    `pair_at`. local: features that are eliminated first. The pairs of local feature l start at local_start[l] in
    local_pair.
    """

    keyframes: Lists
    after: np.ndarray
    coupled: np.ndarray
    alive: np.ndarray
    leave: Lists
    enter: np.ndarray
    born: Lists
    born_at: np.ndarray
    dying: Lists
    pair: Lists
    pair_at: np.ndarray
    local: Lists
    local_start: np.ndarray
    local_pair: np.ndarray


@dataclass(frozen=True)
class _Lives:
    """Groups of keyframes; step (I,) of each image; first and last step (T,) of each feature (first > last if none);
    local (T,), whether a single group sees it."""

    groups: list[np.ndarray]
    step: np.ndarray
    first: np.ndarray
    last: np.ndarray
    local: np.ndarray

    @classmethod
    def of(cls, sums: FeatureSums, n_keyframes: int, forwards: bool, keep: bool, size: int, ends: np.ndarray) -> _Lives:
        """Groups of at most `size` keyframes that do not extend across `ends`; other arguments as of `plan`."""
        order = np.arange(n_keyframes) if forwards else np.arange(n_keyframes)[::-1]
        pivots = order[:-1] if keep else order
        stretches = np.split(pivots, np.flatnonzero(np.diff(np.searchsorted(ends, pivots, side="right"))) + 1)
        groups = [s[k : k + size] for s in stretches for k in range(0, len(s), size)]
        if keep:
            groups.append(order[:0])  # terms of the kept keyframe with features
        which = np.full(n_keyframes + 1, len(groups) - 1)
        for g, keyframes in enumerate(groups):
            which[keyframes] = g
        step = which[sums.keyframe]
        if len(sums.next_pose):
            step = np.minimum(step, which[sums.keyframe + 1])
        first, last = np.full(len(sums.diagonal), len(groups)), np.full(len(sums.diagonal), -1)
        np.minimum.at(first, sums.track, step[sums.image])
        np.maximum.at(last, sums.track, step[sums.image])
        without_keyframes = len(groups) - 1 if keep else -1
        local = (first == last) & (first != without_keyframes) & (len(sums.next_pose) == 0)
        return cls(groups, step, first, last, local)

    def cost(self, coupled: np.ndarray, dim: int, n_calib: int) -> float:
        """Cost of an elimination in multiplications, including memory traffic."""
        n, lasting = len(self.groups), ~self.local & (self.last >= 0)
        born = np.bincount(self.first[lasting], minlength=n)[:n]
        died = np.bincount(self.last[lasting], minlength=n)[:n]
        wide = n_calib + 3.0 * (np.cumsum(born) - np.cumsum(died) + died)
        keyframes = dim * np.array([len(g) for g in self.groups])
        meets = np.array([coupled[g].sum() + (dim - coupled[g[:1]]).sum() for g in self.groups])
        rank = meets + 3.0 * died
        small = keyframes**3 / 6.0 + keyframes**2 * n_calib / 2.0 + wide * rank**2 / 2.0
        moved = FRONT_MOVE_COST * wide**2 + FACTOR_MOVE_COST * (rank * wide + keyframes**2)
        return float((rank * wide**2 / 2.0 + SMALL_PRODUCT_COST * small + moved + STEP_COST).sum())


def plan(
    sums: FeatureSums,
    n_keyframes: int,
    forwards: bool,
    keep: bool,
    ends: np.ndarray = NO_TRACK_ENDS,
    sizes: tuple[int, ...] = GROUP_SIZES,
) -> Plan:
    """Steps that eliminate `n_keyframes` keyframes and all features; with `keep`, all but the last keyframe in this
    direction. ends: keyframes before which all features end; sizes: group sizes, of which the cheapest is taken."""
    n_dims = np.zeros(n_keyframes, dtype=np.int64)
    np.add.at(n_dims, sums.keyframe[np.unique(sums.image)], sums.pose.shape[1])
    coupled = np.minimum(n_dims, sums.dim) if not len(sums.next_pose) else np.full(n_keyframes, sums.dim)
    candidates = [_Lives.of(sums, n_keyframes, forwards, keep, s, ends) for s in sizes]
    lives = min(candidates, key=lambda x: x.cost(coupled, sums.dim, sums.side.shape[2]))
    return _steps(sums, lives, coupled, n_keyframes, forwards)


def _steps(sums: FeatureSums, lives: _Lives, coupled: np.ndarray, n_keyframes: int, forwards: bool) -> Plan:
    """The plan for the groups of `lives`."""
    groups, n = lives.groups, len(lives.groups)
    ends = np.cumsum([len(g) for g in groups])
    order = np.arange(n_keyframes) if forwards else np.arange(n_keyframes)[::-1]
    after = np.append(order, -1)[np.minimum(ends, n_keyframes)]
    coupled_dims = coupled.copy()
    for group in groups:
        coupled_dims[group[:1]] = sums.dim  # the step before coupled all of its dimensions
    coupled_dims[after[after >= 0]] = sums.dim
    tracks, in_front = np.arange(len(sums.diagonal)), ~lives.local
    slots = _slots(lives, n)
    step = np.where(in_front[sums.track], lives.step[sums.image], -1)
    pair = Lists.sorted_by(step, np.arange(len(step)), n)
    local = Lists.sorted_by(np.where(in_front, -1, lives.first), tracks, n)
    rank = np.full(len(tracks), -1)
    rank[local.values] = np.arange(len(local.values))
    local_pair = Lists.sorted_by(rank[sums.track], np.arange(len(step)), len(local.values))
    return Plan(
        Lists.of(groups),
        after,
        coupled_dims,
        slots.alive,
        Lists.of(slots.leave),
        Lists.of(slots.enter).values,
        Lists.of(slots.born),
        Lists.of(slots.born_at).values,
        Lists.of(slots.dying),
        pair,
        _places(slots, pair, sums.track, n),
        local,
        local_pair.start,
        local_pair.values,
    )


@dataclass(frozen=True)
class _Slots:
    """Slots in the front, by step, as in `Plan`: features that move, join (born) and leave (dying). at: feature in each
    slot."""

    alive: np.ndarray
    leave: list[np.ndarray]
    enter: list[np.ndarray]
    born: list[np.ndarray]
    born_at: list[np.ndarray]
    dying: list[np.ndarray]
    at: list[np.ndarray]


def _slots(lives: _Lives, n_steps: int) -> _Slots:
    """Assignment of slots without holes: features keep their slots; those beyond the new end move into holes."""
    lasting = ~lives.local
    born = Lists.sorted_by(np.where(lasting & (lives.last >= 0), lives.first, -1), np.arange(len(lasting)), n_steps)
    features, out = np.zeros(0, dtype=np.int64), _Slots(np.zeros(n_steps, dtype=np.int64), [], [], [], [], [], [])
    for g in range(n_steps):
        new = born.values[born.start[g] : born.start[g + 1]]
        stays = lives.last[features] >= g
        n = int(stays.sum()) + len(new)
        stay_at = np.flatnonzero(stays)
        now = np.full(n, -1)
        now[stay_at[stay_at < n]] = features[stay_at[stay_at < n]]
        leave, holes = stay_at[stay_at >= n], np.flatnonzero(now < 0)
        now[holes] = np.concatenate([features[leave], new])
        out.alive[g] = n
        out.leave.append(leave)
        out.enter.append(holes[: len(leave)])
        out.born.append(new)
        out.born_at.append(holes[len(leave) :])
        out.dying.append(np.flatnonzero(lives.last[now] == g))
        out.at.append(now)
        features = now
    return out


def _places(slots: _Slots, pair: Lists, track: np.ndarray, n_steps: int) -> np.ndarray:
    """(e,) slot in the front of the feature of each pair."""
    at, slot = np.full(int(track.max(initial=-1)) + 1, -1), np.empty(len(pair.values), dtype=np.int64)
    for g in range(n_steps):
        at[slots.at[g]] = np.arange(len(slots.at[g]))
        rows = slice(pair.start[g], pair.start[g + 1])
        slot[rows] = at[track[pair.values[rows]]]
    return slot


# Compiled back substitution for the elimination of keyframes and features (`front_kernels.py`).


@njit(cache=True, nogil=True)
def _solve_columns(U, X):
    """X (p, m) <- U^-1 X."""
    for j in range(X.shape[1]):
        solve_upper(U, X[:, j])


@njit(cache=True, nogil=True)
def substitute_all(plan, sizes, turn, workspace, calib, white, chain):
    """Back substitution: fills chain (n, D, m), whose kept keyframe is an input.

    calib (B + 1, m): steps of the calibration parameters; last row: factor of the gradient. white (rows, m): further
    right-hand sides after forward substitution, by step: uncoupled, coupled, dying.
    """
    n_b, dim, m, end = len(calib), chain.shape[1], calib.shape[1], len(white)
    solved = np.zeros((dim + sizes.wide.max(), m))
    solved[dim : dim + n_b] = calib
    for g in range(len(plan.after) - 1, -1, -1):
        a, c = sizes.uncoupled[g], sizes.coupled[g]
        U, Ud, D, Wr, Wc = step_factors(g, sizes, dim, n_b, workspace)
        begin = end - a - len(Wc)
        solved[:dim] = 0.0
        if plan.after[g] >= 0:
            solved[:dim] = chain[plan.after[g]]
        x = white[begin + a : end] - Wc @ solved[: Wc.shape[1]]
        _solve_columns(Ud, x[c:])
        z = np.empty((a + c, m))
        z[a:] = x[:c] - D @ x[c:]
        _solve_columns(U[a:, a:], z[a:])
        z[:a] = white[begin : begin + a] - Wr @ solved[: dim + n_b]
        for i in range(a):
            for j in range(a, a + c):
                for k in range(m):
                    z[i, k] -= U[i, j] * z[j, k]
        _solve_columns(U[:a, :a], z[:a])
        _take_back(g, plan, dim + n_b, x[c:], solved)
        _turn_back(g, plan, a, turn, z, chain)
        end = begin


@njit(cache=True, nogil=True)
def _take_back(g, plan, o, dying, solved):
    """Restores features to their slots before the step, in `solved`, where they start at row `o`."""
    for q in range(plan.dying.start[g], plan.dying.start[g + 1]):
        at, x = o + 3 * plan.dying.values[q], 3 * (q - plan.dying.start[g])
        solved[at : at + 3] = dying[x : x + 3]
    for q in range(plan.leave.start[g], plan.leave.start[g + 1]):
        a, b = o + 3 * plan.leave.values[q], o + 3 * plan.enter[q]
        solved[a : a + 3] = solved[b : b + 3]


@njit(cache=True, nogil=True)
def _turn_back(g, plan, uncoupled, turn, z, chain):
    """Fills the steps of the keyframes, rotated back to their own dimensions."""
    r, c, dim = 0, uncoupled, chain.shape[1]
    x = np.empty((dim, z.shape[1]))
    for q in range(plan.keyframes.start[g], plan.keyframes.start[g + 1]):
        k = plan.keyframes.values[q]
        n = plan.coupled[k]
        x[:n], x[n:] = z[c : c + n], z[r : r + dim - n]
        c, r = c + n, r + dim - n
        chain[k] = turn[k] @ x
