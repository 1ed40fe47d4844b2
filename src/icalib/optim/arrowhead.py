"""Normal equations of a chain of keyframes with dense calibration parameters: an arrowhead matrix, solved in time
linear in the length of the chain.

    [ T   E ] [chain ]     [g_chain ]      T: block tridiagonal, 15 x 15 blocks
    [ E^T C ] [calib ] = - [g_calib ]      E: chain x calib, C: calib x calib

The chain is cut into pieces that share their end keyframes. Each piece is accumulated and eliminated by its own thread,
towards the keyframe that it shares. Shared keyframe and calibration parameters remain at the end. The number of pieces
does not depend on the number of cores, and so neither does the result.
"""

from __future__ import annotations

import os
from collections.abc import Callable, Iterable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from functools import cache
from itertools import pairwise
from typing import NamedTuple, TypeVar

import numpy as np

from icalib.errors import EstimationError
from icalib.geometry.small import cholesky
from icalib.optim import memory
from icalib.optim.calib_block import NO_DIRECTIONS, calib_draws, calib_step
from icalib.optim.chain_kernels import damp, eliminate_chain, forward_solve, substitute_chain
from icalib.optim.front import Eliminated, PieceFeatures, eliminate
from icalib.optim.front_plan import plan
from icalib.optim.state import KEYFRAME_DIM

T = TypeVar("T")
N_THREADS = 2  # one per piece of the chain; more pieces would need more separators
SEGMENT_KEYFRAMES = 512  # keyframes per segment of `marginalise_in_segments`: bounds memory


@cache
def _pool() -> ThreadPoolExecutor:
    return ThreadPoolExecutor(N_THREADS, thread_name_prefix="icalib")


if hasattr(os, "register_at_fork"):  # threads do not survive a fork
    os.register_at_fork(after_in_child=_pool.cache_clear)


def in_parallel(function: Callable[..., T], items: Iterable) -> list[T]:
    """[function(item) for item in items], on N_THREADS threads; compiled kernels release the interpreter lock."""
    return list(_pool().map(function, items))


class Sums(NamedTuple):
    """Arrays of the `Piece` that starts at keyframe `first`, for kernels to add to; empty if only residuals are
    computed."""

    first: int
    diagonal: np.ndarray
    upper: np.ndarray
    side: np.ndarray
    calib: np.ndarray


@dataclass
class Piece:
    """J^T J and J^T r of the factors between keyframes `first` and `last`, both included; n = last - first + 1.

    diagonal (n, 15, 15); upper (n, 15, 15), keyframe k with k + 1; side (n, 15, B + 1), keyframe with calibration
    parameters, and its gradient in the last column; calib (B + 1, B + 1), the calibration parameters and their gradient
    in the last column. features: feature tracks seen from these keyframes only, which are eliminated with them; None
    without any.
    """

    first: int
    last: int
    diagonal: np.ndarray
    upper: np.ndarray
    side: np.ndarray
    calib: np.ndarray
    features: PieceFeatures | None = None

    @classmethod
    def zeros(cls, first: int, last: int, n_calib: int) -> Piece:
        """A piece with all sums zero, for B = `n_calib` calibration parameters."""
        n = last - first + 1
        return cls(
            first,
            last,
            memory.mmap_zeros((n, KEYFRAME_DIM, KEYFRAME_DIM)),
            memory.mmap_zeros((n, KEYFRAME_DIM, KEYFRAME_DIM)),
            memory.mmap_zeros((n, KEYFRAME_DIM, n_calib + 1)),
            np.zeros((n_calib + 1, n_calib + 1)),
        )

    @classmethod
    def bare(cls, first: int, last: int) -> Piece:
        """A piece for residuals alone, with empty arrays."""
        nothing = np.zeros((0, KEYFRAME_DIM, KEYFRAME_DIM))
        return cls(first, last, nothing, nothing, nothing, np.zeros((0, 0)))

    def clear(self) -> None:
        """Sets all sums to zero."""
        for a in (self.diagonal, self.upper, self.side, self.calib):
            a[:] = 0.0
        if self.features is not None:
            self.features.sums.clear()

    def without_last(self) -> Piece:
        """The same sums without keyframe `last`, to which no factor may have added."""
        features = self.features
        if features is not None:
            features = PieceFeatures.of(features.sums, plan(features.sums, len(self.diagonal) - 1, True, False))
        sums = self.diagonal[:-1], self.upper[:-1], self.side[:-1]
        return Piece(self.first, self.last - 1, *sums, self.calib, features)

    def sums(self, wanted: bool) -> Sums:
        """The arrays for kernels; empty unless `wanted`."""
        piece = self if wanted else Piece.bare(self.first, self.last)
        return Sums(piece.first, piece.diagonal, piece.upper, piece.side, piece.calib)


def chain_cuts(n_keyframes: int) -> tuple[int, ...]:
    """Keyframes that two pieces share: the middle one, or none if the chain is too short."""
    middle = n_keyframes // 2
    return () if middle < 2 else (middle,)


def make_pieces(n_keyframes: int, n_calib: int | None) -> tuple[Piece, ...]:
    """Two pieces of about equal length, or one if the chain is too short. `n_calib` None: pieces for residuals
    alone."""
    ends = (0, *chain_cuts(n_keyframes), n_keyframes - 1)
    if n_calib is not None:
        memory.trim_heap()  # memory peaks here
    return tuple(Piece.bare(a, b) if n_calib is None else Piece.zeros(a, b, n_calib) for a, b in pairwise(ends))


@dataclass(frozen=True)
class Draw:
    """A draw from the posterior, as a step: chain (K, 15), calib (B,)."""

    chain: np.ndarray
    calib: np.ndarray


@dataclass(frozen=True)
class Factors:
    """Cholesky factors of the block elimination, for back substitution and sampling.

    pieces: overwritten by their factors; eliminations: per piece, see `_reduce`. shared (15, 15), shared_side (15, B +
    1): factors of the shared keyframe, empty without one. information (B, B): of the calibration parameters, chain
    marginalised. tolerance, fixed_directions, essential: see `calib_step`.
    """

    pieces: tuple[Piece, ...]
    eliminations: list[Eliminated | bool]
    n_keyframes: int
    shared: np.ndarray
    shared_side: np.ndarray
    information: np.ndarray
    tolerance: np.ndarray
    fixed_directions: np.ndarray
    essential: np.ndarray | None = None

    def back(self, calib: np.ndarray, white: list[np.ndarray]) -> np.ndarray:
        """Back substitution of m right-hand sides: steps (K, 15, m) of the keyframes.

        calib (B + 1, m): steps of the calibration parameters; last row: factor of the gradient (1 solves, 0 samples).
        white: further right-hand sides after forward substitution, per piece, then of the shared keyframe.
        """
        m = calib.shape[1]
        chain = np.zeros((self.n_keyframes, KEYFRAME_DIM, m))
        if len(self.shared):
            chain[self.pieces[0].last] = np.linalg.solve(np.tril(self.shared).T, white[-1] - self.shared_side @ calib)
        keep = len(self.shared) > 0
        tasks = list(zip(self.pieces, self.eliminations, white, strict=False))
        in_parallel(lambda p: _back(p[0], p[1], p[2], keep, calib, chain), tasks)
        return chain

    def rows(self) -> list[int]:
        """Number of unknowns of each piece, then of the shared keyframe."""
        return [*(_unknowns(p, d) for p, d in zip(self.pieces, self.eliminations, strict=True)), len(self.shared)]

    def draws(self, rng: np.random.Generator, free: int, still: int) -> tuple[Draw, ...]:
        """Draws from the posterior, before the pieces are filled anew. In the first `free` ones the calibration
        parameters vary in their observable directions; in the next `still` ones all of them are fixed."""
        m = free + still
        calib = np.zeros((len(self.tolerance) + 1, m))
        white = rng.standard_normal((len(self.tolerance), free))
        calib[:-1, :free] = calib_draws(self.information, self.tolerance, self.fixed_directions, white, self.essential)
        chain = self.back(calib, [rng.standard_normal((n, m)) for n in self.rows()])
        return tuple(Draw(np.ascontiguousarray(chain[:, :, k]), calib[:-1, k].copy()) for k in range(m))


@dataclass(frozen=True)
class Solution:
    """Step (chain (K, 15), calib (B,)), predicted decrease of half the chi^2, and the Cholesky factors.

    gradient (B + 1,): of the calibration parameters, chain marginalised; last element: minus twice the decrease of half
    the chi^2 by the chain alone.
    """

    chain: np.ndarray
    calib: np.ndarray
    decrease: float
    gradient: np.ndarray
    factors: Factors

    @classmethod
    def of(cls, factors: Factors, gradient: np.ndarray) -> Solution:
        """The step, from the factors and the `gradient` (B + 1,) of the calibration parameters."""
        calib, decrease = calib_step(
            factors.information, gradient[:-1], factors.tolerance, factors.fixed_directions, factors.essential
        )
        white = [np.zeros((n, 1)) for n in factors.rows()]
        chain = factors.back(np.append(calib, 1.0)[:, None], white)[:, :, 0]
        return cls(np.ascontiguousarray(chain), calib, decrease - 0.5 * float(gradient[-1]), gradient, factors)

    @property
    def information(self) -> np.ndarray:
        """(B, B) of the calibration parameters, chain marginalised, damping included."""
        return self.factors.information

    def less(self, information: np.ndarray, gradient: np.ndarray) -> Solution:
        """The solution without terms that have this information (B, B) and gradient (B,) on the calibration parameters.
        Must be called before the pieces are filled anew."""
        factors = replace(self.factors, information=self.information - information)
        return Solution.of(factors, self.gradient - np.append(gradient, 0.0))


NOT_DEFINITE = (
    "the estimate failed, because from its initial guess the measurements do not determine the motion; give "
    "rough extrinsics, time offsets and intrinsics in the rig file."
)


class NotDefiniteError(EstimationError):
    """The normal equations are not positive definite: a parameter is unobservable, or damping is too small."""


def _eliminated_part(piece: Piece, keep: bool) -> np.ndarray:
    """Schur complement term (B + 1, B + 1) that the eliminated keyframes of a piece subtract from the calibration
    parameters; `keep`: one end keyframe is not eliminated."""
    rows = piece.side
    if keep:
        rows = rows[:-1] if piece.first == 0 else rows[1:]
    flat = rows.reshape(-1, rows.shape[2])
    return flat.T @ flat


def _reduce(piece: Piece, keep: bool) -> Eliminated | bool:
    """Eliminates a piece in place, but for a kept end keyframe. Sums of that keyframe and of the calibration parameters
    remain.

    Returns `Eliminated` for a piece with features. Without features, returns True, and the factors are in the piece's
    own arrays. Returns False if the sums are not positive definite.
    """
    forwards = piece.first == 0 or not keep
    if piece.features is None:
        elimination = eliminate_chain(piece.diagonal, piece.upper, piece.side, forwards, keep)
        if elimination:
            piece.calib -= _eliminated_part(piece, keep)
        return elimination
    elimination = eliminate(piece.features, piece.diagonal, piece.upper, piece.side, forwards, keep)
    if elimination is None:
        return False
    remaining = np.triu(elimination.remaining) + np.triu(elimination.remaining, 1).T
    kept = KEYFRAME_DIM if keep else 0
    piece.calib += remaining[kept:, kept:]
    if keep:
        end = -1 if forwards else 0
        piece.diagonal[end] += remaining[:KEYFRAME_DIM, :KEYFRAME_DIM]
        piece.side[end] += remaining[:KEYFRAME_DIM, KEYFRAME_DIM:]
    return elimination


def _reduce_all(piece: Piece) -> Eliminated | bool:
    """Eliminates all keyframes of a piece in place; see `_reduce` for the result. Raises NotDefiniteError."""
    elimination = _reduce(piece, False)
    if not elimination:
        raise NotDefiniteError(NOT_DEFINITE)
    return elimination


def _unknowns(piece: Piece, elimination: Eliminated | bool) -> int:
    """Number of eliminated unknowns of a piece; without features, a kept end keyframe counts too."""
    return elimination.rows if isinstance(elimination, Eliminated) else len(piece.diagonal) * KEYFRAME_DIM


def marginalise(piece: Piece) -> np.ndarray:
    """System (B + 1, B + 1) of the calibration parameters and their gradient, all keyframes of `piece` eliminated;
    overwrites the piece. Raises NotDefiniteError."""
    _reduce_all(piece)
    return piece.calib


def chain_step_given_calib(piece: Piece, calib: np.ndarray) -> np.ndarray:
    """Optimal steps (n, 15, m) of the keyframes of `piece` for given steps (B, m) of the calibration parameters;
    overwrites the piece. Raises NotDefiniteError."""
    elimination, m = _reduce_all(piece), calib.shape[1]
    chain = np.zeros((piece.last + 1, KEYFRAME_DIM, m))
    _back(
        piece,
        elimination,
        np.zeros((_unknowns(piece, elimination), m)),
        False,
        np.vstack([calib, np.ones((1, m))]),
        chain,
    )
    return chain[piece.first :]


def marginalise_in_segments(piece: Callable[[int, int], Piece], n_keyframes: int) -> np.ndarray:
    """As `marginalise`, for a chain of `n_keyframes` that is built and eliminated a segment at a time, to bound memory.
    `piece` makes the piece between two keyframes."""
    ends = [*range(0, n_keyframes - 1, SEGMENT_KEYFRAMES), n_keyframes - 1]
    spans, last_keyframe = list(pairwise(ends)), None
    for k in range(0, len(spans), N_THREADS):
        for segment in in_parallel(lambda span: piece(*span), spans[k : k + N_THREADS]):
            if last_keyframe is not None:
                segment.diagonal[0] += last_keyframe.diagonal[0]
                segment.side[0] += last_keyframe.side[0]
                segment.calib += last_keyframe.calib
            last_keyframe = _onto_last(segment)
    return marginalise(piece(0, 0) if last_keyframe is None else last_keyframe)


def _onto_last(piece: Piece) -> Piece:
    """The last keyframe and the calibration parameters of `piece`, all other keyframes eliminated. Raises
    NotDefiniteError."""
    if not eliminate_chain(piece.diagonal, piece.upper, piece.side, True, True):
        raise NotDefiniteError(NOT_DEFINITE)
    last = Piece.zeros(piece.last, piece.last, piece.side.shape[2] - 1)
    last.diagonal[0], last.side[0] = piece.diagonal[-1], piece.side[-1]
    flat = piece.side[:-1].reshape(-1, piece.side.shape[2])
    last.calib[:] = piece.calib - flat.T @ flat
    return last


def _back(
    piece: Piece, elimination: Eliminated | bool, white: np.ndarray, keep: bool, calib: np.ndarray, chain: np.ndarray
) -> None:
    """Back substitution of one piece: fills its part of `chain` (K, 15, m), from `calib` and the kept keyframe; see
    `Factors.back`."""
    steps = chain[piece.first : piece.last + 1]
    if isinstance(elimination, Eliminated):
        elimination.substitute(calib, white, steps)
        return
    for k in range(calib.shape[1]):
        step, calib_k = np.ascontiguousarray(steps[:, :, k]), np.ascontiguousarray(calib[:, k])
        noise, forwards = np.ascontiguousarray(white[:, k]).reshape(-1, KEYFRAME_DIM), piece.first == 0 or not keep
        substitute_chain(piece.diagonal, piece.upper, piece.side, forwards, keep, calib_k, noise, step)
        # The shared keyframe is an input; each piece writes only its own keyframes.
        inner = slice(None) if not keep else slice(None, -1) if piece.first == 0 else slice(1, None)
        steps[inner, :, k] = step[inner]


def solve(
    pieces: tuple[Piece, ...],
    n_keyframes: int,
    tolerance: np.ndarray,
    damping: float = 0.0,
    fixed_directions: np.ndarray = NO_DIRECTIONS,
    essential: np.ndarray | None = None,
) -> Solution:
    """Solves (H + damping diag(H)) step = -gradient; overwrites the pieces. Raises NotDefiniteError.

    tolerance (B,); fixed_directions (B, m), essential: which directions of the calibration parameters are fixed, see
    `calib_step`.
    """
    keep = len(pieces) > 1
    n_calib = len(tolerance)
    scale = np.append(np.full(n_calib, damping), 0.0)
    extra = np.diag(scale * sum((p.calib.diagonal() for p in pieces), np.zeros(n_calib + 1)))
    if damping:
        for piece in pieces:
            damp(piece.diagonal, damping)
    eliminations = in_parallel(lambda p: _reduce(p, keep), pieces)
    if not all(eliminations):
        raise NotDefiniteError(NOT_DEFINITE)
    reduced = sum((p.calib for p in pieces), extra)
    shared, shared_side = np.zeros((0, 0)), np.zeros((0, n_calib + 1))
    if keep:
        shared = pieces[0].diagonal[-1] + pieces[1].diagonal[0]
        shared_side = pieces[0].side[-1] + pieces[1].side[0]
        if not cholesky(shared):
            raise NotDefiniteError(NOT_DEFINITE)
        forward_solve(shared, shared_side)
        reduced -= shared_side.T @ shared_side
    information = reduced[:n_calib, :n_calib]
    factors = Factors(
        pieces, eliminations, n_keyframes, shared, shared_side, information, tolerance, fixed_directions, essential
    )
    return Solution.of(factors, reduced[:, n_calib])
