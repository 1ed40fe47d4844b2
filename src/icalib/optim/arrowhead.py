"""Normal equations of a chain of keyframes with dense calibration parameters: an arrowhead matrix, solved in time
linear in the length of the chain.

    [ T   E ] [chain ]     [g_chain ]      T: block tridiagonal, D x D blocks, D = 15 with one IMU
    [ E^T C ] [calib ] = - [g_calib ]      E: chain x calib, C: calib x calib

The chain is cut into pieces that share their end keyframes. Each piece is accumulated and eliminated by its own thread,
towards the keyframe that it shares. Shared keyframe and calibration parameters remain at the end. The number of pieces
does not depend on the number of cores, and so neither does the result.
"""

from __future__ import annotations

import os
from collections.abc import Callable, Iterable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from functools import cache
from itertools import pairwise
from typing import NamedTuple, TypeVar

import numpy as np

from icalib.base.compiled import njit
from icalib.errors import EstimationError
from icalib.geometry import so3
from icalib.geometry.small import cholesky
from icalib.optim import memory
from icalib.optim.front import Eliminated, PieceFeatures, eliminate, plan
from icalib.optim.state import KEYFRAME_DIM, Block, Layout, State

# Reduced normal equations of the calibration parameters, all keyframes eliminated: steps, draws and inverses in units
# of the tolerances. Unobservable directions are fixed.

# Information in units of 1 / tolerance^2: a standard deviation of ten tolerances. Directions with less are fixed.
UNOBSERVABLE_BELOW = 1e-2
DETERMINED_ABOVE = 1.0  # in the same units: a standard deviation of one tolerance
MIN_INFORMATION = 1e-4  # in the same units: floor that keeps variances finite
NO_DIRECTIONS = np.zeros((0, 0))  # no direction is fixed


def calib_step(
    information: np.ndarray,
    gradient: np.ndarray,
    tolerance: np.ndarray,
    fixed_directions: np.ndarray = NO_DIRECTIONS,
    essential: np.ndarray | None = None,
) -> tuple[np.ndarray, float]:
    """Step (B,) of the calibration parameters and its predicted decrease of half the chi^2.

    information (B, B), gradient (B,): of half the chi^2, chain marginalised. essential: columns of all but nuisance
    parameters (default: all). Fixed are the orthonormal columns of `fixed_directions` (B, m), and eigenvectors below
    UNOBSERVABLE_BELOW of the information of the essential parameters in units of `tolerance` (B,). Nuisance parameters
    count as known there: their priors bound a direction that only they move.
    """
    free, root = free_root(information, tolerance, fixed_directions, essential)
    projected = root.T @ (free.T @ (tolerance * gradient))
    return -tolerance * (free @ (root @ projected)), float(0.5 * projected @ projected)


def free_root(
    information: np.ndarray, tolerance: np.ndarray, fixed_directions: np.ndarray, essential: np.ndarray | None
) -> tuple[np.ndarray, np.ndarray]:
    """Orthonormal directions (B, n) that are not fixed, and a root (n, k) of the inverse of the information within
    them, in units of `tolerance`. Arguments as in `calib_step`."""
    n = len(tolerance)
    columns = np.arange(n) if essential is None else essential
    others = np.setdiff1d(np.arange(n), columns)
    scaled = information * tolerance[:, None] * tolerance
    candidates = complement(fixed_directions[columns] if fixed_directions.size else NO_DIRECTIONS, len(columns))
    values, vectors = np.linalg.eigh(candidates.T @ scaled[np.ix_(columns, columns)] @ candidates)
    kept = vectors[:, values > UNOBSERVABLE_BELOW]
    free = np.zeros((n, kept.shape[1] + len(others)))
    free[columns, : kept.shape[1]] = candidates @ kept
    free[others, kept.shape[1] :] = np.eye(len(others))
    values, vectors = np.linalg.eigh(free.T @ scaled @ free)
    regular = values > MIN_INFORMATION  # far from the solution rounding may leave less
    return free, vectors[:, regular] / np.sqrt(values[regular])


def least_information(information: np.ndarray, tolerance: np.ndarray) -> float:
    """Smallest eigenvalue of `information` (B, B) in units of `tolerance` (B,)."""
    return float(np.linalg.eigvalsh(tolerance[:, None] * information * tolerance).min(initial=np.inf))


def essential_information(information: np.ndarray, tolerance: np.ndarray, layout: Layout) -> float:
    """`least_information` without the rows and columns of nuisance parameters, which their priors bound."""
    essential = layout.essential
    return least_information(information[np.ix_(essential, essential)], tolerance[essential])


def complement(fixed_directions: np.ndarray, n: int) -> np.ndarray:
    """Orthonormal basis (n, n - m) of the orthogonal complement of the columns of `fixed_directions` (n, m)."""
    if not fixed_directions.size:
        return np.eye(n)
    full, _, _ = np.linalg.svd(fixed_directions, full_matrices=True)
    return full[:, fixed_directions.shape[1] :]


def restricted_root(information: np.ndarray, fixed_directions: np.ndarray) -> np.ndarray:
    """Root A (B, n) of the `restricted_inverse` A A^T; arguments as there."""
    free = complement(fixed_directions, len(information))
    values, vectors = np.linalg.eigh(free.T @ information @ free)
    return free @ vectors / np.sqrt(np.maximum(values, MIN_INFORMATION))


def restricted_inverse(information: np.ndarray, fixed_directions: np.ndarray) -> np.ndarray:
    """Inverse (B, B) of `information` (B, B) within the directions orthogonal to the orthonormal `fixed_directions` (B,
    m); all in tolerance units."""
    root = restricted_root(information, fixed_directions)
    return root @ root.T


def calib_draws(
    information: np.ndarray,
    tolerance: np.ndarray,
    fixed_directions: np.ndarray,
    white: np.ndarray,
    essential: np.ndarray | None = None,
) -> np.ndarray:
    """Draws (B, m) with the inverse information as covariance, from standard normal numbers `white` (B, m). Directions
    that `calib_step` fixes are zero. The root of the covariance is symmetric: signs of eigenvectors do not matter."""
    free, root = free_root(information, tolerance, fixed_directions, essential)
    axes = free @ root
    return tolerance[:, None] * (axes @ ((axes / np.linalg.norm(axes, axis=0)).T @ white))


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

    diagonal (n, D, D); upper (n, D, D), keyframe k with k + 1; side (n, D, B + 1), keyframe with calibration
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
    def zeros(cls, first: int, last: int, n_calib: int, dim: int = KEYFRAME_DIM) -> Piece:
        """A piece with all sums zero, for B = `n_calib` calibration parameters and keyframes of `dim` dimensions."""
        n = last - first + 1
        return cls(
            first,
            last,
            memory.mmap_zeros((n, dim, dim)),
            memory.mmap_zeros((n, dim, dim)),
            memory.mmap_zeros((n, dim, n_calib + 1)),
            np.zeros((n_calib + 1, n_calib + 1)),
        )

    @property
    def dim(self) -> int:
        """D, the dimensions of a keyframe."""
        return self.side.shape[1]

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


def make_pieces(n_keyframes: int, n_calib: int | None, dim: int = KEYFRAME_DIM) -> tuple[Piece, ...]:
    """Two pieces of about equal length, or one if the chain is too short. `n_calib` None: pieces for residuals
    alone."""
    ends = (0, *chain_cuts(n_keyframes), n_keyframes - 1)
    if n_calib is not None:
        memory.trim_heap()  # memory peaks here
    return tuple(Piece.bare(a, b) if n_calib is None else Piece.zeros(a, b, n_calib, dim) for a, b in pairwise(ends))


@dataclass(frozen=True)
class Draw:
    """A draw from the posterior, as a step: chain (K, D), calib (B,)."""

    chain: np.ndarray
    calib: np.ndarray


@dataclass(frozen=True)
class Factors:
    """Cholesky factors of the block elimination, for back substitution and sampling.

    pieces: overwritten by their factors; eliminations: per piece, see `_reduce`. shared (D, D), shared_side (D, B +
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
        """Back substitution of m right-hand sides: steps (K, D, m) of the keyframes.

        calib (B + 1, m): steps of the calibration parameters; last row: factor of the gradient (1 solves, 0 samples).
        white: further right-hand sides after forward substitution, per piece, then of the shared keyframe.
        """
        m = calib.shape[1]
        dim = max((p.dim for p in self.pieces), default=KEYFRAME_DIM)
        chain = np.zeros((self.n_keyframes, dim, m))
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
    """Step (chain (K, D), calib (B,)), predicted decrease of half the chi^2, and the Cholesky factors.

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
    dim = piece.dim
    kept = dim if keep else 0
    piece.calib += remaining[kept:, kept:]
    if keep:
        end = -1 if forwards else 0
        piece.diagonal[end] += remaining[:dim, :dim]
        piece.side[end] += remaining[:dim, dim:]
    return elimination


def _reduce_all(piece: Piece) -> Eliminated | bool:
    """Eliminates all keyframes of a piece in place; see `_reduce` for the result. Raises NotDefiniteError."""
    elimination = _reduce(piece, False)
    if not elimination:
        raise NotDefiniteError(NOT_DEFINITE)
    return elimination


def _unknowns(piece: Piece, elimination: Eliminated | bool) -> int:
    """Number of eliminated unknowns of a piece; without features, a kept end keyframe counts too."""
    return elimination.rows if isinstance(elimination, Eliminated) else len(piece.diagonal) * piece.dim


def marginalise(piece: Piece) -> np.ndarray:
    """System (B + 1, B + 1) of the calibration parameters and their gradient, all keyframes of `piece` eliminated;
    overwrites the piece. Raises NotDefiniteError."""
    _reduce_all(piece)
    return piece.calib


def chain_step_given_calib(piece: Piece, calib: np.ndarray) -> np.ndarray:
    """Optimal steps (n, D, m) of the keyframes of `piece` for given steps (B, m) of the calibration parameters;
    overwrites the piece. Raises NotDefiniteError."""
    elimination, m = _reduce_all(piece), calib.shape[1]
    chain = np.zeros((piece.last + 1, piece.dim, m))
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
    last = Piece.zeros(piece.last, piece.last, piece.side.shape[2] - 1, piece.dim)
    last.diagonal[0], last.side[0] = piece.diagonal[-1], piece.side[-1]
    flat = piece.side[:-1].reshape(-1, piece.side.shape[2])
    last.calib[:] = piece.calib - flat.T @ flat
    return last


def _back(
    piece: Piece, elimination: Eliminated | bool, white: np.ndarray, keep: bool, calib: np.ndarray, chain: np.ndarray
) -> None:
    """Back substitution of one piece: fills its part of `chain` (K, D, m), from `calib` and the kept keyframe; see
    `Factors.back`."""
    steps = chain[piece.first : piece.last + 1]
    if isinstance(elimination, Eliminated):
        elimination.substitute(calib, white, steps)
        return
    for k in range(calib.shape[1]):
        step, calib_k = np.ascontiguousarray(steps[:, :, k]), np.ascontiguousarray(calib[:, k])
        noise, forwards = np.ascontiguousarray(white[:, k]).reshape(-1, piece.dim), piece.first == 0 or not keep
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


# Compiled block Cholesky elimination of a chain of keyframes with calibration parameters, and its back substitution
# (`arrowhead.py`).


@njit(cache=True, nogil=True)
def forward_solve(L, X):
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
def _transpose(A):
    """A (n, n) <- A^T."""
    for i in range(A.shape[0]):
        for j in range(i):
            A[i, j], A[j, i] = A[j, i], A[i, j]


@njit(cache=True, nogil=True)
def eliminate_chain(diagonal, upper, side, forwards, keep):
    """Block Cholesky factorisation in place, from the first keyframe on or, not `forwards`, from the last. With `keep`
    the final keyframe is only updated. Returns False if a block is not positive definite.

    Afterwards diagonal holds L_k, upper L_k^-1 T[k, next] (transposed before, when running backwards), and side L_k^-1
    side.
    """
    n = diagonal.shape[0]
    for step in range(n):
        k = step if forwards else n - 1 - step
        if step == n - 1 and keep:
            return True
        if not cholesky(diagonal[k]):
            return False
        forward_solve(diagonal[k], side[k])
        if step < n - 1:
            after = k + 1 if forwards else k - 1
            link = upper[k] if forwards else upper[k - 1]
            if not forwards:
                _transpose(link)
            forward_solve(diagonal[k], link)
            _subtract_product(link, link, diagonal[after])
            _subtract_product(link, side[k], side[after])
    return True


@njit(cache=True, nogil=True)
def substitute_chain(diagonal, upper, side, forwards, keep, calib, white, chain):
    """Back substitution with the factors of `eliminate_chain`: fills chain (n, D). With `keep` the final keyframe's
    step is an input.

    calib (B + 1,): step of the calibration parameters, and the factor of the gradient (1 solves, 0 samples). white (n,
    D): further right-hand side after forward substitution.
    """
    n = diagonal.shape[0]
    for step in range(n - 2 if keep else n - 1, -1, -1):
        k = step if forwards else n - 1 - step
        L = diagonal[k]
        for i in range(L.shape[0]):
            s = -white[k, i]
            for j in range(len(calib)):
                s += side[k, i, j] * calib[j]
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
def damp(diagonal, damping):
    """Multiplies the diagonal elements of all blocks by 1 + damping (Marquardt)."""
    for k in range(diagonal.shape[0]):
        for i in range(diagonal.shape[1]):
            diagonal[k, i, i] *= 1.0 + damping


# Gaussian priors on calibration parameters, and a broad prior on the biases at the first keyframe of each recording.

# Standard deviations of gyroscope [rad/s] and accelerometer [m/s^2] biases, far wider than the turn-on bias of any IMU.
# The prior keeps biases defined without motion.
FIRST_BIAS_SIGMA = np.array([0.5] * 3 + [3.0] * 3)


@dataclass(frozen=True)
class Prior:
    """Gaussian prior on one block: mean `value` and `sigma` (n,), SI units or px.

    The residual is (x - value) / sigma. For rotations it is Log(value^T R) / sigma, with the Jacobian J_r^-1 / sigma.
    """

    block: Block
    value: np.ndarray
    sigma: np.ndarray

    def residual(self, state: State) -> tuple[np.ndarray, np.ndarray]:
        """Whitened residual (n,) and its Jacobian (n, n)."""
        x = state.values[self.block.key]
        if self.block.kind == "rotation":
            error = so3.log(np.ascontiguousarray(self.value.T @ x))
            return error / self.sigma, so3.right_jacobian_inverse(error) / self.sigma[:, None]
        return (x - self.value) / self.sigma, np.diag(1.0 / self.sigma)

    def accumulate(self, state: State, piece: Piece, sums: bool = True) -> float:
        """Adds the prior to the sums of `piece`, unless only the cost is wanted; returns half its chi^2."""
        r, J = self.residual(state)
        columns = self.block.columns
        if sums:
            piece.calib[np.ix_(columns, columns)] += J.T @ J
            piece.calib[columns, -1] += J.T @ r
            piece.calib[-1, columns] += J.T @ r
        return 0.5 * float(r @ r)


def sums_of_priors(priors: Sequence[Prior], state: State, n_calib: int) -> tuple[float, np.ndarray, np.ndarray]:
    """Half the chi^2 of `priors` at `state`, and their gradient (B,) and information (B, B) on the calibration
    parameters."""
    piece = Piece.zeros(0, 0, n_calib)
    cost = sum(p.accumulate(state, piece) for p in priors)
    return cost, piece.calib[:-1, -1], piece.calib[:-1, :-1]


def without_priors(information: np.ndarray, priors: Sequence[Prior], state: State) -> np.ndarray:
    """Information (B, B) of the calibration parameters at `state`, with that of `priors` subtracted."""
    return information - sums_of_priors(priors, state, len(information))[2]


def variance_of_priors(covariance: np.ndarray, priors: Sequence[Prior], state: State) -> np.ndarray:
    """Variances (B,) that errors of the prior means contribute to the diagonal of the covariance `covariance` (B, B):
    diag(C W C) with C = `covariance` and the information W of `priors`. Measurement noise contributes the rest."""
    information = sums_of_priors(priors, state, len(covariance))[2]
    return np.einsum("ij,jk,ki->i", covariance, information, covariance, optimize=True)


def accumulate_bias_prior(
    state: State, piece: Piece, sums: bool = True, centre: np.ndarray | None = None, keyframe: int = 0
) -> float:
    """Adds the broad prior on the biases at `keyframe`, with mean `centre` (6,) or zero, to `piece`; returns half its
    chi^2."""
    r = (state.bias[keyframe] - (0.0 if centre is None else centre)) / FIRST_BIAS_SIGMA
    if sums:
        index, k = np.arange(9, 15), keyframe - piece.first
        piece.diagonal[k, index, index] += 1.0 / FIRST_BIAS_SIGMA**2
        piece.side[k, 9:15, -1] += r / FIRST_BIAS_SIGMA
    return 0.5 * float(r @ r)
