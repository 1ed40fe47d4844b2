"""Elimination of a chain whose nodes are tied together by features, each seen from many nodes (paper (15), Schur).

Nodes are eliminated in groups, from one end of the piece to the other. A feature joins the front at the first group
that sees it, and is eliminated with the last one: the answer is exact however long it lives. The cost per group grows
with the square of the number of features that are alive there.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numba import njit

from icalib.estimation.state import NODE

GROUP = 8  # nodes eliminated at a time: fewer waste calls, more waste zeros (measured: 6 and 10 are within 5 %)
PANEL = 48  # rows of a triangular solve at a time


class FeatureSums(NamedTuple):
    """What features add to the normal equations of a `Piece`: own (T, 3, 3); side (T, 3, B + 1), feature with border,
    its gradient in the last column; block (E, 3, 15), feature with node, of each pair that meets. track (E,) and node
    (E,) of these pairs, tracks and nodes counted from the first of the piece."""

    own: np.ndarray
    side: np.ndarray
    block: np.ndarray
    track: np.ndarray
    node: np.ndarray

    @classmethod
    def zeros(cls, n_tracks: int, track: np.ndarray, node: np.ndarray, n_border: int) -> FeatureSums:
        n_pairs = len(track)
        return cls(
            np.zeros((n_tracks, 3, 3)), np.zeros((n_tracks, 3, n_border + 1)), np.zeros((n_pairs, 3, NODE)), track, node
        )  # fmt: skip

    def clear(self) -> None:
        for a in (self.own, self.side, self.block):
            a[:] = 0.0


class Group(NamedTuple):
    """One step of the elimination: `nodes`, in order, and features `dying` (d,) are its pivots; what is left is the
    node `after` them (-1: none), `surviving` features (s,), and the border.

    Positions are counted in that order. carried (c,): where what the step before left stands now; born (b,): features
    that join, and their positions born_at; pair (e,): pairs of feature and node, their positions row (node), column.
    """

    nodes: np.ndarray
    after: int
    dying: np.ndarray
    surviving: np.ndarray
    carried: np.ndarray
    born: np.ndarray
    born_at: np.ndarray
    pair: np.ndarray
    row: np.ndarray
    column: np.ndarray


def plan(sums: FeatureSums, n_nodes: int, forwards: bool, keep: bool, size: int = GROUP) -> list[Group]:
    """Steps that eliminate `n_nodes` nodes and all features; with `keep`, all but the last node in this direction."""
    order = np.arange(n_nodes) if forwards else np.arange(n_nodes)[::-1]
    pivots = order[:-1] if keep else order
    groups = [pivots[k : k + size] for k in range(0, len(pivots), size)]
    if keep:
        groups.append(order[:0])  # what still ties the kept node to features
    which = np.zeros(n_nodes, dtype=np.int64)
    for g, nodes in enumerate(groups):
        which[nodes] = g
    if keep:
        which[order[-1]] = len(groups) - 1
    n_tracks = len(sums.own)
    first, last = np.full(n_tracks, len(groups)), np.full(n_tracks, -1)
    np.minimum.at(first, sums.track, which[sums.node])
    np.maximum.at(last, sums.track, which[sums.node])
    pairs = np.argsort(which[sums.node], kind="stable")
    ends = np.searchsorted(which[sums.node][pairs], np.arange(len(groups) + 1))
    steps, alive = [], np.zeros(0, dtype=np.int64)
    for g, nodes in enumerate(groups):
        after = int(order[g * size + len(nodes)]) if g * size + len(nodes) < n_nodes else -1
        if keep and g == len(groups) - 1:
            after = int(order[-1])
        born = np.flatnonzero(first == g)
        steps.append(_group(sums, nodes, after, alive, born, last == g, pairs[ends[g] : ends[g + 1]], g == 0))
        alive = steps[-1].surviving
    return steps


def _group(
    sums: FeatureSums,
    nodes: np.ndarray,
    after: int,
    alive: np.ndarray,
    born: np.ndarray,
    dies: np.ndarray,
    pair: np.ndarray,
    starts: bool,
) -> Group:
    """The step of `nodes`, where features `alive` were carried from the one before and `born` join."""
    here = np.concatenate([alive, born])
    dying, surviving = here[dies[here]], here[~dies[here]]
    own, kept = NODE * len(nodes), NODE if after >= 0 else 0
    at = np.full(len(sums.own), -1)
    at[dying] = own + 3 * np.arange(len(dying))
    at[surviving] = own + 3 * len(dying) + kept + 3 * np.arange(len(surviving))
    of_node = np.full((max(int(nodes.max(initial=0)), after) + 1), -1)
    of_node[nodes] = NODE * np.arange(len(nodes))
    if after >= 0:
        of_node[after] = own + 3 * len(dying)
    first = of_node[nodes[0]] if len(nodes) else of_node[after]
    carried = np.zeros(0, dtype=np.int64)
    if not starts:
        carried = np.concatenate([first + np.arange(NODE), (at[alive][:, None] + np.arange(3)).ravel()])
    return Group(
        nodes, after, dying, surviving, carried, born, at[born], pair, of_node[sums.node[pair]], at[sums.track[pair]]
    )  # fmt: skip


@njit(cache=True, nogil=True)
def _fill(M, group, carry, diagonal, upper, side, forwards, sums, n_border):
    """The upper triangle of M: what was carried, then nodes, features and their pairs."""
    o, c = M.shape[0] - n_border, len(group.carried)
    for i in range(c):
        a = group.carried[i]
        for j in range(i, c):
            b = group.carried[j]
            M[min(a, b), max(a, b)] += carry[i, j]
        for j in range(n_border):
            M[a, o + j] += carry[i, c + j]
    for i in range(n_border if len(carry) else 0):
        for j in range(i, n_border):
            M[o + i, o + j] += carry[c + i, c + j]
    n, d = len(group.nodes), 15 * len(group.nodes) + 3 * len(group.dying)
    for q in range(n):
        k = group.nodes[q]
        other = 15 * (q + 1) if q + 1 < n else d
        tied = q + 1 < n or group.after >= 0
        for i in range(15):
            for j in range(i, 15):
                M[15 * q + i, 15 * q + j] += diagonal[k, i, j]
            for j in range(n_border):
                M[15 * q + i, o + j] += side[k, i, j]
            if tied:
                for j in range(15):
                    M[15 * q + i, other + j] += upper[k, i, j] if forwards else upper[k - 1, j, i]
    for q in range(len(group.born)):
        f, a = group.born[q], group.born_at[q]
        for i in range(3):
            for j in range(i, 3):
                M[a + i, a + j] += sums.own[f, i, j]
            for j in range(n_border):
                M[a + i, o + j] += sums.side[f, i, j]
    for q in range(len(group.pair)):
        e, a, b = group.pair[q], group.row[q], group.column[q]
        for i in range(15):
            for j in range(3):
                x, y = a + i, b + j
                M[min(x, y), max(x, y)] += sums.block[e, j, i]


@njit(cache=True, nogil=True)
def _forward_panel(L, X):
    """X <- L^-1 X."""
    for i in range(L.shape[0]):
        for k in range(i):
            f = L[i, k]
            for j in range(X.shape[1]):
                X[i, j] -= f * X[k, j]
        f = 1.0 / L[i, i]
        for j in range(X.shape[1]):
            X[i, j] *= f


def forward_solve(L: np.ndarray, X: np.ndarray) -> None:
    """X <- L^-1 X, the most of it as matrix products, which let other threads run (LAPACK's wrappers do not)."""
    for a in range(0, len(L), PANEL):
        b = min(a + PANEL, len(L))
        if a:
            X[a:b] -= L[a:b, :a] @ X[:a]
        _forward_panel(L[a:b, a:b], X[a:b])


@dataclass(frozen=True)
class Features:
    """Those of a `Piece`: their sums, and the steps in which nodes and features are eliminated."""

    sums: FeatureSums
    steps: list[Group]

    def widened(self, n_border: int) -> Features:
        """The same with further columns of the border, between those there are and the gradient; zero, this too."""
        side = self.sums.side
        wide = np.zeros((*side.shape[:2], n_border + 1))
        wide[:, :, : side.shape[2] - 1] = side[:, :, :-1]
        return Features(self.sums._replace(side=wide), self.steps)


@dataclass(frozen=True)
class Eliminated:
    """factor (p, p) and rest (p, N - p) of each step, and what is `left` (15 or 0 + B + 1): the kept node and the
    border, upper triangle."""

    steps: list[Group]
    factors: list[np.ndarray]
    rests: list[np.ndarray]
    left: np.ndarray

    def substitute(self, border: np.ndarray, chain: np.ndarray) -> None:
        """Back substitution: fills `chain` (n, 15), of which the kept node is given, from the border's step (B,)."""
        features = np.zeros((1 + max((int(s.dying.max(initial=-1)) for s in self.steps), default=-1), 3))
        for step, L, W in zip(reversed(self.steps), reversed(self.factors), reversed(self.rests), strict=True):
            after = chain[step.after] if step.after >= 0 else np.zeros(0)
            known = np.concatenate([after, features[step.surviving].ravel(), border, [1.0]])
            x = -(W @ known)
            _backward(L, x)
            n = NODE * len(step.nodes)
            chain[step.nodes] = x[:n].reshape(-1, NODE)
            features[step.dying] = x[n:].reshape(-1, 3)


@njit(cache=True, nogil=True)
def _backward(L, x):
    """x <- L^-T x."""
    for i in range(len(x) - 1, -1, -1):
        x[i] /= L[i, i]
        for k in range(i):
            x[k] -= L[i, k] * x[i]


def eliminate(
    steps: list[Group],
    diagonal: np.ndarray,
    upper: np.ndarray,
    side: np.ndarray,
    sums: FeatureSums,
    forwards: bool,
) -> Eliminated | None:
    """All steps; None where the sums are not positive definite."""
    n_border = side.shape[2]
    carry, factors, rests = np.zeros((0, 0)), [], []
    for step in steps:
        p = NODE * len(step.nodes) + 3 * len(step.dying)
        size = p + (NODE if step.after >= 0 else 0) + 3 * len(step.surviving) + n_border
        M = np.zeros((size, size))
        _fill(M, step, carry, diagonal, upper, side, forwards, sums, n_border)
        try:
            L = np.linalg.cholesky(M[:p, :p].T)
        except np.linalg.LinAlgError:
            return None
        if not np.isfinite(L.diagonal()).all():
            return None
        W = M[:p, p:].copy()
        forward_solve(L, W)
        factors.append(L)
        rests.append(W)
        carry = M[p:, p:] - W.T @ W
    return Eliminated(steps, factors, rests, carry)
