"""Normal equations of a chain of nodes with a dense border: an arrowhead, solved in time linear in the chain.

    [ T   E ] [chain ]     [g_chain ]      T: block tridiagonal, 15 x 15 blocks
    [ E^T C ] [border] = - [g_border]      E: chain x border, C: border x border

The chain is cut into pieces that share their end nodes. Each piece is accumulated and eliminated on its own, by its own
thread, towards the node that it shares with its neighbour; shared node and border are what is left at the end.
The number of pieces does not depend on the number of cores, so that the answer does not either.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from functools import cache
from itertools import pairwise
from typing import NamedTuple, TypeVar

import numpy as np
from numba import njit

from icalib.errors import EstimationError
from icalib.estimation import pages
from icalib.estimation.front import Eliminated, Features, eliminate
from icalib.estimation.front_plan import plan
from icalib.estimation.state import NODE
from icalib.geometry.small import cholesky

T = TypeVar("T")
THREADS = 2  # pieces of the chain; more would need separators of their own
SEGMENT = 512  # nodes at a time, where nothing is asked of the chain itself


@cache
def _pool() -> ThreadPoolExecutor:
    return ThreadPoolExecutor(THREADS, thread_name_prefix="icalib")


def in_parallel(function: Callable[..., T], items: Iterable) -> list[T]:
    """[function(item) for item in items], on two threads; kernels release the interpreter lock."""
    return list(_pool().map(function, items))


class Sums(NamedTuple):
    """What a kernel adds to: the arrays of the `Piece` that starts at node `first`, empty where only residuals are
    wanted."""

    first: int
    diagonal: np.ndarray
    upper: np.ndarray
    side: np.ndarray
    border: np.ndarray


@dataclass
class Piece:
    """J^T J and J^T r of the factors between nodes `first` and `last`, both included.

    diagonal (n, 15, 15); upper (n, 15, 15), node k with node k + 1; side (n, 15, B + 1), node with border, the node's
    gradient in the last column; border (B + 1, B + 1), the border's gradient in its last column; features: those that
    are seen from its nodes alone, to be eliminated with them.
    """

    first: int
    last: int
    diagonal: np.ndarray
    upper: np.ndarray
    side: np.ndarray
    border: np.ndarray
    features: Features | None = None

    @classmethod
    def zeros(cls, first: int, last: int, n_border: int) -> Piece:
        n = last - first + 1
        return cls(
            first,
            last,
            pages.zeros((n, NODE, NODE)),
            pages.zeros((n, NODE, NODE)),
            pages.zeros((n, NODE, n_border + 1)),
            np.zeros((n_border + 1, n_border + 1)),
        )

    @classmethod
    def bare(cls, first: int, last: int) -> Piece:
        """For residuals alone: nothing to add to."""
        nothing = np.zeros((0, NODE, NODE))
        return cls(first, last, nothing, nothing, nothing, np.zeros((0, 0)))

    def clear(self) -> None:
        for a in (self.diagonal, self.upper, self.side, self.border):
            a[:] = 0.0
        if self.features is not None:
            self.features.sums.clear()

    def without_last(self) -> Piece:
        """The same sums without node `last`, of which they must say nothing."""
        features = self.features
        if features is not None:
            features = Features.of(features.sums, plan(features.sums, len(self.diagonal) - 1, True, False))
        own = self.diagonal[:-1], self.upper[:-1], self.side[:-1]
        return Piece(self.first, self.last - 1, *own, self.border, features)

    def sums(self, wanted: bool) -> Sums:
        """For a kernel to add to; empty where only residuals are wanted."""
        piece = self if wanted else Piece.bare(self.first, self.last)
        return Sums(piece.first, piece.diagonal, piece.upper, piece.side, piece.border)


def chain_cuts(n_nodes: int) -> tuple[int, ...]:
    """The nodes that two pieces share: the middle one; none where the chain is too short."""
    middle = n_nodes // 2
    return () if middle < 2 else (middle,)


def make_pieces(n_nodes: int, n_border: int | None) -> tuple[Piece, ...]:
    """Two pieces of about the same length; one where the chain is too short to share. Without a border, bare ones."""
    ends = (0, *chain_cuts(n_nodes), n_nodes - 1)
    if n_border is not None:
        pages.give_back()  # there is no moment at which more is needed
    return tuple(
        Piece.bare(a, b) if n_border is None else Piece.zeros(a, b, n_border) for a, b in pairwise(ends)
    )  # fmt: skip


@njit(cache=True, nogil=True)
def _forward_solve(L, X):
    """X <- L^-1 X."""
    for i in range(L.shape[0]):
        for k in range(i):
            f = L[i, k]
            for j in range(X.shape[1]):
                X[i, j] -= f * X[k, j]
        f = 1.0 / L[i, i]
        for j in range(X.shape[1]):
            X[i, j] *= f


@njit(cache=True, nogil=True)
def _subtract_product(A, B, X):
    """X <- X - A^T B."""
    for k in range(A.shape[0]):
        for i in range(A.shape[1]):
            f = A[k, i]
            if f != 0.0:
                for j in range(B.shape[1]):
                    X[i, j] -= f * B[k, j]


@njit(cache=True, nogil=True)
def _eliminate(diagonal, upper, side, forwards, keep):
    """Factorises in place from one end to the other; with `keep`, the last node is only updated. False: not definite.

    Afterwards diagonal holds L_k, link (upper, turned when running backwards) L_k^-1 T[k, next], side L_k^-1 side.
    """
    n = diagonal.shape[0]
    for step in range(n):
        k = step if forwards else n - 1 - step
        if step == n - 1 and keep:
            return True
        if not cholesky(diagonal[k]):
            return False
        _forward_solve(diagonal[k], side[k])
        if step < n - 1:
            after = k + 1 if forwards else k - 1
            link = upper[k] if forwards else upper[k - 1].T.copy()
            _forward_solve(diagonal[k], link)
            if not forwards:
                upper[k - 1] = link
            _subtract_product(link, link, diagonal[after])
            _subtract_product(link, side[k], side[after])
    return True


@njit(cache=True, nogil=True)
def _substitute(diagonal, upper, side, forwards, keep, border, chain):
    """Back substitution: fills chain (n, 15) from the border step and, with `keep`, the last node's step in it."""
    n = diagonal.shape[0]
    B = side.shape[2] - 1
    for step in range(n - 2 if keep else n - 1, -1, -1):
        k = step if forwards else n - 1 - step
        L = diagonal[k]
        for i in range(L.shape[0]):
            s = side[k, i, B]
            for j in range(B):
                s += side[k, i, j] * border[j]
            chain[k, i] = -s
        if step < n - 1:
            after = k + 1 if forwards else k - 1
            link = upper[k] if forwards else upper[k - 1]
            for i in range(L.shape[0]):
                for j in range(L.shape[0]):
                    chain[k, i] -= link[i, j] * chain[after, j]
        for i in range(L.shape[0] - 1, -1, -1):
            s = chain[k, i]
            for j in range(i + 1, L.shape[0]):
                s -= L[j, i] * chain[k, j]
            chain[k, i] = s / L[i, i]


@njit(cache=True, nogil=True)
def _damp(diagonal, damping):
    for k in range(diagonal.shape[0]):
        for i in range(diagonal.shape[1]):
            diagonal[k, i, i] *= 1.0 + damping


@dataclass(frozen=True)
class Solution:
    """Step (chain (K, 15), border (B,)), `decrease` of half the chi^2 that the linear model predicts, and the
    `information` (B, B) of the border, the chain marginalised (damping included)."""

    chain: np.ndarray
    border: np.ndarray
    decrease: float
    information: np.ndarray


BROKEN_DOWN = (
    "the estimate broke down: from where it started the measurements do not determine the motion; give rough "
    "extrinsics, time offsets and intrinsics in the rig file."
)


class NotDefiniteError(EstimationError):
    """The normal equations are not positive definite: something is not determined, or damping is too small."""


def _eliminated_part(piece: Piece, keep: bool) -> np.ndarray:
    """(B + 1, B + 1) what the eliminated chain of a piece, but for a kept end node, takes from the border."""
    rows = piece.side
    if keep:
        rows = rows[:-1] if piece.first == 0 else rows[1:]
    flat = rows.reshape(-1, rows.shape[2])
    return flat.T @ flat


def _reduce(piece: Piece, keep: bool) -> Eliminated | bool:
    """Eliminates a piece in place, but for a kept end node: that node's sums and the border's are left. False: not
    definite."""
    forwards = piece.first == 0 or not keep
    if piece.features is None:
        done = _eliminate(piece.diagonal, piece.upper, piece.side, forwards, keep)
        if done:
            piece.border -= _eliminated_part(piece, keep)
        return done
    done = eliminate(piece.features, piece.diagonal, piece.upper, piece.side, forwards, keep)
    if done is None:
        return False
    left = np.triu(done.left) + np.triu(done.left, 1).T
    kept = NODE if keep else 0
    piece.border += left[kept:, kept:]
    if keep:
        end = -1 if forwards else 0
        piece.diagonal[end] += left[:NODE, :NODE]
        piece.side[end] += left[:NODE, NODE:]
    return done


def marginalise(piece: Piece) -> np.ndarray:
    """Border (B + 1, B + 1) with all nodes of `piece` eliminated; overwrites the piece. Raises NotDefiniteError."""
    if not _reduce(piece, False):
        raise NotDefiniteError(BROKEN_DOWN)
    return piece.border


def marginalise_in_segments(piece: Callable[[int, int], Piece], n_nodes: int) -> np.ndarray:
    """As `marginalise`, of a whole chain whose `piece` from one node to another is made when it is its turn, so that
    the chain never lies in memory as a whole."""
    ends = [*range(0, n_nodes - 1, SEGMENT), n_nodes - 1]
    spans, rest = list(pairwise(ends)), None
    for k in range(0, len(spans), THREADS):
        for own in in_parallel(lambda span: piece(*span), spans[k : k + THREADS]):
            if rest is not None:
                own.diagonal[0] += rest.diagonal[0]
                own.side[0] += rest.side[0]
                own.border += rest.border
            rest = _onto_last(own)
    return marginalise(piece(0, 0) if rest is None else rest)


def _onto_last(piece: Piece) -> Piece:
    """The last node and the border, all other nodes eliminated. Raises NotDefiniteError."""
    if not _eliminate(piece.diagonal, piece.upper, piece.side, True, True):
        raise NotDefiniteError(BROKEN_DOWN)
    last = Piece.zeros(piece.last, piece.last, piece.side.shape[2] - 1)
    last.diagonal[0], last.side[0] = piece.diagonal[-1], piece.side[-1]
    flat = piece.side[:-1].reshape(-1, piece.side.shape[2])
    last.border[:] = piece.border - flat.T @ flat
    return last


HELD_BELOW = 1e-2  # information in tolerance units: a direction known to less than ten tolerances stays where it is


LEAST = 1e-4  # of information in tolerance units; keeps variances finite
NOTHING = np.zeros((0, 0))


def border_step(
    information: np.ndarray, gradient: np.ndarray, tolerance: np.ndarray, held: np.ndarray = NOTHING
) -> tuple[np.ndarray, float]:
    """Step (B,) of the border and the decrease of half the chi^2 it promises; undetermined directions are held, and
    those in the columns of `held` (B, m), orthonormal.

    Directions are those of the information in units of `tolerance` (B,).
    """
    scaled, g = information * tolerance[:, None] * tolerance, tolerance * gradient
    free = complement(held, len(tolerance))
    values, vectors = np.linalg.eigh(free.T @ scaled @ free)
    projected = vectors.T @ (free.T @ g)
    step = np.where(values > HELD_BELOW, -projected / np.maximum(values, HELD_BELOW), 0.0)
    return tolerance * (free @ (vectors @ step)), float(-0.5 * projected @ step)


def complement(held: np.ndarray, n: int) -> np.ndarray:
    """(n, n - m) orthonormal columns, all at right angles to those of `held` (n, m)."""
    if not held.size:
        return np.eye(n)
    full, _, _ = np.linalg.svd(held, full_matrices=True)
    return full[:, held.shape[1] :]


def restricted_inverse(information: np.ndarray, held: np.ndarray) -> np.ndarray:
    """(B, B) inverse of the information within the directions that are not held, both in tolerance units."""
    free = complement(held, len(information))
    values, vectors = np.linalg.eigh(free.T @ information @ free)
    basis = free @ vectors
    return (basis / np.maximum(values, LEAST)) @ basis.T


def _back(piece: Piece, done: Eliminated | bool, keep: bool, border: np.ndarray, chain: np.ndarray) -> None:
    """Fills the part of `chain` (K, 15) that belongs to a piece, from the border's step and the kept node's."""
    own = chain[piece.first : piece.last + 1]
    if isinstance(done, Eliminated):
        done.substitute(border, own)
    else:
        _substitute(piece.diagonal, piece.upper, piece.side, piece.first == 0, keep, border, own)


def solve(
    pieces: tuple[Piece, ...], n_nodes: int, tolerance: np.ndarray, damping: float = 0.0, held: np.ndarray = NOTHING
) -> Solution:
    """Solves (H + damping diag(H)) step = -gradient, directions of the border in `held` left alone (see border_step);
    overwrites the pieces. Raises NotDefiniteError."""
    keep = len(pieces) > 1
    n_border = len(tolerance)
    scale = np.append(np.full(n_border, damping), 0.0)
    extra = np.diag(scale * sum((p.border.diagonal() for p in pieces), np.zeros(n_border + 1)))
    if damping:
        for piece in pieces:
            _damp(piece.diagonal, damping)
    done = in_parallel(lambda p: _reduce(p, keep), pieces)
    if not all(done):
        raise NotDefiniteError(BROKEN_DOWN)
    rest = sum((p.border for p in pieces), extra)
    shared, shared_side = np.zeros((0, 0)), np.zeros((0, n_border + 1))
    if keep:
        shared = pieces[0].diagonal[-1] + pieces[1].diagonal[0]
        shared_side = pieces[0].side[-1] + pieces[1].side[0]
        if not cholesky(shared):
            raise NotDefiniteError(BROKEN_DOWN)
        _forward_solve(shared, shared_side)
        rest -= shared_side.T @ shared_side
    information = rest[:n_border, :n_border]
    border, decrease = border_step(information, rest[:n_border, n_border], tolerance, held)
    chain = np.zeros((n_nodes, NODE))
    if keep:
        rhs = -(shared_side[:, -1] + shared_side[:, :-1] @ border)
        chain[pieces[0].last] = np.linalg.solve(np.tril(shared).T, rhs)
    in_parallel(lambda p: _back(p[0], p[1], keep, border, chain), zip(pieces, done, strict=True))
    return Solution(chain, border, decrease - 0.5 * float(rest[n_border, n_border]), information)
