"""Where factors and solver meet: all measurements, as sums over the pieces of the chain (paper (15))."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Protocol, runtime_checkable

import numpy as np

from icalib.estimate.problem.gauge import hold_frame
from icalib.motion.factor import Factor, FactorKey, Residuals, Whitened, keyed
from icalib.optim.arrowhead import Piece, in_parallel, make_pieces, marginalise, marginalise_in_segments
from icalib.optim.calib_block import NO_DIRECTIONS
from icalib.optim.prior_factor import Prior
from icalib.optim.state import Layout, State


@runtime_checkable
class ChainFactor(Factor, Protocol):
    """What ties the keyframes together: an `ImuFactor`, or `IndependentKeyframes`. kinds: columns of its residuals by
    name; starts: the first keyframe of each recording, which nothing ties to the one before."""

    @property
    def n_keyframes(self) -> int: ...

    @property
    def starts(self) -> tuple[int, ...]: ...

    @property
    def kinds(self) -> dict[str, slice]: ...

    def output(self) -> Whitened:
        """Rows (K - 1, 15), one an interval between keyframes."""
        ...

    def accumulate_bias_prior(self, state: State, piece: Piece, sums: bool = True) -> float:
        """Adds what keeps the biases of those `starts` defined that lie in `piece`, its last keyframe aside; returns
        half its chi^2."""
        ...


@dataclass(frozen=True)
class Problem:
    """Minimise half the sum of all squared, whitened, robust residuals over a `State`. factors: one of them is the
    chain."""

    layout: Layout
    factors: dict[FactorKey, Factor]
    priors: tuple[Prior, ...]
    tolerance: np.ndarray  # (B,) what a user would call the same number; scales the calibration parameters
    fixed_directions: np.ndarray = field(
        default_factory=lambda: NO_DIRECTIONS
    )  # (B, m) orthonormal directions of the calibration parameters, in tolerance units, that stay
    framed: bool = True  # a target says where the world's origin is; else nothing does, and it stays where it is
    levelled: bool = True  # gravity says which way is up

    @cached_property
    def chain(self) -> ChainFactor:
        return next(f for f in self.factors.values() if isinstance(f, ChainFactor))

    @property
    def n_keyframes(self) -> int:
        return self.chain.n_keyframes

    @cached_property
    def ties_distant_keyframes(self) -> bool:
        """Whether segments of the chain do not stand alone."""
        return any(f.ties_distant_keyframes for f in self.factors.values())

    def replacing(self, factors: Sequence[Factor]) -> Problem:
        """The same problem with other `factors` of the same keys, or more of them."""
        return replace(self, factors=self.factors | keyed(factors))

    def pieces(self, sums: bool = True) -> tuple[Piece, ...]:
        """The chain in pieces; without `sums`, only residuals can be asked for."""
        pieces = make_pieces(self.n_keyframes, self.layout.size if sums else None)
        return tuple(self.attach(p, len(pieces) > 1) for p in pieces) if sums else pieces

    def attach(self, piece: Piece, keep: bool = False) -> Piece:
        """The piece with room for what factors eliminate; `keep`: another piece shares a keyframe with it."""
        for factor in self.factors.values():
            piece = factor.attach(piece, keep)
        return piece

    def without(self, priors: Sequence[Prior]) -> Problem:
        """The same problem, in which `priors` of it count no more."""
        gone = {id(p) for p in priors}
        return replace(self, priors=tuple(p for p in self.priors if id(p) not in gone))

    def cut(self, state: State, keyframes: np.ndarray) -> Problem:
        """The same problem with independent pieces between `keyframes` (n,): across one of these nothing but the chain
        ties others."""
        ends = tuple(int(k) for k in keyframes)
        return self.replacing([f.cut(state, ends) for f in self.factors.values()])

    def marginal(self, sums_of: Callable[[int, int], Piece]) -> np.ndarray:
        """Border (B + 1, B + 1) of `sums_of` from one keyframe to another, all keyframes eliminated: a segment at a
        time, but where factors tie distant keyframes."""
        if self.ties_distant_keyframes:
            return marginalise(sums_of(0, self.n_keyframes - 1))
        return marginalise_in_segments(sums_of, self.n_keyframes)

    def sums_of(self, state: State, first: int, last: int) -> Piece:
        """The sums between two keyframes alone, with the true curvature of robust losses; residuals are not kept."""
        piece = self.attach(Piece.zeros(first, last, self.layout.size))
        for factor in self.factors.values():
            factor.accumulate(state, piece, factor.discarded_output(), curved=True)
        self.add_bias_prior(state, piece)
        for prior in self.priors if first == 0 else ():
            prior.accumulate(state, piece)
        self.hold_frames(state, piece)
        return piece

    def residuals(self) -> Residuals:
        """Empty arrays for `linearise` to fill."""
        return {key: factor.output() for key, factor in self.factors.items()}

    def reusable_output(self, at: Residuals) -> Residuals:
        """`at`, to be filled once more, with new arrays where this problem's own are of another size."""
        return {key: factor.reusable_output(at[key]) for key, factor in self.factors.items()}

    def warm_started(self, at: Residuals) -> Problem:
        """The same problem, points of the scene first looked for where they were at `at`."""
        return self.replacing([factor.warm_started(at[key]) for key, factor in self.factors.items()])

    def linearise(
        self, state: State, pieces: tuple[Piece, ...], out: Residuals, sums: bool = True, curved: bool = False
    ) -> float:
        """Fills `pieces` and `out` at `state`; returns half the robust chi^2. `curved`: see `Factor.accumulate`."""
        return sum(in_parallel(lambda p: self._accumulate(state, p, out, sums, curved), pieces))

    def _accumulate(self, state: State, piece: Piece, out: Residuals, sums: bool, curved: bool) -> float:
        if sums:
            piece.clear()
        cost = self.add_measurements(state, piece, out, sums, curved) + self.add_bias_prior(state, piece, sums)
        if piece.first == 0:
            cost += sum(p.accumulate(state, piece, sums) for p in self.priors)
        if sums:
            self.hold_frames(state, piece)
        return cost

    def hold_frames(self, state: State, piece: Piece) -> None:
        """Each recording's world stays where it is, if nothing says where that is."""
        for keyframe in self.chain.starts if not self.framed else ():
            if piece.first <= keyframe < piece.last:
                hold_frame(state, piece, keyframe, self.levelled)

    def add_measurements(
        self, state: State, piece: Piece, out: Residuals, sums: bool = True, curved: bool = False
    ) -> float:
        """Adds all factors in `piece`; returns half their robust chi^2."""
        return sum(f.accumulate(state, piece, out[key], sums, curved) for key, f in self.factors.items())

    def add_bias_prior(self, state: State, piece: Piece, sums: bool = True) -> float:
        """Adds the broad prior on the biases of recordings' first keyframes, about those that the pass started from."""
        return self.chain.accumulate_bias_prior(state, piece, sums)

    @staticmethod
    def narrow(piece: Piece, n_calib: int) -> Piece:
        """A piece over the same chain blocks with `n_calib` calibration parameters of its own."""
        own = Piece.zeros(piece.first, piece.last, n_calib)
        return Piece(piece.first, piece.last, piece.diagonal, piece.upper, own.side, own.calib)
